"""How far a measurement lies from what was known: whether the mirror has jumped.

The filter allows for a random walk, which can go far in a few seconds. Flexure is smooth: over less
than a minute it goes as time itself and not as its root, and what goes faster should be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.estimation.passive import BIAS_FLOOR
from service.estimation.wind import Joint
from service.model.misregistration import Misregistration
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.validity import flexure
from service.state import Earlier, Pointing, Registration

STEADY_S = 60.0
"""The drift of a minute is what the settings tell: over less it is that share of it."""

VARYING = 0.3
"""Share of the model error that differs from window to window: bright stars scatter by 0.1 % of a
subaperture and 6 mdeg, twice what their own data say (docs/results/night.md)."""

CLOCK_SET_BACK_S = 60.0
"""Telemetry never waits so long for the worker: the RTC's clock has gone back."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """What was measured, when, and where the telescope looked."""

    value: Array
    """``(4,)`` numeric units."""

    noise: Array
    """``(4, 4)`` its covariance."""

    t_ns_utc: int
    pointing: Pointing | None


def window_surprise(known: Registration, reading: Reading, policy: Policy) -> float:
    """Return how far a window lies from α.

    Squared, normalised, expected 4. It is seen from after the last window and from before it: a
    jump in the middle of a window moves that one by half of it and the next by the other half, and
    neither half need be far out.
    """
    last = Earlier(
        alpha=known.alpha,
        covariance=known.covariance,
        t_ns_utc=known.t_ns_utc,
        pointing=known.pointing,
    )
    return max(
        _surprise(earlier, reading, policy, np.zeros(4))
        for earlier in (last, known.earlier)
        if earlier is not None
    )


def look_surprise(known: Registration, joint: Joint, reading: Reading, policy: Policy) -> float:
    """Return the same of a passive look, its bias allowed for; ``joint`` is at ``known``'s time."""
    before = known.bias.earlier if known.bias is not None else None
    found = []
    for earlier in (sum_of(known, joint), before):
        if earlier is not None:
            elapsed_s = max(reading.t_ns_utc - earlier.t_ns_utc, 0) / SECOND_NS
            fading = -np.expm1(-2.0 * elapsed_s / policy.bias_memory_s)
            found.append(_surprise(earlier, reading, policy, BIAS_FLOOR**2 * fading))
    return max(found)


def sum_of(known: Registration, joint: Joint) -> Earlier:
    """Return what a passive look should read: α and its bias together, the filter as it stands."""
    covariance = joint.covariance
    shared = covariance[4:, :4]
    return Earlier(
        alpha=Misregistration.from_vector(joint.alpha + joint.bias),
        covariance=covariance[:4, :4] + covariance[4:, 4:] + shared + shared.T,
        t_ns_utc=known.t_ns_utc,
        pointing=known.pointing,
    )


def _surprise(earlier: Earlier, reading: Reading, policy: Policy, forgot: Array) -> float:
    elapsed_s = (reading.t_ns_utc - earlier.t_ns_utc) / SECOND_NS
    if elapsed_s < -CLOCK_SET_BACK_S:
        return 0.0
    elapsed_s = max(elapsed_s, 0.0)
    drifted = policy.drift_rate**2 * elapsed_s * min(elapsed_s / STEADY_S, 1.0)
    bent = flexure(earlier.pointing, reading.pointing, policy)
    added = drifted + bent**2 + (VARYING * policy.floor) ** 2 + forgot
    total = earlier.covariance + reading.noise + np.diag(added)
    difference = reading.value - earlier.alpha.vector
    return float(difference @ np.linalg.solve(total, difference))
