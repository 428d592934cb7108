"""Decide what the service requests next: a verdict, a new matrix, a dither."""

from __future__ import annotations

from dataclasses import replace

from service.records.alarms import Interlock
from service.records.events import MakeMatrix
from service.records.products import MatrixState, ReconstructorRecord
from service.records.state import Mode, TrackerState
from service.tracking import reconstructors, update_policy
from service.tracking.mode_proof import awaits_proof, n_proven_modes
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext, present
from service.tracking.window_processing import MAX_TIME_WITHOUT_WINDOW_S
from service.wire import Status

FIRST_MATRIX_INTERVAL_S = 3.0
"""Interval between requests for a new matrix of the RTC until it has arrived."""

MATRIX_REQUEST_INTERVAL_S = 10.0
"""Interval between two requests for a matrix that was not available or has no name."""

JUDGE_INTERVAL_S = 60.0
"""Interval between two verdicts on the matrix in use while the last one holds. A verdict takes 2 s
of a core with 500 modes, and only the star and the optical gains may have changed."""

REFUSED_JUDGE_INTERVAL_S = 15.0
"""The same where the margin is short, or no answer came: a smaller σ may let it pass."""

MAX_REFUSED_WINDOWS = 2
"""Windows refused in a row after which α is reported to stay unknown."""

MIN_JUDGE_INTERVAL_S = 2.0
"""Least time between two looks when the last one holds no longer."""

_FAILED_STATES = frozenset(
    {MatrixState.REFUSED, MatrixState.REJECTED, MatrixState.FAILED, MatrixState.DISCARDED}
)


def fetch_in_use(context: StepContext) -> None:
    """Ask for the matrix in use until it was had once in this session."""
    rtc, state = present(context.rtc), context.state
    # A matrix of FLAO is 3 MB: it travels once in a session.
    if rtc.cm_id in state.matrices.verified_ids:
        return
    anew = (
        rtc.cm_id is not None
        and not state.matrices.read_back_error
        and state.matrices.mismatched_id is None
    )
    # An RTC that could not show its matrix, or shows other numbers, is asked less often.
    every_s = FIRST_MATRIX_INTERVAL_S if anew else MATRIX_REQUEST_INTERVAL_S
    if context.now_ns - state.matrices.applied_asked_ns_utc >= every_s * SECOND_NS:
        reconstructors.request_applied(context, rtc)


def decide_updates(context: StepContext) -> None:
    """Ask for a reconstructor, or for a verdict on the one in use, where one is needed."""
    rtc = present(context.rtc)
    hindrance = explain_hindrance(context, rtc)
    if hindrance != context.matrices.hindrance:
        context.matrices = replace(context.matrices, hindrance=hindrance)
    unjudged = _find_unjudged(context)
    # asked for first: after a jump the loop waits for it, and nobody for the old one's margin
    _choose_update(context, rtc)
    if unjudged is not None:
        reconstructors.request_verdict(context, unjudged)


def _find_unjudged(context: StepContext) -> str | None:
    """Return the matrix in use if its margin is not known or was judged too long ago, else None.

    Nothing is sent on such an answer: what is made, approved, copied or asked of the loop is judged
    there and then.
    """
    matrices, registration = context.matrices, context.registration
    if registration is None or not update_policy.is_settled(registration):
        return None
    if matrices.making_since_ns_utc is not None or not _is_judgement_due(context):
        return None
    return matrices.in_use


def _is_judgement_due(context: StepContext) -> bool:
    matrices, record = context.matrices, context.state.used
    if matrices.judged_ns_utc is None:
        return True
    waited_s = (context.now_ns - matrices.judged_ns_utc) / SECOND_NS
    if matrices.margin is None or record is None or record.judged is None:
        return waited_s > REFUSED_JUDGE_INTERVAL_S
    # A smaller σ may let a rejected matrix pass soon.
    every_s = JUDGE_INTERVAL_S if matrices.margin.accepted else REFUSED_JUDGE_INTERVAL_S
    return waited_s > every_s or (
        waited_s > MIN_JUDGE_INTERVAL_S and update_policy.assessment_is_old(context.state, record)
    )


def _choose_update(context: StepContext, rtc: Status) -> None:
    """Compute a reconstructor when it is worthwhile, or could command more modes."""
    state, registration, now_ns = context.state, context.registration, context.now_ns
    if registration is None or not update_policy.is_settled(registration) or not rtc.in_loop:
        return
    making = state.matrices.making_since_ns_utc is not None
    if state.operator.mode is Mode.HOLD or state.on_probation or making:
        return
    if context.blocking_alarm(Interlock.SEND_NEW) is not None:
        return
    first_ns = max(
        _next_attempt_ns(state, rtc, context.policy), state.matrices.no_making_before_ns_utc
    )
    in_use = state.used
    if _is_busy(context) or now_ns < first_ns or in_use is None:
        return
    n_now = rtc.n_controlled
    why = update_policy.update_reason(state, in_use, context.policy, now_ns)
    n_safe = n_proven_modes(state, rtc.n_modes)
    # No new matrix may control modes whose response has not been verified.
    if n_safe < n_now:
        return
    if why is not None:
        reconstructors.request_matrix(
            context, MakeMatrix(n_modes=n_now, why=why, fewer=update_policy.fewer_modes_than(n_now))
        )
        return
    # More modes are tried only when the matrix in use needs no replacement.
    more = tuple(
        n
        for n in update_policy.more_modes_to_try(state, rtc, context.policy, now_ns)
        if n <= n_safe
    )
    if more and not awaits_proof(context, rtc):
        why = f"{n_now} of {more[0]} modes controlled"
        reconstructors.request_matrix(context, MakeMatrix(n_modes=more[0], why=why, fewer=more[1:]))


def explain_hindrance(context: StepContext, rtc: Status) -> str:
    """Return what keeps a wanted reconstructor from being made for good, and what to change.

    Empty while nothing does, and while it is a matter of a few windows. What the operator has
    ordered, and alarms that forbid all decisions, are reported elsewhere.
    """
    state, registration, in_use = context.state, context.registration, context.state.used
    busy = state.operations.acquisition.under_way or state.on_probation
    if state.operator.mode is Mode.HOLD or in_use is None or not rtc.in_loop or busy:
        return ""
    if registration is not None and not _is_wanted(context, rtc, in_use):
        return ""
    alarm = context.blocking_alarm(Interlock.SEND_NEW)
    if alarm is not None:
        return f"No reconstructor is sent during the alarm {alarm.name}: {alarm.text}"
    if registration is None:
        return _explain_no_window(context)
    if not registration.usable and not registration.doubt:
        reason = registration.validity.reason
        return f"No reconstructor is made while α is invalid: {reason}. {_advise(context)}"
    return _explain_modes(context, rtc)


def _is_wanted(context: StepContext, rtc: Status, in_use: ReconstructorRecord) -> bool:
    """Return whether a reconstructor would be made if nothing kept the service from it."""
    state, policy = context.state, context.policy
    if policy.wanted_modes(rtc) > rtc.n_controlled:
        return True
    return update_policy.update_reason(state, in_use, policy, context.now_ns) is not None


def _explain_modes(context: StepContext, rtc: Status) -> str:
    """Return what keeps more modes, or those of the loop, from being controlled by a new one."""
    state, n_wanted = context.state, context.policy.wanted_modes(rtc)
    more = update_policy.more_modes_to_try(state, rtc, context.policy, context.now_ns)
    n_safe = n_proven_modes(state, max(n_wanted, rtc.n_controlled))
    if n_safe < max(rtc.n_controlled, *more, 0):
        return _explain_unproven(context, rtc, n_safe)
    if more or n_wanted <= rtc.n_controlled:
        return ""
    if not rtc.gains[rtc.n_controlled - 1]:
        return (
            f"No more than {rtc.n_controlled} modes are controlled: the gain of mode "
            f"{rtc.n_controlled - 1} is 0, and modes that are added get it. Give it a gain."
        )
    limit = state.matrices.mode_limit
    if limit is None:
        return ""
    return (
        f"No more than {limit.n_modes} of {n_wanted} modes are controlled for now: "
        f"{limit.reason}. Lower [control] n_modes_target to stop further attempts."
    )


def _explain_no_window(context: StepContext) -> str:
    """Return why α stays unknown; empty while the first windows may still come."""
    if not context.policy.dither_enabled:
        return (
            "No reconstructor is made because α is unknown and [dither] enabled is false: enable "
            "it, or start a dither (pyrcal dither start)."
        )
    if context.windows.run > -MAX_REFUSED_WINDOWS:
        return ""
    return f"No reconstructor is made because no window gives α: {context.windows.refused_because}"


def _explain_unproven(context: StepContext, rtc: Status, n_safe: int) -> str:
    """Return why modes that are to be controlled are not shown to answer as the model says."""
    proof = context.matrices.mode_proof
    if not awaits_proof(context, rtc):
        return (
            f"Mode {n_safe} has not been shown to answer as the model says, and no dither may show "
            "it: set [dither] enabled = true, or end pyrcal dither stop."
        )
    if n_safe in proof.contrary:
        return (
            f"Mode {n_safe} does not answer as the instrument file says: no reconstructor controls "
            "it. Correct order and signs of the modes in the instrument file."
        )
    if proof.n_tries:
        tried = f"Mode {n_safe} was not seen to answer in {proof.n_tries} dithers"
        return f"{tried}. {_advise(context)}"
    return ""


def _advise(context: StepContext) -> str:
    """Return what to do for a surer α: a stronger dither helps only where windows are accepted."""
    windows, known = context.windows, context.registration
    if windows.run < 0:
        return f"Windows are refused: {windows.refused_because}."
    longest_s = max(MAX_TIME_WITHOUT_WINDOW_S, 2.0 * context.policy.longest_window_s)
    if known is not None and context.now_ns - known.t_ns_utc > longest_s * SECOND_NS:
        return "No window comes any more: check the frames of the RTC and its dither."
    return "Raise [dither] budget_m or longest_window_s for a smaller σ."


def _is_busy(context: StepContext) -> bool:
    """Return True if a reconstructor is on its way, awaits an operator, or could not be sent.

    None can after the RTC has renamed its sensor, until that is shown to be the same.
    In auto a proposal left from another mode or an absent RTC awaits no decision, unless there is
    no matrix to return to.
    """
    state = context.state
    if state.loop.renamed_ns_utc is not None:
        return True
    awaited = state.operator.mode is not Mode.AUTO or reconstructors.check_return(state) is not None
    return any(
        r.on_its_way
        or (r.state is MatrixState.PROPOSED and awaited and _is_left_to_operator(context, r))
        for r in state.matrices.reconstructors
    )


def _is_left_to_operator(context: StepContext, record: ReconstructorRecord) -> bool:
    """Return whether a proposal is left for an operator to decide on: it fits α, or is new."""
    state = context.state
    if not update_policy.is_outdated(state, record):
        return True
    age_s = (context.now_ns - record.created_ns_utc) / SECOND_NS
    if update_policy.is_left_behind(state, record, context.policy):
        return False
    new = age_s < update_policy.MIN_PROPOSAL_LIFETIME_S
    return new and reconstructors.check_sendable(state, record) is None


def _next_attempt_ns(state: TrackerState, rtc: Status, policy: Policy) -> int:
    """Return before when no reconstructor is computed by itself.

    One refused for another α, or for more modes than are controlled, holds back no other.
    """
    newest = (r for r in reversed(state.matrices.reconstructors) if r.parent is not None)
    for last in newest:
        overtaken = update_policy.is_outdated(state, last)
        # One that was never sent, while α is elsewhere by now.
        if last.state is MatrixState.DISCARDED and overtaken:
            continue
        failed = last.state in _FAILED_STATES
        again = failed and not overtaken and last.n_modes <= rtc.n_controlled
        wait_s = update_policy.REFUSED_INTERVAL_S if again else policy.minimum_interval_s
        return last.created_ns_utc + int(wait_s * SECOND_NS)
    return 0
