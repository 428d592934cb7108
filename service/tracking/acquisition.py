"""From nothing known to tracking: open, look from afar, confirm, close on few modes, widen.

Nothing is assumed of the registration. The loop is opened, for one that is closed far from
registration slips; smooth modes lead to α and other modes must confirm it; a reconstructor for as
many modes as the gate accepts everywhere in α ± 3σ closes the loop; then ordinary windows sharpen
α and more modes follow. What does not come true within its time begins anew with the loop opened
again, a few times, and then ends in a state that says why.

One that was cut off, by the end of the service or a gap in the link, leaves the RTC's loop as it
had it, mostly open. The next service, or the same one when the RTC is back, begins anew where it
may and the loop is as it was left; whatever else it finds it says, and leaves to the operator. It
never closes a loop.
"""

from __future__ import annotations

from dataclasses import replace

from service.control.gate import FORGIVING_LEAK
from service.estimation.windows import RefusalKind
from service.tracking import acquisition_stages as stages
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking import reconstructors, worth
from service.tracking.activity import ramping
from service.tracking.alarms import ACQUISITION, Act
from service.tracking.dither import allow, choose_dither, make_way
from service.tracking.loop import present
from service.tracking.measuring import cut_off
from service.tracking.policy import SECOND_NS
from service.tracking.products import MatrixState, ReconstructorRecord
from service.tracking.sending import why_unsendable
from service.tracking.state import Acquisition, AcquisitionStage, Interruption, Mode, TrackerState
from service.tracking.turn import Turn
from service.wire import DitherRequest, LoopRequest, Reply, Status

ENOUGH_WINDOWS = 2
"""Ordinary windows that must have held with the last reconstructor."""

NO_RTC = "no RTC is there: when one is, it begins anew or says why not; the loop may be open"

_LASTING = (AcquisitionStage.FAILED, AcquisitionStage.INTERRUPTED)
"""Stages that an operator, or windows, must end."""

PATIENCE_S = 180.0
"""In one stage: a simulated RTC may be ten times slower than its timestamps."""

_LOST = (MatrixState.REJECTED, MatrixState.FAILED)


def acquire_on_command(turn: Turn, _: cmd.Acquire) -> None:
    """Begin one because an operator says so."""
    allow(turn)
    _begin(turn, present(turn.rtc), "the operator asks", commanded=True)


def abort_on_command(turn: Turn, _: cmd.AbortAcquisition) -> None:
    """End one because an operator says so."""
    turn.calm(ACQUISITION)
    stages.abort(turn, "by the operator", held_off=True)


def acquire(turn: Turn) -> None:
    """Take an acquisition further after an event, or begin one where the service needs it."""
    acquisition = turn.acquisition
    if acquisition.stage is AcquisitionStage.INTERRUPTED:
        _take_up(turn)
    elif not acquisition.under_way:
        if turn.state.windows_accepted > turn.before.windows_accepted:
            stages.go_on(turn, replace(acquisition, misses=0))
        _forget_when_over(turn)
        stages.tell_of_misses(turn)
        why = stages.why_needed(turn.state, turn.policy, turn.now_ns)
        if why is not None and turn.rtc and ramping(turn.state, turn.now_ns) is None:
            _begin(turn, turn.rtc, why, commanded=False)
    elif isinstance(turn.event, ev.RtcVanished):
        # the state before still knows in which session that was
        stages.go_on(turn, _cut_off(turn.before, "the RTC vanished"))
        _wait(turn, NO_RTC)
    else:
        _advance(turn)


def left_behind(state: TrackerState) -> Acquisition | None:
    """Return what the next service must know of an acquisition; None: nothing.

    One that was aborted matters while α is not known: it says why, and why the loop may be open. So
    does one that holds back the next.
    """
    acquisition = state.acquisition
    if acquisition.under_way:
        return _cut_off(state, "the service ended")
    aborted = acquisition.stage is AcquisitionStage.ABORTED and state.registration is None
    lasts = acquisition.stage in _LASTING or acquisition.held_off
    return _kept(acquisition) if aborted or lasts else None


def inherit(turn: Turn, left: Acquisition) -> None:
    """Take over the acquisition that the service before this one has left."""
    stages.go_on(turn, left)
    if left.stage is AcquisitionStage.FAILED:
        turn.alarm(ACQUISITION, left.text)
    elif left.stage is not AcquisitionStage.ABORTED:
        _wait(turn, NO_RTC)


def _begin(turn: Turn, rtc: Status, why: str, *, commanded: bool) -> None:
    turn.calm(ACQUISITION)
    make_way(turn)
    cut_off(turn, "an acquisition has begun")
    lost = _own_loop_lost(turn)
    stages.begin(turn, rtc, why=why, commanded=commanded)
    turn.log("acquisition.begun", why)
    if lost is not None:
        most = worth.half_of(rtc.n_controlled)
        first = min(turn.acquisition.n_modes, most)
        stages.go_on(turn, replace(turn.acquisition, most_modes=most, n_modes=first))
        worth.limit_modes(turn, most, f"{lost} with {rtc.n_controlled} modes")
    stages.far_stage(turn, rtc)


def _own_loop_lost(turn: Turn) -> str | None:
    """Return the alarm of a loop that did not hold on a matrix made for where the mirror is.

    On as many modes it would not hold the next time; the RTC's own matrix says nothing of that.
    """
    state = turn.state
    record = state.reconstructor(state.in_use) if state.in_use is not None else None
    if record is None or record.alpha is None:
        return None
    alarm = turn.forbidden(Act.HOLD)
    return None if alarm is None else alarm.name


def _advance(turn: Turn) -> None:
    """Take one that is under way further."""
    n_effects = len(turn.effects)
    if not _end_by_event(turn):
        _take_in(turn)
    acted = len(turn.effects) > n_effects
    if acted or not turn.acquisition.under_way or turn.rtc is None:
        return
    if turn.acquisition.stage in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        _closed_stage(turn, turn.rtc)
    else:
        stages.far_stage(turn, turn.rtc)


def _end_by_event(turn: Turn) -> bool:
    """End one that cannot go on after the event, or begin it anew; return whether that is so."""
    acquisition, state = turn.acquisition, turn.state
    late = turn.now_ns - acquisition.since_ns_utc > PATIENCE_S * SECOND_NS
    match turn.event:
        case cmd.StopDither():
            stages.abort(turn, "because the dither was stopped")
        case cmd.SetMode(mode=mode) if mode is not Mode.AUTO and not acquisition.commanded:
            stages.abort(turn, f"because the mode is {mode}")
        case ev.SessionStarted() if acquisition.stage is not AcquisitionStage.OPENING:
            stages.restart(turn, "the RTC began a new session")
        case ev.DitherMeasured(id=loud, text=text) if loud == state.dithering.loud_id and text:
            stages.give_up(turn, text)
        case ev.Noted(name="dither.unusable", text=text):
            stages.give_up(turn, f"its dither cannot be read: {text}")
        case ev.Tick() if late:
            stages.restart(turn, f"{acquisition.text}: not done in {PATIENCE_S:.0f} s")
        case _:
            return _end_by_answer(turn)
    return True


def _end_by_answer(turn: Turn) -> bool:
    acquisition = turn.acquisition
    match turn.event:
        case ev.Answered(
            request=LoopRequest(id=acquisition.command), reply=Reply(accepted=False, reason=reason)
        ):
            stages.give_up(turn, f"the RTC will not change its loop: {reason}")
        case ev.JobFailed(effect=ev.Ask(request=LoopRequest(id=acquisition.command)), text=text):
            stages.restart(turn, text)
        case _:
            return False
    return True


def _take_in(turn: Turn) -> None:
    match turn.event:
        case ev.FarFitted():
            stages.on_far(turn, turn.event)
        case ev.WindowLost(refused=refused) if refused.kind is RefusalKind.NOT_FOUND:
            stages.on_missed(turn, refused.reason)
        case ev.Answered(request=DitherRequest(), reply=Reply(accepted=False, reason=reason)):
            stages.on_missed(turn, f"the RTC refused the dither: {reason}")
        case ev.MatrixMade():
            _on_made(turn, turn.event)
        case _:
            pass


def _closed_stage(turn: Turn, rtc: Status) -> None:
    """Make, send, close; then let ordinary windows sharpen α and go on to more modes."""
    acquisition = turn.acquisition
    record = turn.state.reconstructor(acquisition.matrix) if acquisition.matrix else None
    if record is not None and record.state in _LOST:
        stages.restart(turn, f"{record.id} was not applied: {record.reason}")
    elif acquisition.stage is AcquisitionStage.WIDENING:
        _widen(turn, rtc, record)
    elif record is None:
        if acquisition.command is None or rtc.leak <= FORGIVING_LEAK:
            _make(turn, acquisition.n_modes, rtc)
    elif rtc.cm_id != record.id:
        return
    elif rtc.loop == "open":
        if acquisition.command is None:
            stages.request_loop(turn, cmd.SetLoop(loop="closed"))
    else:
        n_windows = turn.state.windows_accepted
        stages.go_on(turn, replace(acquisition, applied=record.id, windows=n_windows))
        text = f"closed on {record.n_modes} modes: sharpening the registration"
        stages.enter_stage(turn, AcquisitionStage.WIDENING, text)


def _on_made(turn: Turn, made: ev.MatrixMade) -> None:
    """Send a reconstructor that has passed the gate, with the gains it was judged with."""
    record, acquisition, rtc = made.record, turn.acquisition, turn.rtc
    if acquisition.stage not in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        return
    if record.state is MatrixState.REFUSED:
        _on_refused(turn, record)
        return
    found = acquisition.found
    if rtc is None or found is None:
        stages.restart(turn, f"{record.id} cannot be sent: no RTC is there")
        return
    gains = stages.gains_for(found, record.n_modes, rtc.n_modes)
    stale = worth.why_worthless(turn.state, record.judged, gains[: record.n_modes])
    if stale is not None:
        reconstructors.change_state(
            turn, record.id, MatrixState.DISCARDED, f"while it was made, {stale}"
        )
        turn.log("reconstructor.discarded", f"{record.id}: {stale}")
        return
    reason = why_unsendable(turn.state, record)
    if reason is not None:
        stages.restart(turn, f"{record.id} cannot be sent: {reason}")
        return
    reconstructors.send_with(turn, record.id, gains)
    most = acquisition.most_modes
    if acquisition.stage is AcquisitionStage.WIDENING and record.n_modes < (made.asked_modes or 0):
        most = record.n_modes
    sent = replace(acquisition, matrix=record.id, n_modes=record.n_modes, sent=True, command=None)
    stages.go_on(turn, replace(sent, most_modes=most))


def _on_refused(turn: Turn, record: ReconstructorRecord) -> None:
    """With the loop closed be content with the modes there are; else try a leak for the edge."""
    acquisition, gate, rtc = turn.acquisition, record.gate, turn.rtc
    slippery = gate is not None and gate.edge_motion_m is not None
    if acquisition.stage is AcquisitionStage.WIDENING:
        stages.go_on(turn, replace(acquisition, most_modes=acquisition.n_modes))
    elif slippery and rtc is not None and rtc.leak > FORGIVING_LEAK:
        text = f"a leak of {FORGIVING_LEAK} is to keep the outer ring in place"
        turn.log("acquisition.leak", text)
        stages.request_loop(turn, cmd.SetLoop(leak=FORGIVING_LEAK))
    else:
        reason = gate.reason if gate is not None else record.reason
        stages.give_up(turn, f"no number of modes passes the gate: {reason}")


def _widen(turn: Turn, rtc: Status, record: ReconstructorRecord | None) -> None:
    acquisition, known = turn.acquisition, turn.known
    slipped = turn.forbidden(Act.HOLD)
    if slipped is not None:
        stages.restart(turn, f"{slipped.name} with {acquisition.n_modes} modes", slipped=True)
        return
    if rtc.loop == "open":
        stages.restart(turn, "somebody opened the loop")
        return
    doubted = known is not None and bool(known.doubt)
    waiting = doubted or turn.state.making_since_ns_utc is not None
    if record is not None and rtc.cm_id == record.id and not waiting:
        if record.applied_frame_seq is not None and acquisition.applied != record.id:
            n_windows = turn.state.windows_accepted
            acquisition = replace(acquisition, applied=record.id, windows=n_windows)
            stages.go_on(turn, acquisition)
        seen, goal = turn.state.windows_accepted - acquisition.windows, _goal(acquisition)
        if seen >= 1 and (record.n_modes < goal or worth.moved(turn.state, record, turn.policy)):
            _make(turn, goal, rtc, at_least=record.n_modes)
            return
        if seen >= ENOUGH_WINDOWS:
            _finish(turn, record)
            return
    choose_dither(turn, rtc)


def _make(turn: Turn, n_modes: int, rtc: Status, *, at_least: int = 0) -> None:
    """Ask for a reconstructor of so many modes, or fewer but more than ``at_least``."""
    found, state = turn.acquisition.found, turn.state
    if state.making_since_ns_utc is not None or found is None:
        return
    if turn.now_ns >= state.no_making_before_ns_utc:
        effect = ev.MakeMatrix(
            n_modes=n_modes,
            why=f"acquisition: {n_modes} modes",
            gains=stages.gains_for(found, n_modes, rtc.n_modes),
            fewer=tuple(rung for rung in worth.fewer_than(n_modes) if rung > at_least),
        )
        reconstructors.make(turn, effect)


def _goal(acquisition: Acquisition) -> int:
    goal = acquisition.n_modes if acquisition.found is None else acquisition.found.n_controlled
    return goal if acquisition.most_modes is None else min(goal, acquisition.most_modes)


def _finish(turn: Turn, record: ReconstructorRecord) -> None:
    acquisition = turn.acquisition
    goal = acquisition.found.n_controlled if acquisition.found is not None else record.n_modes
    took_s = (turn.now_ns - acquisition.started_ns_utc) / SECOND_NS
    of_goal = "" if record.n_modes >= goal else f" of {goal}"
    text = f"tracking after {took_s:.0f} s, {record.n_modes}{of_goal} modes controlled"
    stages.enter_stage(turn, AcquisitionStage.TRACKING, text)
    turn.calm(ACQUISITION)


def _forget_when_over(turn: Turn) -> None:
    """Forget an acquisition that holds back the next, once it need not.

    One that had failed: when α is known without it, for whoever closed the loop has mended what it
    could not, and the next trouble is another one. One that an operator ended: then too, or when an
    operator sets the mode, which is to say what the service may do by itself.
    """
    acquisition, event = turn.acquisition, turn.event
    if acquisition.stage is not AcquisitionStage.FAILED and not acquisition.held_off:
        return
    if acquisition.held_off and isinstance(event, cmd.SetMode):
        text = f"an operator has set the mode, {event.mode}, since the last was ended"
    elif _followed(turn.state):
        text = f"{ENOUGH_WINDOWS} windows agree in the closed loop: none is needed any more"
    else:
        return
    stages.go_on(turn, Acquisition(text=text, since_ns_utc=turn.now_ns))
    turn.calm(ACQUISITION)
    turn.log("acquisition.idle", text)


def _followed(state: TrackerState) -> bool:
    """Return whether windows that came since agree on α, in a closed loop."""
    rtc, known = state.rtc, state.registration
    if rtc is None or not rtc.in_loop or known is None:
        return False
    since = state.windows_accepted - state.acquisition.windows
    believed = known.usable and known.candidate is None
    return believed and min(since, known.n_windows) >= ENOUGH_WINDOWS


def _kept(acquisition: Acquisition) -> Acquisition:
    """Return it without what is of telemetry and commands that have been overtaken."""
    return replace(acquisition, alpha=None, covariance=None, command=None, applied=None, windows=0)


def _cut_off(state: TrackerState, cause: str) -> Acquisition:
    session = None if state.rtc is None else state.rtc.session
    doing = f"{state.acquisition.stage}: {state.acquisition.text}"
    interruption = Interruption(doing=doing, session=session, cause=cause)
    return replace(_kept(state.acquisition), interruption=interruption)


def _take_up(turn: Turn) -> None:
    """Begin an acquisition that was cut off anew, or say why not and what the operator can do."""
    rtc = turn.rtc
    if rtc is None:
        return
    if rtc.loop != "open":
        _note_closed(turn, rtc)
        return
    why_not = _why_not_by_itself(turn, rtc)
    if why_not is not None:
        do = (
            "The loop may be open, and its matrix is for a registration that was not believed: "
            "acquire again, or close the loop on a matrix of your own"
        )
        _wait(turn, f"it does not begin anew by itself: {why_not}", do)
        return
    cause = _cause(turn.acquisition)
    stages.go_on(turn, replace(turn.acquisition, interruption=None))
    turn.calm(ACQUISITION)
    stages.restart(turn, cause)


def _why_not_by_itself(turn: Turn, rtc: Status) -> str | None:
    state = turn.state
    if stages.left_open(state, rtc) is None:
        return "the RTC has begun another session since, and who left its loop open is not known"
    if state.mode is not Mode.AUTO:
        return f"the mode is {state.mode}"
    if not turn.policy.acquires:
        return "the settings forbid that"
    if state.dither_stopped:
        return "the dither was stopped"
    return stages.why_not_now(state, turn.policy)


def _wait(turn: Turn, what: str, do: str = "") -> None:
    """Say what was going on, and what it waits for."""
    text = f"{_said(turn.acquisition)}; {what}{'. ' if do else ''}{do}"
    if any((alarm.name, alarm.text) == (ACQUISITION, text) for alarm in turn.state.alarms):
        return
    stage = AcquisitionStage.INTERRUPTED
    stages.go_on(turn, replace(turn.acquisition, stage=stage, text=text, since_ns_utc=turn.now_ns))
    turn.warn("acquisition.interrupted", what)
    turn.alarm(ACQUISITION, text)


def _note_closed(turn: Turn, rtc: Status) -> None:
    """End it after somebody, or the acquisition itself, has closed the loop."""
    matrix, told = rtc.cm_id or "an unknown matrix", "which it has not judged"
    if rtc.cm_id is not None and rtc.cm_id == turn.acquisition.matrix:
        told = "which had passed the gate: the registration is followed from there"
    text = f"{_said(turn.acquisition)}; the loop is closed on {matrix}, {told}"
    turn.calm(ACQUISITION)
    stages.enter_stage(turn, AcquisitionStage.ABORTED, text)


def _said(acquisition: Acquisition) -> str:
    left = acquisition.interruption
    doing = "unknown" if left is None else left.doing
    return f"{_cause(acquisition)} during an acquisition ({doing})"


def _cause(acquisition: Acquisition) -> str:
    left = acquisition.interruption
    return "it was cut off" if left is None else left.cause
