"""What the RTC says, does not say, and what fails on the way to it."""

from __future__ import annotations

from dataclasses import replace

from service.tracking import events as ev
from service.tracking.alarms import (
    OTHER_SUM,
    SECOND_SERVICE,
    STANDING_BY,
    counted,
    logged,
    with_alarm,
    without_alarm,
)
from service.tracking.dither import follow_status, found_again, gone
from service.tracking.events import Effect
from service.tracking.loop import RtcView, same_numbers
from service.tracking.policy import SECOND_NS
from service.tracking.products import MatrixState
from service.tracking.reconstructors import known_record, with_in_use, with_state
from service.tracking.stages import AcquisitionStage
from service.tracking.state import Level, Retries, TrackerState
from service.tracking.validity import over, pointed, voided

ACKNOWLEDGE_WITHIN_S = 3.0
"""An RTC applies within 2 s of the commit, or it has failed."""

FORGOTTEN_AFTER_S = 15.0
"""An alarm the link repeats while it lasts is over after this much silence."""

_RENEWED = ("second-rtc", "basis-mismatch")

COMPUTE_WITHIN_S = 60.0
"""A reconstructor that takes longer was lost with its worker."""


def on_tick(state: TrackerState, now_ns: int) -> TrackerState:
    """Give up what has been waited for too long."""
    for record in state.reconstructors:
        waiting = record.state in {MatrixState.PUBLISHED, MatrixState.STAGED}
        sent_ns = record.published_ns_utc or now_ns
        if waiting and now_ns - sent_ns > ACKNOWLEDGE_WITHIN_S * SECOND_NS:
            text = (
                f"{record.id} was not applied within {ACKNOWLEDGE_WITHIN_S:.0f} s; the RTC keeps "
                "the old one: look at the RTC's log, then publish again"
            )
            state = with_state(state, record.id, MatrixState.FAILED, text)
            state = with_alarm(state, "no-acknowledgement", text, now_ns)
    for alarm in state.alarms:
        silent_ns = now_ns - alarm.seen_ns_utc
        if alarm.name in _RENEWED and silent_ns > FORGOTTEN_AFTER_S * SECOND_NS:
            state = over(state, alarm.name, now_ns)
    since_ns = state.making_since_ns_utc
    if since_ns is not None and now_ns - since_ns > COMPUTE_WITHIN_S * SECOND_NS:
        state = replace(state, making_since_ns_utc=None)
        text = f"no reconstructor came within {COMPUTE_WITHIN_S:.0f} s"
        state = logged(state, "reconstructor.lost", text, now_ns, Level.WARNING)
    return counted(state, now_ns)


def on_status(state: TrackerState, rtc: RtcView, now_ns: int) -> TrackerState:
    """Take over what the RTC says of itself."""
    state, before = without_alarm(state, "rtc-vanished", now_ns), state.rtc
    if state.rtc is not None and not state.rtc.same_loop(rtc):
        # the margin is not what it was
        state = replace(state, judged_ns_utc=None)
    state = _of_this_loop(state, rtc)
    state = replace(
        state,
        rtc=rtc,
        basis_id=state.basis_id or rtc.basis_id,
        config_id=state.config_id or rtc.config_id,
    )
    state = pointed(state, rtc.pointing)
    state = _of_this_basis(state, now_ns)
    state = _told_of_gains(before, state, rtc, now_ns)
    known = rtc.cm_id is not None and state.reconstructor(rtc.cm_id) is not None
    if rtc.cm_id is not None and known and rtc.cm_id != state.wrong_matrix:
        state = _used_by_status(state, rtc.cm_id, now_ns)
    measuring = state.measuring
    opened = state.acquisition.under_way or (measuring is not None and measuring.opens_loop)
    # its alarm tells more, and not to close the loop on any matrix
    opened = opened or state.acquisition.stage is AcquisitionStage.INTERRUPTED
    if not rtc.in_loop and not opened:
        state = with_alarm(state, "loop-open", f"{rtc.why_open}: close it to calibrate", now_ns)
    else:
        state = without_alarm(state, "loop-open", now_ns)
    return follow_status(state, rtc, now_ns)


def _of_this_loop(state: TrackerState, rtc: RtcView) -> TrackerState:
    """Forget the passive estimate's bias if it was learnt in another loop, in whichever session."""
    known = state.registration
    if known is None or known.bias is None or not known.bias.looked_ns_utc:
        return state
    if same_numbers(known.bias.loop, rtc.loop_numbers):
        return state
    return replace(state, registration=replace(known, bias=None))


def _used_by_status(state: TrackerState, matrix_id: str, now_ns: int) -> TrackerState:
    """Take a reconstructor for applied, whatever became of its acknowledgement."""
    before = known_record(state, matrix_id).state
    state = with_in_use(state, matrix_id)
    if before not in {MatrixState.PUBLISHED, MatrixState.STAGED, MatrixState.FAILED}:
        return state
    state = without_alarm(state, "no-acknowledgement", now_ns)
    if before is not MatrixState.FAILED:
        return state
    text = f"{matrix_id} is in use after all, by the RTC's status; nobody acknowledged it"
    state = with_state(state, matrix_id, MatrixState.APPLIED, text)
    return logged(state, "reconstructor.applied", text, now_ns)


def _told_of_gains(
    before: RtcView | None, state: TrackerState, rtc: RtcView, now_ns: int
) -> TrackerState:
    """Say how many modes are in the loop where it is not all that are controlled."""
    n_before = rtc.n_controlled if before is None else len(before.in_loop)
    n_now = len(rtc.in_loop)
    if rtc.loop == "open" or n_now in {n_before, rtc.n_controlled}:
        return state
    text = f"{n_now} of {rtc.n_controlled} controlled modes have a gain: the others are let be"
    return logged(state, "loop.partial", text, now_ns)


def _of_this_basis(state: TrackerState, now_ns: int) -> TrackerState:
    """Drop an α that was restored from a night with another basis or configuration."""
    known = state.registration
    if known is None or known.basis_id is None or known.config_id is None:
        return state
    found, expected = (known.basis_id, known.config_id), (state.basis_id, state.config_id)
    if found == expected:
        return state
    text = f"α was measured with {found[0]}, {found[1]}; the RTC has {expected[0]}, {expected[1]}"
    return logged(replace(state, registration=None), "registration.void", text, now_ns)


def on_new_session(state: TrackerState, session: str, now_ns: int) -> TrackerState:
    """Void what belonged to the old session; α is the telescope's and stays, to be confirmed."""
    for record in state.reconstructors:
        if record.state in {MatrixState.PUBLISHED, MatrixState.STAGED}:
            state = with_state(state, record.id, MatrixState.FAILED, "the RTC restarted")
    registration = state.registration
    state = voided(state, "the RTC was in another session")
    state = replace(
        state,
        rtc=None,
        dither=None,
        in_use=None,
        wrong_matrix=None,
        applied_asked_ns_utc=0,
        unfetched="",
        margin=None,
        assessment=None,
        judged_ns_utc=None,
        loop_command=state.loop_command and replace(state.loop_command, lasts_s=0.0),
        retries=Retries(),
        registration=registration and replace(registration, n_windows=0),
    )
    state = without_alarm(gone(found_again(state, now_ns), now_ns), OTHER_SUM, now_ns)
    return logged(state, "rtc.session", f"the RTC started session {session}", now_ns)


def on_services(state: TrackerState, event: ev.ServicesMet, now_ns: int) -> TrackerState:
    """Stand by while another service drives the RTC, or say that one stands by."""
    who = " and ".join(event.others)
    stood_by = any(alarm.name == STANDING_BY for alarm in state.alarms)
    if not event.others:
        state = without_alarm(state, SECOND_SERVICE, now_ns)
    else:
        does = "drives the RTC" if event.drives else "stands by"
        text = (
            f"more than one service of system {state.system}: beside this one, which {does}, "
            f"{who}: end all but one"
        )
        state = with_alarm(state, SECOND_SERVICE, text, now_ns)
    if not event.drives:
        text = (
            f"another service drives the RTC: {who}; this one asks and sends nothing until that "
            "one has gone: end one of them"
        )
        return with_alarm(replace(state, dither=None), STANDING_BY, text, now_ns)
    if stood_by:
        text = "the service that drove the RTC has gone: this one drives it from now on"
        state = logged(state, "service.takes-over", text, now_ns, Level.WARNING)
    return without_alarm(state, STANDING_BY, now_ns)


def on_failure(state: TrackerState, effect: Effect, text: str, now_ns: int) -> TrackerState:
    """Undo the memory of having asked, so that it can be asked again later."""
    later = now_ns + 5 * SECOND_NS
    match effect:
        case ev.MakeMatrix() | ev.CopyMatrix():
            retries = state.retries.later(make_ns_utc=later)
            state = replace(state, making_since_ns_utc=None, retries=retries)
        case ev.AskDither():
            retries = state.retries.later(dither_ns_utc=later)
            state = replace(state, dither=None, retries=retries)
        case ev.AskNoDither():
            pass  # it is asked again while it must be; nothing else has to wait for that
        case ev.FetchMatrix():
            state = replace(state, unfetched=text)
        case ev.SendMatrix(id=matrix_id):
            state = with_state(state, matrix_id, MatrixState.FAILED, text)
        case _:
            state = replace(state, retries=state.retries.later(make_ns_utc=later))
    return logged(state, "job.failed", text, now_ns, Level.WARNING)


def on_vanished(state: TrackerState, now_ns: int) -> TrackerState:
    """Forget what belonged to the RTC, and nothing else."""
    state = gone(found_again(replace(state, rtc=None, dither=None), now_ns), now_ns)
    text = (
        "the RTC's token is gone: it has ended, stood still for over 2 s or lost the network; α "
        "and every reconstructor are kept; it comes back by itself if it runs, else restart it"
    )
    return with_alarm(state, "rtc-vanished", text, now_ns)
