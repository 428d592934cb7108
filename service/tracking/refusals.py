"""Windows refused one after the other, or missing: an alarm when nothing else explains it."""

from __future__ import annotations

from dataclasses import replace

from service.estimation.windows import RefusalKind
from service.tracking import alarms
from service.tracking.activity import ramping
from service.tracking.alarms import Act
from service.tracking.policy import SECOND_NS
from service.tracking.turn import Turn, says_the_same

IN_A_ROW = 3
"""Windows refused one after the other that are no chance, and windows used that end it."""

NONE_FOR_S = 60.0
"""Of a running dither without a window that could be used. A simulated RTC may be ten times slower
than its timestamps: a window then takes 20 s."""

AS_EXPECTED = (RefusalKind.CUT_SHORT, RefusalKind.VOID)
"""Kinds of refusals that are no fault, and say nothing of the windows before and after."""


def count(turn: Turn) -> None:
    """Count a window that was refused."""
    turn.state = replace(turn.state, windows_refused=turn.state.windows_refused + 1)


def refuse(turn: Turn, reason: str, kind: RefusalKind) -> None:
    """Count a window that gave nothing; the third in a row is an alarm, with its reason."""
    count(turn)
    if kind in AS_EXPECTED:
        return
    run = min(turn.state.window_run, 0) - 1
    turn.state = replace(turn.state, window_run=run)
    if run > -IN_A_ROW or _excused(turn):
        return
    text = f"windows are refused one after the other: {reason}; α is not measured meanwhile"
    before = turn.state.alarm(alarms.WINDOWS_REFUSED)
    if before is not None and says_the_same(before.text, text):
        text = before.text  # one cause is one text: of each window the log tells the numbers
    turn.alarm(alarms.WINDOWS_REFUSED, text)


def use(turn: Turn) -> None:
    """Note that a window could be used; as many in a row as raise the alarm end it."""
    run = max(turn.state.window_run, 0) + 1
    turn.state = replace(turn.state, window_run=run)
    if run >= IN_A_ROW:
        turn.calm(alarms.WINDOWS_REFUSED)


def follow(turn: Turn) -> None:
    """End the alarm, and begin to count anew, where no window is expected any more.

    One that is expected and does not come is as good as refused.
    """
    if _excused(turn):
        if turn.state.window_run < 0 or turn.state.alarm(alarms.WINDOWS_REFUSED):
            turn.state = replace(turn.state, window_run=0)
            turn.calm(alarms.WINDOWS_REFUSED)
        return
    known, dither = turn.known, turn.dither
    if dither is None or dither.start_seq is None:
        return
    since_ns = max(known.window_ns_utc if known else 0, dither.asked_ns_utc)
    patience_s = max(NONE_FOR_S, 3.0 * (dither.window_s or 0.0))
    raised = turn.state.alarm(alarms.WINDOWS_REFUSED) is not None
    if not raised and turn.now_ns - since_ns >= patience_s * SECOND_NS:
        text = f"no window was accepted for {patience_s:.0f} s although a dither runs"
        turn.alarm(alarms.WINDOWS_REFUSED, text)


def _excused(turn: Turn) -> bool:
    """Return whether windows are refused for what is known already, or none is wanted."""
    state, rtc = turn.state, turn.rtc
    if rtc is None or not rtc.in_loop or state.dither_stopped or state.stopped_because:
        return True
    if turn.acquisition.under_way or state.measuring is not None:
        return True
    return (
        ramping(state, turn.now_ns) is not None
        or turn.forbidden(Act.MEASURE) is not None
        or turn.forbidden(Act.ASK) is not None
    )
