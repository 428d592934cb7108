"""Follow the law of pointing: α moves as it says, and the filter follows the deviation from it.

All that is known of α is carried along when the law moves, and an estimate is brought from the
pointing of its telemetry to the present one. So what the filter compares is deviations from the
law, whatever the telescope does meanwhile.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.misregistration import Misregistration, step_text, wrap_angle
from service.model.pointing_law import ANGLES, PointingLaw, Reported
from service.tracking import events as ev
from service.tracking import validity
from service.tracking.events import Event
from service.tracking.operations.acquisition import carry_alpha
from service.tracking.policy import SECOND_NS
from service.tracking.registration import LawLeap, LawState, Purpose, Registration, moved
from service.tracking.state import TrackerState
from service.tracking.step_context import StepContext

Array = NDArray[np.float64]

PATH_SPACING_NS = SECOND_NS // 2
"""Spacing of the recorded points of the path; between them it is interpolated linearly."""

MAX_PATH_POINTS = 240

MAX_STEP = np.array([0.5, 0.5, np.deg2rad(3.0), 0.02])
"""Largest step of a law at once, and per second in addition, numeric units. Telescopes turn by a
few degrees a second at most; a larger step is an error of the reported values."""

MAX_STEP_AT_REST = np.array([0.03, 0.03, np.deg2rad(0.3), 0.002])
"""Largest step of a law of the pointing alone while the telescope is at rest, numeric units."""

STEP_PER_DEG = np.array([0.2, 0.2, np.deg2rad(3.0), 0.004])
"""Additional step per degree that the telescope turns, numeric units. Near the zenith a field turns
faster than the azimuth, and a pupil that turns about a point ten subapertures away moves by 0.17. A
law that is not periodic moves by its whole range at north, where the telescope has hardly turned.
"""

LEAP_CONFIRMATION_S = 3.0
"""A leap of the pointing that has lasted for this time is accepted."""

MATRIX_LEAD_S = 6.0
"""A matrix is made for the law so far ahead: it is judged and sent in half of that."""

MAX_LEAD_STEP = np.array([0.2, 0.2, np.deg2rad(0.5), 0.008])
"""A law that moves further in that time is of a telescope that slews, numeric units."""

RATE_INTERVAL_NS = 2 * SECOND_NS
"""Over so long the rate of the law is taken."""

MAX_WINDOW_MOTION = np.array([0.1, 0.1, np.deg2rad(0.3), 0.004])
"""A window in which the law moved further belongs to no single registration."""


def follow_law(context: StepContext) -> None:
    """Note where the law has the mirror now, and carry along what is known of α."""
    law = context.policy.law
    if law is None:
        return
    now = _nominal(context, law)
    if isinstance(now, str):
        # The last nominal registration is kept: a missing report is no motion of the telescope.
        _set(context, replace(context.alpha.law, problem=now))
        return
    state = context.alpha.law
    since_s = (context.now_ns - state.worked_out_ns_utc) / SECOND_NS
    if state.nominal is not None and (
        _is_far(state.nominal, now, since_s) or _outruns_pointing(context, law, now)
    ):
        _hold(context, state.nominal, now)
        return
    _carry(context, now)


def begin_law(context: StepContext) -> None:
    """Forget the way of the law: the sensor's subapertures are others."""
    _set(context, LawState())


def event_of_now(context: StepContext, event: Event) -> Event:
    """Return an event whose estimate of α is brought to the present pointing."""
    match event:
        case ev.WindowFitted(estimate=estimate, began_ns_utc=began_ns):
            alpha = _to_present(context.state, estimate.alpha, began_ns, estimate.t_ns_utc)
            return replace(event, estimate=replace(estimate, alpha=alpha))
        case ev.PassiveFitted(estimate=estimate, began_ns_utc=began_ns, t_ns_utc=t_ns):
            alpha = _to_present(context.state, estimate.alpha, began_ns, t_ns)
            return replace(event, estimate=replace(estimate, alpha=alpha))
        case ev.WideCaptureFitted(found=found, began_ns_utc=began_ns):
            estimate = found.estimate
            alpha = _to_present(context.state, estimate.alpha, began_ns, estimate.t_ns_utc)
            return replace(event, found=replace(found, estimate=replace(estimate, alpha=alpha)))
        case _:
            return event


def start_of_fit(
    state: TrackerState, alpha: Misregistration | None, t_ns_utc: int
) -> Misregistration | None:
    """Return where α of now, or the nominal registration, lay at a time of the RTC's clock."""
    now, then = state.alpha.law.nominal, law_at(state, t_ns_utc)
    if now is None or then is None:
        return alpha
    return then if alpha is None else alpha.add_step(difference(now, then))


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
    """Return how the law moves ``(4,)``, numeric units a second."""
    way = state.alpha.law.way
    if len(way) < 2:
        return np.zeros(4)
    (last_ns, last), first_ns = way[-1], way[0][0]
    since_ns = max(last_ns - RATE_INTERVAL_NS, first_ns)
    then = law_at(state, since_ns)
    if then is None or since_ns >= last_ns:
        return np.zeros(4)
    return difference(then, last) * (SECOND_NS / (last_ns - since_ns))


def check_pointing_motion(state: TrackerState, began_ns_utc: int, ended_ns_utc: int) -> str | None:
    """Return why a window belongs to no single registration (the law moved within it), or None."""
    first, last = law_at(state, began_ns_utc), law_at(state, ended_ns_utc)
    if first is None or last is None:
        return None
    step = difference(first, last)
    if np.all(np.abs(step) <= MAX_WINDOW_MOTION):
        return None
    return f"the law of pointing moved α inside the window, by {step_text(step)}"


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
    return before.add_step(share * difference(before, after))


def difference(one: Misregistration, other: Misregistration) -> Array:
    """Return the step ``(4,)`` from one to the other, numeric units, by the shorter turn."""
    step = other.vector - one.vector
    step[2] = wrap_angle(float(step[2]))
    return step


def _to_present(
    state: TrackerState, alpha: Misregistration, began_ns_utc: int, ended_ns_utc: int
) -> Misregistration:
    """Return an estimate at the present pointing, made of telemetry of another."""
    now = state.alpha.law.nominal
    # A window measures the mean registration, which is that of its middle if the law is smooth.
    middle_ns = ((began_ns_utc or ended_ns_utc) + ended_ns_utc) // 2
    then = law_at(state, middle_ns)
    if now is None or then is None:
        return alpha
    return alpha.add_step(difference(then, now))


def _nominal(context: StepContext, law: PointingLaw) -> Misregistration | str:
    """Return the present registration by the law, or why it is unknown and what to do."""
    reported = _reported_values(context)
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


def _is_far(one: Misregistration, other: Misregistration, since_s: float) -> bool:
    # A clock that was set back must not reduce what is allowed at once.
    allowed = MAX_STEP * (1.0 + max(since_s, 0.0))
    return bool(np.any(np.abs(difference(one, other)) > allowed))


def _outruns_pointing(context: StepContext, law: PointingLaw, now: Misregistration) -> bool:
    """Return whether a law of the pointing alone moves by more than the telescope has turned."""
    state, pointing = context.alpha.law, context.alpha.pointing
    if state.nominal is None or state.pointing is None or pointing is None:
        return False
    if not law.names <= set(ANGLES):  # values of the observatory change by themselves
        return False
    turned_deg = abs(pointing.elevation_deg - state.pointing.elevation_deg) + abs(
        # From 359 to 1 deg the telescope turns by 2 deg.
        math.remainder(pointing.azimuth_deg - state.pointing.azimuth_deg, 360.0)
    )
    allowed = MAX_STEP_AT_REST + STEP_PER_DEG * turned_deg
    return bool(np.any(np.abs(difference(state.nominal, now)) > allowed))


def _hold(context: StepContext, before: Misregistration, now: Misregistration) -> None:
    """Hold α where the reported values leap. A leap that lasts is accepted, and α is in doubt."""
    law, leap = context.alpha.law, context.alpha.law.leap
    # A single wrong report must not move α; another leap restarts the wait.
    if leap is None or _is_far(leap.to, now, (context.now_ns - leap.worked_out_ns_utc) / SECOND_NS):
        leap = LawLeap(to=now, since_ns_utc=context.now_ns, worked_out_ns_utc=context.now_ns)
        text = (
            f"the pointing or values reported for the pointing law jumped, which would move α by "
            f"{step_text(difference(before, now))} at once; α is left unchanged until they have "
            f"been steady for {LEAP_CONFIRMATION_S:.0f} s; check the program that reports them"
        )
        _set(context, replace(law, problem=text, leap=leap))
        return
    leap = replace(leap, to=now, worked_out_ns_utc=context.now_ns)
    if context.now_ns - leap.since_ns_utc < LEAP_CONFIRMATION_S * SECOND_NS:
        _set(context, replace(law, leap=leap))
        return
    # The path restarts: interpolation across the leap would yield registrations that never were.
    _set(context, replace(law, way=()))
    _carry(context, now)
    because = "the values reported for the pointing law jumped"
    registration, t_ns = context.registration, 0 if context.rtc is None else context.rtc.t_ns
    if registration is not None:
        doubted = replace(registration, doubt=because, doubt_voids=True, suspected_jump=None)
        validity.store_registration(context, doubted)
        validity.cast_doubt(context, t_ns)
        validity.request_window(context, because)
        validity.age_registration(context)
    validity.void_until(context, t_ns, because, Purpose.MEASURE)
    context.warn(
        "law.leapt", f"{because}: α follows the law from now on, until a window confirms it"
    )


def _carry(context: StepContext, now: Misregistration) -> None:
    """Take this for nominal, and move what is known of α as far as it has moved."""
    registration, before = context.registration, context.alpha.law.nominal
    if registration is not None and registration.nominal != now:
        # A registration that was not related to the law yet has not moved with it: it only gets a
        # place.
        if registration.nominal is not None:
            registration = moved(registration, difference(registration.nominal, now))
        validity.store_registration(context, replace(registration, nominal=now))
    if before is not None and before != now:
        carry_alpha(context, difference(before, now))
    state = LawState(
        nominal=now,
        worked_out_ns_utc=context.now_ns,
        way=_way(context, now),
        pointing=context.alpha.pointing,
    )
    if state != context.alpha.law:
        _set(context, state)


def _way(context: StepContext, now: Misregistration) -> tuple[tuple[int, Misregistration], ...]:
    """Return the way of the law with the present place, as far as it is kept."""
    way = context.alpha.law.way
    if context.rtc is None:
        return way
    t_ns = context.rtc.t_ns
    if way and t_ns <= way[-1][0]:
        # The RTC's clock was set back, or the status has the same time again: the path must stay in
        # order for the interpolation.
        kept = tuple(place for place in way if place[0] < t_ns)
        return (*kept, (t_ns, now))
    # While nothing moves one point is enough: the last one is replaced.
    still = len(way) > 1 and way[-1][1] == way[-2][1] == now
    close = len(way) > 1 and t_ns - way[-2][0] < PATH_SPACING_NS and way[-1][1] != way[-2][1]
    return (*(way[:-1] if still or close else way), (t_ns, now))[-MAX_PATH_POINTS:]


def _set(context: StepContext, law: LawState) -> None:
    if law != context.alpha.law:
        context.alpha = replace(context.alpha, law=law)
