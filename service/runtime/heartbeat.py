"""Detect that a part of the service has stopped although its process lives."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

MAX_ROUND_S: Final = 30.0
"""Longest time between two rounds: a round takes a second at most, but some on a machine that is
overloaded or swaps."""


class Heartbeat:
    """Time at which each part of the service last began a round of its work.

    A part is watched from its first round on.

    Parameters
    ----------
    now_s
        Monotonic clock, seconds.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._beats_s: dict[str, float] = {}

    def beat(self, part: str) -> None:
        """Take note that a part goes on."""
        self._beats_s[part] = self._now_s()

    @property
    def stalled(self) -> str:
        """Return the part that has stopped, and for how long; empty if all are running."""
        ages_s = {part: self._now_s() - beat_s for part, beat_s in self._beats_s.items()}
        return "; ".join(
            f"{part} has stood still for {age_s:.0f} s, expected a round within {MAX_ROUND_S:g} s: "
            "restart the service"
            for part, age_s in ages_s.items()
            if age_s > MAX_ROUND_S
        )
