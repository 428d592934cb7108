"""Windows refused one after the other, or missing: an alarm when nothing else explains it."""

from __future__ import annotations

from dataclasses import replace

from service.estimation.windows import RefusalKind
from service.tracking import alarms
from service.tracking.alarms import Interlock
from service.tracking.operations.running import ramping
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, says_the_same

IN_A_ROW = 3
"""Windows refused one after the other that are no chance, and windows used that end it."""

NONE_FOR_S = 60.0
"""Of a running dither without a window that could be used. A simulated RTC may be ten times slower
than its timestamps: a window then takes 20 s."""

AS_EXPECTED = (RefusalKind.CUT_SHORT, RefusalKind.VOID)
"""Kinds of refusals that are no fault, and say nothing of the windows before and after."""


def count(context: StepContext) -> None:
    """Count a window that was refused."""
    context.windows = replace(context.windows, refused=context.windows.refused + 1)


def refuse(context: StepContext, reason: str, kind: RefusalKind) -> None:
    """Count a window that gave nothing; the third in a row is an alarm, with its reason."""
    count(context)
    if kind in AS_EXPECTED:
        return
    run = min(context.windows.run, 0) - 1
    context.windows = replace(context.windows, run=run)
    if run > -IN_A_ROW or _excused(context):
        return
    text = f"windows are refused one after the other: {reason}; α is not measured meanwhile"
    before = context.state.alarm(alarms.WINDOWS_REFUSED)
    if before is not None and says_the_same(before.text, text):
        text = before.text  # one cause is one text: of each window the log tells the numbers
    context.raise_alarm(alarms.WINDOWS_REFUSED, text)


def use(context: StepContext) -> None:
    """Note that a window could be used; as many in a row as raise the alarm end it."""
    run = max(context.windows.run, 0) + 1
    context.windows = replace(context.windows, run=run)
    if run >= IN_A_ROW:
        context.clear_alarm(alarms.WINDOWS_REFUSED)


def follow(context: StepContext) -> None:
    """End the alarm, and begin to count anew, where no window is expected any more.

    One that is expected and does not come is as good as refused.
    """
    if _excused(context):
        if context.windows.run < 0 or context.state.alarm(alarms.WINDOWS_REFUSED):
            context.windows = replace(context.windows, run=0)
            context.clear_alarm(alarms.WINDOWS_REFUSED)
        return
    registration, dither = context.registration, context.dither
    if dither is None or dither.start_seq is None:
        return
    since_ns = max(registration.window_ns_utc if registration else 0, dither.asked_ns_utc)
    patience_s = max(NONE_FOR_S, 3.0 * (dither.window_s or 0.0))
    raised = context.state.alarm(alarms.WINDOWS_REFUSED) is not None
    if not raised and context.now_ns - since_ns >= patience_s * SECOND_NS:
        text = f"no window was accepted for {patience_s:.0f} s although a dither runs"
        context.raise_alarm(alarms.WINDOWS_REFUSED, text)


def _excused(context: StepContext) -> bool:
    """Return whether windows are refused for what is known already, or none is wanted."""
    state, rtc = context.state, context.rtc
    if rtc is None or not rtc.in_loop or state.dithers.stopped or state.operator.stopped_because:
        return True
    if context.acquisition.under_way or state.measuring is not None:
        return True
    return (
        ramping(state, context.now_ns) is not None
        or context.blocking_alarm(Interlock.MEASURE) is not None
        or context.blocking_alarm(Interlock.ASK) is not None
    )
