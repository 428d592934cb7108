"""Update the registration by a measurement: the joint filter of α and bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.gains import GAIN_RATE
from service.estimation import kalman
from service.estimation.estimate import model_error
from service.estimation.kalman import Drift, Joint, begin_joint, predict_state
from service.estimation.lockin import MAX_LAG_FRAMES
from service.estimation.windows import OTHER_SESSION
from service.model.misregistration import Misregistration
from service.records.alarms import Interlock, blocking_alarm
from service.records.estimates import DitheredEstimate, RandomEstimate, RefusalKind, Why
from service.records.messages import as_message, compose
from service.records.registration import (
    HistoryEntry,
    KnownStretches,
    ModeGain,
    PassiveBias,
    PointedEstimate,
    PreviousEstimate,
    Purpose,
    Registration,
    Source,
    TimedEstimate,
)
from service.records.state import TrackerState
from service.tracking import mode_proof, validity
from service.tracking.jumps import to_previous_estimate
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext
from service.tracking.validity import without_previous

MODES_KEPT = 64
"""More than any dither plays at once: of those measured longest ago the rest is forgotten."""

PRIOR_SCATTER, PRIOR_FLUCTUATION = 0.1, 0.03
"""Relative 1 σ of one window before any two were compared: all of it where the window does not know
its own noise, and besides that noise."""

GAIN_CHANGE_SIGMA = 3.0
"""The gains of a window that differ by more than this, all alike, are of another seeing."""

SCATTER_WEIGHT = 0.1
"""Weight of the newest window in the scatter: ten windows are remembered."""

_MAX_SCATTER_SIGMA = 3.0
"""A window further out than this many σ counts as one at this distance."""

Array = NDArray[np.float64]

CAPTURE_RANGE = np.array([0.8, 0.8, np.deg2rad(2.0), 0.02])
"""Beyond this, one linearised fit with high modes cannot be trusted (numeric units)."""

N_FAR_WINDOWS = 3
"""Windows beyond ``CAPTURE_RANGE`` that must agree while α is unknown before they are used."""

AGREEMENT_DISTANCE = np.array([0.02, 0.02, np.deg2rad(0.1), 0.002])
"""Distance of two windows that agree whatever their σ (numeric units): a loop's turbulence moves a
window by so much."""

MAX_UNEXPLAINED_SHARE = 0.5
"""Share of a line's power that the model may leave unexplained in a window far from its start. A
model that is 40 % wrong per mode leaves 0.15 to 0.3, modes or slopes in another order 0.8."""

GAIN_RANGE = (0.1, 3.0)
"""Gains outside this are no pyramid seeing the dither: about 0.4 to 0.9 on sky, twice that when the
mirror is seen twice."""

GAIN_GROUPS = 16
"""Largest number of modes of a random dither with individual gains; beyond it neighbours share one.
"""

MISFIT_WINDOWS = 10
"""Number of windows that determine the model error together: the misfit of one window of a faint
star is mostly noise."""


def update_gains(
    before: tuple[ModeGain, ...],
    modes: tuple[int, ...],
    gains: Array,
    sigma: Array | None,
    t_ns: int,
) -> tuple[ModeGain, ...]:
    """Return the gains after a window with these modes, in mode order.

    ``gains`` and ``sigma`` ``(n_lines,)`` are modulus and 1 σ from the window's own data; None if
    only the scatter from window to window determines their accuracy.
    """
    table = {gain.mode: gain for gain in before}
    own = np.zeros(len(gains)) if sigma is None else sigma
    change = _common_change([table.get(mode) for mode in modes], gains, own, t_ns)
    if change:
        # The others are of the seeing before, and would hold the curve through all gains there.
        table = {mode: table[mode] for mode in modes if mode in table}
    for mode, gain, noise in zip(modes, gains, own, strict=True):
        table[mode] = _update_gain(table.get(mode), mode, float(gain), float(noise), t_ns, change)
    # Sorted by time, so that the oldest measurements are forgotten.
    newest = sorted(table.values(), key=lambda gain: gain.t_ns_utc)[-MODES_KEPT:]
    return tuple(sorted(newest, key=lambda gain: gain.mode))


def _predict_variance(gain: ModeGain, t_ns: int) -> float:
    """Return the variance of a gain at a later time."""
    elapsed_s = max((t_ns - gain.t_ns_utc) / SECOND_NS, 0.0)
    return float(gain.sigma**2 + (GAIN_RATE * gain.gain) ** 2 * elapsed_s)


def _common_change(
    known: Sequence[ModeGain | None], measured: Array, noise: Array, t_ns: int
) -> float:
    """Return the relative change that all gains of a window have in common; 0 if insignificant.

    Seeing changes all gains at once. A single gain of a faint star is too uncertain to show that.
    """
    pairs = [(gain, *one) for gain, *one in zip(known, measured, noise, strict=True) if gain]
    if not pairs:
        return 0.0
    before, now, own = np.array([(g.gain, m, n) for g, m, n in pairs]).T
    variance = np.array([_predict_variance(g, t_ns) + g.scatter**2 for g, _, __ in pairs])
    # Only the noise of the lines is independent; gains fluctuate together.
    relative, own = variance / before**2, np.minimum(own**2, variance) / before**2
    weights = 1.0 / relative / np.sum(1.0 / relative)
    change = float(weights @ (now / before - 1.0))
    expected = float(weights @ (relative - own) + weights**2 @ own)
    return change if change**2 > GAIN_CHANGE_SIGMA**2 * expected else 0.0


def _update_gain(
    gain: ModeGain | None, mode: int, measured: float, noise: float, t_ns: int, change: float
) -> ModeGain:
    """Return one gain as a scalar random walk; the scatter of its windows is learnt.

    A window's own σ describes the noise next to the lines, not the fluctuation of the gain itself.
    After a ``change`` of the seeing σ is at least as large: one window alone does not move the gain
    far, because a loop that slips measures other gains, too. The next one then decides.
    """
    if gain is None:
        unknown = PRIOR_FLUCTUATION if noise else PRIOR_SCATTER
        scatter = float(np.hypot(noise, unknown * measured))
        return ModeGain(mode=mode, gain=measured, sigma=scatter, scatter=scatter, t_ns_utc=t_ns)
    prior = _predict_variance(gain, t_ns)
    farthest = _MAX_SCATTER_SIGMA * float(np.sqrt(prior + gain.scatter**2))
    # A single outlier must not inflate the scatter for the next ten windows.
    innovation = float(np.clip(measured - gain.gain, -farthest, farthest))
    # The innovation scatters by the uncertainty of the gain, too: what is left is the window's own.
    learnt = noise**2 if change else max(innovation**2 - prior, noise**2)
    scatter = float(np.sqrt((1 - SCATTER_WEIGHT) * gain.scatter**2 + SCATTER_WEIGHT * learnt))
    weight = prior / (prior + scatter**2)
    return ModeGain(
        mode=mode,
        gain=gain.gain + weight * innovation,
        sigma=float(np.hypot(np.sqrt((1 - weight) * prior), change * gain.gain)),
        scatter=scatter,
        t_ns_utc=t_ns,
    )


HISTORY_LENGTH = 5000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowEstimate(PointedEstimate):
    """Estimate of α from one dithered window, with its inputs."""

    source: Source
    optical_gain: float
    """Mean modulus of the gains of the dithered modes."""

    optical_gains: tuple[ModeGain, ...]
    """Optical gains of all known modes, this window's included."""

    floor: Array
    """``(4,)`` 1 σ of the model error, numeric units: it does not average down."""

    misfit: float
    """Residual power over what noise explains; 1: the model explains the window."""

    with_stretches: Array | None = None
    """``(6, 6)`` covariance of α and its anamorphosis together; None: that is not followed."""

    @property
    def numbers(self) -> Array:
        """``(4,)``, or ``(6,)`` with the anamorphosis where that is followed."""
        if self.with_stretches is None:
            return self.alpha.vector
        return np.concatenate([self.alpha.vector, self.alpha.stretches])

    @property
    def noise(self) -> Array:
        """Covariance of these numbers."""
        return self.covariance if self.with_stretches is None else self.with_stretches


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterUpdate:
    """The filter after a window."""

    joint: Joint
    n_windows: int
    """Windows that agree with it, it included."""

    innovation: float
    """Normalised innovation squared (4 degrees of freedom)."""

    scatter: float = 1.0
    """Ratio of the scatter of windows to their prediction, in variance, this one included."""

    jumped: bool = False
    """True if it is of a new registration, about which earlier estimates contain no information."""


def predict(context: StepContext, registration: Registration, t_ns_utc: int) -> Joint:
    """Return what is known at a time of the RTC's clock, drift and flexure since then added."""
    elapsed_ns = t_ns_utc - registration.t_ns_utc
    if elapsed_ns < -validity.CLOCK_SET_BACK_S * SECOND_NS:
        # a clock that was set back, or another night played again: the service's own must do
        elapsed_ns = context.now_ns - registration.arrived_ns_utc
    policy = context.policy
    drift = Drift(alpha_rate=policy.drift_rate, bias_memory_s=policy.bias_memory_s)
    bent = validity.flexure(registration.pointing, context.alpha.pointing, policy)
    return predict_state(joint_of(registration), drift, elapsed_ns / SECOND_NS, bent)


def predict_for(context: StepContext, registration: Registration, window: WindowEstimate) -> Joint:
    """Return what is known at the end of a window, before it: what it follows is in it."""
    prior = predict(context, registration, window.t_ns_utc)
    if window.with_stretches is None:
        return prior
    return kalman.with_stretches(prior, registration.alpha.stretches)


def joint_of(registration: Registration) -> Joint:
    """Return the filter's state that a registration holds."""
    joint = begin_joint(registration.alpha.vector, registration.covariance)
    known = registration.stretches
    if known is not None:
        mean = np.concatenate([joint.mean, registration.alpha.stretches])
        every = [[joint.covariance, known.shared.T], [known.shared, known.covariance]]
        # The anamorphosis comes directly after the four of α, before the bias: ``stretches_of`` and
        # ``bias_of`` read the state in this order.
        joint = begin_joint(mean, np.block(every))
    bias = registration.bias
    if bias is None:
        return joint
    covariance = [[joint.covariance, bias.shared.T], [bias.shared, bias.covariance]]
    return Joint(
        mean=np.concatenate([joint.mean, bias.offset]),
        covariance=np.block(covariance),
        n_alpha=joint.n_alpha,
        bias=bias,
    )


def alpha_of(joint: Joint, before: Misregistration) -> Misregistration:
    """Return α as filtered; an anamorphosis that the filter does not track is left as it was."""
    alpha = before.with_vector(joint.alpha)
    return alpha.with_anamorphosis(joint.stretches) if joint.n_alpha > 4 else alpha


def stretches_of(joint: Joint) -> KnownStretches | None:
    """Return how well the filter knows the anamorphosis; None: it does not follow it."""
    if joint.n_alpha == 4:
        return None
    return KnownStretches(covariance=joint.covariance[4:6, 4:6], shared=joint.covariance[4:6, :4])


def bias_of(joint: Joint) -> PassiveBias | None:
    """Return what the filter knows of the bias; when and in which loop is as it was before."""
    bias, place = joint.bias, joint.place
    if bias is None:
        return None
    if not isinstance(bias, PassiveBias):  # the filter has just begun with it
        bias = PassiveBias(excess=bias.excess, scatter=bias.scatter)
    shared, own = joint.covariance[place, : place.start], joint.covariance[place, place]
    return replace(bias, offset=joint.offset, covariance=own, shared=shared)


def add_history(context: StepContext, entry: HistoryEntry) -> None:
    """Keep one more line of history."""
    entry = replace(entry, in_use=context.matrices.in_use)
    history = (*context.alpha.history, entry)[-HISTORY_LENGTH:]
    context.alpha = replace(context.alpha, history=history)


def n_agreeing(context: StepContext, registration: Registration, prior: Joint) -> int:
    """Return the number of agreeing windows after this one; 1 if α had become stale."""
    policy = context.policy
    sigma = np.sqrt(np.diag(prior.alpha_covariance))
    slewed = validity.slewed_deg(context.state, registration) > policy.slew_limit_deg
    return 1 if slewed or np.any(sigma > policy.stale_sigma) else registration.n_windows + 1


def accept(
    context: StepContext, update: FilterUpdate, measured: WindowEstimate, *, n_accepted: int = 1
) -> None:
    """Take what the filter says after a window for what is known; it may be the second accepted."""
    joint, previous = update.joint, context.registration
    doubted = _still_doubted(context.state, update, measured)
    anew = update.jumped or (previous is not None and previous.suspected_jump is not None)
    bias = bias_of(joint)
    registration = Registration(
        alpha=alpha_of(joint, measured.alpha),
        covariance=joint.alpha_covariance,
        stretches=stretches_of(joint),
        floor=measured.floor,
        image_floor=context.policy.image_floor,
        t_ns_utc=measured.t_ns_utc,
        arrived_ns_utc=context.now_ns,
        n_windows=update.n_windows,
        scatter=update.scatter,
        window_ns_utc=context.now_ns,
        window_began_ns_utc=measured.began_ns_utc,
        optical_gain=measured.optical_gain,
        optical_gains=measured.optical_gains,
        # What was known before a jump is of another registration.
        bias=without_previous(bias) if anew else bias,
        previous_estimate=None if anew else _previous_estimate(previous, update, measured),
        jumped_ns_utc=_jumped_ns_utc(previous, update, context.now_ns),
        doubt=previous.doubt if previous is not None and doubted else "",
        doubt_voids=previous is None or previous.doubt_voids,
        pointing=measured.pointing,
        window_pointing=validity.pointing_at(context.state, measured.began_ns_utc),
        restored_ns_utc=previous.restored_ns_utc if previous is not None else None,
        basis_id=context.loop.basis_id,
        config_id=context.loop.config_id,
        nominal=context.alpha.law.nominal,
    )
    validity.store_registration(context, registration)
    context.alpha = replace(context.alpha, far_windows=())
    context.windows = replace(context.windows, accepted=context.windows.accepted + n_accepted)
    if not doubted:
        validity.make_valid(context, Purpose.SETTLE)
        validity.end_window_request(context)
    add_history(context, history_entry(measured, registration, update.innovation))
    validity.age_registration(context)


def _still_doubted(state: TrackerState, update: FilterUpdate, measured: WindowEstimate) -> bool:
    """Return True if α stays in doubt because the window began before the doubt.

    A window that confirms the registration after a jump need not have begun since: it agrees with
    the window before it.
    """
    registration = state.alpha.registration
    if registration is None or not registration.doubt:
        return False
    # A jump is confirmed by two windows that agree, even if the first began before the doubt.
    since_ns = measured.t_ns_utc if update.jumped else measured.began_ns_utc
    return validity.explain_void(state, since_ns, Purpose.SETTLE) is not None


def _jumped_ns_utc(
    registration: Registration | None, update: FilterUpdate, now_ns: int
) -> int | None:
    if update.jumped:
        return now_ns
    return None if registration is None else registration.jumped_ns_utc


def _previous_estimate(
    registration: Registration | None, update: FilterUpdate, measured: WindowEstimate
) -> PreviousEstimate | None:
    """Return what was known before a window, and before the one that came before it."""
    # After a first window, or a jump, no earlier estimate describes the same registration.
    if registration is None or update.n_windows == 1:
        return None
    before = registration.previous_estimate
    return replace(
        to_previous_estimate(registration),
        next_window=measured,
        previous_estimate=None
        if before is None
        else replace(before, next_window=None, previous_estimate=None),
    )


def history_entry(
    measured: WindowEstimate, registration: Registration, innovation: float, *, entered: bool = True
) -> HistoryEntry:
    """Return the line of the history that a window leaves."""
    return HistoryEntry(
        t_ns_utc=measured.t_ns_utc,
        measured=measured.alpha,
        measured_sigma=measured.sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.shown_sigma,
        innovation=innovation,
        misfit=measured.misfit,
        source=measured.source,
        entered=entered,
    )


def model_error_of(
    registration: Registration | None,
    estimate: DitheredEstimate,
    policy: Policy,
    own: tuple[float, ...] | None = None,
) -> Array:
    """Return the model error by all windows so far.

    It is the larger of the setting and of what windows leave unexplained. A window with less
    accuracy than this loop needs of α cannot determine it: the noise in its misfit, times its own
    σ, would exceed any model error. ``own`` ``(4,)`` is the model error from the RTC's own matrix,
    a lower bound that no window reduces.
    """
    before = policy.floor if registration is None else registration.floor
    if own is not None:
        before = np.maximum(before, np.hypot(policy.floor, own))
    # Noise in the misfit of such a window, times its own σ, would exceed any model error.
    if np.any(np.diag(estimate.covariance) > (policy.tolerance * policy.dither_sigma) ** 2):
        return before
    error = model_error(estimate.covariance, estimate.misfit)
    if own is not None:
        error = np.maximum(error, own)
    # The model error does not average down with the number of windows.
    squared = policy.floor**2 + error**2
    share = 1.0 if registration is None else 1.0 / min(registration.n_windows + 1, MISFIT_WINDOWS)
    return np.asarray(np.sqrt(before**2 + share * (squared - before**2)))


def gains_of(estimate: DitheredEstimate) -> tuple[tuple[int, ...], Array, Any]:
    """Return modes, moduli of their gains, and 1 σ of them where it is known."""
    if isinstance(estimate, RandomEstimate):
        return estimate.gains_by_group(GAIN_GROUPS)
    return estimate.modes, np.abs(estimate.optical_gain), estimate.gain_sigma


def strong_gains(estimate: DitheredEstimate) -> Array:
    """Return the moduli of the gains that determine α."""
    modes, gains, _ = gains_of(estimate)
    return gains if len(modes) != len(estimate.strong) else gains[estimate.strong]


def check_window(context: StepContext, estimate: DitheredEstimate, began_ns_utc: int) -> Why | None:
    """Return why a window's estimate must not be used, or None."""
    if context.rtc is None or estimate.session != context.rtc.session:
        return RefusalKind.VOID, OTHER_SESSION
    void = check_measurable(context.state, began_ns_utc)
    if void is not None:
        return RefusalKind.VOID, as_message("window.void", void)
    odd = mode_proof.check_information(context, estimate)
    if odd is not None:
        return RefusalKind.VOID, as_message("window.modes", odd)
    lag = float(np.median(estimate.lag_frames))
    if abs(lag) > MAX_LAG_FRAMES:
        return RefusalKind.MISALIGNED, compose("window.misaligned", lag_frames=lag)
    gains = strong_gains(estimate)
    if gains.min() < GAIN_RANGE[0] or gains.max() > GAIN_RANGE[1]:
        least, most = float(gains.min()), float(gains.max())
        expected = "{} to {}".format(*GAIN_RANGE)
        return RefusalKind.OTHER, compose("window.gains", least=least, most=most, expected=expected)
    if np.any(estimate.sigma > context.policy.useless_sigma):
        return RefusalKind.OTHER, compose("window.uncertain")
    near = context.start_of_fits if context.registration is None else context.registration.alpha
    step, leap = estimate.alpha.vector - near.vector, context.alpha.law.leap
    sides = np.abs([step] if leap is None else [step, step - leap.other_side])
    if np.all(np.any(sides > CAPTURE_RANGE, axis=1)) and not _far_windows_agree(context, estimate):
        return RefusalKind.OUT_OF_REACH, compose(
            "window.far",
            alpha=str(estimate.alpha.to_boundary()),
            start=str(near.to_boundary()),
        )
    return None


def _far_windows_agree(context: StepContext, estimate: DitheredEstimate) -> bool:
    """Return whether windows far from where their fits began agree so often that α is there.

    Only while α is unknown, and only windows that the model explains: a wrong order of modes or
    slopes leads every window to the same wrong place, and leaves most of it unexplained.
    """
    if context.registration is not None:
        return False
    shares = None if estimate.unexplained is None else estimate.unexplained[estimate.strong]
    if shares is None or shares.max(initial=0.0) > MAX_UNEXPLAINED_SHARE:
        context.alpha = replace(context.alpha, far_windows=())
        return False
    earlier = context.alpha.far_windows
    window = TimedEstimate(
        alpha=estimate.alpha, covariance=estimate.covariance, t_ns_utc=estimate.t_ns_utc
    )
    if earlier:
        sigma = np.sqrt(np.diag(earlier[-1].covariance + estimate.covariance))
        apart = np.abs(estimate.alpha.vector - earlier[-1].alpha.vector)
        if np.any(apart > np.maximum(_MAX_SCATTER_SIGMA * sigma, AGREEMENT_DISTANCE)):
            earlier = ()
    together = (*earlier, window)[-N_FAR_WINDOWS:]
    context.alpha = replace(context.alpha, far_windows=together)
    return len(together) >= N_FAR_WINDOWS


def check_measurable(state: TrackerState, began_ns_utc: int) -> str | None:
    """Return why telemetry that began then, or any that comes now, measures nothing, or None."""
    alarm = blocking_alarm(state.alarms.active, Interlock.MEASURE)
    if alarm is None:
        because = validity.explain_void(state, began_ns_utc)
        return because and f"{because} when it was taken: its telemetry is no measurement"
    return f"{alarm.definition.because}: its telemetry is no measurement"
