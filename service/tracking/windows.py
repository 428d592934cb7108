"""Windows, and looks at ordinary telemetry, become the registration, or a reason why not.

One window far out may be a jump or a mistake. It is held, nothing is made from α meanwhile, and
the next window decides: one that agrees with it makes it a jump, one that agrees with all before
makes it an outlier. A jump that one window alone cannot tell from noise is told by two together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.telemetry.estimate import DitheredEstimate, model_error
from service.telemetry.kalman import (
    JUMP_THRESHOLD,
    Joint,
    allowing,
    begin_joint,
    dithered_innovation,
    forgotten,
    passive_innovation,
    widened,
    with_dithered,
    with_passive,
)
from service.telemetry.lockin import MAX_LAG_FRAMES
from service.telemetry.passive import PassiveEstimate
from service.telemetry.random_dither import RandomEstimate
from service.tracking import events as ev
from service.tracking.acquisition_stages import missed
from service.tracking.alarms import (
    RULES,
    WRONG_ANSWER,
    Act,
    forbidding,
    logged,
    with_alarm,
    without_alarm,
)
from service.tracking.dither import DITHER_LOST, found_again
from service.tracking.estimate import (
    DISAGREES,
    SUSPECTED,
    Folded,
    Measured,
    accepted,
    bias_of,
    brought_forward,
    counted,
    entry_of,
    followed_gains,
    joint_of,
    remembered,
)
from service.tracking.events import WindowFitted
from service.tracking.jumps import (
    Distance,
    Reading,
    look_surprise,
    pair_surprise,
    sum_of,
    wholly_after,
    window_before,
    window_surprise,
)
from service.tracking.loop import same_numbers
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.registration import (
    Candidate,
    HistoryEntry,
    Registration,
    Seen,
    Source,
    Watchdog,
)
from service.tracking.state import Level, TrackerState
from service.tracking.validity import (
    USELESS_SIGMA,
    Taken,
    aged,
    pointing_at,
    precedes,
    taken,
    tells_of,
    why_void,
    with_dither_due,
)

TOO_EARLY = (
    "it began before α came into doubt and agrees with what was known then: only one taken since "
    "can tell"
)


def with_window(
    state: TrackerState, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    known = state.registration
    if known is None:
        joint = begin_joint(measured.alpha.vector, measured.covariance)
        folded = Folded(joint=joint, n_windows=1, innovation=0.0)
        return accepted(state, folded, measured, policy, now_ns)
    reading = _reading(measured, state)
    first = window_before(known)
    if first is not None and pair_surprise(known, reading, policy).far:
        return _jumped(state, first, measured, policy, now_ns)
    far = window_surprise(known, reading, policy)
    if known.doubt and not far.far and precedes(state, measured.when, known.doubted_ns_utc):
        state = replace(state, windows_refused=state.windows_refused + 1)
        return logged(state, "window.refused", TOO_EARLY, now_ns)
    if known.candidate is not None:
        state = _outlier(state, known.candidate, measured, now_ns)
    if far.far:
        return _held(state, measured, far, policy, now_ns)
    prior = brought_forward(state, known, measured.t_ns_utc, policy, now_ns)
    folded = Folded(
        joint=with_dithered(prior, measured.alpha.vector, measured.covariance),
        n_windows=counted(state, known, prior, policy),
        innovation=_innovation(prior, measured),
    )
    return accepted(state, folded, measured, policy, now_ns)


def _held(
    state: TrackerState, measured: Measured, far: Distance, policy: Policy, now_ns: int
) -> TrackerState:
    """Put a window that is far out aside, and doubt α until another one has come."""
    known, innovation = _known(state), far.innovation
    text = (
        f"a window lies {_step(measured, known)} from α (innovation {innovation:.0f}, expected 4, "
        f"rotation {np.sqrt(far.rotation):.1f} sigma): the next one decides; nothing is made or "
        "sent meanwhile"
    )
    candidate = Candidate(
        alpha=measured.alpha,
        covariance=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        held_ns_utc=now_ns,
        innovation=innovation,
    )
    since_ns = max(known.doubted_ns_utc if known.doubt else 0, measured.t_ns_utc)
    doubted = replace(
        known, candidate=candidate, doubt="a jump is suspected", doubted_ns_utc=since_ns
    )
    state = remembered(
        replace(state, registration=doubted), entry_of(measured, known, innovation, entered=False)
    )
    state = logged(state, "registration.jump-suspected", text, now_ns, Level.WARNING)
    state = with_dither_due(with_alarm(state, SUSPECTED, text, now_ns), doubted.doubt, now_ns)
    return aged(state, policy, now_ns)


def _outlier(
    state: TrackerState, candidate: Candidate, measured: Measured, now_ns: int
) -> TrackerState:
    """Count the window held before: the one after it has not confirmed it."""
    known = _known(state)
    text = (
        f"the window {_step(candidate, known)} from α was not confirmed: the one after it lies "
        f"{_step(measured, known)} away"
    )
    state = replace(state, windows_outlying=state.windows_outlying + 1)
    return logged(state, "window.outlier", text, now_ns, Level.WARNING)


def _jumped(
    state: TrackerState, first: Seen, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Return the state at the new place, which two windows have now seen.

    The first of them is used if it is wholly of the new place.
    """
    known = _known(state)
    prior = brought_forward(state, known, measured.t_ns_utc, policy, now_ns)
    noise = measured.covariance
    whole = wholly_after(first, _reading(measured, state), known.alpha.vector, policy)
    if whole:
        elapsed_s = max(measured.t_ns_utc - first.t_ns_utc, 0) / SECOND_NS
        noise = first.covariance + np.diag(policy.drift_rate**2 * elapsed_s)
    joint = widened(prior, noise)
    if whole:
        joint = with_dithered(joint, first.alpha.vector, noise)
    joint = with_dithered(joint, measured.alpha.vector, measured.covariance)
    state = replace(
        state,
        windows_accepted=state.windows_accepted + (whole and known.candidate is not None),
        registration=replace(known, passive_after_ns_utc=first.t_ns_utc),
    )
    folded = Folded(
        joint=joint,
        n_windows=2 if whole else 1,
        innovation=_innovation(prior, measured),
        jumped=True,
    )
    state = accepted(state, folded, measured, policy, now_ns)
    text = f"jumped by {_step(measured, known)}, as two windows have seen"
    return logged(state, "registration.jump", text, now_ns, Level.WARNING)


def _reading(measured: Measured, state: TrackerState) -> Reading:
    return Reading(
        value=measured.alpha.vector,
        noise=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        pointing=pointing_at(state, measured.t_ns_utc),
    )


def _known(state: TrackerState) -> Registration:
    if state.registration is None:
        raise ValueError("no α is known: there is nothing to doubt")
    return state.registration


def _innovation(prior: Joint, measured: Measured) -> float:
    return dithered_innovation(prior, measured.alpha.vector, measured.covariance)


def _step(measured: Measured | Candidate, known: Registration) -> str:
    step = (measured.alpha.vector - known.alpha.vector) * BOUNDARY_SCALE
    return f"{step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f}"


Array = NDArray[Any]

CAPTURE_RANGE = np.array([0.8, 0.8, np.deg2rad(2.0), 0.02])
"""Beyond this, one linearised fit with high modes cannot be trusted (numeric units)."""

EXPECTED = ("the reconstructor changed", "the dither ended")
"""What cuts a window short when all is well."""

GAIN_RANGE = (0.1, 3.0)
"""Gains outside this are no pyramid seeing the dither: about 0.4 to 0.9 on sky, twice that when the
mirror is seen twice."""


GAIN_GROUPS = 16
"""A random dither on more modes than this is believed on the gains of neighbours together."""

MISFIT_WINDOWS = 10
"""So many tell the model error together: the misfit of a faint star's window is mostly chance."""


def on_window(
    state: TrackerState, event: WindowFitted, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold one window's estimate into the registration, or refuse it with its reason."""
    estimate = event.estimate
    when = taken(event.began_ns_utc, estimate.t_ns_utc)
    reason = _why_no_window(state, estimate, when, policy)
    if reason is not None:
        return refuse_window(state, reason, now_ns)
    if tells_of(state, DITHER_LOST, when):
        state = found_again(state, now_ns)
    told = () if isinstance(estimate, RandomEstimate) else (WRONG_ANSWER,)
    for name in ("columns-misaligned", *told):
        if tells_of(state, name, when):
            state = without_alarm(state, name, now_ns)
    known, random = state.registration, isinstance(estimate, RandomEstimate)
    modes, gains, gain_sigma = _gains_of(estimate)
    measured = Measured(
        alpha=estimate.alpha,
        covariance=estimate.covariance,
        when=when,
        source=Source.RANDOM if random else Source.LOCK_IN,
        optical_gain=float(gains.mean()),
        optical_gains=followed_gains(
            () if known is None else known.optical_gains,
            modes,
            gains[: len(modes)],
            gain_sigma,
            estimate.t_ns_utc,
        ),
        floor=_floor(known, estimate, policy),
        misfit=estimate.misfit,
    )
    return with_window(state, measured, policy, now_ns)


def _floor(known: Registration | None, estimate: DitheredEstimate, policy: Policy) -> Array:
    """Return the model error by all windows so far: what is set, and what they do not explain.

    A window weaker than what is asked of α cannot tell: the chance in its misfit, times its own σ,
    would be more than any model error.
    """
    before = policy.floor if known is None else known.floor
    if np.any(np.diag(estimate.covariance) > policy.dither_sigma**2):
        return before
    squared = policy.floor**2 + model_error(estimate.covariance, estimate.misfit) ** 2
    share = 1.0 if known is None else 1.0 / min(known.n_windows + 1, MISFIT_WINDOWS)
    return np.asarray(np.sqrt(before**2 + share * (squared - before**2)))


def _gains_of(estimate: DitheredEstimate) -> tuple[tuple[int, ...], Array, Any]:
    """Return modes, moduli of their gains, and 1 σ of them where it is known."""
    if isinstance(estimate, RandomEstimate):
        return estimate.gains_by_group(GAIN_GROUPS)
    return estimate.modes, np.abs(estimate.optical_gain), estimate.gain_sigma


def _why_no_window(
    state: TrackerState, estimate: DitheredEstimate, when: Taken, policy: Policy
) -> str | None:
    """Return why a window's estimate must not be used, or None."""
    if state.rtc is None or estimate.session != state.rtc.session:
        return "the RTC has restarted since"
    reason = why_no_measurement(state, when)
    if reason is not None:
        return reason
    lag = float(np.median(estimate.lag_frames))
    if abs(lag) > MAX_LAG_FRAMES:
        return f"columns misaligned: slopes lag commands by {lag:+.2f} frame, 0 is expected"
    _, gains, _ = _gains_of(estimate)
    if gains.min() < GAIN_RANGE[0] or gains.max() > GAIN_RANGE[1]:
        return (
            f"optical gains of {gains.min():.2f} to {gains.max():.2f}, expected {GAIN_RANGE[0]} "
            f"to {GAIN_RANGE[1]}: wrong instrument file, or the dither is not on the mirror"
        )
    sigma = np.sqrt(np.diag(estimate.covariance))
    if np.any(sigma > USELESS_SIGMA):
        return "too uncertain: raise the dither's amplitude or the window's length"
    known = state.registration
    near = policy.start if known is None else known.alpha
    distance = np.abs(estimate.alpha.vector - near.vector)
    if np.any(distance > CAPTURE_RANGE):
        return (
            f"outside the capture range: {estimate.alpha.to_boundary()}, "
            f"the fit began at {near.to_boundary()}"
        )
    return None


def why_no_measurement(state: TrackerState, when: Taken) -> str | None:
    """Return why telemetry taken then, or any that comes now, measures nothing; None: it does."""
    alarm = forbidding(state, Act.MEASURE)
    if alarm is None:
        return why_void(state, when)
    return f"{RULES[alarm.name].because}: its telemetry is no measurement"


def refuse_window(
    state: TrackerState, reason: str, now_ns: int, *, mistold: bool = False
) -> TrackerState:
    """Count a window that gave nothing, and say why.

    ``mistold``: because slopes or commands are not what the instrument file says.
    """
    state = missed(replace(state, windows_refused=state.windows_refused + 1), reason)
    if reason.startswith("columns misaligned"):
        state = with_alarm(state, "columns-misaligned", reason, now_ns)
    if mistold:
        state = with_alarm(state, WRONG_ANSWER, reason, now_ns)
    level = Level.INFO if reason.startswith(EXPECTED) else Level.WARNING
    return logged(state, "window.refused", reason, now_ns, level)


def on_watchdog(
    state: TrackerState, event: ev.Watched, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold the passive estimate in, its bias allowed for, or doubt α where it does not fit."""
    reason = _why_no_look(state, event) or _why_known_already(state, event)
    if reason is not None:
        return replace(state, unwatched=f"a look was not used: {reason}")
    known = state.registration
    if known is None:
        return _alone(state, event, policy)
    excess = event.estimate.bias_excess
    known = _expecting(known, excess)
    prior = allowing(brought_forward(state, known, event.t_ns_utc, policy, now_ns), excess)
    if _mixed(known):
        text = "not used: its telemetry may be from both sides of a jump"
        bias = bias_of(joint_of(known), event.t_ns_utc, _loop(state, known))
        state = replace(state, registration=replace(known, bias=bias))
        return _shown(state, event, _reading_sigma(event.estimate, prior), prior.bias, text)
    measured = event.estimate.alpha.vector
    reading = Reading(
        value=measured,
        noise=event.estimate.covariance,
        t_ns_utc=event.t_ns_utc,
        pointing=pointing_at(state, event.t_ns_utc),
    )
    far = look_surprise(known, joint_of(known), reading, policy)
    if far > JUMP_THRESHOLD:
        return _barking(state, event, prior, far, policy, now_ns)
    innovation = passive_innovation(prior, measured, event.estimate.covariance)
    joint = with_passive(prior, measured, event.estimate.covariance)
    registration = _after(state, known, joint, event, now_ns)
    state = aged(replace(state, registration=registration), policy, now_ns)
    sigma = _reading_sigma(event.estimate, prior)
    entry = HistoryEntry(
        t_ns_utc=event.t_ns_utc,
        measured=Misregistration.from_vector(measured - joint.bias),
        measured_sigma=sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.sigma,
        innovation=innovation,
        misfit=event.estimate.misfit,
        source=Source.PASSIVE,
    )
    text = "agrees with α and with what is known of its own bias"
    return _shown(remembered(state, entry), event, sigma, joint.bias, text)


def fit_begins_at(state: TrackerState) -> Misregistration | None:
    """Return about what a look is to be fitted: α, or the last look; None: the nominal rotation."""
    if state.registration is not None:
        return state.registration.alpha
    last = state.watchdog
    return last.alpha if last is not None and np.isfinite(last.sigma).all() else None


def _why_no_look(state: TrackerState, event: ev.Watched) -> str | None:
    """Return why a look says nothing of the telescope as it is, or None."""
    of_loop = () if state.rtc is None else state.rtc.loop_numbers
    if event.loop and of_loop and not same_numbers(event.loop, of_loop):
        return "the loop has changed since"
    return why_no_measurement(state, taken(event.began_ns_utc, event.t_ns_utc))


def _why_known_already(state: TrackerState, event: ev.Watched) -> str | None:
    """Return which later telemetry has told more than a look that was long under way, or None."""
    known = state.registration
    if known is None or not known.window_began_ns_utc:
        return None
    since = taken(known.window_began_ns_utc, known.window_began_ns_utc)
    if precedes(state, since, event.t_ns_utc):
        return None
    return "a dithered window taken since has been fitted before it"


def _alone(state: TrackerState, event: ev.Watched, policy: Policy) -> TrackerState:
    """Show a look while α is not known: it is all there is, and no more than it says it is."""
    step = event.estimate.alpha.vector - policy.start.vector
    if np.any(np.abs(step) > CAPTURE_RANGE):
        text = (
            f"it cannot tell: {event.estimate.alpha.to_boundary()} is too far from where its fit "
            "begins, the nominal rotation; let the service acquire, or dither"
        )
        return _shown(state, event, np.full(4, np.inf), np.zeros(4), text)
    text = "no dithered estimate to compare with: nothing is made from this reading alone"
    return _shown(state, event, event.estimate.sigma, np.zeros(4), text)


def _expecting(known: Registration, excess: Array) -> Registration:
    """Return what is known with the bias as large as the first look at it says that it may be.

    A later look that says more is allowed for by the filter alone: whether the mirror has jumped is
    told with less patience.
    """
    if known.bias is not None and known.bias.looked_ns_utc:
        return known
    return replace(known, bias=bias_of(forgotten(joint_of(known), excess), 0, ()))


def _loop(state: TrackerState, known: Registration) -> tuple[float, ...]:
    """Return the loop that is looked at; while no RTC is there, the one of the last look."""
    if state.rtc is not None:
        return state.rtc.loop_numbers
    return () if known.bias is None else known.bias.loop


def _mixed(known: Registration) -> bool:
    """Return whether a look may be at telemetry from before a jump and from after it.

    It began no earlier than the one before it ended.
    """
    began_ns_utc = known.bias.looked_ns_utc if known.bias is not None else 0
    jumped_ns_utc = known.passive_after_ns_utc
    return known.candidate is not None or (jumped_ns_utc > 0 and began_ns_utc < jumped_ns_utc)


def _barking(
    state: TrackerState,
    event: ev.Watched,
    prior: Joint,
    far: float,
    policy: Policy,
    now_ns: int,
) -> TrackerState:
    """Forget the bias and doubt α: the wind has changed or the mirror has moved."""
    known = state.registration
    if known is None:
        raise ValueError("no α is known: there is nothing to doubt")
    text = (
        "ordinary telemetry disagrees: the wind has changed or the mirror has moved, and a "
        "dithered window must tell which"
    )
    gone = forgotten(prior, event.estimate.bias_excess)
    registration = _after(state, known, gone, event, now_ns)
    bias = bias_of(gone, event.t_ns_utc, _loop(state, known))
    since_ns = max(known.doubted_ns_utc if known.doubt else 0, event.t_ns_utc)
    registration = replace(registration, doubt=text, doubted_ns_utc=since_ns, bias=bias)
    state = replace(state, registration=registration)
    detail = f"{text} (innovation {far:.0f}, expected 4)"
    state = logged(state, "registration.passive-jump", detail, now_ns, Level.WARNING)
    state = with_dither_due(with_alarm(state, DISAGREES, text, now_ns), text, now_ns)
    state = aged(state, policy, now_ns)
    return _shown(state, event, event.estimate.sigma, np.zeros(4), text, consistent=False)


def _after(
    state: TrackerState, known: Registration, joint: Joint, event: ev.Watched, now_ns: int
) -> Registration:
    """Return the registration as the filter has it after a look."""
    return replace(
        known,
        alpha=Misregistration.from_vector(joint.alpha),
        covariance=joint.alpha_covariance,
        t_ns_utc=max(event.t_ns_utc, known.t_ns_utc),
        arrived_ns_utc=now_ns,
        bias=bias_of(joint, event.t_ns_utc, _loop(state, known), sum_of(known, joint_of(known))),
        pointing=pointing_at(state, event.t_ns_utc),
    )


def _reading_sigma(estimate: PassiveEstimate, prior: Joint) -> Array:
    """Return ``(4,)`` 1 σ of the estimate as a reading of α: its scatter, and that of its bias."""
    return np.sqrt(np.diag(estimate.covariance) + np.diag(prior.covariance)[4:])


def _shown(
    state: TrackerState,
    event: ev.Watched,
    sigma: Array,
    bias: Array,
    text: str,
    *,
    consistent: bool = True,
) -> TrackerState:
    watchdog = Watchdog(
        alpha=event.estimate.alpha,
        sigma=sigma,
        misfit=event.estimate.misfit,
        t_ns_utc=event.t_ns_utc,
        consistent=consistent,
        text=text,
        bias=bias,
    )
    return replace(state, watchdog=watchdog, unwatched="")
