"""The margin of the matrix in use, looked at again only when something has moved.

The service asks every few seconds, for α moves a little with every window. What the gate and the
expected gain would say changes less than either of them is sure of while α, its σ and the loop stay
about where they were: the last answer then serves again. Nothing is sent on such an answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import ExpectedGain, Timing
from service.control.gate import GateVerdict, LoopSettings
from service.model.misregistration import Misregistration
from service.tracking.loop import SAME_GAIN

Array = NDArray[np.float64]

STAYED = np.array([5e-3, 5e-3, 1.7e-4, 5e-4])
"""A move of α (numeric units) that no verdict would show: a tenth of what costs 594 modes any."""

SHARE_OF_SIGMA = 0.5
"""So much of σ is no move either."""

SIGMA_RATIOS = (0.3, 1.25)
"""σ over that of the answer: much smaller deserves a better one, larger is not covered by it."""

SAME_MAGNITUDE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InUse:
    """A matrix in use, and the loop it runs in."""

    matrix: NDArray[np.float32]
    """``(n_modes, n_slopes)`` metres per slope."""

    alpha: Misregistration
    covariance: Array
    """``(4, 4)`` numeric units, floor included."""

    loop: LoopSettings
    """As the gate is to see it."""

    bound: float
    timing: Timing
    """As the expected gain is to see it."""

    magnitude: float | None
    """Of the star; None: the noise of the settings."""

    @property
    def sigma(self) -> Array:
        """``(4,)`` 1 σ, numeric units."""
        return np.sqrt(np.diag(self.covariance))

    def is_about(self, other: InUse) -> bool:
        """Return whether the answer to the ``other`` is as good for this one."""
        moved = np.abs(self.alpha.vector - other.alpha.vector)
        ratio = self.sigma / other.sigma
        low, high = SIGMA_RATIOS
        return bool(
            np.all(moved <= np.maximum(STAYED, SHARE_OF_SIGMA * other.sigma))
            and np.all((ratio >= low) & (ratio <= high))
            and self._same_loop(other)
            and np.array_equal(self.matrix, other.matrix)
        )

    def _same_loop(self, other: InUse) -> bool:
        one, two = self.loop, other.loop
        numbers = [
            (one.leak, one.delay_frames, one.n_holding, self.bound, self.timing.frame_rate_hz),
            (two.leak, two.delay_frames, two.n_holding, other.bound, other.timing.frame_rate_hz),
        ]
        stars = [q.magnitude for q in (self, other)]
        return (
            numbers[0] == numbers[1]
            and _same_star(*stars)
            and _alike(one.gains, two.gains)
            and _alike(one.optical_gain, two.optical_gain)
            and _alike(self.timing.optical_gain, other.timing.optical_gain)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Margin:
    """What is known of a matrix in use."""

    verdict: GateVerdict
    expected: ExpectedGain | None
    """What a new one would win; None: nobody can say."""

    alpha: Misregistration
    """Where it was looked at."""

    sigma: Array
    """``(4,)`` 1 σ of α then, numeric units."""

    gains: tuple[float, ...]
    """Of the loop that was judged."""


def _same_star(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return abs(one - other) <= SAME_MAGNITUDE


def _alike(some: Array | float, others: Array | float) -> bool:
    same_shape = np.shape(some) == np.shape(others)
    return same_shape and np.allclose(some, others, rtol=SAME_GAIN, atol=0.0)
