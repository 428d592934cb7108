"""Void telemetry: which, for what, and why.

A window is fitted seconds after it was taken, by a busy worker later still, when what spoilt it is
over. So what spoils telemetry leaves an interval behind, by the RTC's clock: what began before its
end is void for its purpose, whenever it is worked out. When the trouble itself began is known later
than it was, and only to a detector's patience: an interval has no begin.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from service.tracking.alarms import Interlock, alarm_blocks
from service.tracking.policy import SECOND_NS
from service.tracking.registration import Purpose, VoidInterval
from service.tracking.state import TrackerState
from service.tracking.step_context import StepContext

CLOCK_SET_BACK_S = 60.0
"""Telemetry is never so much older than what is known: the RTC's clock has gone back."""

KEPT_S = 600.0
"""Telemetry older than this is worked out no more."""

INTERVALS_KEPT = 16

MOVING = "the mirror's image was being moved"
BOTH_SIDES = "its telemetry may be from both sides of a jump"
BEFORE_DOUBT = (
    "it began before α came into doubt and agrees with what was known then: only one taken since "
    "can tell"
)

_ROUNDING_NS = 1_000_000
"""A window that follows another begins where that one ends, but for the rounding of a frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TelemetrySpan:
    """A stretch of telemetry, by the RTC's clock."""

    began_ns_utc: int
    ended_ns_utc: int


def telemetry_span(began_ns_utc: int, ended_ns_utc: int) -> TelemetrySpan:
    """Return the stretch that ended then; 0: nobody says when it began, it is taken for short."""
    return TelemetrySpan(began_ns_utc=began_ns_utc or ended_ns_utc, ended_ns_utc=ended_ns_utc)


def precedes(state: TrackerState, span: TelemetrySpan, since_ns_utc: int) -> bool:
    """Return whether telemetry began before a time, and so cannot tell of what is since then."""
    rtc = state.loop.rtc
    if rtc is not None and since_ns_utc - rtc.t_ns > CLOCK_SET_BACK_S * SECOND_NS:
        return False
    return span.began_ns_utc < since_ns_utc - _ROUNDING_NS


def why_void(
    state: TrackerState, span: TelemetrySpan, purpose: Purpose = Purpose.MEASURE
) -> str | None:
    """Return why telemetry taken then is void for a purpose, whatever is the matter now, or None.

    What is the matter now is asked of the alarms.
    """
    of_purpose = (each for each in state.alpha.void_intervals if each.purpose is purpose)
    covers = (each for each in of_purpose if precedes(state, span, each.until_ns_utc))
    return next((each.because for each in covers), None)


def end_of(state: TrackerState, because: str) -> int:
    """Return until when telemetry is void for a reason, by the RTC's clock; 0: it is not."""
    ends = (v.until_ns_utc for v in state.alpha.void_intervals if v.because == because)
    return max(ends, default=0)


def void_until(
    context: StepContext, until_ns_utc: int, because: str, purpose: Purpose = Purpose.MEASURE
) -> None:
    """Make telemetry void that began before a time of the RTC's clock.

    It takes the place of what is void for the same reason already.
    """
    new = VoidInterval(until_ns_utc=until_ns_utc, because=because, purpose=purpose)
    others = [
        each
        for each in context.alpha.void_intervals
        if (each.purpose, each.because) != (purpose, because)
        and until_ns_utc - each.until_ns_utc <= KEPT_S * SECOND_NS
    ]
    _set(context, [*others, new][-INTERVALS_KEPT:])


def make_valid(context: StepContext, purpose: Purpose, because: str | None = None) -> None:
    """Make telemetry void no more for a purpose: for this reason, or for any (None)."""
    kept = [
        each
        for each in context.alpha.void_intervals
        if each.purpose is not purpose or because not in {None, each.because}
    ]
    _set(context, kept)


def restore_intervals(context: StepContext, intervals: Iterable[VoidInterval]) -> None:
    """Take over what was void before a restart of the service."""
    _set(context, intervals)


def cast_doubt(context: StepContext, since_ns_utc: int) -> None:
    """Let no window settle the doubt that began before what has cast it, or has done so before."""
    until_ns = max(end_of(context.state, BEFORE_DOUBT), since_ns_utc)
    void_until(context, until_ns, BEFORE_DOUBT, Purpose.SETTLE)


def invalidate_telemetry(context: StepContext, because: str, t_ns_utc: int = 0) -> None:
    """Note that nothing taken until now is a measurement any more.

    ``t_ns_utc`` is the RTC's clock now, where it is known better than by its status.
    """
    until_ns = max(t_ns_utc, 0 if context.rtc is None else context.rtc.t_ns)
    void_until(context, until_ns, because)


def end_alarm(context: StepContext, name: str, t_ns_utc: int = 0) -> None:
    """End an alarm; telemetry that it was of stays what it was."""
    alarm = context.state.alarm(name)
    context.clear_alarm(name)
    if alarm is not None and alarm_blocks(alarm, Interlock.MEASURE):
        invalidate_telemetry(context, alarm.definition.because, t_ns_utc)


def is_since_alarm(state: TrackerState, name: str, span: TelemetrySpan) -> bool:
    """Return whether telemetry was taken since this alarm was raised, or there is no such alarm."""
    alarm = state.alarm(name)
    return alarm is None or not precedes(state, span, alarm.t_ns_utc)


def _set(context: StepContext, intervals: Iterable[VoidInterval]) -> None:
    kept = tuple(intervals)
    if kept != context.alpha.void_intervals:
        context.alpha = replace(context.alpha, void_intervals=kept)
