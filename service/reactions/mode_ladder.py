"""How many modes to control: fewer where gate, RTC or operator will not have more; more later."""

from __future__ import annotations

from dataclasses import replace

from service.events import Event, Reject
from service.reactions.journal import logged
from service.reactions.policy import SECOND_NS, Policy
from service.state import (
    Level,
    MatrixState,
    ModeLimit,
    ReconstructorRecord,
    RtcView,
    TrackerState,
)

LADDER = (
    *(594, 550, 500, 450, 400, 350, 300, 260, 230, 200, 175, 150),
    *(130, 115, 100, 90, 80, 70, 60, 52, 45, 40, 35, 30),
)
"""Numbers of modes that are tried. A step costs 2 nm of wavefront at 594 modes, 6 at 400, 11 at 100
(FLAO, 1", where 400 leave 117); halves are tried, so that a finer list costs a trial at most."""

FIRST_WAIT_S = 60.0
"""After modes were lowered, before more are tried."""

LONGEST_WAIT_S = 1800.0

OPERATORS_WAIT_S = 3600.0
"""After an operator declined more modes: who has said no is not asked again in the same hour."""

FORGIVEN_AFTER_S = 3600.0
"""A limit found again later than this has nothing to do with the last one."""

COMFORT = 1.5
"""More modes are tried only while there is this times the margin that the gate asks for."""

_DECLINED = frozenset({MatrixState.REFUSED, MatrixState.REJECTED, MatrixState.FAILED})
"""By the gate when it judged it again, or by the RTC."""


def half_of(n_modes: int) -> int:
    """Return the largest rung that is at most half of ``n_modes``, or these where there is none."""
    return max((rung for rung in LADDER if 2 * rung <= n_modes), default=n_modes)


def fewer_than(n_modes: int) -> tuple[int, ...]:
    """Return the rungs below ``n_modes``, largest first."""
    return tuple(rung for rung in LADDER if rung < n_modes)


def more_to_try(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> tuple[int, ...]:
    """Return the numbers of modes above the present one that may be tried now, largest first.

    New modes get the gain of the last: where that is 0 they would not be in the loop.
    """
    if not rtc.gains[rtc.n_controlled - 1]:
        return ()
    target = min(policy.n_modes_target, rtc.n_modes)
    limit = state.mode_limit
    if limit is not None and (now_ns < limit.until_ns_utc or not _comfortable(state)):
        target = min(target, limit.n_modes)
    rungs = {target, *fewer_than(target)}
    return tuple(sorted((rung for rung in rungs if rung > rtc.n_controlled), reverse=True))


def _comfortable(state: TrackerState) -> bool:
    margin = state.margin
    if margin is None or not margin.accepted:
        return False
    return 1.0 - margin.worst_pole_radius >= COMFORT * (1.0 - margin.bound)


def with_limit(
    state: TrackerState, record: ReconstructorRecord, asked: int, why_fewer: str, now_ns: int
) -> TrackerState:
    """Note what a reconstructor asked to have ``asked`` modes says of how many are possible."""
    n_now = state.rtc.n_controlled if state.rtc is not None else record.n_modes
    if record.state is MatrixState.REFUSED:
        if asked <= n_now:
            return state
        reason = record.gate.reason if record.gate is not None else record.reason
        return limited(state, n_now, reason, now_ns)
    if record.n_modes < asked:
        state = limited(state, record.n_modes, why_fewer, now_ns)
    if record.n_modes < n_now:
        text = f"{record.id} has {record.n_modes} modes, {n_now} are controlled: {why_fewer}"
        return logged(state, "modes.lowered", text, now_ns, Level.WARNING)
    if record.n_modes > n_now:
        text = f"{record.id} has {record.n_modes} modes, {n_now} are controlled"
        state = logged(state, "modes.raised", text, now_ns)
    limit = state.mode_limit
    if limit is not None and record.n_modes > limit.n_modes:
        # kept: a limit found again soon must be waited out longer
        state = replace(state, mode_limit=replace(limit, n_modes=record.n_modes))
    return state


def declined(before: TrackerState, state: TrackerState, event: Event, now_ns: int) -> TrackerState:
    """Note that a reconstructor which had passed the gate was declined before it came into use.

    If it has more modes than are controlled, that is what it was made for: no more are tried for a
    while, longer each time. An acquisition counts its own failures.
    """
    if state.reconstructors is before.reconstructors or state.acquisition.under_way:
        return state
    rtc = state.rtc or before.rtc
    if rtc is None or rtc.n_controlled == 0:
        return state
    earlier = {record.id: record.state for record in before.reconstructors}
    for record in state.reconstructors:
        wait_s = _wait_after(record, earlier.get(record.id), event)
        if wait_s is not None and record.n_modes > rtc.n_controlled:
            reason = f"{record.id} was {record.state}: {record.reason}"
            state = limited(state, rtc.n_controlled, reason, now_ns, wait_s)
    return state


def _wait_after(
    record: ReconstructorRecord, earlier: MatrixState | None, event: Event
) -> float | None:
    """Return for how long more modes are not tried after what became of one; None: no matter."""
    if earlier is None or earlier is record.state:
        return None
    if record.state in _DECLINED:
        return FIRST_WAIT_S
    if record.state is MatrixState.DISCARDED and isinstance(event, Reject):
        return OPERATORS_WAIT_S
    return None


def limited(
    state: TrackerState,
    n_modes: int,
    reason: str,
    now_ns: int,
    first_wait_s: float = FIRST_WAIT_S,
) -> TrackerState:
    """Try no more than these for a while, longer each time that it is found again."""
    before, wait_s = state.mode_limit, first_wait_s
    if before is not None and now_ns - before.since_ns_utc < FORGIVEN_AFTER_S * SECOND_NS:
        left_s = (before.until_ns_utc - now_ns) / SECOND_NS
        wait_s = max(first_wait_s, min(2.0 * before.wait_s, LONGEST_WAIT_S), left_s)
    limit = ModeLimit(
        n_modes=n_modes,
        since_ns_utc=now_ns,
        until_ns_utc=now_ns + round(wait_s * SECOND_NS),
        wait_s=wait_s,
        reason=reason,
    )
    text = f"no more than {n_modes} modes for {wait_s:.0f} s: {reason}"
    return logged(replace(state, mode_limit=limit), "modes.limited", text, now_ns)
