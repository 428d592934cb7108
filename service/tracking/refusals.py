"""Windows refused one after the other: counted, and an alarm when nothing else explains them."""

from __future__ import annotations

from dataclasses import replace

from service.telemetry.windows import RefusalKind
from service.tracking import alarms
from service.tracking.activity import ramping
from service.tracking.alarms import Act
from service.tracking.turn import Turn

IN_A_ROW = 3
"""Windows refused one after the other that are no chance, and windows used that end it."""

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
    if run <= -IN_A_ROW and not _excused(turn):
        text = (
            f"{-run} windows in a row were refused, the last one because {reason}; α is not "
            "measured meanwhile"
        )
        turn.alarm(alarms.WINDOWS_REFUSED, text)


def use(turn: Turn) -> None:
    """Note that a window could be used; as many in a row as raise the alarm end it."""
    run = max(turn.state.window_run, 0) + 1
    turn.state = replace(turn.state, window_run=run)
    if run >= IN_A_ROW:
        turn.calm(alarms.WINDOWS_REFUSED)


def follow(turn: Turn) -> None:
    """End the alarm, and begin to count anew, where no window is expected any more."""
    if turn.state.window_run < 0 and _excused(turn):
        turn.state = replace(turn.state, window_run=0)
        turn.calm(alarms.WINDOWS_REFUSED)


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
