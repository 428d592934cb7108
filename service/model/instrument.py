"""What pyrcal knows of an instrument: frozen records, filled from a TOML file elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray


class Stop(StrEnum):
    """The element that limits the beam."""

    MIRROR = "mirror"
    """The adaptive mirror is the stop: pupil edge and obscuration move with the shift (FLAO)."""

    TELESCOPE = "telescope"
    """The pupil is fixed; only the influence functions move (the ELT, most simulators)."""


class Influence(StrEnum):
    """Shape of an analytic influence function."""

    THIN_PLATE = "thin-plate"
    GAUSSIAN = "gaussian"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pyramid:
    """The modulated pyramid wavefront sensor."""

    n_subapertures: int
    """Subapertures across the sensor grid."""

    wavelength_m: float
    """Sensing wavelength, metres."""

    modulation_lambda_over_d: float
    """Radius of the modulation circle, in λ/D."""

    pupil_separation_subap: float = 36.0
    """Distance between the centres of neighbouring pupil images, in subapertures."""

    pupil_diameter_subap: float | None = None
    """Diameter of the pupil image, in subapertures; None: ``n_subapertures``."""

    flux_threshold: float = 0.5
    """A subaperture is valid when its flux is at least this fraction of a full one."""

    valid_subapertures: NDArray[np.bool_] | None = None
    """Mask ``(n_subapertures, n_subapertures)``, [y, x]; None: by ``flux_threshold`` at α = 0."""

    @property
    def pupil_diameter(self) -> float:
        """Diameter of the pupil image, in subapertures."""
        return float(self.pupil_diameter_subap or self.n_subapertures)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mirror:
    """An analytic deformable mirror: actuator positions and the shape of an influence function."""

    positions_m: NDArray[np.float64]
    """Actuator positions ``(n_actuators, 2)``, columns x and y, metres in the pupil plane."""

    pitch_m: float
    """Typical distance between neighbours, metres in the pupil plane."""

    influence: Influence = Influence.THIN_PLATE
    """Shape of the influence functions."""

    coupling: float = 0.35
    """Gaussian influence functions only: height at a distance of one pitch, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KarhunenLoeve:
    """The modal basis: Karhunen-Loeve modes of von Karman turbulence in mirror space."""

    n_modes: int = 594
    """Modes of the basis, controlled or not."""

    r0_m: float = 0.10
    """Fried parameter at 500 nm, metres: sets the expected variance of each mode."""

    outer_scale_m: float = 25.0
    """Outer scale of the turbulence, metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Instrument:
    """One telescope, its mirror and its wavefront sensor."""

    name: str
    """Also the ``{system}`` of the wire unless configured otherwise."""

    diameter_m: float
    """Pupil diameter, metres."""

    obscuration_ratio: float = 0.0
    """Linear central obscuration, 0..1."""

    stop: Stop
    """Which element limits the beam."""

    double_pass: bool = False
    """Whether a measured matrix of this instrument sees the mirror twice."""

    wfs: Pyramid
    """The wavefront sensor."""

    mirror: Mirror
    """The deformable mirror."""

    modes: KarhunenLoeve = field(default_factory=KarhunenLoeve)
    """The modal basis."""

    basis_id: str | None = None
    """Pins the RTC's basis; None: the first seen is adopted."""

    config_id: str | None = None
    """Pins the RTC's sensor configuration; None: the first seen is adopted."""

    @property
    def subaperture_m(self) -> float:
        """Width of a subaperture in the pupil plane, metres."""
        return self.diameter_m / self.wfs.pupil_diameter
