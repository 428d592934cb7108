"""Windows refused one after the other, or missing: an alarm when nothing else explains it."""

from __future__ import annotations

from dataclasses import replace

from service.estimation.windows import RefusalKind
from service.tracking import alarms
from service.tracking.alarms import Interlock
from service.tracking.operations.running import running_ramp
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, same_but_for_numbers

IN_A_ROW = 3
"""Windows refused one after the other that are no chance, and windows used that end it."""

NONE_FOR_S = 60.0
"""Of a running dither without a window that could be used. A simulated RTC may be ten times slower
than its timestamps: a window then takes 20 s."""

AS_EXPECTED = (RefusalKind.CUT_SHORT, RefusalKind.VOID)
"""Kinds of refusals that are no fault, and say nothing of the windows before and after."""


def count_refused(context: StepContext) -> None:
    """Count a window that was refused."""
    context.windows = replace(context.windows, refused=context.windows.refused + 1)


def note_refused(context: StepContext, reason: str, kind: RefusalKind) -> None:
    """Count a window that gave nothing, and why."""
    count_refused(context)
    if kind in AS_EXPECTED:
        return
    run = min(context.windows.run, 0) - 1
    context.windows = replace(context.windows, run=run, refused_because=reason)


def note_used(context: StepContext) -> None:
    """Note that a window could be used."""
    context.windows = replace(context.windows, run=max(context.windows.run, 0) + 1)


def reset_run(context: StepContext) -> None:
    """Begin to count anew where no window is expected any more."""
    if context.windows.run < 0 and _excused(context):
        context.windows = replace(context.windows, run=0)


def refused_text(context: StepContext) -> str | None:
    """Return why windows are refused one after the other, or none comes; None: they are not.

    As many in a row as raise the alarm end it. One that is expected and does not come is as good as
    refused.
    """
    raised, run = context.alarm_text(alarms.WINDOWS_REFUSED), context.windows.run
    if run <= -IN_A_ROW:
        because = context.windows.refused_because
        text = f"windows are refused one after the other: {because}; α is not measured meanwhile"
        if raised is not None and same_but_for_numbers(raised, text):
            text = raised  # one cause is one text: of each window the log tells the numbers
    elif raised is not None:
        text = raised if run < IN_A_ROW else ""
    else:
        text = _missing_text(context)
    return None if not text or _excused(context) else text


def _missing_text(context: StepContext) -> str:
    registration, dither = context.registration, context.dither
    if dither is None or dither.start_seq is None:
        return ""
    since_ns = max(registration.window_ns_utc if registration else 0, dither.asked_ns_utc)
    patience_s = max(NONE_FOR_S, 3.0 * (dither.window_s or 0.0))
    if context.now_ns - since_ns < patience_s * SECOND_NS:
        return ""
    return f"no window was accepted for {patience_s:.0f} s although a dither runs"


def _excused(context: StepContext) -> bool:
    """Return whether windows are refused for what is known already, or none is wanted."""
    state, rtc = context.state, context.rtc
    if rtc is None or not rtc.in_loop or state.dithers.stopped or state.operator.stopped_because:
        return True
    if context.acquisition.under_way or state.measuring is not None:
        return True
    return (
        running_ramp(state, context.now_ns) is not None
        or context.blocking_alarm(Interlock.MEASURE) is not None
        or context.blocking_alarm(Interlock.ASK) is not None
    )
