"""Age and validity of α, and the intervals of telemetry that are void.

A window is fitted seconds after it was taken, later if the worker is busy, when the cause that
spoilt it may be over. Whatever spoils telemetry therefore leaves an interval, by the RTC's clock:
telemetry that began before its end is void for the interval's purpose, whenever it is processed. An
interval has no beginning, because the beginning of a disturbance is known only as accurately as its
detector is fast.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.records.alarms import STALE, TELEMETRY_OLD, Interlock, alarm_blocks
from service.records.estimates import LockInEstimate, PassiveEstimate, RandomEstimate
from service.records.registration import (
    PassiveBias,
    Purpose,
    Registration,
    Validity,
    ValidityState,
    VoidInterval,
)
from service.records.state import TrackerState
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext
from service.wire import Pointing

_POINTINGS_KEPT = 120
_TURNED_DEG = 0.05
"""Rotation of the telescope after which another point of its path is recorded."""

AGEING_SHARE = 0.5
"""Share of the stale limit from which on α is ageing."""

STALE_END_SHARE = 0.8
"""Share of the stale limit that σ must be below before α is stale no more: one that wavers about
the limit does not come and go."""

N_FIRST_WINDOWS = 5
"""Windows that a faint star needs until σ is within its limit for the first time,"""

FIRST_WINDOWS_INTERVAL_S = 10.0
"""as long as they follow one another within this: σ shrinks then, and is no alarm."""

MAX_SUSPICION_S = 60.0
"""A jump that nothing has confirmed or denied for so long is no longer waited for."""

CLOCK_SET_BACK_S = 60.0
"""Telemetry is never so much older than what is known: the RTC's clock has gone back."""

MAX_TELEMETRY_AGE_S = 600.0
"""Telemetry older than this is worked out no more."""

INTERVALS_KEPT = 16

MOVING = "the mirror's image was being moved"
BOTH_SIDES = "its telemetry may be from both sides of a jump"
BEFORE_DOUBT = (
    "it began before α came into doubt and agrees with the α of that time: only a window taken "
    "since then can decide"
)

_ROUNDING_NS = 1_000_000
"""A window that follows another begins where that one ends, but for the rounding of a frame."""

LEAPT = "the pointing law leapt, and no window has confirmed α since"
"""Doubt about α, which is then a prediction."""

_WORTHLESS = (Validity.STALE, Validity.PREDICTED, Validity.INVALID)

Array = NDArray[np.float64]

EstimateT = TypeVar("EstimateT", bound=LockInEstimate | PassiveEstimate | RandomEstimate)


def note_pointing(context: StepContext, pointing: Pointing | None) -> None:
    """Record the pointing of the telescope and its path; None if it is not reported."""
    if pointing is None:
        return
    way, t_ns = context.alpha.pointings, 0 if context.rtc is None else context.rtc.t_ns
    if not way or separation_deg(way[-1][1], pointing) >= _TURNED_DEG:
        way = (*way, (t_ns, pointing))[-_POINTINGS_KEPT:]
    context.alpha = replace(context.alpha, pointing=pointing, pointings=way)


def pointing_at(state: TrackerState, t_ns_utc: int) -> Pointing | None:
    """Return the pointing at a time of the RTC's clock, as far as known."""
    later = [place for place in state.alpha.pointings if place[0] > t_ns_utc]
    if not later:
        return state.alpha.pointing
    # A report is valid until the next one.
    earlier = state.alpha.pointings[: len(state.alpha.pointings) - len(later)]
    return earlier[-1][1] if earlier else later[0][1]


def law_at(state: TrackerState, t_ns_utc: int) -> Misregistration | None:
    """Return the registration by the law at a time of the RTC's clock; None if unknown."""
    way = state.alpha.law.way
    later = next((k for k, (t_ns, _) in enumerate(way) if t_ns >= t_ns_utc), len(way))
    if not way:
        return state.alpha.law.nominal
    # Outside of the recorded path its nearest end counts: nothing is extrapolated.
    if later in {0, len(way)}:
        return way[min(later, len(way) - 1)][1]
    (before_ns, before), (after_ns, after) = way[later - 1], way[later]
    share = (t_ns_utc - before_ns) / (after_ns - before_ns)
    return before.add_step(share * before.step_to(after))


def at_present(
    state: TrackerState, estimate: EstimateT, began_ns_utc: int, ended_ns_utc: int
) -> EstimateT:
    """Return an estimate at the present pointing, made of telemetry of another."""
    now = state.alpha.law.nominal
    # A window measures the mean registration, which is that of its middle if the law is smooth.
    then = law_at(state, (began_ns_utc + ended_ns_utc) // 2)
    if now is None or then is None:
        return estimate
    return replace(estimate, alpha=estimate.alpha.add_step(then.step_to(now)))


def store_registration(context: StepContext, registration: Registration | None) -> None:
    """Take something for what is known of α."""
    context.alpha = replace(context.alpha, registration=registration)


def shift_estimate(context: StepContext, step: Array, spread: Array, still_ns_utc: int) -> None:
    """Shift the estimate of α because the mirror's image was moved; windows must confirm it.

    Parameters
    ----------
    context
        Context of the event.
    step, spread
        Shift ``(4,)`` and its 1 σ, numeric units.
    still_ns_utc
        Time at which the image has stopped moving, by the RTC's clock.
    """
    registration = context.registration
    if registration is None:
        return
    store_registration(
        context,
        replace(
            registration,
            alpha=registration.alpha.add_step(step),
            covariance=registration.covariance + np.diag(spread**2),
            n_windows=0,
            previous_estimate=None,
            suspected_jump=None,
            # The passive bias is of the loop and the wind: it does not move with the image.
            bias=without_previous(registration.bias),
        ),
    )
    void_until(context, still_ns_utc, MOVING, Purpose.PASSIVE)
    request_window(context, MOVING)
    age_registration(context)


def forget_registration(context: StepContext) -> None:
    """Know nothing of α any more, nor of what has been doubted of it."""
    make_valid(context, Purpose.PASSIVE)
    make_valid(context, Purpose.SETTLE)
    store_registration(context, None)


def in_subapertures(registration: Registration, scale: Array, config_id: str) -> Registration:
    """Return what is known of α in the subapertures of another mode of the sensor.

    ``scale`` ``(4,)`` multiplies its numbers. What was learnt of gains and biases was of the mode
    before.
    """
    known = registration.stretches
    return replace(
        registration,
        alpha=registration.alpha.with_vector(registration.alpha.vector * scale),
        covariance=registration.covariance * np.outer(scale, scale),
        # A stretch has no unit: only the columns of α in its covariance are scaled.
        stretches=known and replace(known, shared=known.shared * scale),
        floor=registration.floor * scale,
        image_floor=registration.image_floor * scale,
        grown=registration.grown * scale**2,
        optical_gain=None,
        optical_gains=(),
        bias=None,
        previous_estimate=None,
        suspected_jump=None,
        config_id=config_id,
        nominal=None,
    )


def require_new_windows(context: StepContext) -> None:
    """Require new windows to confirm the estimate."""
    if context.registration is not None:
        store_registration(context, replace(context.registration, n_windows=0))


def age_registration(context: StepContext) -> None:
    """Increase σ to the present time and update the validity of α."""
    registration = context.registration
    if registration is not None:
        registration = _without_old_suspicion(registration, context.now_ns)
        walked = context.policy.drift_rate**2 * elapsed_s(
            context.state, registration, context.now_ns
        )
        bent = flexure(registration.pointing, context.alpha.pointing, context.policy)
        registration = replace(registration, grown=walked + bent**2)
        standing = _validity_of(context, registration)
        if standing.level in _WORTHLESS:
            request_window(context, standing.reason)
        # The gate examines α ± 3σ: a large σ would reject any new matrix.
        elif context.dither is None and _too_wide_for_the_gate(context.state, registration):
            request_window(context, "σ has grown beyond what the stability gate accepts")
        store_registration(context, replace(registration, validity=standing))


def request_window(context: StepContext, reason: str) -> None:
    """Request a dithered window; a request that is pending keeps its start."""
    if context.alpha.dither_due_since_ns_utc is None:
        context.alpha = replace(
            context.alpha, dither_due_since_ns_utc=context.now_ns, dither_due_reason=reason
        )
        context.log("dither.due", reason)


def end_window_request(context: StepContext) -> None:
    """Note that the wish has been fulfilled."""
    context.alpha = replace(context.alpha, dither_due_since_ns_utc=None, dither_due_reason="")


def flexure(pointing_then: Pointing | None, now: Pointing | None, policy: Policy) -> Array:
    """Return ``(4,)`` 1 σ of flexure since then; 0 where the pointing is unknown."""
    if pointing_then is None or now is None:
        return np.zeros(4)
    return policy.flexure_per_degree * abs(now.elevation_deg - pointing_then.elevation_deg)


def slewed_deg(state: TrackerState, registration: Registration) -> float:
    """Return how far the telescope has moved since the last dithered window, degrees."""
    if state.alpha.pointing is None or registration.window_pointing is None:
        return 0.0
    return separation_deg(state.alpha.pointing, registration.window_pointing)


def elapsed_s(state: TrackerState, registration: Registration, now_ns: int) -> float:
    """Return the age of the estimate: by the RTC's clock if there is one, else by arrival.

    A simulated RTC may be slower than its timestamps, and the mirror drifts by its time. Statuses
    are as old as the telemetry: where that is old, arrival counts.
    """
    rtc, is_old = state.loop.rtc, state.alarm(TELEMETRY_OLD) is not None
    if rtc is not None and rtc.t_ns >= registration.t_ns_utc and not is_old:
        return (rtc.t_ns - registration.t_ns_utc) / SECOND_NS
    return max(now_ns - registration.arrived_ns_utc, 0) / SECOND_NS


def _validity_of(context: StepContext, registration: Registration) -> ValidityState:
    policy = context.policy
    reason = _explain_invalidity(context.state, registration, policy)
    if reason is not None:
        return ValidityState(level=Validity.INVALID, reason=reason)
    # A doubt of the watchdog may have replaced that of the law.
    if registration.doubt == LEAPT or (registration.doubt and context.alpha.law.leap is not None):
        return ValidityState(level=Validity.PREDICTED, reason=LEAPT)
    sigma, before = registration.tracking_sigma, context.before.alpha.registration
    limit = policy.stale_sigma
    if registration.n_windows == 0:
        return ValidityState(level=Validity.STALE, reason="no window has confirmed it yet")
    was_stale = before is not None and before.validity.level is Validity.STALE
    # Hysteresis: a σ near its limit must not raise and clear the alarm in turn.
    ends = STALE_END_SHARE if was_stale and before and before.n_windows else 1.0
    if np.any(sigma > ends * limit):
        return ValidityState(level=Validity.STALE, reason=_worst(sigma, limit))
    # No division by zero without a drift: α then never becomes stale.
    rate = np.maximum(policy.drift_rate**2, np.finfo(float).tiny)
    left_s = float(np.min((limit**2 - sigma**2) / rate))
    # a rate of zero never ends it; a century is beyond any night
    until_ns = context.now_ns + round(left_s * SECOND_NS) if left_s < 3e9 else None
    if np.any(sigma > AGEING_SHARE * limit):
        reason = _worst(sigma, AGEING_SHARE * limit)
        return ValidityState(level=Validity.AGEING, reason=reason, until_ns_utc=until_ns)
    return ValidityState(until_ns_utc=until_ns)


def _explain_invalidity(
    state: TrackerState, registration: Registration, policy: Policy
) -> str | None:
    """Return why α may be somewhere else altogether, or None."""
    if registration.doubt and registration.doubt_voids:
        return registration.doubt
    moved_deg = slewed_deg(state, registration)
    # With a pointing law α follows the slew.
    if moved_deg > policy.slew_limit_deg and registration.nominal is None:
        return f"the telescope has moved by {moved_deg:.0f} deg since the last dithered window"
    sigma = registration.tracking_sigma
    if np.any(sigma > policy.useless_sigma):
        return _worst(sigma, policy.useless_sigma)
    return None


def _worst(sigma: Array, limit: Array) -> str:
    worst = int(np.argmax(sigma / limit))
    most = limit[worst] * BOUNDARY_SCALE[worst]
    # the present value would make another alarm of it every second
    return f"1 sigma of {PARAMETERS[worst]}, less the model error, has grown beyond {most:.4g}"


def _without_old_suspicion(registration: Registration, now_ns: int) -> Registration:
    candidate = registration.suspected_jump
    if candidate is None or now_ns - candidate.held_ns_utc < MAX_SUSPICION_S * SECOND_NS:
        return registration
    doubt = "a window was far out, and none has come since"
    return replace(registration, suspected_jump=None, doubt=doubt, doubt_voids=True)


def stale_text(context: StepContext) -> str | None:
    """Return why α is not accurate enough for a closed loop, as its validity states it, or None."""
    registration, rtc = context.registration, context.rtc
    if registration is None or rtc is None or not rtc.in_loop or registration.n_windows == 0:
        return None
    if context.alarm_text(STALE) is None and _sharpens(registration, context.now_ns):
        return None
    if registration.validity.level in _WORTHLESS and not registration.doubt:
        return f"{registration.validity.reason}: have it dithered"
    return None


def _sharpens(registration: Registration, now_ns: int) -> bool:
    """Return whether σ is above its limit because only the first windows have come so far."""
    since_s = (now_ns - registration.window_ns_utc) / SECOND_NS
    few = registration.n_windows < N_FIRST_WINDOWS and since_s < FIRST_WINDOWS_INTERVAL_S
    return few and registration.validity.level is Validity.STALE


def _too_wide_for_the_gate(state: TrackerState, registration: Registration) -> bool:
    """Return whether the margin is short only because σ has grown since the last window."""
    margin = state.matrices.margin
    # an edge that would slip is refused whatever σ is
    if margin is None or margin.worst_pole_radius <= margin.bound:
        return False
    own = np.sqrt(np.diag(registration.covariance) + registration.floor**2)
    return bool(np.any(registration.sigma > 2.0 * own))


def separation_deg(one: Pointing, other: Pointing) -> float:
    """Return the angle on the sky between two directions, degrees."""
    # Rounding may take the product of equal directions beyond 1, where arccos is NaN.
    return float(np.rad2deg(np.arccos(np.clip(_unit(one) @ _unit(other), -1.0, 1.0))))


def _unit(pointing: Pointing) -> NDArray[np.float64]:
    elevation, azimuth = np.deg2rad([pointing.elevation_deg, pointing.azimuth_deg])
    across = np.cos(elevation)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


def precedes(state: TrackerState, began_ns_utc: int, since_ns_utc: int) -> bool:
    """Return True if telemetry began before a time, so that it contains earlier states.

    Both are times of the RTC's clock.
    """
    rtc = state.loop.rtc
    # A time so far in the future is of before the RTC's clock was set back: it voids nothing.
    if rtc is not None and since_ns_utc - rtc.t_ns > CLOCK_SET_BACK_S * SECOND_NS:
        return False
    return began_ns_utc < since_ns_utc - _ROUNDING_NS


def explain_void(
    state: TrackerState, began_ns_utc: int, purpose: Purpose = Purpose.MEASURE
) -> str | None:
    """Return why telemetry that began then is void for a purpose, or None.

    What is the matter now is asked of the alarms.
    """
    of_purpose = (each for each in state.alpha.void_intervals if each.purpose is purpose)
    covers = (each for each in of_purpose if precedes(state, began_ns_utc, each.until_ns_utc))
    return next((each.because for each in covers), None)


def end_of(state: TrackerState, because: str) -> int:
    """Return until when telemetry is void for a reason, by the RTC's clock; 0: it is not."""
    ends = (v.until_ns_utc for v in state.alpha.void_intervals if v.because == because)
    return max(ends, default=0)


def void_until(
    context: StepContext, until_ns_utc: int, because: str, purpose: Purpose = Purpose.MEASURE
) -> None:
    """Make telemetry void that began before a time of the RTC's clock.

    It takes the place of what is void for the same reason already.
    """
    new = VoidInterval(until_ns_utc=until_ns_utc, because=because, purpose=purpose)
    others = [
        each
        for each in context.alpha.void_intervals
        if (each.purpose, each.because) != (purpose, because)
        # Telemetry that old is no longer on its way: intervals that ended before it are forgotten.
        and until_ns_utc - each.until_ns_utc <= MAX_TELEMETRY_AGE_S * SECOND_NS
    ]
    _store_intervals(context, [*others, new][-INTERVALS_KEPT:])


def make_valid(context: StepContext, purpose: Purpose, because: str | None = None) -> None:
    """Make telemetry void no more for a purpose: for this reason, or for any (None)."""
    kept = [
        each
        for each in context.alpha.void_intervals
        if each.purpose is not purpose or because not in {None, each.because}
    ]
    _store_intervals(context, kept)


def restore_intervals(context: StepContext, intervals: Iterable[VoidInterval]) -> None:
    """Take over what was void before a restart of the service."""
    _store_intervals(context, intervals)


def cast_doubt(context: StepContext, since_ns_utc: int) -> None:
    """Let no window settle the doubt that began before what has cast it, or has done so before."""
    # void_until replaces the interval of the same reason, so that the later end must be kept here.
    until_ns = max(end_of(context.state, BEFORE_DOUBT), since_ns_utc)
    void_until(context, until_ns, BEFORE_DOUBT, Purpose.SETTLE)


def invalidate_telemetry(context: StepContext, because: str, t_ns_utc: int = 0) -> None:
    """Note that nothing taken until now is a measurement any more.

    ``t_ns_utc`` is the RTC's clock now, where it is known better than by its status.
    """
    until_ns = max(t_ns_utc, 0 if context.rtc is None else context.rtc.t_ns)
    if until_ns:  # else no clock is known that tells more than what is void already
        void_until(context, until_ns, because)


def end_alarm(context: StepContext, name: str, t_ns_utc: int = 0) -> None:
    """End an alarm; telemetry that it was of stays what it was."""
    alarm = context.state.alarm(name)
    context.clear_alarm(name)
    if alarm is not None and alarm_blocks(alarm, Interlock.MEASURE):
        invalidate_telemetry(context, alarm.definition.because, t_ns_utc)


def is_since_alarm(state: TrackerState, name: str, began_ns_utc: int) -> bool:
    """Return whether telemetry began since this alarm was raised, or there is no such alarm."""
    alarm = state.alarm(name)
    return alarm is None or not precedes(state, began_ns_utc, alarm.t_ns_utc)


def _store_intervals(context: StepContext, intervals: Iterable[VoidInterval]) -> None:
    kept = tuple(intervals)
    if kept != context.alpha.void_intervals:
        context.alpha = replace(context.alpha, void_intervals=kept)


def without_previous(bias: PassiveBias | None) -> PassiveBias | None:
    """Return the bias without what was known before its last update: it is out of date."""
    return bias and replace(bias, previous_estimate=None)
