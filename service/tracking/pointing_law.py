"""Follow the law of pointing: α moves as it says, and the filter follows the deviation from it.

All that is known of α is carried along when the law moves, and an estimate is brought from the
pointing of its telemetry to the present one. So what the filter compares is deviations from the
law, whatever the telescope does meanwhile.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.misregistration import Misregistration, step_text
from service.model.pointing_law import ANGLES, PointingLaw, Reported
from service.records.messages import Message, compose
from service.records.registration import (
    LawLeap,
    LawState,
    PointedEstimate,
    PreviousEstimate,
    Purpose,
    Registration,
    TimedEstimate,
)
from service.records.state import TrackerState
from service.tracking import jumps, validity
from service.tracking.operations.acquisition import carry_alpha
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext

Array = NDArray[np.float64]

PATH_SPACING_NS = SECOND_NS // 2
"""Spacing of the recorded points of the path; between them it is interpolated linearly."""

MAX_PATH_POINTS = 240

MAX_STEP = np.array([0.5, 0.5, np.deg2rad(3.0), 0.02])
"""Largest step of a law at once, and per second in addition, numeric units. Telescopes turn by a
few degrees a second at most; a larger step is an error of the reported values."""

MAX_STEP_AT_REST = np.array([0.03, 0.03, np.deg2rad(0.1), 0.002])
"""Largest step of a law that has been at rest, numeric units: a matrix hardly suffers from it."""

MOTION_MEMORY_S = 12.0
"""Time in which a motion is forgotten, so that a report every ten seconds shows one."""

USUAL_STEP_RATIO = 2.0
"""Largest ratio of a step of a motion to those before."""

STEP_PER_DEG = np.array([0.2, 0.2, np.deg2rad(3.0), 0.004])
"""Step per degree that the telescope turns up to which α is moved at once, numeric units. Near the
zenith a field turns faster than the azimuth, and a pupil that turns about a point ten subapertures
away moves by 0.17."""

LEAP_CONFIRMATION_S = 3.0
"""A leap out of reach of a fit is taken after this time: no window could be fitted from before it.
"""

MATRIX_LEAD_S = 6.0
"""A matrix is made for the law so far ahead: it is judged and sent in half of that."""

MAX_LEAD_STEP = np.array([0.2, 0.2, np.deg2rad(0.5), 0.008])
"""A law that moves further in that time is of a telescope that slews, numeric units."""

RATE_INTERVAL_NS = 2 * SECOND_NS
"""Over so long the rate of the law is taken."""

MAX_WINDOW_MOTION = np.array([0.1, 0.1, np.deg2rad(0.3), 0.004])
"""A window in which the law moved further belongs to no single registration."""


def follow_law(context: StepContext) -> None:
    """Note where the law has the mirror now, and carry along what is known of α.

    A step of the law that no motion explains is a leap: α stays where it is, or is moved, and
    nothing is made from it until a window has shown on which side of the leap the mirror is.
    """
    law = context.policy.law
    if law is None:
        return
    reported = _reported_values(context)
    now = _nominal(context, law, reported)
    if isinstance(now, str):
        # The last nominal registration is kept: a missing report is no motion of the telescope.
        _set(context, replace(context.alpha.law, problem=now))
        return
    _forget_decided(context)
    before, registration = context.alpha.law, context.registration
    used = sorted((name, reported[name]) for name in law.names)
    _set(context, replace(before, problem="", reported=tuple(used)))
    # After a restart the law may be elsewhere than when α was saved.
    known = None if registration is None else registration.nominal
    place, leap = before.nominal or known, before.leap
    step = np.zeros(4) if place is None else place.step_to(now)
    returned = leap is not None and np.all(np.abs(np.array(leap.step) + step) <= MAX_STEP_AT_REST)
    if leap is not None and (returned or _goes_on(context, law, leap, dict(before.reported), now)):
        _end_leap(context, wrong=bool(returned))
        _carry(context, now, step if leap.taken else np.array(leap.step) + step)
    elif np.any(np.abs(step) > MAX_STEP_AT_REST + USUAL_STEP_RATIO * _usual_step(context)):
        _leap(context, before, now, step)
        return
    else:
        _carry(context, now, step)
    if np.any(step) and not returned:
        usual = np.maximum(_usual_step(context), np.abs(step)).tolist()
        state = context.alpha.law
        _set(context, replace(state, usual_step=tuple(usual), usual_ns_utc=context.now_ns))


def begin_law(context: StepContext) -> None:
    """Forget the way of the law: the sensor's subapertures are others."""
    _set(context, LawState())


def start_of_fit(
    state: TrackerState, alpha: Misregistration | None, t_ns_utc: int
) -> Misregistration | None:
    """Return where α of now, or the nominal registration, lay at a time of the RTC's clock."""
    now, then = state.alpha.law.nominal, validity.law_at(state, t_ns_utc)
    if now is None or then is None:
        return alpha
    return then if alpha is None else alpha.add_step(now.step_to(then))


def registration_ahead(state: TrackerState, registration: Registration) -> Registration:
    """Return what a matrix is to be made for: α half its life ahead, and σ for all of it.

    The returned α ± 3σ contains the present α ± 3σ and that at twice ``MATRIX_LEAD_S`` from now, as
    the law moves.
    Nothing can be made for a slew: then, and where nothing moves, it is what is known now.
    """
    step = MATRIX_LEAD_S * _rate(state)
    # A step this large is a slew, for which no matrix can be made.
    if not step.any() or np.any(np.abs(step) > MAX_LEAD_STEP):
        return registration
    third, sigma = np.abs(step) / 3.0, registration.sigma
    added = third**2 + 2.0 * sigma * third  # the root of σ² and this is σ and a third
    return replace(
        registration,
        alpha=registration.alpha.add_step(step),
        covariance=registration.covariance + np.diag(added),
    )


def _rate(state: TrackerState) -> Array:
    """Return how the law moves ``(4,)``, numeric units a second.

    It is the slower one of two halves of the last seconds: a single step is no motion.
    """
    way = state.alpha.law.way
    length_ns = min(RATE_INTERVAL_NS, way[-1][0] - way[0][0]) if way else 0
    if length_ns < PATH_SPACING_NS:
        return np.zeros(4)
    ends = (validity.law_at(state, way[-1][0] - share * length_ns // 2) for share in (2, 1, 0))
    first, middle, last = (end or way[-1][1] for end in ends)
    halves = np.array([first.step_to(middle), middle.step_to(last)])
    slower = np.where(halves.prod(axis=0) > 0.0, np.abs(halves).min(axis=0), 0.0)
    return np.asarray(np.sign(halves[1]) * slower * (2.0 * SECOND_NS / length_ns))


def check_pointing_motion(
    state: TrackerState, began_ns_utc: int, ended_ns_utc: int
) -> Message | None:
    """Return why a window belongs to no single registration (the law moved within it), or None."""
    first, last = validity.law_at(state, began_ns_utc), validity.law_at(state, ended_ns_utc)
    if first is None or last is None:
        return None
    step = first.step_to(last)
    if np.all(np.abs(step) <= MAX_WINDOW_MOTION):
        return None
    return compose("window.law-moved", step=step_text(step))


def _nominal(context: StepContext, law: PointingLaw, reported: Reported) -> Misregistration | str:
    """Return the present registration by the law, or why it is unknown and what to do."""
    missing = sorted(law.names - reported.keys())
    if missing and context.alpha.pointing is None:
        return (
            "the instrument file has a pointing law, but no pointing is reported; have the RTC "
            "report it in its status, or use PUT /v1/pointing; until then α is followed without "
            "the law"
        )
    if missing:
        names = " and ".join(missing)
        return (
            f"the pointing law needs {names}, which is not reported; use PUT /v1/values/"
            f"{missing[0]}; until then α is followed without the law"
        )
    try:
        found = law.at(reported)
    except ModelError as error:
        return f"the pointing law gives no registration: {error}; correct [law] or what is reported"
    modes = context.policy.sensor_modes
    scale = context.policy.alpha_scale(next(iter(modes), None), context.loop.config_id)
    return found if scale is None else Misregistration.from_vector(found.vector * scale)


def _reported_values(context: StepContext) -> Reported:
    """Return the numbers that a law may be of."""
    values = {
        value.name: float(value.value)
        for value in context.alarms.observatory_values
        # Not isinstance: a bool is an int, but no number of a law.
        if context.now_ns < value.until_ns_utc and type(value.value) in {int, float}
    }
    pointing = context.alpha.pointing
    if pointing is None:
        return values
    return values | {"azimuth": pointing.azimuth_deg, "elevation": pointing.elevation_deg}


def _usual_step(context: StepContext) -> Array:
    """Return the size ``(4,)`` of recent steps of the law, numeric units; 0: it was at rest."""
    law = context.alpha.law
    since_s = max(context.now_ns - law.usual_ns_utc, 0) / SECOND_NS
    return np.array(law.usual_step) * math.exp(-since_s / MOTION_MEMORY_S)


def _goes_on(
    context: StepContext, law: PointingLaw, leap: LawLeap, was: Reported, now: Misregistration
) -> bool:
    """Return whether a leap was the beginning of a motion.

    The next step is as far, to a factor of 3, and so is the one that the law would make after it if
    what it depends on went on: at the edge of a table it would not.
    """
    state, since_ns = context.alpha.law, context.now_ns - leap.since_ns_utc
    further = {name: 2.0 * value - was.get(name, value) for name, value in state.reported}
    then = _nominal(context, law, further)
    late = since_ns > MOTION_MEMORY_S * SECOND_NS
    if leap.far or late or isinstance(then, str) or state.nominal is None:
        return False
    first = np.array(leap.step) / MAX_STEP**2
    steps = state.nominal.step_to(now), now.step_to(then)
    length, *along = (float(first @ step) for step in (np.array(leap.step), *steps))
    return all(length < 3.0 * each < 9.0 * length for each in along)


def _leap(context: StepContext, before: LawState, now: Misregistration, step: Array) -> None:
    """Move the law by a step that no motion explains, and have a window decide about α."""
    was, leap, begins = dict(before.reported), before.leap, before.nominal is None
    since_s = (context.now_ns - before.worked_out_ns_utc) / SECOND_NS
    # A clock that was set back must not reduce what is allowed at once.
    far = bool(np.any(np.abs(step) > MAX_STEP * (1.0 + max(since_s, 0.0))))
    moves = [
        (name, was.get(name, value), value)
        for name, value in context.alpha.law.reported
        if was.get(name, value) != value
    ]
    # From 359 to 1 deg the telescope turns by 2 deg.
    turned_deg = sum(abs(math.remainder(b - a, 360.0)) for name, a, b in moves if name in ANGLES)
    turns = bool(np.all(np.abs(step) <= MAX_STEP_AT_REST + STEP_PER_DEG * turned_deg))
    taken = begins or (turns and not far and (leap is None or leap.taken))
    _carry(context, now, step if taken else np.zeros(4))
    registration = context.registration
    if registration is None:
        return
    if leap is not None and leap.taken is taken:
        step = step + np.array(leap.step)
    because = " and ".join(f"{name} went from {a:.6g} to {b:.6g}" for name, a, b in moves)
    text = (
        f"the pointing law moves α by {step_text(step)} at once, because "
        f"{because or 'the service was away'}. α {'follows' if taken else 'stays'}, and no "
        "reconstructor is made from it until a window has shown where the mirror is. If such a "
        "value is an angle that begins anew, give its table period = 360 and equal values at both "
        "ends; else check the program that reports it"
    )
    leap = LawLeap(
        step=tuple(step.tolist()), taken=taken, far=far, since_ns_utc=context.now_ns, text=text
    )
    _set(context, replace(context.alpha.law, leap=leap))
    doubted = replace(registration, doubt=validity.LEAPT, doubt_voids=False, suspected_jump=None)
    validity.store_registration(context, doubted)
    t_ns = 0 if context.rtc is None else context.rtc.t_ns
    validity.cast_doubt(context, t_ns)
    validity.void_until(context, t_ns, validity.LEAPT, Purpose.MEASURE)
    validity.request_window(context, validity.LEAPT)
    validity.age_registration(context)


def _end_leap(context: StepContext, *, wrong: bool) -> None:
    """End a leap that was a wrong report, or a motion: α is as sure as it was before."""
    # The mirror was never on the path to a wrong report.
    way = () if wrong else context.alpha.law.way
    _set(context, replace(context.alpha.law, leap=None, way=way))
    registration = context.registration
    if registration is not None and registration.doubt == validity.LEAPT:
        validity.store_registration(context, replace(registration, doubt=""))
        validity.make_valid(context, Purpose.SETTLE)
        validity.make_valid(context, Purpose.MEASURE, validity.LEAPT)
        validity.end_window_request(context)
        validity.age_registration(context)


def _forget_decided(context: StepContext) -> None:
    """Forget a leap of which a window has decided; take one that lasts where none can."""
    leap, registration = context.alpha.law.leap, context.registration
    if leap is None:
        return
    if registration is None or not registration.doubt:
        _set(context, replace(context.alpha.law, leap=None))
    elif leap.far and context.now_ns - leap.since_ns_utc >= LEAP_CONFIRMATION_S * SECOND_NS:
        change_side(context)


def decide_leap(context: StepContext, window: PointedEstimate) -> None:
    """Move α to the side of the law's leap that is nearer to a window."""
    leap, registration = context.alpha.law.leap, context.registration
    if leap is None or registration is None:
        return
    here, there = (
        jumps.window_innovation(each, window, context.policy).mahalanobis_squared
        for each in (registration, moved(registration, leap.other_side))
    )
    if there < here:
        change_side(context)


def change_side(context: StepContext) -> None:
    """Move α to the other side of the law's leap, where a fit may begin; it stays in doubt."""
    leap, registration = context.alpha.law.leap, context.registration
    if leap is not None and registration is not None:
        validity.store_registration(context, moved(registration, leap.other_side))
        other = replace(leap, taken=not leap.taken, far=False)
        _set(context, replace(context.alpha.law, leap=other))


def _carry(context: StepContext, now: Misregistration, step: Array) -> None:
    """Take this for nominal, and move what is known of α by a step ``(4,)``, numeric units."""
    registration = context.registration
    if registration is not None and registration.nominal != now:
        # A registration that was not related to the law yet has not moved with it: it only gets a
        # place.
        if registration.nominal is not None:
            registration = moved(registration, step)
        validity.store_registration(context, replace(registration, nominal=now))
    if np.any(step):
        carry_alpha(context, step)
    law, way = context.alpha.law, _way(context, now)
    _set(context, replace(law, nominal=now, worked_out_ns_utc=context.now_ns, way=way))


def _way(context: StepContext, now: Misregistration) -> tuple[tuple[int, Misregistration], ...]:
    """Return the way of the law with the present place, as far as it is kept."""
    way = context.alpha.law.way
    if context.rtc is None:
        return way
    t_ns = context.rtc.t_ns
    if way and t_ns <= way[-1][0] < t_ns + SECOND_NS:
        # A value that comes between two statuses: the path must stay in order, and not begin to
        # bend at the status before.
        t_ns = way[-1][0] + (way[-1][1] != now)
    if way and t_ns <= way[-1][0]:
        # The RTC's clock was set back, or nothing moved.
        kept = tuple(place for place in way if place[0] < t_ns)
        return (*kept, (t_ns, now))
    # While nothing moves one point is enough: the last one is replaced.
    still = len(way) > 1 and way[-1][1] == way[-2][1] == now
    close = len(way) > 1 and t_ns - way[-2][0] < PATH_SPACING_NS and way[-1][1] != way[-2][1]
    return (*(way[:-1] if still or close else way), (t_ns, now))[-MAX_PATH_POINTS:]


def _set(context: StepContext, law: LawState) -> None:
    if law != context.alpha.law:
        context.alpha = replace(context.alpha, law=law)


_Timed = TypeVar("_Timed", bound="TimedEstimate")


def moved(registration: Registration, step: Array) -> Registration:
    """Return what is known of α with all of it a step ``(4,)`` further, numeric units."""
    bias = registration.bias
    if bias is not None:
        bias = replace(bias, previous_estimate=_previous_moved(bias.previous_estimate, step))
    return replace(
        registration,
        alpha=registration.alpha.add_step(step),
        previous_estimate=_previous_moved(registration.previous_estimate, step),
        suspected_jump=_moved(registration.suspected_jump, step),
        bias=bias,
    )


def _previous_moved(previous: PreviousEstimate | None, step: Array) -> PreviousEstimate | None:
    if previous is None:
        return None
    return replace(
        previous,
        alpha=previous.alpha.add_step(step),
        next_window=_moved(previous.next_window, step),
        previous_estimate=_previous_moved(previous.previous_estimate, step),
    )


def _moved(estimate: _Timed | None, step: Array) -> _Timed | None:
    return None if estimate is None else replace(estimate, alpha=estimate.alpha.add_step(step))
