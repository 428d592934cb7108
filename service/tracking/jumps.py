"""Decide whether the mirror has jumped.

The filter allows for a random walk, which can go far in a few seconds. Flexure is smooth: over less
than a minute it goes as time itself and not as its root, and what goes faster should be seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.estimation.estimate import BIAS_WANDER
from service.estimation.kalman import JUMP_THRESHOLD, Joint
from service.model.misregistration import Misregistration
from service.records.estimates import BIAS_FLOOR
from service.records.registration import (
    PointedEstimate,
    PreviousEstimate,
    Registration,
    TimedEstimate,
)
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.validity import CLOCK_SET_BACK_S, flexure

DRIFT_TIME_S = 60.0
"""Time scale of the drift: the settings give the drift of a minute; a shorter time has a
proportional share."""

MODEL_ERROR_VARYING_SHARE = 0.3
"""Share of the model error that differs from window to window: bright stars scatter by 0.1 % of a
subaperture and 6 mdeg, twice what their own data say (docs/results/tracking.md)."""

USUAL_MODEL_ERROR_RATIO = 1.5
"""Times the instrument's floor that windows of simulated telescopes find as their model error, and
have in common: beyond it windows of other modes differ by it. Benches find 2 to 12 times."""

MAX_ROTATION_INNOVATION = 15.1
"""Value that the normalised square of one parameter exceeds once in 10 000, as ``JUMP_THRESHOLD``
does for four parameters. A rotation of 0.1 deg is 4 to 6 σ of a window at magnitude 10 and is not
significant among four parameters; a tenth of a subaperture is 20 σ and needs no separate test."""

MAX_ROTATION_INNOVATION_OF_TWO = 12.2
"""The same for two windows together, once in 2000: they must also agree."""

MAX_PASSIVE_INNOVATION = 26.9
"""Value that the innovation of a passive estimate exceeds once in 10 000. It is the larger of two,
and the scatter that normalises both is learnt from some forty estimates (four times F of 4 and 156,
at half of that probability)."""

MAX_SCATTER_RATIO = 1.5
"""Ratio of the scatter of windows to their prediction, in variance, that is significant: an
estimate of it from twenty windows scatters by 0.1, and one rejected window adds a quarter."""

WINDOW_CORRELATION_TIME_S = 10.0
"""Time for which the effect of turbulence on windows may be correlated: when a loop slips out of
the pyramid's range, windows are on one side of α for four to six seconds, then on the other."""

MAX_TURBULENCE_EXCESS = 12.0
"""Times what two windows together hardly exceed by chance that is beyond all turbulence: it has led
them as far as 6."""

MIN_JUMP_COSINE = 0.95
"""Cosine between two steps from α, each by the noise of windows, of one and the same jump. Of two
mistakes in four parameters one pair in 150 points as much the same way."""

MAX_JUMP_SHORTFALL_SHARE = 0.3
"""Share of a jump by which a window may fall short of it and still be of the new place."""

_ROTATION = 2

Array = NDArray[np.float64]
EstimateT = TypeVar("EstimateT", bound=TimedEstimate)


@dataclass(frozen=True, slots=True, kw_only=True)
class Innovation:
    """Distance of a measurement from the prediction."""

    mahalanobis_squared: float
    """Squared, normalised, of all four parameters: 4 is expected."""

    rotation: float
    """The same of the likelihood ratio of a mirror that has turned against none: 1 is expected."""

    rotation_limit: float = MAX_ROTATION_INNOVATION

    @property
    def excess(self) -> float:
        """Its least likely part, over what chance hardly ever exceeds."""
        return max(self.mahalanobis_squared / JUMP_THRESHOLD, self.rotation / self.rotation_limit)

    @property
    def is_outlier(self) -> bool:
        """Return True if the deviation is significant."""
        return self.excess > 1.0


ZERO_INNOVATION = Innovation(mahalanobis_squared=0.0, rotation=0.0)
"""Result when there is nothing to compare with."""


def innovation_of(difference: Array, covariance: Array) -> Innovation:
    """Return the distance of ``(4,)`` from zero, normalised by its covariance ``(4, 4)``."""
    weight = np.linalg.inv(covariance)
    score = weight @ difference
    return Innovation(
        mahalanobis_squared=float(score @ difference),
        # Likelihood ratio for a step of the rotation alone, given the correlations with the others.
        rotation=float(score[_ROTATION] ** 2 / weight[_ROTATION, _ROTATION]),
    )


def window_innovation(
    registration: Registration,
    window: PointedEstimate,
    policy: Policy,
    own_error: tuple[float, ...] | None = None,
) -> Innovation:
    """Return the distance of a window from α; ``own_error`` as ``ModeProof.own_model_error``.

    It is computed from the estimate after the last window and from the estimate before it. A jump
    in the middle of a window moves that window by half of it and the next by the other half, and
    neither half need be significant.
    """
    return _farthest(
        (to_previous_estimate(registration), registration.previous_estimate),
        _with_scatter(registration, window),
        policy,
        _model_scatter(registration, policy, own_error),
    )


def pair_innovation(
    registration: Registration,
    window: PointedEstimate,
    policy: Policy,
    own_error: tuple[float, ...] | None = None,
) -> Innovation:
    """Return the distance of a window and the previous one from the earlier estimate, together.

    Two windows have half the noise of one, so that a jump too small for one window is detected. The
    previous window was held or accepted. The estimates before both and before the window before are
    used, because the jump may have occurred in the middle of that one. It is no jump unless each is
    nearer to the other than to α.
    """
    first, before = previous_window(registration), registration.previous_estimate
    if first is None:
        return ZERO_INNOVATION
    seen_from = (to_previous_estimate(registration), before)
    if registration.suspected_jump is None and before is not None:
        # The first window has entered α already, so both are compared with the estimate before it.
        seen_from = (before, before.previous_estimate)
    window = _with_scatter(registration, window)
    first = _with_scatter(registration, first)
    varies = _model_scatter(registration, policy, own_error)
    alone = replace(window, alpha=first.alpha, covariance=first.covariance, t_ns_utc=first.t_ns_utc)
    nearest = min(
        _farthest(seen_from, one, policy, varies).mahalanobis_squared for one in (alone, window)
    )
    # Two windows of one new registration are near one another. Otherwise one is an outlier, or
    # began before the jump.
    if _squared_distance(first.alpha, first, window, policy) >= min(nearest, JUMP_THRESHOLD):
        return _jump_inside_first(registration, first, window, policy, varies)
    found = _farthest(seen_from, _together(first, window), policy, varies)
    return replace(found, rotation_limit=MAX_ROTATION_INNOVATION_OF_TWO)


def _jump_inside_first(
    registration: Registration,
    first: TimedEstimate,
    window: PointedEstimate,
    policy: Policy,
    varies: Array,
) -> Innovation:
    """Return the distance of a window if the mirror jumped to it during the previous window.

    That window is then between α and the new registration: significant by itself, in the same
    direction, and not beyond. Only a jump larger than any effect of turbulence is detected in this
    way.
    """
    if registration.suspected_jump is None:
        return ZERO_INNOVATION
    found = _farthest((to_previous_estimate(registration),), window, policy, varies)
    # A third window would cost two seconds of a loop that suffers, but only a jump this large
    # excludes turbulence (docs/decisions/0025-jumps.md).
    if found.excess <= MAX_TURBULENCE_EXCESS:
        return ZERO_INNOVATION
    # Both steps are measured in units of the noise, otherwise the units of the four parameters
    # would decide their angle.
    total = _noise_of_two(first, window, policy)
    part, whole = (one.alpha.vector - registration.alpha.vector for one in (first, window))
    along = float(part @ np.linalg.solve(total, whole))
    part_sq, whole_sq = (float(step @ np.linalg.solve(total, step)) for step in (part, whole))
    same_way = along >= MIN_JUMP_COSINE * np.sqrt(part_sq * whole_sq) and part_sq <= whole_sq
    return found if same_way else ZERO_INNOVATION


def previous_window(registration: Registration) -> TimedEstimate | None:
    """Return the window before the present one: held, or the last that entered."""
    if registration.suspected_jump is not None:
        return registration.suspected_jump
    previous = registration.previous_estimate
    return None if previous is None else previous.next_window


def jump_lasts(
    registration: Registration, first: TimedEstimate, window: PointedEstimate, both: Innovation
) -> bool:
    """Return whether windows have shown the new place, ``both`` so far, for long enough.

    Two suffice where windows scatter by what they say and are independent. Where they scatter by
    more, neighbours are wrong together, and they must agree for longer than that lasts.
    """
    if registration.scatter < MAX_SCATTER_RATIO or both.excess > MAX_TURBULENCE_EXCESS:
        return True
    return (window.t_ns_utc - first.began_ns_utc) / SECOND_NS >= WINDOW_CORRELATION_TIME_S


def is_after_jump(
    first: TimedEstimate, window: PointedEstimate, old: Misregistration, policy: Policy
) -> bool:
    """Return whether a window is of the new place ``reading`` shows, and not partly of ``old``.

    The first window after a jump began before it. What it may lack of the way (2 σ of the
    difference allowed for) must be little.
    """
    apart = _squared_distance(first.alpha, first, window, policy)
    # Upper limit of what the first window may lack, 2 σ of the difference included.
    lacks = np.sqrt(apart) + 2.0
    return apart < JUMP_THRESHOLD and bool(
        lacks <= MAX_JUMP_SHORTFALL_SHARE * np.sqrt(_squared_distance(old, first, window, policy))
    )


def passive_innovation(
    registration: Registration, joint: Joint, window: PointedEstimate, policy: Policy
) -> float:
    """Return the innovation of a passive estimate; ``joint`` is at the registration's time."""
    before = None if registration.bias is None else registration.bias.previous_estimate
    found, off = [], np.square(BIAS_WANDER) * np.diag(window.covariance)
    for earlier in (sum_of(registration, joint), before):
        if earlier is not None:
            elapsed_s = max(window.t_ns_utc - earlier.t_ns_utc, 0) / SECOND_NS
            # 1 - exp(-2t/T): the variance of a bias with memory T that has been forgotten. Twice
            # the rate, because it is a variance.
            fading = -np.expm1(-2.0 * elapsed_s / policy.bias_memory_s)
            # The bias fades with its memory, so an old comparison must allow for a new bias.
            forgot = np.square(BIAS_FLOOR) * fading + off
            found.append(_innovation_from(earlier, window, policy, forgot).mahalanobis_squared)
    # The larger of the two, because a change within one estimate shows fully only in comparison
    # with the state before it.
    return max(found)


def to_previous_estimate(registration: Registration) -> PreviousEstimate:
    """Return what is known, for when it will have been before."""
    return PreviousEstimate(
        alpha=registration.alpha,
        covariance=registration.covariance,
        t_ns_utc=registration.t_ns_utc,
        pointing=registration.pointing,
    )


def sum_of(registration: Registration, joint: Joint) -> PreviousEstimate:
    """Return the expected passive estimate: α and its bias together."""
    sees = joint.observation_rows()
    return PreviousEstimate(
        alpha=Misregistration.from_vector(sees @ joint.mean),
        covariance=sees @ joint.covariance @ sees.T,
        t_ns_utc=registration.t_ns_utc,
        pointing=registration.pointing,
    )


def _with_scatter(registration: Registration, window: EstimateT) -> EstimateT:
    """Return a window that says of itself how much windows have scattered lately."""
    return replace(window, covariance=registration.scatter * window.covariance)


def _together(first: TimedEstimate, window: PointedEstimate) -> PointedEstimate:
    """Return the mean of two windows, each by its precision, at the time of the second."""
    weights = [np.linalg.inv(noise) for noise in (first.covariance, window.covariance)]
    # Independent windows: their inverse covariances add.
    noise = np.linalg.inv(weights[0] + weights[1])
    value = noise @ (weights[0] @ first.alpha.vector + weights[1] @ window.alpha.vector)
    return replace(window, alpha=Misregistration.from_vector(value), covariance=noise)


def _squared_distance(
    place: Misregistration, first: TimedEstimate, window: PointedEstimate, policy: Policy
) -> float:
    """Return the squared distance of a window by the noise of two windows; expected 4."""
    difference = window.alpha.vector - place.vector
    return float(difference @ np.linalg.solve(_noise_of_two(first, window, policy), difference))


def _noise_of_two(first: TimedEstimate, window: PointedEstimate, policy: Policy) -> Array:
    """Return ``(4, 4)`` covariance of the difference of two windows of one place."""
    elapsed_s = max(window.t_ns_utc - first.t_ns_utc, 0) / SECOND_NS
    added = (
        _drift_variance(elapsed_s, policy) + 2.0 * (MODEL_ERROR_VARYING_SHARE * policy.floor) ** 2
    )
    return np.asarray(first.covariance + window.covariance + np.diag(added))


def _drift_variance(elapsed_s: float, policy: Policy) -> Array:
    """Return ``(4,)`` variance that a smooth flexure has added."""
    # Flexure is smooth: within a minute its variance grows with the square of the time.
    return np.asarray(policy.drift_rate**2 * elapsed_s * min(elapsed_s / DRIFT_TIME_S, 1.0))


def _model_scatter(
    registration: Registration, policy: Policy, own_error: tuple[float, ...] | None
) -> Array:
    """Return ``(4,)`` variance between windows by the model error that they have found.

    A window of other modes, or of a loop with another reconstructor, has another share of it: the
    whole of it may differ.
    """
    # Variances: only the part beyond the usual error differs between windows.
    usual = USUAL_MODEL_ERROR_RATIO * policy.floor
    beyond = np.maximum(registration.floor**2 - usual**2, 0.0)
    # The RTC's own matrix has shown the scatter between modes itself: no part of it is common to
    # all windows, however coarse the mirror and so large the floor. AO188's magnification would
    # otherwise "jump" by 17 σ from the many modes of the first dither to the next four.
    return np.asarray(beyond if own_error is None else np.maximum(beyond, np.square(own_error)))


def _farthest(
    seen_from: tuple[PreviousEstimate | None, ...],
    window: PointedEstimate,
    policy: Policy,
    varies: Array,
) -> Innovation:
    found = [_innovation_from(earlier, window, policy, varies) for earlier in seen_from if earlier]
    return max(found, key=lambda one: one.excess)


def _innovation_from(
    previous: PreviousEstimate, window: PointedEstimate, policy: Policy, forgot: Array
) -> Innovation:
    elapsed_s = (window.t_ns_utc - previous.t_ns_utc) / SECOND_NS
    # The RTC's clock was set back: the two times cannot be compared.
    if elapsed_s < -CLOCK_SET_BACK_S:
        return ZERO_INNOVATION
    elapsed_s = max(elapsed_s, 0.0)
    bent = flexure(previous.pointing, window.pointing, policy)
    added = (
        _drift_variance(elapsed_s, policy)
        + bent**2
        + (MODEL_ERROR_VARYING_SHARE * policy.floor) ** 2
        + forgot
    )
    total = previous.covariance + window.covariance + np.diag(added)
    return innovation_of(window.alpha.vector - previous.alpha.vector, total)
