"""What a night of a campaign is made of."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from pyrcal_studies.campaign.trouble import Trouble


class Estimator(StrEnum):
    """What looks at the telemetry."""

    LOCK_IN = "lock-in"
    RANDOM = "random"


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """A telescope, and what it looks at."""

    plant: str = "diffractive"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    magnitude: float = 10.0
    wind_m_s: float = 12.0
    profile: str | None = None
    """Named layers instead of one wind."""

    seed: int = 0
    gain: float = 0.6

    def words(self, direction_deg: float) -> list[str]:
        """Return the simulator's command line; one wind blows in this direction."""
        options = {
            "plant": self.plant,
            "imperfections": self.truth,
            "mag": self.magnitude,
            "seed": self.seed,
            "gain": self.gain,
        }
        if self.profile is None:
            options["wind"] = f"{self.wind_m_s},{direction_deg % 360:g}"
        else:
            options["profile"] = self.profile
        return [f"--{name}={value}" for name, value in options.items()]


@dataclass(frozen=True, slots=True, kw_only=True)
class Night(Observed):
    """What is run; two nights that are equal give the same rows."""

    estimator: Estimator = Estimator.LOCK_IN
    trouble: Trouble = Trouble.NONE
    n_controlled: int = 400
    amplitude_nm: float = 5.0
    """RMS of each of four modes."""

    window_s: float = 5.0
    n_windows: int = 4
    working_point_modes: int | None = None
    modes: tuple[int, ...] | None = None
    """0-based indices of the dithered ones; None: four above the controlled ones."""

    camera: str = "ccd"
    """The simulator's usual one, with 4 electrons of read noise, or "emccd": 0.4, and twice the
    photon noise."""

    instrument: str = "flao-lbt"
    rate_hz: float | None = None
    """Frames per second; None: the simulator's usual ones."""

    @property
    def dithered(self) -> tuple[int, ...]:
        """The modes a dither moves."""
        return self.modes or tuple(self.n_controlled + step for step in (9, 27, 45, 63))
