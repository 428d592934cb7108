"""The table of loop gains that undoes the optical gain: offered, never folded into a matrix."""

from __future__ import annotations

from fastapi import APIRouter

from service.control.gain_table import GainTable
from service.errors import CommandError, UnknownIdError
from service.reactions.gain_tables import table_of
from service.routes.problems import COMMAND, INVALID, UNKNOWN
from service.routes.reading import MatrixId
from service.routes.registration_views import ModeGainView
from service.routes.service import ServiceDep
from service.routes.views import View
from service.state import ModeGain

router = APIRouter(prefix="/v1", tags=["what the service knows"], responses={**INVALID})


class GainTableView(View):
    """Optical gains, and the factors of the loop gains that undo them, mode by mode."""

    reconstructor: str | None
    """The one it goes with; null: the present gains, with whichever is in use."""

    measured: tuple[ModeGainView, ...]
    """Empty: the table is only what is expected at 1 arcsec of seeing."""

    optical_gain: list[float]
    """Of each mode: how much of the model's response the sensor shows."""

    relative_sigma: list[float]
    """1 σ of each as a share of it; it grows away from the measured modes."""

    factor: list[float]
    """By which to multiply one loop gain for all modes: mean 1, 0.5 to 2."""


@router.get("/gains", responses={**COMMAND})
async def gains(service: ServiceDep) -> GainTableView:
    """Return the table as it is now, for all modes of the basis.

    ``POST /v1/loop`` with ``effective_gain`` sets the loop gains by it, if the gate agrees.
    """
    tracker = service.snapshot().tracker
    if tracker.rtc is None:
        raise CommandError("gains: no RTC is there: the number of modes is not known")
    known = tracker.registration
    measured = () if known is None else known.optical_gains
    return _view(None, measured, table_of(measured, tracker.rtc.n_modes))


@router.get("/reconstructors/{id}/gains", responses={**UNKNOWN})
async def reconstructor_gains(service: ServiceDep, matrix_id: MatrixId) -> GainTableView:
    """Return the table that was measured when this reconstructor was made, for its modes."""
    record = service.snapshot().tracker.reconstructor(matrix_id)
    if record is None:
        raise UnknownIdError(f"reconstructor {matrix_id}: nobody has heard of it")
    measured = record.optical_gains
    return _view(record.id, measured, table_of(measured, record.n_modes))


def _view(matrix_id: str | None, measured: tuple[ModeGain, ...], table: GainTable) -> GainTableView:
    return GainTableView.model_validate(
        {
            "reconstructor": matrix_id,
            "measured": measured,
            "optical_gain": table.optical_gain.tolist(),
            "relative_sigma": table.relative_sigma.tolist(),
            "factor": table.factors.tolist(),
        }
    )
