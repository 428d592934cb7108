"""Frames that are missing, come ever later, or stay away: alarms ``frames-lost``, ``no-frames``."""

from __future__ import annotations

from collections import deque
from typing import Final

from service.link.statistics import LinkStatistics
from service.records.alarms import FRAMES_LOST, NO_FRAMES
from service.records.messages import Message, compose
from service.wire import Status

LOSS_PERIOD_S: Final = 5.0
"""Losses are summed over so long."""

MAX_LOST_SHARE: Final = 0.01
"""Fraction of lost frames that raises an alarm; half of it does not end the alarm."""

RATE_PERIOD_S: Final = 2.0
"""Frames that come are counted over so long."""

MIN_RATE_SHARE: Final = 0.25
"""Fraction of the previous frame rate below which an alarm is raised; twice as much does not end
it."""

FRAMES_TIMEOUT_S: Final = 2.0
"""Frames, of which tens come a second, are missed after so long."""

REMEDY: Final = "check the network, the RTC's publisher, and what else this machine does"

Counts = deque[tuple[float, LinkStatistics]]
"""Times with the counters at each."""


def silence(rtc: Status | None, frame_age_s: float | None) -> dict[str, Message | None]:
    """Return, by alarm, that frames stay away though the loop is closed; None: they come.

    A matrix made of what was known before is not sent then.
    """
    if rtc is None or not rtc.in_loop or frame_age_s is None or frame_age_s < FRAMES_TIMEOUT_S:
        return {NO_FRAMES: None}
    return {NO_FRAMES: compose("link.no-frames", silent_s=frame_age_s, remedy=REMEDY)}


class Losses:
    """Counters of frames, second by second."""

    __slots__ = ("_counts", "_raised", "_slowness")

    def __init__(self) -> None:
        self._counts: Counts = deque()
        self._raised = False
        self._slowness = _Slowness()

    def complaint(self, link: LinkStatistics, now_s: float) -> dict[str, Message | None]:
        """Return, by alarm, what is lost, where it is more than chance; None: next to nothing.

        ``now_s`` is of a clock that does not leap.
        """
        counts = self._counts
        counts.append((now_s, link))
        # The second entry decides, so that the first is always at least a whole period old.
        while len(counts) > 1 and now_s - counts[1][0] >= LOSS_PERIOD_S:
            counts.popleft()
        slow = self._slowness.complaint(counts)
        return {FRAMES_LOST: self._lost(*counts[0], link, now_s) or slow}

    def _lost(
        self, since_s: float, before: LinkStatistics, link: LinkStatistics, now_s: float
    ) -> Message | None:
        # The counter falls when a lost frame is recovered after all.
        never_came = max(link.frames_lost - before.frames_lost, 0)
        not_finite = link.frames_nonfinite - before.frames_nonfinite
        overwritten = link.frames_overwritten - before.frames_overwritten
        received = link.frames_received - before.frames_received
        lost = never_came + not_finite + overwritten
        # Overwritten frames were received before, so that they are not added again.
        n_frames = max(received + never_came + not_finite, 1)
        share = lost / n_frames
        # A burst right after the start would be a large share of few frames.
        enough = now_s - since_s >= LOSS_PERIOD_S
        self._raised = share > (0.5 if self._raised else 1.0) * MAX_LOST_SHARE and enough
        if not self._raised:
            return None
        found = [
            f"{n} {how}"
            for n, how in (
                (never_came, "never came"),
                (not_finite, "are not finite"),
                (overwritten, "were not read in time"),
            )
            if n
        ]
        return compose(
            "link.frames-lost",
            n_frames=n_frames,
            period_s=now_s - since_s,
            details=", ".join(found),
            percent=100.0 * share,
            remedy=REMEDY,
        )


class _Slowness:
    """Frames that come at a fraction of the rate they came at: nothing is lost yet, all is late."""

    __slots__ = ("_before_hz",)

    def __init__(self) -> None:
        self._before_hz: float | None = None
        """The rate before they became slow; None: they are not."""

    def complaint(self, counts: Counts) -> Message | None:
        """Return how slowly they come; None: as before, or not at all, which others name."""
        now_s, now = counts[-1]
        recent = next((at for at in reversed(counts) if now_s - at[0] >= RATE_PERIOD_S), None)
        # Frames that stopped have the alarm no-frames; a rate of zero is no slowness.
        if recent is None or now.frames_received == counts[-2][1].frames_received:
            self._before_hz = None
            return None
        rate_hz = _rate_hz(recent, counts[-1])
        if self._before_hz is not None:
            slow = rate_hz < 2.0 * MIN_RATE_SHARE * self._before_hz
        else:
            # Kept from the moment before the slowdown: a moving average would adapt to the slow
            # rate and end the alarm.
            self._before_hz = _rate_hz(counts[0], recent)
            slow = rate_hz < MIN_RATE_SHARE * self._before_hz
        if not slow:
            self._before_hz = None
            return None
        return compose(
            "link.frames-slow",
            rate_hz=rate_hz,
            period_s=RATE_PERIOD_S,
            before_hz=self._before_hz,
            remedy=REMEDY,
        )


def _rate_hz(first: tuple[float, LinkStatistics], last: tuple[float, LinkStatistics]) -> float:
    """Return how many frames came a second; 0 where no time passed."""
    seconds = last[0] - first[0]
    return (last[1].frames_received - first[1].frames_received) / seconds if seconds else 0.0
