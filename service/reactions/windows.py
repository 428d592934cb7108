"""Windows of telemetry become the registration, or a reason why not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.events import WindowFitted
from service.reactions.acquisition_plan import missed
from service.reactions.alarms import RULES, WRONG_ANSWER, Act, forbidding
from service.reactions.dither import DITHER_LOST, found_again
from service.reactions.estimate import Measured
from service.reactions.evidence import Taken, taken, tells_of, why_void
from service.reactions.journal import logged, with_alarm, without_alarm
from service.reactions.modal_gain import followed_gains
from service.reactions.policy import Policy
from service.reactions.tracking import with_window
from service.reactions.validity import USELESS_SIGMA
from service.state import Level, Registration, Source, TrackerState
from service.telemetry.estimator import DitheredEstimate, model_error
from service.telemetry.instrumental import MAX_LAG_FRAMES
from service.telemetry.noisymatrix import RandomEstimate

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
    reason = _why_useless(state, estimate, when, policy)
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


def _why_useless(
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
