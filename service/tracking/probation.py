"""Probation: a matrix just applied that makes the loop worse gives way to the one before."""

from __future__ import annotations

from dataclasses import replace

from service.telemetry.probation import WITHIN_S, Verdict
from service.tracking import events as ev
from service.tracking import reconstructors
from service.tracking.alarms import PROBATION
from service.tracking.loop import commanded_gains, same_but_for_modes, why_open
from service.tracking.operator import hold
from service.tracking.policy import SECOND_NS
from service.tracking.products import (
    MatrixState,
    Probation,
    ProbationState,
    ReconstructorRecord,
)
from service.tracking.state import TrackerState
from service.tracking.turn import Turn
from service.tracking.worth import why_of_another_loop

LATE_S = 1.0
"""For telemetry to come with the verdict: nothing else waits longer."""

COPIED_WITHIN_S = 10.0
"""For the matrix before to be ready to be sent again."""

_OVER = frozenset(
    {MatrixState.FAILED, MatrixState.REJECTED, MatrixState.REFUSED, MatrixState.DISCARDED}
)
_GOING_BACK = frozenset({ProbationState.ROLLING_BACK, ProbationState.KEPT})


def follow(turn: Turn) -> None:
    """Begin a probation with every matrix that is applied, and end one that nothing can end."""
    if turn.state.in_use != turn.before.in_use:
        _on_swap(turn, turn.before.in_use, turn.state.in_use)
        return
    trial = turn.state.probation
    if trial is None:
        return
    if trial.awaits(trial.before, trial.id):
        why = _why_not_comparable(turn)
        if why:
            _set(turn, replace(trial, state=ProbationState.NOT_JUDGED, text=why))
        elif trial.under_way and turn.now_ns > trial.until_ns_utc + LATE_S * SECOND_NS:
            _set(turn, replace(trial, state=ProbationState.OVERDUE, text="telemetry is late"))
    elif trial.under_way:
        why = _why_stuck(turn, trial)
        if why:
            _keep(turn, trial, why)


def on_compared(turn: Turn, event: ev.Compared) -> None:
    """Take the verdict of telemetry: a matrix that is worse gives way, and nobody asked does more.

    What was said of other matrices than the two on record is not meant.
    """
    trial, found = turn.state.probation, event.finding
    if trial is None or not trial.awaits(found.before, found.after):
        return
    trial = replace(trial, finding=found)
    if found.verdict is Verdict.UNKNOWN:
        _end(turn, trial, ProbationState.NOT_JUDGED, found.text)
        return
    if found.verdict is Verdict.AS_GOOD:
        _end(turn, trial, ProbationState.PASSED, found.text)
        turn.calm(PROBATION)
        return
    hold(turn, f"{trial.id} made the loop worse")
    why = _why_no_way_back(turn, trial)
    if why is not None:
        _keep(turn, trial, why)
        return
    text = f"{_numbers(trial)}: going back to {trial.before}"
    _set(turn, replace(trial, state=ProbationState.ROLLING_BACK, text=text))
    turn.alarm(PROBATION, f"{trial.id} {text}")
    why = f"the service goes back to {trial.before}: {trial.id} made the loop worse"
    reconstructors.make(turn, ev.CopyMatrix(source=trial.before, why=why, judged=False))


def is_way_back(state: TrackerState, made: ev.MatrixMade) -> bool:
    """Return whether this is the matrix before, to be sent again: its numbers, not only its child.

    One that was being made when the verdict came has the same parent.
    """
    trial = state.probation
    if trial is None or trial.state is not ProbationState.ROLLING_BACK or trial.rollback:
        return False
    before = state.reconstructor(trial.before)
    return before is not None and made.record.sha256 == before.sha256 != ""


def go_back(turn: Turn, made: ev.MatrixMade) -> None:
    """Send the matrix before under its new id, unless something forbids it by now."""
    trial = turn.state.probation
    reconstructors.propose(turn, made.record)
    if trial is None:
        return
    why = _why_no_way_back(turn, trial)
    if why is not None:
        _keep(turn, trial, why)
        return
    reconstructors.send(turn, made.record.id)
    _set(turn, replace(trial, rollback=made.record.id))


def _on_swap(turn: Turn, before: str | None, in_use: str | None) -> None:
    trial = turn.state.probation
    record = None if in_use is None else turn.state.reconstructor(in_use)
    if trial is not None and trial.state in _GOING_BACK and trial.rollback == in_use is not None:
        text = f"{_numbers(trial)}: the service went back to {trial.before}, as {in_use}"
        # an operator's rollback would go back to it
        reconstructors.change_state(
            turn, trial.id, MatrixState.FAILED, f"rolled back, it {_numbers(trial)}"
        )
        _end(turn, trial, ProbationState.ROLLED_BACK, text)
        turn.alarm(PROBATION, f"{trial.id} {text}; the mode is hold until an operator sets another")
        return
    if record is None or before is None:
        if trial is not None and trial.awaits(trial.before, trial.id):
            why = "nobody knows what the RTC uses"
            _set(turn, replace(trial, state=ProbationState.NOT_JUDGED, text=why))
        return
    why = _why_none(turn, record, trial)
    _set(
        turn,
        Probation(
            id=record.id,
            before=before,
            state=ProbationState.NOT_JUDGED if why else ProbationState.RUNNING,
            text=why or f"compared with {before}",
            since_ns_utc=turn.now_ns,
            until_ns_utc=turn.now_ns + round(WITHIN_S * SECOND_NS),
            loop=turn.before.rtc,
        ),
    )


def _why_none(turn: Turn, record: ReconstructorRecord, last: Probation | None) -> str:
    """Return why a matrix just applied is not put on probation; empty: it is."""
    if record.published_ns_utc is None:
        return "the RTC took it by itself"
    if last is not None and last.state in {ProbationState.ROLLED_BACK, ProbationState.KEPT}:
        worse = turn.state.reconstructor(last.id)
        if worse is not None and worse.sha256 == record.sha256 != "":
            return "it was found worse before, and somebody wants it all the same"
    return _why_not_comparable(turn)


def _why_not_comparable(turn: Turn) -> str:
    """Return why telemetry cannot be compared now; empty: it can."""
    if turn.rtc is None:
        return "the RTC is gone"
    if not turn.rtc.in_loop:
        return why_open(turn.rtc)
    if turn.acquisition.under_way:
        return "an acquisition watches its matrices itself"
    return ""


def _why_stuck(turn: Turn, trial: Probation) -> str:
    """Return why the matrix before does not come into use again; empty: it is on its way."""
    failed = turn.event
    if isinstance(failed, ev.JobFailed) and isinstance(failed.effect, ev.CopyMatrix):
        return failed.text
    sent = None if trial.rollback is None else turn.state.reconstructor(trial.rollback)
    if sent is None:
        late = turn.now_ns > trial.until_ns_utc + COPIED_WITHIN_S * SECOND_NS
        return "its copy did not come" if late else ""
    return sent.reason or sent.state if sent.state in _OVER else ""


def _why_no_way_back(turn: Turn, trial: Probation) -> str | None:
    """Return why the matrix before may not be sent by itself now, or None.

    The RTC has shown its numbers in this session, the gate has accepted it in this loop, and the
    loop is as it was then. α may be what is wrong: it is not judged at that.
    """
    state, rtc, record = turn.state, turn.rtc, turn.state.reconstructor(trial.before)
    if rtc is None or record is None:
        return "it is no longer known, or the RTC is gone"
    if record.id not in state.proven:
        return "the RTC has not shown its numbers in this session"
    if record.gate is None or not record.gate.accepted:
        return "the gate has not accepted it" if record.gate is None else record.gate.reason
    if trial.loop is None or not same_but_for_modes(trial.loop, rtc):
        return "the loop has been changed since"
    on_way = next((r.id for r in state.reconstructors if r.on_its_way), None)
    if on_way is not None:
        return f"{on_way} is on its way to the RTC"
    gains = commanded_gains(rtc, record.n_modes)
    return reconstructors.why_unsendable(state, record) or why_of_another_loop(
        state, record.judged, gains
    )


def _numbers(trial: Probation) -> str:
    found = trial.finding
    return "made the loop worse" + ("" if found is None else f": {found.text}")


def _keep(turn: Turn, trial: Probation, why: str) -> None:
    """Say that a matrix that is worse stays in use."""
    text = f"{_numbers(trial)}; the service did not go back to {trial.before}: {why}"
    _end(turn, trial, ProbationState.KEPT, text)
    turn.alarm(PROBATION, f"{trial.id} {text}; open the loop if it suffers, or roll back by hand")


def _end(turn: Turn, trial: Probation, state: ProbationState, text: str) -> None:
    _set(turn, replace(trial, state=state, text=text))
    turn.log(f"probation.{state}", f"{trial.id}: {text}")


def _set(turn: Turn, trial: Probation) -> None:
    turn.state = replace(turn.state, probation=trial)
