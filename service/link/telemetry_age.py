"""Age of the newest telemetry: how much longer it takes to arrive than the fastest frame did.

Three clocks show the delay of a message: the time stamp of the RTC's zenoh session, the time of the
frame and the number of the frame, each compared with the arrival. The least delay counts, because a
clock that is set, a pause of the loop and an RTC slower than its frame period each disturb one or
two of them, and a slow link all three. The stamps do not show a queue within the RTC. Its statuses
do: their frame number is ahead of the telemetry.
"""

from __future__ import annotations

import math
from typing import Final

from service.wire import FrameHeader, Status

MAX_AGE_S: Final = 2.5
"""Telemetry that is older when it arrives is not used: α may have jumped meanwhile, or the matrix
have been swapped."""

MAX_DRIFT: Final = 0.009
"""Largest difference between two clocks that is no delay, as a fraction; nine times what the
contract allows the frame rate."""

MAX_DRIFT_S: Final = 1.0
"""Excess above which a delay is no drift, and is not forgotten however long it stays."""


class TelemetryAge:
    """Follows the delay of the newest frames; not thread-safe."""

    def __init__(self) -> None:
        self._session: str | None = None
        self._end = 0
        self._stamps, self._times, self._numbers, self._lead = (_Excess() for _ in range(4))
        self._delay_s = self._lead_s = 0.0

    @property
    def age_s(self) -> float:
        """Age of the newest frame at its arrival, seconds."""
        return max(self._delay_s, self._lead_s)

    def add_frames(self, header: FrameHeader, at_s: float, latency_s: float | None) -> float:
        """Return the age of the newest frame, seconds.

        Parameters
        ----------
        header
            Header of a batch in its place in the sequence.
        at_s
            Arrival by a monotonic clock.
        latency_s
            Arrival less the stamp of the message; None without a stamp.
        """
        is_new, end = header.session != self._session, header.seq0 + header.n
        if is_new:
            # Its numbers have no relation to those before, and its frames perhaps another clock.
            self._session, self._lead_s = header.session, 0.0
            self._times, self._numbers, self._lead = (_Excess() for _ in range(3))
        elif end <= self._end:  # a recovered frame says nothing about the newest one
            return self.age_s
        self._end, t_ns = end, header.t0_ns + header.n * header.dt_ns
        excess_s = {
            self._times: self._times.add(at_s - t_ns * 1e-9, at_s),
            self._numbers: self._numbers.add(at_s - end * header.dt_ns * 1e-9, at_s),
        }
        if latency_s is not None:
            excess_s[self._stamps] = self._stamps.add(latency_s, at_s)
        if is_new:
            self._delay_s = min(self._delay_s, excess_s.get(self._stamps, 0.0))
        else:
            self._delay_s = min(excess_s.values())
        for clock in excess_s:
            clock.agree(self._delay_s)
        return self.age_s

    def add_status(self, status: Status, at_s: float) -> None:
        """Note by how many frames a status is ahead of the telemetry."""
        if status.session == self._session and status.seq is not None:
            ahead_s = (status.seq - self._end) / status.frame_rate_hz
            self._lead_s = self._lead.add(ahead_s, at_s)


class _Excess:
    """Excess of a delay over its least value, which may drift."""

    def __init__(self) -> None:
        self._least_s, self._last_s, self._at_s = math.inf, 0.0, 0.0

    def add(self, delay_s: float, at_s: float) -> float:
        """Return the excess of a delay at this time, seconds."""
        if self._last_s - self._least_s < MAX_DRIFT_S:
            self._least_s += MAX_DRIFT * (at_s - self._at_s)
        self._least_s = min(self._least_s, delay_s)
        self._last_s, self._at_s = delay_s, at_s
        return delay_s - self._least_s

    def agree(self, excess_s: float) -> None:
        """Change the least delay if the excess differs from what another clock shows."""
        if not 0.0 <= self._last_s - self._least_s - excess_s <= MAX_DRIFT_S:
            self._least_s = self._last_s - excess_s
