"""Sums of ordinary telemetry, closed every few seconds.

What an estimator sums, and how α is fitted to it, is its own; when it is asked is the same for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from typing_extensions import override

from service.estimation.estimate import PassiveEstimate
from service.estimation.estimator import Change, Estimator, LoopContext, Mark
from service.estimation.frames import FrameBlock
from service.estimation.loop import explain_open_loop
from service.model.interaction import Linearisation

PASSIVE_INTERVAL_S = 4.0
"""Duration of telemetry in a passive estimate, and interval between two: a jump must be detected
within 5 s."""

MIN_PASSIVE_S = 3.0
"""Shortest telemetry for an estimate next to a dither."""

RESTS, LONG_RESTS = 1, 3
"""Intervals skipped after an estimate next to a dither, and while its windows are accepted: windows
detect a jump sooner than a passive estimate."""

MIN_FRAMES_PER_MODE = 5
"""Fewer effective frames leave the command covariance too noisy to invert."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveSums(Estimator):
    """Sums over frames of one loop, that α is fitted to when they are closed."""

    resets = Change.GONE | Change.LOOP | Change.STANDSTILL
    unless = Mark.STANDS
    only_closed = True

    n_modes: int
    """Controlled modes: the only ones that move by themselves."""

    n_effective: float = 0.0
    """Frames in the sums, forgetting included."""

    tail: FrameBlock | None = None
    """The last frames, as many as what is summed reaches back."""

    from_seq: int = 0
    """Frames before this one are left out."""

    since_ns_utc: int = 0
    """No frame in the sums is older, by the RTC's clock; 0: not known."""

    @property
    def why_unusable(self) -> str | None:
        """Return why this loop's telemetry says nothing, or None."""
        return None

    @property
    def n_instruments(self) -> int:
        """Modes whose commands are the instruments of the regression: all, or some of too many."""
        return self.n_modes

    @property
    def n_waiting(self) -> int:
        """Frames that have come and are not summed yet."""
        return 0

    @property
    def end_ns_utc(self) -> int:
        """End of exposure of the last frame; 0: none has come."""
        return 0 if self.tail is None else self.tail.next_t_ns - self.tail.dt_ns

    def empty(self, *, rests: bool) -> Self:
        """Return it with nothing summed; what waits is of the sums that begin, unless it rests."""
        raise NotImplementedError

    def fit(self, linearisation: Linearisation) -> PassiveEstimate | None:
        """Estimate α about a linearisation, in the worker; None: too few frames have come."""
        raise NotImplementedError

    @override
    def begun_anew(self, loop: LoopContext, why: Change) -> Self:
        """Return sums that have begun with nothing, for another loop or after a standstill."""
        begun = self.begin(loop)
        from_seq = loop.settled_seq if Change.STANDSTILL in why else 0
        return replace(begun, since_ns_utc=loop.received_ns_utc, from_seq=from_seq)

    @override
    def close(
        self, loop: LoopContext, marks: Mark, *, has_windows: bool
    ) -> tuple[Self, Self | str | None]:
        """Return reset sums with the finished ones, or the reason why there is no estimate yet.

        Two estimates never share telemetry, so that their errors are independent and an estimate
        entirely after a jump shows it. Next to a dither some telemetry is skipped, more if windows
        have recently measured α; the reason is then None. The pause ends early when they stop.
        """
        beside, now_ns = Mark.WINDOWS in marks, loop.received_ns_utc
        rests = has_windows and beside and not self._oversleeps(now_ns)
        sums = self if rests else self._awake(now_ns)
        since_ns = sums.since_ns_utc if beside else 0
        if now_ns - since_ns < MIN_PASSIVE_S * 1e9 and since_ns:
            return sums, None
        why = sums.check_fittable(loop)
        if loop.rtc is None or why is not None:
            return sums, why
        rate_hz = loop.rtc.frame_rate_hz
        if not beside or sums.tail is None:
            # Frames that wait are kept for the next estimate, which therefore began earlier.
            waiting_ns = round(sums.n_waiting * 1e9 / rate_hz)
            return replace(sums.empty(rests=False), since_ns_utc=now_ns - waiting_ns), sums
        rest_s = PASSIVE_INTERVAL_S * (LONG_RESTS if has_windows else RESTS)
        begun = replace(
            sums.empty(rests=True),
            # The pause is counted in frames for the sums, and by the clock for the decision to wake
            # up.
            from_seq=sums.tail.next_seq + round(rest_s * rate_hz),
            since_ns_utc=now_ns + round(rest_s * 1e9),
        )
        return begun, sums

    def check_fittable(self, loop: LoopContext) -> str | None:
        """Return why the sums cannot be fitted, or None."""
        if loop.rtc is None:
            return "no passive estimate: there is no telemetry that could be used"
        if not loop.rtc.in_loop:
            return f"no passive estimate: {explain_open_loop(loop.rtc)}"
        if self.why_unusable is not None:
            return self.why_unusable
        least = MIN_FRAMES_PER_MODE * self.n_instruments
        if self.n_effective >= least:
            return None
        return (
            f"no passive estimate yet: {self.n_effective:.0f} frames in runs without gaps, "
            f"{least} are needed for {self.n_instruments} modes"
        )

    def _awake(self, now_ns: int) -> Self:
        """Return sums that, where they rest, begin with what comes."""
        if self.since_ns_utc <= now_ns:
            return self
        return replace(self, from_seq=0, since_ns_utc=now_ns)

    def _oversleeps(self, now_ns: int) -> bool:
        """Return whether the rest after a look would be longer than any: the clock went back."""
        return self.since_ns_utc - now_ns > 2 * LONG_RESTS * PASSIVE_INTERVAL_S * 1e9
