"""What a night of a campaign is made of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from studies.campaign.trouble import Trouble


class Estimator(StrEnum):
    """What looks at the telemetry."""

    LOCK_IN = "lock-in"
    RANDOM = "random"
    PASSIVE = "passive"


@dataclass(frozen=True, slots=True, kw_only=True)
class Night:
    """What is run; two nights that are equal give the same rows."""

    plant: str = "diffractive"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    estimator: Estimator = Estimator.LOCK_IN
    trouble: Trouble = Trouble.NONE
    magnitude: float = 10.0
    wind_m_s: float = 12.0
    profile: str | None = None
    """Named layers instead of one wind."""

    seed: int = 0
    gain: float = 0.6
    n_controlled: int = 400
    amplitude_nm: float = 5.0
    """RMS of each of four modes; 0: the dither is left out, for the wavefront error."""

    window_s: float = 5.0
    n_windows: int = 4
    working_point_modes: int | None = None
    modes: tuple[int, ...] | None = None
    """0-based indices of the dithered ones; None: four above the controlled ones."""

    camera: str = "ccd"
    """The simulator's usual one, with 4 electrons of read noise, or "emccd": 0.4, and twice the
    photon noise."""

    @property
    def dithered(self) -> tuple[int, ...]:
        """The modes a dither moves."""
        return self.modes or tuple(self.n_controlled + step for step in (9, 27, 45, 63))


def without_dither(night: Night) -> Night:
    """Return the twin of a night whose wavefront error shows what the dither costs."""
    return replace(night, amplitude_nm=0.0)
