"""Request that a lens or stage moves the mirror's image back.

Some telescopes move a lens or a stage instead of the matrix, or in addition. A demand is a change
of α. The reply confirms it and states when the image is at rest. From then on α is expected at the
new registration, with the uncertainty of a device that follows to some tenths, and windows must
confirm it before anything else is requested or computed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, step_text, wrap_angle
from service.records import events as ev
from service.records.alarms import Interlock
from service.records.registration import Offload, OffloadState, Purpose, Registration, Validity
from service.records.state import Mode, TrackerState
from service.tracking import validity
from service.tracking.policy import SECOND_NS, Offloading
from service.tracking.step_context import StepContext
from service.tracking.update_policy import REFUSED_INTERVAL_S, is_settled
from service.tracking.validity import MOVING, end_of, make_valid, void_until
from service.wire import OffloadRequest, Reply, Status

OFFLOAD_ERROR_SIGMA = 0.3
"""1 σ of the relative error with which a device follows a demand."""

CROSS_TALK_SIGMA = 0.05
"""1 σ of what a step of one axis does to another, in limits of a step."""

MAX_STEPS_BEHIND = 1.5
"""Steps by which α may leave the registration that the matrix in use was made for."""

MAX_MOVE_DURATION_S = 50.0
"""Longest move that a reply may announce; telemetry of a minute ago may be of another clock."""

MAX_STATUS_AGE_S = 1.0
"""Largest age of the last status, whose clock gives the end of a move."""

Array = NDArray[np.float64]


def request_offload(context: StepContext) -> None:
    """Ask for a move where α is known well enough and too far from the nominal registration."""
    limits, registration, rtc = context.policy.offloading, context.registration, context.rtc
    if limits is None or registration is None or rtc is None:
        return
    if not _may_move(context, registration, rtc, limits):
        return
    step = wanted_step(context.state, registration, context.nominal.vector, limits)
    if not step.any():
        return
    last = context.alpha.offload
    offload = Offload(
        id=f"offload-{context.now_ns}",
        step=step,
        total=np.zeros(4) if last is None else last.total,
        asked_ns_utc=context.now_ns,
        n_moves=0 if last is None else last.n_moves,
    )
    void_until(context, _clock_ns(context, limits.settle_s), MOVING)
    context.alpha = replace(context.alpha, offload=offload)
    named = dict(zip(PARAMETERS, (step * BOUNDARY_SCALE).tolist(), strict=True))
    context.ask(ev.Ask(request=OffloadRequest(id=offload.id, **named)))
    context.log("offload.asked", f"{offload.id}: α is to change by {step_text(step)}")


def wanted_step(
    state: TrackerState, registration: Registration, start: Array, limits: Offloading
) -> Array:
    """Return the change of α to request ``(4,)``, numeric units; 0 for none.

    A step never takes α further from the registration of the matrix in use than the loop tolerates.
    The rest is left to the next matrix.
    """
    alpha = registration.alpha.vector
    off = _apart(alpha, start)
    step = np.clip(-limits.share * off, -limits.max_step, limits.max_step)
    done = np.zeros(4) if state.alpha.offload is None else state.alpha.offload.total
    # The travel limits the sum of all moves, not a single one.
    step = np.clip(done + step, -limits.travel, limits.travel) - done
    made_for = start if state.used is None or state.used.alpha is None else state.used.alpha.vector
    before, after = (np.abs(_apart(at, made_for)) for at in (alpha, alpha + step))
    allowed = np.maximum(before, MAX_STEPS_BEHIND * limits.max_step)
    idle = (np.abs(off) <= limits.near) | (after > allowed) | (limits.travel == 0.0)
    return np.where(idle, 0.0, step)


def on_answer(context: StepContext, request: OffloadRequest, reply: Reply) -> None:
    """Expect α where the device has moved it, or note that it has not."""
    offload, limits, rtc = context.alpha.offload, context.policy.offloading, context.rtc
    if offload is None or limits is None or offload.id != request.id:
        return
    if not reply.accepted:
        # The image has not moved: the telemetry since the request is a measurement after all.
        make_valid(context, Purpose.MEASURE, MOVING)
        refused = replace(offload, state=OffloadState.REFUSED, text=reply.reason)
        context.alpha = replace(context.alpha, offload=refused)
        context.warn("offload.refused", f"{offload.id}: {reply.reason}")
        return
    lasts_s = limits.settle_s
    if reply.start_seq is not None and rtc is not None and rtc.seq is not None:
        until_s = (reply.start_seq - rtc.seq) / rtc.frame_rate_hz
        # The frame may be in the past already, and a wrong one must not void telemetry for hours.
        lasts_s = min(max(until_s, 0.0), MAX_MOVE_DURATION_S)
    moved = replace(offload, state=OffloadState.MOVED, text="", n_moves=offload.n_moves + 1)
    _expect(context, moved, limits, _clock_ns(context, lasts_s))
    context.log("offload.moved", f"{offload.id}: α is expected {step_text(offload.step)} away")


def on_failure(context: StepContext, request: OffloadRequest, text: str) -> None:
    """Record that the RTC did not reply, so that the image may or may not have moved."""
    offload, limits = context.alpha.offload, context.policy.offloading
    if offload is not None and limits is not None and offload.id == request.id:
        _note_failure(context, offload, limits, text)


def _note_failure(context: StepContext, offload: Offload, limits: Offloading, text: str) -> None:
    still_ns = max(end_of(context.state, MOVING), _clock_ns(context, limits.settle_s))
    failed = replace(offload, state=OffloadState.FAILED, text=text)
    _expect(context, failed, limits, still_ns)
    context.warn("offload.failed", f"{offload.id}: {text}; whether it was made must be measured")


def _expect(context: StepContext, offload: Offload, limits: Offloading, still_ns: int) -> None:
    """Store a move that was, or may have been, made, and expect α where it leads."""
    known = offload.state is OffloadState.MOVED
    # Without a reply α is left where it was, and the whole step is its uncertainty.
    step, error_sigma = (offload.step, OFFLOAD_ERROR_SIGMA) if known else (np.zeros(4), 1.0)
    # An axis that is never moved may have a largest step of 0.
    share = np.abs(offload.step) / np.maximum(limits.max_step, 1e-12)
    cross_talk = CROSS_TALK_SIGMA * share.max() * limits.max_step
    void_until(context, still_ns, MOVING)
    # The travel of the device is limited, whether or not its reply has arrived.
    done = replace(offload, total=offload.total + offload.step)
    context.alpha = replace(context.alpha, offload=done)
    spread = error_sigma * np.abs(offload.step) + cross_talk
    validity.shift_estimate(context, step, spread, still_ns)


def restore_offload(context: StepContext, offload: Offload) -> None:
    """Take over the last demand of the service before; one without a reply may have been made.

    A service that asks for no moves forgets it: somebody may bring the device elsewhere meanwhile.
    """
    limits = context.policy.offloading
    if limits is None:
        return
    context.alpha = replace(context.alpha, offload=offload)
    if offload.state is OffloadState.ASKED:
        _note_failure(context, offload, limits, "the service ended before the reply came")


def _may_move(
    context: StepContext, registration: Registration, rtc: Status, limits: Offloading
) -> bool:
    """Return whether α is beyond doubt, nothing else is under way, and no alarm forbids it."""
    state, last = context.state, context.alpha.offload
    if state.operator.mode is not Mode.AUTO or state.on_probation or not rtc.in_loop:
        return False
    if context.blocking_alarm(Interlock.SEND_NEW) or state.noisy_measurement is not None:
        return False
    sure = is_settled(registration) and registration.validity.level is Validity.FRESH
    if not sure or np.any(np.sqrt(np.diag(registration.covariance)) > limits.near):
        return False
    if state.matrices.making_since_ns_utc is not None or state.sent is not None:
        return False
    if last is None:
        return True
    # A demand without a reply is awaited.
    moved = last.state is OffloadState.MOVED
    pause_s = context.policy.minimum_interval_s if moved else REFUSED_INTERVAL_S
    return context.now_ns >= last.asked_ns_utc + round(pause_s * SECOND_NS)


def _clock_ns(context: StepContext, after_s: float) -> int:
    """Return the RTC's clock so long after now, at the latest; 0: unknown."""
    if context.rtc is None:
        return 0
    # The RTC's clock has run on since its last status.
    return context.rtc.t_ns + round((MAX_STATUS_AGE_S + after_s) * SECOND_NS)


def _apart(alpha: Array, other: Array) -> Array:
    apart = alpha - other
    # Rotations are compared by the shorter turn.
    apart[2] = wrap_angle(float(apart[2]))
    return np.asarray(apart)
