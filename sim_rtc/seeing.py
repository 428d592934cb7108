"""Seeing that changes during a run, smoothly, between values given for certain times."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class SeeingSchedule:
    """The seeing at any time of a run."""

    start_arcsec: float
    """At time 0: FWHM at 500 nm, infinite outer scale."""

    later: tuple[tuple[float, float], ...] = ()
    """Times in seconds of loop time, and the seeing then, arcseconds; in any order."""

    def __post_init__(self) -> None:
        """Refuse two values for one time.

        Raises
        ------
        ConfigurationError
            If a time occurs twice.
        """
        times = sorted(time_s for time_s, _ in self.later)
        for earlier, later in pairwise(times):
            if earlier == later:
                raise ConfigurationError(f"--seeing-at: found {later:g} s twice; expected once")

    @property
    def changes(self) -> bool:
        """Whether the seeing is not the same all through the run."""
        return any(arcsec != self.start_arcsec for _, arcsec in self.later)

    def arcsec(self, time_s: Array) -> Array:
        """Return the seeing at these times, arcseconds.

        Between two times its logarithm follows ``3 t² - 2 t³``: no kink, no overshoot.
        """
        knots = sorted([(0.0, self.start_arcsec), *self.later])
        times, values = np.array(knots).T
        rise = np.diff(np.log(values), prepend=np.log(values[0]))
        width = np.diff(times, prepend=-1.0)
        share = np.clip((time_s[..., None] - times + width) / width, 0.0, 1.0)
        eased = share**2 * (3.0 - 2.0 * share)
        return np.asarray(values[0] * np.exp(eased @ rise))

    def strength(self, time_s: Array) -> Array:
        """Return the amplitude of the turbulence at these times over that at time 0.

        The variance of the phase goes with ``r0^(-5/3)`` and r0 with the inverse of the seeing,
        the outer scale staying as it is.
        """
        return np.asarray((self.arcsec(time_s) / self.start_arcsec) ** (5 / 6))
