"""Probation: return from a matrix that makes the loop worse.

The previous matrix was stable until a moment ago, whatever its origin. It is sent again regardless
of what the gate or the telemetry have reported since.

If the loop is no better with the previous matrix, the swap was not the cause: the mirror may have
jumped within seconds of it, or turbulence that saturates the sensor may have lost the loop. The
service then goes on as after a jump at any other time, and acquires the registration again if the
loop is lost. It does so once in a while; if the same happens again soon, or where it may not
acquire, a lost loop is opened and the mode remains hold.
"""

from __future__ import annotations

from dataclasses import replace

from service.estimation.loop import explain_open_loop, same_but_for_modes
from service.estimation.probation import MAX_PROBATION_S
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import Alarm, Interlock
from service.records.operations import CommandState, Probation, ProbationState, Verdict
from service.records.products import MatrixState, ReconstructorRecord
from service.records.state import Mode, TrackerState
from service.tracking import mode_proof, reconstructors, validity
from service.tracking.operations.acquisition import may_acquire
from service.tracking.operator import enter_hold, leave_hold, set_loop
from service.tracking.policy import SECOND_NS
from service.tracking.reconstructors import check_sendable
from service.tracking.step_context import StepContext
from service.tracking.transitions import move

MAX_VERDICT_DELAY_S = 1.0
"""Time for the telemetry with the verdict to arrive; everything else waits no longer."""

REPUBLICATION_TIMEOUT_S = 10.0
"""Time for the previous matrix to be ready for sending."""

MAX_LAW_DETECTION_S = 5.0
"""Commands that contradict the loop law within this time are a consequence of the swap; it takes up
to 2 s of telemetry to detect it."""

MAX_CALMING_S = 1.0
"""Time for a diverging loop to become calm with the previous matrix; its detector remembers half a
second."""

RESUMPTION_INTERVAL_S = 600.0
"""Shortest time between two resumptions after a rollback that did not help: a matrix that is wrong
must not be sent again and again."""

MAX_OPPOSITE_S = 1.5
"""Time from the first commands of the wrong sign until a loop that is lost is opened."""

OPEN_REQUEST_INTERVAL_S = 2.0
"""Interval between two requests to open the loop."""

MAY_HAVE_JUMPED = "the mirror may have jumped at the time of a swap"

_CONCLUSIVE_ALARMS = (alarms.WRONG_LOOP, alarms.OFF_LOOP, alarms.DIVERGING)
"""Alarms that say by themselves that the RTC plays another matrix, or one that does not hold."""

_JUDGED = frozenset({ProbationState.RUNNING, ProbationState.OVERDUE, ProbationState.PASSED})
_FINAL_STATES = frozenset(
    {MatrixState.FAILED, MatrixState.REJECTED, MatrixState.REFUSED, MatrixState.DISCARDED}
)
_ROLLBACK_STATES = frozenset({ProbationState.ROLLING_BACK, ProbationState.KEPT})
_TAKEN_OVER = {
    ProbationState.OPENING: ProbationState.KEPT,
    ProbationState.ACQUIRING: ProbationState.NOT_CONFIRMED,
}
_WORSE_STATES = frozenset(
    {
        ProbationState.ROLLING_BACK,
        ProbationState.WATCHED,
        ProbationState.ROLLED_BACK,
        ProbationState.KEPT,
        ProbationState.OPENING,
    }
)


def advance(context: StepContext) -> None:
    """Begin a probation with every matrix that is applied, and end one that nothing can end."""
    if context.matrices.in_use != context.before.matrices.in_use:
        _on_swap(context, context.before.matrices.in_use, context.matrices.in_use)
        return
    trial = context.probation
    if trial is None:
        return
    alarm, misapplied = _alarm_of_swap(context, trial), context.matrices.misapplied_id
    if trial.state in _JUDGED and trial.id == misapplied and not _check_comparable(context):
        _begin_rollback(context, trial, context.matrices.misapplied, resumes=False)
    elif alarm is not None:
        # Commands that contradict the law of the loop are the RTC's fault and not the mirror's.
        _begin_rollback(context, trial, alarm.text, resumes=alarm.name == alarms.DIVERGING)
    else:
        _go_on(context, trial)


def _go_on(context: StepContext, trial: Probation) -> None:
    match trial.state:
        case ProbationState.RUNNING | ProbationState.OVERDUE:
            _await_verdict(context, trial)
        case ProbationState.ROLLING_BACK:
            if why := _explain_failed_rollback(context, trial):
                _keep_worse(context, trial, why)
        case ProbationState.WATCHED:
            _watch(context, trial)
        case ProbationState.OPENING:
            _await_opening(context, trial)
        case ProbationState.ACQUIRING:
            _await_acquisition(context, trial)
        case ProbationState.OPENED if context.rtc is not None and context.rtc.in_loop:
            _move(context, replace(trial, state=ProbationState.ROLLED_BACK))


def on_mode_set(context: StepContext, _: cmd.SetMode) -> None:
    """Leave a lost loop to the operator, who has taken over by setting the mode."""
    trial = context.probation
    if trial is not None and trial.state in _TAKEN_OVER:
        _move(context, replace(trial, state=_TAKEN_OVER[trial.state]))


def on_copy_failed(context: StepContext, _: ev.RepublishMatrix, text: str) -> None:
    """Keep a matrix that is worse where the one before cannot be copied."""
    trial = context.probation
    if trial is not None and trial.state is ProbationState.ROLLING_BACK:
        _keep_worse(context, trial, text)


def on_compared(context: StepContext, event: ev.Compared) -> None:
    """Process the verdict of a probation; a worse matrix is replaced.

    Statements about other matrices than the two on record do not count.
    """
    trial, found = context.probation, event.finding
    if trial is None or not trial.awaits(found.before, found.after):
        return
    # The comparison now concerns the previous matrix, which is in use again.
    if trial.state is ProbationState.WATCHED:
        # A mirror at its limits stands still, so that nothing can be compared: the alarms decide.
        unknown = found.verdict is Verdict.UNKNOWN
        if unknown and context.blocking_alarm(Interlock.HOLD) is not None:
            return
        helped = found.verdict is not Verdict.WORSE
        _end_watch(context, trial, found.text, lost=found.lost, helped=helped)
        return
    trial = replace(trial, finding=found)
    if found.verdict is Verdict.UNKNOWN:
        _end(context, trial, ProbationState.NOT_JUDGED, found.text)
    elif found.verdict is Verdict.AS_GOOD:
        _end(context, trial, ProbationState.PASSED, found.text)
        context.clear_alarm(alarms.PROBATION)
        passed = context.state.reconstructor(trial.id)
        if passed is not None:
            mode_proof.note_passed(context, passed)
    # A jump explains why the loop is worse: the matrix need not be to blame.
    elif jump := _check_jump(context, trial):
        _end(context, trial, ProbationState.NOT_JUDGED, f"{jump}: {found.text}")
    else:
        _begin_rollback(context, trial, found.text)


def is_way_back(state: TrackerState, made: ev.MatrixMade) -> bool:
    """Return whether this is the matrix before, to be sent again: its numbers, not only its child.

    One that was being made when the verdict came has the same parent.
    """
    trial = state.operations.probation
    if trial is None or trial.state is not ProbationState.ROLLING_BACK or trial.rollback:
        return False
    before = state.reconstructor(trial.before)
    # An unknown checksum is empty and equals nothing.
    return before is not None and made.record.sha256 == before.sha256 != ""


def send_way_back(context: StepContext, made: ev.MatrixMade) -> None:
    """Send the matrix before under its new id, unless something forbids it by now."""
    trial = context.probation
    reconstructors.propose(context, made.record)
    if trial is None:
        return
    why = _check_rollback(context, trial)
    if why is not None:
        _keep_worse(context, trial, why)
        return
    reconstructors.send(context, made.record.id, trial.since_ns_utc)
    context.probation = replace(trial, rollback=made.record.id)


def _begin_rollback(
    context: StepContext, trial: Probation, found: str, *, resumes: bool = True
) -> None:
    """Have the matrix before sent again; where that cannot be say why.

    ``resumes`` is False if the cause cannot be the mirror.
    """
    resumes = resumes and context.operator.mode is Mode.AUTO
    enter_hold(context, f"{trial.id} made the loop worse")
    trial = replace(trial, worse=f"made the loop worse: {found}", resumes=resumes)
    why = _check_rollback(context, trial)
    if why is not None:
        _keep_worse(context, trial, why)
        return
    text = f"{trial.worse}. The service goes back to {trial.before}"
    _move(context, replace(trial, state=ProbationState.ROLLING_BACK, text=text))
    context.raise_alarm(alarms.PROBATION, f"{trial.id} {text}")
    why = f"the service goes back to {trial.before}: {trial.id} made the loop worse"
    # Not judged: the loop ran with this matrix, and α may be what is wrong.
    reconstructors.request_matrix(
        context, ev.RepublishMatrix(source=trial.before, why=why, judged=False)
    )


def _on_swap(context: StepContext, before: str | None, in_use: str | None) -> None:
    trial = context.probation
    record = context.state.reconstructor(in_use)
    if trial is not None and trial.rollback == in_use is not None:
        # It may come when the loop is being opened already.
        if trial.state in _ROLLBACK_STATES:
            _begin_watch(context, trial, in_use)
        return
    if trial is not None and trial.state is ProbationState.WATCHED and trial.id == in_use:
        _keep_worse(context, trial, context.matrices.misapplied or f"the RTC names {in_use} again")
        return
    # Without both matrices nothing can be compared.
    if record is None or before is None:
        if trial is not None and trial.judges is not None:
            why = "the RTC's matrix is unknown"
            _move(context, replace(trial, state=ProbationState.NOT_JUDGED, text=why))
        return
    why = _explain_missing_probation(context, record, trial)
    # The reference is the last matrix that was good, not the one that made the loop worse.
    worse = trial is not None and trial.id == before and trial.state in _WORSE_STATES
    asked = context.policy.opens_lost_loop
    context.probation = Probation(
        id=record.id,
        before=before,
        reference=trial.reference if trial is not None and worse else before,
        state=ProbationState.NOT_JUDGED if why else ProbationState.RUNNING,
        text=why or f"compared with {before}",
        since_ns_utc=context.now_ns,
        until_ns_utc=context.now_ns + round(MAX_PROBATION_S * SECOND_NS),
        # A rollback requires the loop to be as it was before the swap.
        loop=context.before.loop.rtc,
        opens=context.before.operator.mode is Mode.AUTO if asked is None else asked,
        resumed_ns_utc=None if trial is None else trial.resumed_ns_utc,
    )


def _await_verdict(context: StepContext, trial: Probation) -> None:
    why = _check_comparable(context)
    if why:
        _move(context, replace(trial, state=ProbationState.NOT_JUDGED, text=why))
    elif trial.under_way and context.now_ns > trial.until_ns_utc + MAX_VERDICT_DELAY_S * SECOND_NS:
        _move(context, replace(trial, state=ProbationState.OVERDUE, text="telemetry is late"))


def _begin_watch(context: StepContext, trial: Probation, in_use: str) -> None:
    """Check whether the loop recovers, now that the matrix before is in use again."""
    text = f"{trial.worse}. The service went back to {trial.before}, as {in_use}"
    # an operator's rollback would go back to it
    reconstructors.change_state(
        context, trial.id, MatrixState.FAILED, f"rolled back, it {trial.worse}"
    )
    watched = replace(
        trial,
        since_ns_utc=context.now_ns,
        until_ns_utc=context.now_ns + round(MAX_PROBATION_S * SECOND_NS),
    )
    _end(context, watched, ProbationState.WATCHED, text)
    context.raise_alarm(
        alarms.PROBATION, f"{trial.id} {text}. The mode is hold until an operator sets another"
    )


def _watch(context: StepContext, trial: Probation) -> None:
    """End the check of the loop with the matrix before: lost, opened, or undecided."""
    waited_s = (context.now_ns - trial.since_ns_utc) / SECOND_NS
    lost, named = context.blocking_alarm(Interlock.HOLD), context.state.alarm(alarms.MISAPPLIED)
    opposite = named is not None and context.matrices.misapplied_id is not None
    opposite_s = (context.now_ns - named.since_ns_utc) / SECOND_NS if named and opposite else 0.0
    if gone := _check_loop(context):
        _end_watch(context, trial, gone, lost=False)
    # The detector of divergence averages over half a second, so that it still shows the rejected
    # matrix.
    elif lost is not None and (waited_s > MAX_CALMING_S or opposite_s > MAX_OPPOSITE_S):
        _end_watch(context, trial, lost.text, lost=True, helped=False)
    elif waited_s > MAX_PROBATION_S + MAX_VERDICT_DELAY_S:
        _end_watch(context, trial, "telemetry does not show how the loop is since", lost=False)


def _end_watch(
    context: StepContext, trial: Probation, found: str, *, lost: bool, helped: bool = True
) -> None:
    trial = replace(trial, text=f"{trial.text}. Since then: {found}")
    if not helped and _may_resume(context, trial, lost=lost):
        _resume(context, trial, lost=lost)
        return
    if lost and trial.opens:
        _open(context, trial)
        return
    _end(context, trial, ProbationState.ROLLED_BACK, trial.text)
    do = ". Open the loop" if lost else ""
    text = f"{trial.id} {trial.text}. The mode is hold until an operator sets another{do}"
    context.raise_alarm(
        alarms.PROBATION, text, alarms.as_critical(alarms.PROBATION) if lost else None
    )


def _may_resume(context: StepContext, trial: Probation, *, lost: bool) -> bool:
    """Return whether the service may go on by itself after a rollback that did not help."""
    since_ns = trial.resumed_ns_utc
    again = since_ns is not None and (context.now_ns - since_ns < RESUMPTION_INTERVAL_S * SECOND_NS)
    # An operator who has set a mode meanwhile has taken over.
    # Where the RTC applies other numbers the mirror is not the cause, and nothing more is sent.
    again = again or bool(context.matrices.misapplied)
    if again or not trial.resumes or context.operator.mode is not Mode.HOLD:
        return False
    return not lost or may_acquire(context.state, context.policy)


def _resume(context: StepContext, trial: Probation, *, lost: bool) -> None:
    """Go on as after a jump at any other time: the loop is no better with the matrix before."""
    state = ProbationState.ACQUIRING if lost else ProbationState.NOT_CONFIRMED
    reconstructors.change_state(
        context, trial.id, MatrixState.FAILED, "rolled back, but it was not the cause"
    )
    _end(context, replace(trial, resumed_ns_utc=context.now_ns), state, trial.text)
    context.clear_alarm(alarms.PROBATION)
    leave_hold(
        context,
        f"the loop is no better with {trial.before}, so {trial.id} was not the cause. The mirror "
        "may have jumped, or turbulence may have lost the loop",
    )
    # Windows from before the event say nothing of where the mirror is now.
    validity.invalidate_telemetry(context, MAY_HAVE_JUMPED)
    validity.require_new_windows(context)
    validity.request_window(context, MAY_HAVE_JUMPED)


def _open(context: StepContext, trial: Probation) -> None:
    """Ask the RTC to open a loop that is lost, and say so."""
    _end(context, trial, ProbationState.OPENING, trial.text)
    set_loop(context, cmd.SetLoop(loop="open"))


def _await_opening(context: StepContext, trial: Probation) -> None:
    """Ask again until the loop is open."""
    rtc, asked = context.rtc, context.loop.command
    if rtc is not None and not rtc.in_loop:
        _move(context, replace(trial, state=ProbationState.OPENED))
    elif rtc is not None and asked is not None and not context.operator.stopped_because:
        waited_ns = context.now_ns - asked.asked_ns_utc
        if waited_ns > OPEN_REQUEST_INTERVAL_S * SECOND_NS:
            set_loop(context, cmd.SetLoop(loop="open"))


def _await_acquisition(context: StepContext, trial: Probation) -> None:
    """Note that the acquisition has begun, or that the loop is open."""
    closed = context.rtc is not None and context.rtc.in_loop
    if context.acquisition.under_way or not closed:
        _move(context, replace(trial, state=ProbationState.NOT_CONFIRMED))


def explain_opening(context: StepContext) -> str | None:
    """Return that the loop was lost and is asked to open, and whether it did; None: it is not."""
    trial, asked = context.probation, context.loop.command
    if trial is None or trial.state not in {ProbationState.OPENING, ProbationState.OPENED}:
        return None
    raised, does = context.alarm_text(alarms.LOOP_OPENED), "The RTC is asked to open the loop"
    if trial.state is ProbationState.OPENED:
        does = "The loop was asked to open, and is open"
    elif asked is not None and asked.state in {CommandState.REFUSED, CommandState.FAILED}:
        does = f"The RTC was asked to open the loop and has not ({asked.reason}): open it there"
    elif raised is not None:
        return raised  # it is asked again and again
    return (
        f"{trial.id} {trial.text}. {does}. Find out why, then close it on a matrix known to be "
        "good. The mode is hold until an operator sets another"
    )


def _alarm_of_swap(context: StepContext, trial: Probation) -> Alarm | None:
    """Return an alarm that has come with a matrix just applied, or None."""
    # A later alarm has another cause than the swap.
    late = context.now_ns > trial.since_ns_utc + MAX_LAW_DETECTION_S * SECOND_NS
    if trial.state not in _JUDGED or late or _check_comparable(context):
        return None
    if _check_jump(context, trial):
        return None
    since = (a for a in context.alarms.active if a.since_ns_utc >= trial.since_ns_utc)
    return next((alarm for alarm in since if alarm.name in _CONCLUSIVE_ALARMS), None)


def _explain_missing_probation(
    context: StepContext, record: ReconstructorRecord, last: Probation | None
) -> str:
    """Return why a matrix just applied is not put on probation; empty: it is."""
    candidate_id = None if last is None or last.before != record.id else last.id
    named = context.state.reconstructor(candidate_id)
    if context.matrices.misapplied and named is not None and named.state is MatrixState.FAILED:
        return "it never was out of use"
    if record.published_ns_utc is None:
        return "the RTC took it by itself"
    if last is not None and last.state in _WORSE_STATES:
        worse = context.state.reconstructor(last.id)
        # The same numbers under a new id: an operator has sent them despite the verdict.
        if worse is not None and worse.sha256 == record.sha256 != "":
            return "it was found worse before, and is wanted all the same"
    return _check_comparable(context)


def _check_comparable(context: StepContext) -> str:
    """Return why telemetry cannot be compared now; empty: it can."""
    acquiring = context.acquisition.under_way
    return _check_loop(context) or (
        "an acquisition watches its matrices itself" if acquiring else ""
    )


def _check_loop(context: StepContext) -> str:
    """Return why no loop is closed; empty: one is."""
    if context.rtc is None:
        return "the RTC is gone"
    return "" if context.rtc.in_loop else explain_open_loop(context.rtc)


def _check_jump(context: StepContext, trial: Probation) -> str:
    """Return that windows have shown a jump since the swap; empty: they have not."""
    registration = context.registration
    jumped_ns = None if registration is None else registration.jumped_ns_utc
    jumped = jumped_ns is not None and jumped_ns >= trial.since_ns_utc
    return "the mirror has jumped since the swap" if jumped else ""


def _explain_failed_rollback(context: StepContext, trial: Probation) -> str:
    """Return why the matrix before does not come into use again; empty: it is on its way."""
    sent = context.state.reconstructor(trial.rollback)
    waited_s = (context.now_ns - trial.since_ns_utc) / SECOND_NS
    if trial.id == context.matrices.misapplied_id and waited_s > MAX_OPPOSITE_S:
        return f"it is not back after {MAX_OPPOSITE_S:g} s"
    if sent is None:
        late = context.now_ns > trial.until_ns_utc + REPUBLICATION_TIMEOUT_S * SECOND_NS
        return "its copy did not come" if late else ""
    return sent.reason or sent.state if sent.state in _FINAL_STATES else ""


def _check_rollback(context: StepContext, trial: Probation) -> str | None:
    """Return why the matrix before may not be sent by itself now, or None.

    The RTC has shown its numbers in this session, and the loop is as it was then. The gate is not
    asked: the loop ran with it, and α may be what is wrong.
    """
    state, rtc, record = context.state, context.rtc, context.state.reconstructor(trial.before)
    if rtc is None or record is None:
        return "it is no longer known, or the RTC is gone"
    # A restarted RTC may hold other numbers under this id.
    if record.id not in state.matrices.verified_ids:
        return "the RTC has not shown its numbers in this session"
    if trial.loop is None or not same_but_for_modes(trial.loop, rtc):
        return "the loop has been changed since"
    if state.sent is not None:
        return f"{state.sent.id} is on its way to the RTC"
    return check_sendable(state, record, trial.since_ns_utc)


def _keep_worse(context: StepContext, trial: Probation, why: str) -> None:
    """Say that a matrix that is worse stays in use; open the loop that is lost with it."""
    text = f"{trial.worse}; the service did not go back to {trial.before}: {why}"
    # If there is no way back, an open loop is better than a lost one.
    out_of_hand = context.blocking_alarm(Interlock.HOLD) is not None
    lost = out_of_hand or trial.id == context.matrices.misapplied_id
    lost = lost or (trial.finding is not None and trial.finding.lost)
    if lost and trial.opens and context.rtc is not None and not context.operator.stopped_because:
        _open(context, replace(trial, text=text))
        return
    _end(context, trial, ProbationState.KEPT, text)
    do = "open the loop if it suffers, or roll back by hand"
    own = alarms.as_critical(alarms.PROBATION) if lost else None
    context.raise_alarm(alarms.PROBATION, f"{trial.id} {text}; {do}", own)


def _end(context: StepContext, trial: Probation, state: ProbationState, text: str) -> None:
    if _move(context, replace(trial, state=state, text=text)):
        context.log(f"probation.{state}", f"{trial.id}: {text}")


def _move(context: StepContext, trial: Probation) -> bool:
    """Store a probation in its new state and return True, unless that is no transition."""
    context.probation = move(context, context.probation, trial)
    return context.probation is trial
