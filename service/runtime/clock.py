"""UTC by elapsed time: it never leaps with the machine's clock."""

from __future__ import annotations

import time
from collections.abc import Callable

MAX_CLOCK_STEP_NS = 1_000_000_000
"""A clock that is set by less is followed at once: what is waited for lasts seconds."""


def _uptime_ns() -> int:
    """Return the time that has passed since the machine was started, its sleep included."""
    return time.clock_gettime_ns(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class ServiceClock:
    """UTC as it was when the service began, and the time that has passed since.

    Every wait of the service's ends at a time of this clock. Were it the machine's, one set an
    hour ahead and back would leave waits that last an hour.
    """

    __slots__ = ("_offset_ns", "_passed_ns", "_utc_ns")

    def __init__(
        self,
        utc_ns: Callable[[], int] = time.time_ns,
        passed_ns: Callable[[], int] = _uptime_ns,
    ) -> None:
        self._utc_ns, self._passed_ns = utc_ns, passed_ns
        self._offset_ns = utc_ns() - passed_ns()

    def now_ns(self) -> int:
        """Return the time, nanoseconds UTC."""
        ahead_ns = self._ahead_ns()
        if abs(ahead_ns) <= MAX_CLOCK_STEP_NS:
            self._offset_ns += ahead_ns
        return self._passed_ns() + self._offset_ns

    def complaint(self) -> str:
        """Return by how much the machine's clock has leapt; empty: it is followed."""
        ahead_ns = self._ahead_ns()
        if abs(ahead_ns) <= MAX_CLOCK_STEP_NS:
            return ""
        return (
            f"this machine's clock has leapt by {ahead_ns / 1e9:+.0f} s: the service goes on by "
            "elapsed time, in its log and estimates too; if the new time is "
            "right, restart the service when convenient"
        )

    def _ahead_ns(self) -> int:
        return self._utc_ns() - self._passed_ns() - self._offset_ns
