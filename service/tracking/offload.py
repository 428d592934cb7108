"""Correction by moving: the mirror's image is asked back to where it was drawn, step by step.

Some telescopes move a lens or a stage instead of the matrix, or beside it. A demand is a change of
α. The reply tells that it was made, and when the image stands still: α is expected at the new
place from then on, with the doubt of a device that does as it is told to some tenths, and windows
must confirm it before anything else is asked for or made.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, step_text, wrapped
from service.tracking import events as ev
from service.tracking import validity
from service.tracking.activity import ramping
from service.tracking.alarms import Act
from service.tracking.policy import SECOND_NS, Offloading, Policy
from service.tracking.registration import Move, MoveState, Registration, Validity
from service.tracking.state import Mode, TrackerState
from service.tracking.turn import Turn
from service.tracking.worth import settled
from service.wire import OffloadRequest, Reply, Status

DISOBEDIENCE = 0.3
"""1 σ of what a device does over what it was asked for, less 1."""

CROSS_TALK = 0.05
"""1 σ of what a step of one axis does to another, in limits of a step."""

BEHIND = 1.5
"""Steps by which α may leave the registration that the matrix in use was made for."""

LONGEST_S = 50.0
"""Of a move by its reply; telemetry of a minute ago is another clock's."""

STATUS_S = 1.0
"""So old the last status may be, by whose clock the end of a move is told."""

Array = NDArray[np.float64]


def demand(turn: Turn) -> None:
    """Ask for a move where α is known well enough and too far from the nominal registration."""
    limits, known, rtc = turn.policy.offloading, turn.known, turn.rtc
    if limits is None or known is None or rtc is None or not _may_move(turn, known, rtc, limits):
        return
    step = wanted(turn.state, known, turn.policy.start.vector, limits)
    if not step.any():
        return
    last = turn.state.move
    move = Move(
        id=f"offload-{turn.now_ns}",
        step=step,
        total=np.zeros(4) if last is None else last.total,
        asked_ns_utc=turn.now_ns,
        n_moves=0 if last is None else last.n_moves,
        still_ns_utc=_clock_ns(turn, limits.settle_s),
    )
    turn.state = replace(turn.state, move=move)
    named = dict(zip(PARAMETERS, (step * BOUNDARY_SCALE).tolist(), strict=True))
    turn.ask(ev.Ask(request=OffloadRequest(id=move.id, **named)))
    turn.log("offload.asked", f"{move.id}: α is to change by {step_text(step)}")


def wanted(state: TrackerState, known: Registration, start: Array, limits: Offloading) -> Array:
    """Return by how much α is to change ``(4,)``, numeric units; 0: by nothing.

    A step never takes α further from what the matrix in use was made for than the loop may stand:
    the rest waits for the next matrix.
    """
    alpha = known.alpha.vector
    off = _apart(alpha, start)
    step = np.clip(-limits.share * off, -limits.most_step, limits.most_step)
    done = np.zeros(4) if state.move is None else state.move.total
    step = np.clip(done + step, -limits.reach, limits.reach) - done
    used = state.reconstructor(state.in_use) if state.in_use else None
    made_for = start if used is None or used.alpha is None else used.alpha.vector
    before, after = (np.abs(_apart(at, made_for)) for at in (alpha, alpha + step))
    allowed = np.maximum(before, BEHIND * limits.most_step)
    idle = (np.abs(off) <= limits.near) | (after > allowed) | (limits.reach == 0.0)
    return np.where(idle, 0.0, step)


def on_answer(turn: Turn, request: OffloadRequest, reply: Reply) -> None:
    """Expect α where the device has moved it, or note that it has not."""
    move, limits, rtc = turn.state.move, turn.policy.offloading, turn.rtc
    if move is None or limits is None or move.id != request.id:
        return
    if not reply.accepted:
        _end(turn, replace(move, still_ns_utc=0), MoveState.REFUSED, reply.reason)
        turn.warn("offload.refused", f"{move.id}: {reply.reason}")
        return
    lasts_s = limits.settle_s
    if reply.start_seq is not None and rtc is not None and rtc.seq is not None:
        until_s = (reply.start_seq - rtc.seq) / rtc.frame_rate_hz
        lasts_s = min(max(until_s, 0.0), LONGEST_S)
    spread = DISOBEDIENCE * np.abs(move.step) + _cross_talk(move.step, limits)
    still_ns = _clock_ns(turn, lasts_s)
    done = replace(move, total=move.total + move.step, n_moves=move.n_moves + 1)
    _end(turn, replace(done, still_ns_utc=still_ns), MoveState.MOVED, "")
    validity.displace(turn, move.step, spread, still_ns)
    turn.log("offload.moved", f"{move.id}: α is expected {step_text(move.step)} away")


def on_failure(turn: Turn, name: str, text: str) -> None:
    """Know no more whether the image has moved: no reply came."""
    move, limits = turn.state.move, turn.policy.offloading
    if move is None or limits is None or move.id != name:
        return
    still_ns = max(move.still_ns_utc, _clock_ns(turn, limits.settle_s))
    _end(turn, replace(move, still_ns_utc=still_ns), MoveState.FAILED, text)
    spread = np.abs(move.step) + _cross_talk(move.step, limits)
    validity.displace(turn, np.zeros(4), spread, still_ns)
    turn.warn("offload.failed", f"{move.id}: {text}; whether it was made must be measured")


def go_on(turn: Turn, move: Move) -> None:
    """Take over the last demand of the service before; one without a reply may have been made.

    A service that asks for no moves forgets it: somebody may bring the device elsewhere meanwhile.
    """
    if turn.policy.offloading is None:
        return
    turn.state = replace(turn.state, move=move)
    if move.state is MoveState.ASKED:
        on_failure(turn, move.id, "the service ended before the reply came")


def _may_move(turn: Turn, known: Registration, rtc: Status, limits: Offloading) -> bool:
    """Return whether α is beyond doubt, nothing else is under way, and nobody forbids it."""
    state, last = turn.state, turn.state.move
    if state.mode is not Mode.AUTO or state.on_probation or not rtc.in_loop:
        return False
    if any(turn.forbidden(act) for act in (Act.ASK, Act.DECIDE, Act.SEND_NEW)):
        return False
    sure = settled(known) and not known.doubt and known.standing.validity is Validity.FRESH
    if not sure or np.any(np.sqrt(np.diag(known.covariance)) > limits.near):
        return False
    if state.making_since_ns_utc is not None or any(r.on_its_way for r in state.reconstructors):
        return False
    if state.gathering is not None or ramping(state, turn.now_ns) is not None:
        return False
    return last is None or turn.now_ns >= last.asked_ns_utc + _rest_ns(last, turn.policy)


def _rest_ns(last: Move, policy: Policy) -> int:
    """Return how long nothing is asked for after a demand; one without an answer is awaited."""
    if last.state is MoveState.MOVED:
        return round(policy.minimum_interval_s * SECOND_NS)
    return round(policy.refused_interval_s * SECOND_NS)


def _clock_ns(turn: Turn, after_s: float) -> int:
    """Return the RTC's clock so long after now, at the latest; 0: no RTC tells it."""
    return 0 if turn.rtc is None else turn.rtc.t_ns + round((STATUS_S + after_s) * SECOND_NS)


def _end(turn: Turn, move: Move, state: MoveState, text: str) -> None:
    turn.state = replace(turn.state, move=replace(move, state=state, text=text))


def _cross_talk(step: Array, limits: Offloading) -> Array:
    """Return ``(4,)`` 1 σ of what a step may do to the axes that it does not mean."""
    share = np.abs(step) / np.maximum(limits.most_step, 1e-12)
    return np.asarray(CROSS_TALK * share.max() * limits.most_step)


def _apart(alpha: Array, other: Array) -> Array:
    apart = alpha - other
    apart[2] = wrapped(float(apart[2]))
    return np.asarray(apart)
