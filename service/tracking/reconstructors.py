"""A reconstructor's way: made, kept, judged, sent, acknowledged, in use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.errors import CommandError, UnknownIdError
from service.tracking import events as ev
from service.tracking.alarms import OTHER_SUM, Act, forbidding, logged, with_alarm, without_alarm
from service.tracking.events import Step
from service.tracking.loop import SAME_DELAY, SAME_LEAK, RtcView, same_gains
from service.tracking.products import Assessment, Judged, MatrixState, ReconstructorRecord
from service.tracking.registration import Registration
from service.tracking.state import Level, Mode, TrackerState
from service.tracking.worth import outdated, with_limit

RECONSTRUCTORS_KEPT = 200

RETURNS_KEPT = 100
"""Newest of those that have been in use before: what an operator may want to go back to."""

UNSENT_KEPT = 50
"""Newest of those that were never sent: enough to see what is being refused, and why."""

_UNSENT = frozenset({MatrixState.REFUSED, MatrixState.DISCARDED})
_SPARE = frozenset({MatrixState.REJECTED, MatrixState.FAILED, MatrixState.SUPERSEDED})

_RESTARTED = {
    MatrixState.PUBLISHED: MatrixState.FAILED,
    MatrixState.STAGED: MatrixState.FAILED,
    MatrixState.PROPOSED: MatrixState.DISCARDED,
}


def restored(records: tuple[ReconstructorRecord, ...]) -> tuple[ReconstructorRecord, ...]:
    """Return what a restarted service takes over from its archive.

    Only its own: what the RTC brought is fetched anew, for nobody can say it is the same as last
    time. What was under way has failed; a proposal's verdict is of another day.
    """
    own = [record for record in records if record.parent is not None]
    taken_over = [
        replace(record, state=_RESTARTED[record.state], reason="the service restarted")
        if record.state in _RESTARTED
        else record
        for record in own
    ]
    return _thinned(taken_over, None)


def with_record(state: TrackerState, record: ReconstructorRecord) -> TrackerState:
    """Return the state with one more reconstructor; what is needed least gives way."""
    shelf = [*(r for r in state.reconstructors if r.id != record.id), record]
    return replace(state, reconstructors=_thinned(shelf, state.in_use))


def _thinned(
    shelf: list[ReconstructorRecord], in_use: str | None
) -> tuple[ReconstructorRecord, ...]:
    """Return as many as are kept, oldest first.

    First to go is what was never sent, however new what is worth going back to: a flood of
    proposals that nobody wants must not wash away the way back.
    """
    excess = len(shelf) - RECONSTRUCTORS_KEPT
    if excess <= 0:
        return tuple(shelf)
    unsent = [r.id for r in shelf if r.state in _UNSENT and r.id != in_use]
    used = [r.id for r in shelf if r.state is MatrixState.SUPERSEDED]
    kept = frozenset((*used[-RETURNS_KEPT:], in_use))
    spare = [r.id for r in shelf if r.state in _SPARE and r.id not in kept]
    first_to_go = [*unsent[:-UNSENT_KEPT], *spare, *unsent[-UNSENT_KEPT:]]
    gone = frozenset(first_to_go[:excess])
    return tuple(r for r in shelf if r.id not in gone)


def with_changed(state: TrackerState, record: ReconstructorRecord) -> TrackerState:
    """Return the state with the record of the same id replaced."""
    return replace(
        state,
        reconstructors=tuple(record if r.id == record.id else r for r in state.reconstructors),
    )


def known_record(state: TrackerState, matrix_id: str) -> ReconstructorRecord:
    """Return the record of this id.

    Raises
    ------
    UnknownIdError
        If there is none.
    """
    record = state.reconstructor(matrix_id)
    if record is None:
        raise UnknownIdError(f"no reconstructor {matrix_id}")
    return record


def with_state(state: TrackerState, matrix_id: str, to: MatrixState, reason: str) -> TrackerState:
    """Return the state with one reconstructor further on its way."""
    return with_changed(state, replace(known_record(state, matrix_id), state=to, reason=reason))


def with_in_use(state: TrackerState, matrix_id: str) -> TrackerState:
    """Mark one reconstructor as applied; whichever was, has been superseded."""
    if state.in_use == matrix_id and known_record(state, matrix_id).state is MatrixState.APPLIED:
        return state
    for record in state.reconstructors:
        if record.id != matrix_id and record.state is MatrixState.APPLIED:
            state = with_state(state, record.id, MatrixState.SUPERSEDED, f"{matrix_id} is in use")
    state = with_state(state, matrix_id, MatrixState.APPLIED, known_record(state, matrix_id).reason)
    return replace(state, in_use=matrix_id, margin=None, assessment=None, judged_ns_utc=None)


MIN_WINDOWS = 2
"""Windows that must agree before anything is made from them."""

REACH = np.array([0.05, 0.05, np.deg2rad(0.05), 0.005])
"""Half of what 594 modes tolerate without loss (Heritier et al. 2018): a verdict is as good so far
beyond α ± 3σ (numeric units)."""


def settled(known: Registration) -> bool:
    """Return whether α may be believed: windows agree, and none of them hints at a jump."""
    return known.n_windows >= MIN_WINDOWS and known.candidate is None and known.usable


def why_stale(state: TrackerState, judged: Judged | None, gains: tuple[float, ...]) -> str | None:
    """Return why a verdict says nothing of a loop with these gains now; None: it does.

    It was taken over α ± 3σ as they were then, which must hold all of α ± 3σ as they are now, but
    for a small ``REACH``: σ grows between two windows, and another verdict takes as long.
    """
    known = state.registration
    if known is None or judged is None:
        return None if known is None else why_of_another_loop(state, judged, gains)
    moved = np.abs(known.alpha.vector - judged.alpha.vector)
    if np.any(moved + 3.0 * known.sigma > 3.0 * judged.sigma + REACH):
        return "α ± 3σ reaches further than it was judged for"
    return why_of_another_loop(state, judged, gains)


def why_worthless(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return the same where it need not be sent: while α is in doubt no verdict is of where it is.

    A reconstructor that somebody wants back is sent all the same.
    """
    known = state.registration
    if known is not None and known.doubt:
        return known.doubt
    return why_stale(state, judged, gains)


def why_of_another_loop(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return what is different in the loop since a verdict; None: nothing, or no RTC is there.

    An open loop does not tell the gains it will close with.
    """
    rtc = state.rtc
    if rtc is None:
        return None
    if judged is None:
        return "nobody knows of which loop its verdict is"
    if judged.session != rtc.session:
        return "the RTC has begun a new session"
    if abs(judged.leak - rtc.leak) > SAME_LEAK:
        return f"the leak was {judged.leak:g}, it is {rtc.leak:g}"
    if abs(judged.delay_frames - rtc.delay_frames) > SAME_DELAY:
        return f"the delay was {judged.delay_frames:g} frames, it is {rtc.delay_frames:g}"
    same = rtc.loop == "open" or same_gains(gains, judged.gains)
    return None if same else "the gains have changed"


def on_matrix(state: TrackerState, made: ev.MatrixMade, now_ns: int) -> Step:
    """Shelve a new reconstructor; send it if it passed the gate and nobody need approve.

    What an operator wants is sent whatever else is known; what nobody asked for only to a closed
    loop that behaves, and if α may be believed.
    """
    record, wanted = made.record, made.wanted
    overtaken = not wanted and _jumped_since(state, record, state.making_since_ns_utc)
    state = shelved(state, record, now_ns)
    if made.asked_modes is not None:
        state = with_limit(state, record, made.asked_modes, made.why_fewer, now_ns)
    if record.state is MatrixState.REFUSED:
        return state, ()
    if overtaken:
        text = f"{record.id}: the mirror jumped while it was made"
        state = with_state(state, record.id, MatrixState.DISCARDED, text)
        return logged(state, "reconstructor.discarded", text, now_ns), ()
    sendable = why_unsendable(state, record) is None and not _beyond_judging(state, record)
    if sendable and (wanted or _may_follow(state)):
        return send_once_judged(state, record.id, now_ns, wanted=wanted)
    return state, ()


def _may_follow(state: TrackerState) -> bool:
    """Return whether a reconstructor that nobody asked for may be sent."""
    rtc, known = state.rtc, state.registration
    if state.mode is not Mode.AUTO or rtc is None or not rtc.in_loop:
        return False
    if forbidding(state, Act.DECIDE) is not None:
        return False
    return known is not None and settled(known)


def _why_not_by_itself(state: TrackerState) -> str:
    """Return why nothing is sent that nobody asked for, where that is so."""
    alarm = forbidding(state, Act.DECIDE)
    if alarm is not None:
        return f"{alarm.name}: {alarm.text}"
    return "the mode, the loop or α has changed"


def send_once_judged(
    state: TrackerState, matrix_id: str, now_ns: int, *, wanted: bool = True
) -> Step:
    """Send a reconstructor; where its verdict is not of the present loop and α, judge it first.

    Raises
    ------
    CommandError
        If it cannot be sent now, whatever the gate would say.
    """
    record, rtc = known_record(state, matrix_id), state.rtc
    reason = why_unsendable(state, record)
    if record.gate is not None and not record.gate.accepted:
        reason = record.gate.reason
    if rtc is None or reason is not None:
        raise CommandError(f"{matrix_id} cannot be sent: {reason}")
    gains = commanded_gains(rtc, record.n_modes)
    stale = why_stale(state, record.judged, gains)
    if stale is None:
        return send(state, matrix_id, now_ns)
    if rtc.loop == "open" and record.gate is None:
        return send(state, matrix_id, now_ns)
    if _beyond_judging(state, record):
        raise CommandError(f"{matrix_id}: an open loop does not tell its gains: close it first")
    if rtc.loop == "open" and record.judged is not None:
        gains = record.judged.gains
    text = f"{matrix_id} is judged again before it is sent: {stale}"
    state = logged(state, "reconstructor.judged-again", text, now_ns)
    return state, (ev.JudgeProposal(id=matrix_id, gains=gains, wanted=wanted),)


def _beyond_judging(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether nobody knows the gains it was judged with, nor those it would run with."""
    opened = state.rtc is not None and state.rtc.loop == "open"
    return opened and record.gate is not None and record.judged is None


def on_proposal_judged(state: TrackerState, event: ev.ProposalJudged, now_ns: int) -> Step:
    """Send a reconstructor that has passed the gate anew; what has changed meanwhile ends it."""
    record, rtc = state.reconstructor(event.id), state.rtc
    if record is None or record.state is not MatrixState.PROPOSED:
        return state, ()
    verdict = event.verdict
    record = replace(record, gate=verdict, judged=event.judged)
    if not verdict.accepted:
        record = replace(record, state=MatrixState.REFUSED, reason=verdict.reason)
        state = with_changed(state, record)
        text = f"{record.id}: {verdict.reason}"
        return logged(state, "reconstructor.refused", text, now_ns, Level.WARNING), ()
    state = with_changed(state, record)
    reason = why_unsendable(state, record)
    if reason is None and not event.wanted and not _may_follow(state):
        reason = _why_not_by_itself(state)
    if rtc is not None and reason is None:
        reason = why_stale(state, record.judged, commanded_gains(rtc, record.n_modes))
    if reason is None:
        return send(state, record.id, now_ns)
    text = f"{record.id} was not sent: while it was judged, {reason}; approve it again"
    return logged(state, "reconstructor.not-sent", text, now_ns, Level.WARNING), ()


def _jumped_since(
    state: TrackerState, record: ReconstructorRecord, began_ns_utc: int | None
) -> bool:
    """Return whether a jump has been named since, to where the gate's verdict does not reach."""
    known = state.registration
    if known is None or known.jumped_ns_utc is None or began_ns_utc is None:
        return False
    return known.jumped_ns_utc >= began_ns_utc and outdated(state, record)


def shelved(state: TrackerState, record: ReconstructorRecord, now_ns: int) -> TrackerState:
    """Put a new reconstructor on the shelf in place of any proposal."""
    state = replace(state, making_since_ns_utc=None)
    for older in state.reconstructors:
        if older.state is MatrixState.PROPOSED:
            state = with_state(state, older.id, MatrixState.DISCARDED, f"{record.id} replaces it")
    state = with_record(state, record)
    verdict = record.gate.reason if record.gate is not None else record.reason
    if record.state is MatrixState.REFUSED:
        text = f"{record.id}: {verdict}"
        return logged(state, "reconstructor.refused", text, now_ns, Level.WARNING)
    text = f"{record.id}, {record.n_modes} modes, {verdict}"
    return logged(state, "reconstructor.made", text, now_ns)


def send(state: TrackerState, matrix_id: str, now_ns: int) -> Step:
    """Mark a reconstructor as published and ask for it to be sent.

    Raises
    ------
    CommandError
        If no RTC is there, it may be the wrong one, or the gate's latest verdict is no.
    """
    record, rtc = known_record(state, matrix_id), state.rtc
    reason = why_unsendable(state, record)
    if record.gate is not None and not record.gate.accepted:
        reason = record.gate.reason
    if rtc is None or reason is not None:
        raise CommandError(f"{matrix_id} cannot be sent: {reason}")
    unjudged = _why_unjudged(record)
    sent = replace(record, state=MatrixState.PUBLISHED, published_ns_utc=now_ns, reason=unjudged)
    text = f"{matrix_id} sent to the RTC{'; ' if unjudged else ''}{unjudged}"
    level = Level.WARNING if unjudged else Level.INFO
    state = logged(with_changed(state, sent), "reconstructor.published", text, now_ns, level)
    gains = None
    if record.n_modes != rtc.n_controlled:
        gains = extended_gains(rtc, record.n_modes)
    return state, (ev.SendMatrix(id=matrix_id, n_modes=record.n_modes, gains=gains),)


def _why_unjudged(record: ReconstructorRecord) -> str:
    """Return why the gate has said nothing of one on its way to the RTC; empty: it has."""
    on_its_way = {MatrixState.PROPOSED, MatrixState.PUBLISHED, MatrixState.STAGED}
    return record.reason if record.gate is None and record.state in on_its_way else ""


def why_unsendable(state: TrackerState, record: ReconstructorRecord) -> str | None:
    """Return why a reconstructor may not be published now, whoever wants it, or None."""
    if state.rtc is None:
        return "no RTC is there"
    if state.registration is not None and state.registration.candidate is not None:
        return "a jump is suspected: the next window of telemetry decides"
    known = _was_in_use(state, record)
    if state.registration is not None and state.registration.doubt and not known:
        return f"α is invalid ({state.registration.doubt})"
    act = Act.SEND_KNOWN if known else Act.SEND_NEW
    alarm = forbidding(state, act)
    return None if alarm is None else alarm.text


def _was_in_use(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether the very numbers of this reconstructor have been in use before."""
    used = {MatrixState.APPLIED, MatrixState.SUPERSEDED}
    same = (r for r in state.reconstructors if r.sha256 == record.sha256 and r.state in used)
    return bool(record.sha256) and any(same)


def commanded_gains(rtc: RtcView, n_modes: int) -> tuple[float, ...]:
    """Return the gains of the modes that a reconstructor of ``n_modes`` would command."""
    return extended_gains(rtc, n_modes)[:n_modes]


def extended_gains(rtc: RtcView, n_modes: int) -> tuple[float, ...]:
    """Return gains for ``n_modes`` controlled modes: those in force, the last one for new modes."""
    last = rtc.gains[rtc.n_controlled - 1]
    kept = rtc.gains[: min(rtc.n_controlled, n_modes)]
    return (*kept, *(last,) * (n_modes - len(kept)), *(0.0,) * (rtc.n_modes - n_modes))


def on_acknowledgement(state: TrackerState, event: ev.Acknowledged, now_ns: int) -> TrackerState:
    """Fold the RTC's answer to a reconstructor back in; a late one is accepted."""
    record = _meant(state, event)
    if record is None:
        text = f"an acknowledgement for {event.id}, which this service never sent"
        return logged(state, "acknowledgement.unknown", text, now_ns, Level.WARNING)
    event = replace(event, id=record.id)
    if _is_old(state, record, event):
        return state
    if record.sha256 and event.sha256 not in {None, record.sha256}:
        return _wrong(state, record, event, now_ns)
    if event.state is MatrixState.APPLIED:
        state = _right(state, record.id, now_ns)
        reason = event.reason or _why_unjudged(record)
        record = replace(record, applied_frame_seq=event.frame_seq, reason=reason)
        state = with_in_use(with_changed(state, record), record.id)
        state = without_alarm(state, "no-acknowledgement", now_ns)
        state = without_alarm(state, "margin", now_ns)
        gains = () if state.rtc is None else commanded_gains(state.rtc, record.n_modes)
        of_other = why_worthless(state, record.judged, gains)
        state = replace(
            state,
            margin=None if of_other else record.gate,
            judged_ns_utc=None if of_other else now_ns,
        )
        text = f"{event.id} applied from frame {event.frame_seq}"
        return logged(state, "reconstructor.applied", text, now_ns)
    reason = event.reason
    if event.state is MatrixState.STAGED:
        reason = reason or _why_unjudged(record)
    state = with_state(state, record.id, event.state, reason)
    if event.state is MatrixState.REJECTED:
        text = f"the RTC rejected {event.id}: {event.reason}"
        return logged(state, "reconstructor.rejected", text, now_ns, Level.WARNING)
    return state


def _meant(state: TrackerState, event: ev.Acknowledged) -> ReconstructorRecord | None:
    """Return which reconstructor is acknowledged: a commit nobody could read was the last one."""
    if event.id is not None:
        return state.reconstructor(event.id)
    sent = {MatrixState.PUBLISHED, MatrixState.STAGED}
    return next((r for r in reversed(state.reconstructors) if r.state in sent), None)


def _wrong(
    state: TrackerState, record: ReconstructorRecord, event: ev.Acknowledged, now_ns: int
) -> TrackerState:
    """Believe that the RTC holds other numbers than were sent: nothing more goes out."""
    text = (
        f"the RTC has {event.state} other numbers as {record.id}: sha256 {event.sha256}, sent were "
        f"{record.sha256}; nothing is published until it holds what was sent (rtc/cm/applied) or "
        "begins a new session: open the loop if it suffers, look at the RTC's log"
    )
    state = with_state(state, record.id, MatrixState.FAILED, text)
    if event.state is MatrixState.APPLIED:
        state = replace(state, in_use=None, margin=None, assessment=None)
    state = replace(state, wrong_matrix=record.id, applied_asked_ns_utc=now_ns)
    return with_alarm(state, OTHER_SUM, text, now_ns)


def _right(state: TrackerState, matrix_id: str, now_ns: int) -> TrackerState:
    """Return the state once the RTC holds the numbers that it should."""
    if state.wrong_matrix is None:
        return state
    text = f"the RTC holds {matrix_id} as it was sent"
    state = logged(replace(state, wrong_matrix=None), "reconstructor.right", text, now_ns)
    return without_alarm(state, OTHER_SUM, now_ns)


def _is_old(state: TrackerState, record: ReconstructorRecord, event: ev.Acknowledged) -> bool:
    """Return whether an acknowledgement tells of something that has been overtaken."""
    if state.rtc is not None and event.session not in {None, state.rtc.session}:
        return True
    if event.state is MatrixState.STAGED:
        return record.state is not MatrixState.PUBLISHED
    repeated = record.applied_frame_seq == event.frame_seq
    return record.state is MatrixState.SUPERSEDED and repeated


def on_fetched(state: TrackerState, record: ReconstructorRecord, now_ns: int) -> TrackerState:
    """Shelve the matrix the RTC uses, which the service did not make, or find its own again."""
    state = replace(state, unfetched="")
    known = state.reconstructor(record.id)
    if known is not None and known.sha256 not in {"", record.sha256}:
        event = ev.Acknowledged(
            id=record.id,
            sha256=record.sha256,
            state=MatrixState.APPLIED,
            reason="",
            frame_seq=known.applied_frame_seq,
        )
        return _wrong(state, known, event, now_ns)
    state = _right(state, record.id, now_ns)
    if known is not None and state.in_use == record.id:
        return state
    state = state if known is not None else with_record(state, record)
    state = with_in_use(state, record.id)
    text = f"the RTC uses {record.id}, {record.n_modes} modes"
    return logged(state, "reconstructor.adopted", text, now_ns)


def on_margin(state: TrackerState, judged: ev.MarginJudged, now_ns: int) -> TrackerState:
    """Note margin and loss of the matrix in use; raise an alarm when the margin is short."""
    matrix_id, verdict = judged.id, judged.verdict
    record = state.reconstructor(matrix_id)
    if record is None:
        return state
    gains = () if state.rtc is None else state.rtc.gains[: record.n_modes]
    of = judged.judged
    if of is not None and why_worthless(state, of, gains) is not None:
        return replace(state, judged_ns_utc=None) if matrix_id == state.in_use else state
    state = with_changed(state, replace(record, gate=verdict, judged=of))
    if matrix_id != state.in_use:
        return state
    state = replace(state, margin=verdict, assessment=_assessment(judged, now_ns))
    if verdict.accepted:
        return without_alarm(state, "margin", now_ns)
    return with_alarm(state, "margin", f"{matrix_id}: {verdict.reason}", now_ns)


def _assessment(judged: ev.MarginJudged, now_ns: int) -> Assessment | None:
    if judged.alpha is None or judged.expected is None:
        return None
    return Assessment(id=judged.id, alpha=judged.alpha, expected=judged.expected, t_ns_utc=now_ns)
