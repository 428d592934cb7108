"""The operator's page: the mirror that it draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from fastapi import APIRouter, Response
from numpy.typing import NDArray

from service.control.gate import LIMIT_M
from service.model.instrument import Instrument, Mirror, Stop
from service.model.misregistration import Misregistration
from service.routes.views import ServiceDep, answer, shows, view

router = APIRouter(prefix="/v1", tags=["what the service knows"])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MirrorDrawn:
    """The mirror on the sensor, as far as it can be drawn: lengths in subapertures, centred."""

    n_subapertures: int
    """Across the sensor's grid."""

    pupil_diameter_subap: float
    """Of the pupil's image."""

    obscuration_ratio: float
    """Of it, linear."""

    stop: Stop
    """"mirror": the pupil's rim moves with the shift, and keeps its size; "telescope": it stays."""

    nominal: Misregistration
    """Where the mirror should be: what the instrument file says."""

    tolerance: NDArray[np.float64]
    """``(4,)`` further than this from what the reconstructor in use was made for, and another one
    is made whatever it wins, numeric units."""

    edge_limit_m: float
    """Largest RMS motion of an outer actuator for slope noise of 1 that the gate accepts."""

    actuators: tuple[tuple[float, float], ...]
    """x and y of each on the sensor where α is nothing; empty: modes were measured, and nobody has
    told where the actuators are."""


MIRROR: Final = view("MirrorView", MirrorDrawn)


@router.get("/mirror", responses={200: shows(MIRROR)})
async def mirror(service: ServiceDep) -> Response:
    """Return what the mirror looks like on the sensor; α of ``GET /v1/alpha`` says where it is."""
    instrument = service.instrument
    wfs = instrument.wfs
    return answer(
        MirrorDrawn(
            n_subapertures=wfs.n_subapertures,
            pupil_diameter_subap=wfs.pupil_diameter,
            obscuration_ratio=instrument.obscuration_ratio,
            stop=instrument.stop,
            nominal=instrument.start,
            tolerance=service.policy.update_threshold,
            edge_limit_m=LIMIT_M,
            actuators=_actuators(instrument),
        )
    )


def _actuators(instrument: Instrument) -> tuple[tuple[float, float], ...]:
    mirror = instrument.mirror
    if not isinstance(mirror, Mirror):
        return ()
    places = mirror.positions_m / instrument.subaperture_m * [1.0, mirror.y_sign]
    return tuple((round(x, 4), round(y, 4)) for x, y in places.tolist())
