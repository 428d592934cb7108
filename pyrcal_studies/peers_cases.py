"""Which matrices the peers make, of which mirror, at which registrations."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.peers_pushpull import Bench
from service.instrument import load_instrument
from service.model.instrument import Instrument, Mirror
from service.model.kinds import Influence, InfluenceShape, Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.model.sensors.pyramid.description import pyramid_in

Array = NDArray[Any]

INSTRUMENT = "flao-lbt"
"""The packaged instrument whose telescope and mirror the peers imitate."""

N_MODES = 400
"""Columns of every matrix."""

SAMPLING = 4
"""Of the peers' pupils, points per subaperture."""

N_MODULATION = 28
"""Points of the peers' modulation."""

SMALL = Misregistration(
    shift_x_subap=0.31, shift_y_subap=-0.17, rotation_rad=np.deg2rad(0.6), magnification=1.004
)
LARGE = Misregistration(
    shift_x_subap=0.9, shift_y_subap=-0.7, rotation_rad=np.deg2rad(2.0), magnification=1.02
)
OTHER = Misregistration(
    shift_x_subap=-0.9, shift_y_subap=0.5, rotation_rad=np.deg2rad(-2.0), magnification=0.98
)
OTHER_SAMPLES = replace(OTHER, shift_x_subap=-0.75)
SMALL_SAMPLES = replace(SMALL, shift_x_subap=0.25, shift_y_subap=-0.25)
"""Whole samples, for a peer that cannot move its images by less."""

SMALLEST = (SMALL, SMALL_SAMPLES)
"""The registrations nearest to perfect."""

_SIZES = {SMALL: "small", LARGE: "large", OTHER: "other"}
_SIZES |= {SMALL_SAMPLES: "small", OTHER_SAMPLES: "other"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One matrix of one peer."""

    peer: str
    """Name of its package."""

    stop: Stop
    """What moves: the mirror alone, or the pupil images with it."""

    alpha: Misregistration
    """The truth."""

    own_mirror: bool = False
    """Whether the peer's own mirror is moved by its own tools, and told to pyrcal as a cube."""

    as_shipped: bool = False
    """Whether the peer keeps its own pupil and its own reading of the modulation radius."""

    @property
    def name(self) -> str:
        """Of its files."""
        kind = "own-mirror" if self.own_mirror else str(self.stop)
        shipped = "-as-shipped" if self.as_shipped else ""
        return f"{self.peer}-{kind}-{_SIZES[self.alpha]}{shipped}"


def cases(peer: str) -> tuple[Case, ...]:
    """Return what a peer is asked for."""
    other, small = (OTHER_SAMPLES, SMALL_SAMPLES) if peer == "specula" else (OTHER, SMALL)
    asked = [
        Case(peer=peer, stop=Stop.TELESCOPE, alpha=LARGE),
        Case(peer=peer, stop=Stop.MIRROR, alpha=other),
        Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL),
        Case(peer=peer, stop=Stop.MIRROR, alpha=small),
    ]
    if peer == "oopao":
        asked += [
            Case(peer=peer, stop=Stop.TELESCOPE, alpha=LARGE, own_mirror=True),
            Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL, own_mirror=True),
            Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL, as_shipped=True),
        ]
    return tuple(asked)


@cache
def instrument() -> Instrument:
    """Return the telescope that all of them imitate."""
    return load_instrument(INSTRUMENT)


@cache
def basis(influence: Influence) -> ModalBasis:
    """Return its modes, with the influence functions given."""
    shared = instrument()
    drawn = shared.analytic_mirror
    mirror = Mirror(
        positions_m=drawn.positions_m,
        pitch_m=drawn.pitch_m,
        shape=InfluenceShape(influence=influence),
    )
    return karhunen_loeve_basis(
        replace(shared, mirror=mirror, modes=replace(shared.modes, n_modes=N_MODES))
    )


def bench(case: Case) -> Bench:
    """Return what the peer is told of the optics."""
    shared, alpha = instrument(), case.alpha
    wfs = pyramid_in(shared)
    moved = case.stop is Stop.MIRROR
    return Bench(
        diameter_m=shared.diameter_m,
        obscuration_ratio=shared.obscuration_ratio,
        n_subapertures=wfs.n_subapertures,
        pupil_separation_subap=round(wfs.image_separation_subap),
        wavelength_m=wfs.wavelength_m,
        modulation_lambda_over_d=wfs.modulation_lambda_over_d,
        n_modulation=N_MODULATION,
        sampling=SAMPLING,
        as_shipped=case.as_shipped,
        image_shift_subap=(alpha.shift_x_subap, alpha.shift_y_subap) if moved else (0.0, 0.0),
        misregistration=in_degrees(alpha) if case.own_mirror else None,
    )


def job_arrays(case: Case) -> dict[str, Array]:
    """Return the shapes the peer shall push: modes where the mirror lies, or the mirror itself."""
    if case.own_mirror:
        return {
            "positions_m": instrument().analytic_mirror.positions_m,
            "pitch_m": np.array(instrument().analytic_mirror.pitch_m),
            "mode_to_actuator": basis(Influence.GAUSSIAN).mode_to_actuator,
        }
    points = mirror_points(bench(case), case.alpha, case.stop)
    shapes = basis(Influence.THIN_PLATE).render(points)
    n = bench(case).n_pupil
    return {"shapes_m": shapes.T.reshape(N_MODES, n, n)}


def mirror_points(told: Bench, alpha: Misregistration, stop: Stop) -> Array:
    """Return where each point of a peer's pupil grid, row-major, lies on the mirror, subapertures.

    Where the mirror is the stop the pupil moves with it: only what turns it and its size is left.
    """
    along = (np.arange(told.n_pupil) - (told.n_pupil - 1) / 2) / told.sampling
    x, y = np.meshgrid(along, along)
    points = np.column_stack([x.ravel(), y.ravel()])
    if stop is Stop.TELESCOPE:
        points = points - alpha.vector[:2]
    return np.asarray(points @ rotation(alpha.rotation_rad) / alpha.magnification)


def digest(case: Case, requirement: str) -> str:
    """Return a name for everything that the peer's matrix depends on."""
    told = json.dumps([requirement, N_MODES, asdict(bench(case)), in_degrees(case.alpha)])
    return hashlib.sha256(told.encode()).hexdigest()[:10]


def in_degrees(alpha: Misregistration) -> tuple[float, float, float, float]:
    """Return shift x and y in subapertures, rotation in degrees, magnification."""
    return (
        alpha.shift_x_subap,
        alpha.shift_y_subap,
        float(np.rad2deg(alpha.rotation_rad)),
        alpha.magnification,
    )
