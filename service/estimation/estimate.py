"""One estimate of the registration, from any estimator.

Every estimator cuts telemetry into windows, or forgets the old of it, in constant memory. Its fit
says what it found of α, how sure it is by the scatter of the data themselves, and how well the
model explains them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.misregistration import Determination

MODEL_ERROR_VARIANCE_RATIO = 15.0
"""Variance of α per unit of misfit above 1, over that of its scatter: what the model leaves over is
smooth across the pupil and pulls at α more than noise of the same power. From campaigns on the
diffractive telescope, two truths and two models (docs/results/tracking.md)."""


BIAS_FLOOR = np.array([0.10, 0.10, np.deg2rad(0.05), 0.001])
"""1 σ of the bias of a passive estimate that none may go below without a dither, numeric units.

It is the wind's, and the model's own error. Where the loop's own noise hardly shows (a bright star
in 25 m/s) the scatter grows, and the bias with it: a quarter of a subaperture was seen at a scatter
of 0.014. On 12 subapertures a bright star turns it, too: by up to 1 deg at a scatter of 0.4, in
OOPAO's loops. Where 60 modes look through bad seeing the magnification is 2 to 5 times its scatter
too large, every time, and on a bright star the rotation up to 2.5 times off.
"""

BIAS_OVER_SCATTER = np.array([10.0, 10.0, 2.0, 0.0])
"""Multiples of its own scatter that the bias of an estimate may have beyond that."""

BIAS_WANDER = np.array([0.0, 0.0, 2.0, 4.0])
"""Multiples of its own scatter by which the bias may change from one estimate to the next."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate(Determination):
    """One estimate of the registration from telemetry.

    The covariance is of the scatter of the data; no model error is in it.
    """

    optical_gain: NDArray[Any]
    """``(n,)`` gain of the sensor on each mode looked at, against the model; complex with a lag."""

    misfit: float
    """Residual power over what noise explains; 1: the model explains the data."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation to the estimate, numeric units."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveEstimate(Estimate):
    """A registration estimated from ordinary telemetry.

    The covariance describes the scatter alone, not the bias. A misfit of NaN means too little
    telemetry.
    """

    @property
    def bias_excess(self) -> NDArray[np.float64]:
        """Return ``(4,)`` variance of the bias beyond its floor, as the scatter indicates it."""
        return np.asarray(np.diag(self.covariance) * np.square(BIAS_OVER_SCATTER))

    @property
    @override
    def sigma(self) -> NDArray[np.float64]:
        """``(4,)`` 1 σ in numeric units where nothing is known of the bias."""
        return np.asarray(
            np.sqrt(np.diag(self.covariance) + np.square(BIAS_FLOOR) + self.bias_excess)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitheredEstimate(Estimate):
    """One window's estimate, which may enter the registration."""

    lag_frames: NDArray[np.float64]
    """Frames by which slopes lag commands; 0 if the columns are aligned as the contract requires.
    """

    t_ns_utc: int
    """End of the window."""

    cm_id: str | None
    """The reconstructor in use."""

    session: str
    modes: tuple[int, ...] = ()
    """0-based basis index of each gain; empty: not known."""

    gain_sigma: NDArray[np.float64] | None = None
    """``(n,)`` 1 σ of each gain's modulus; None: not known."""

    weak: tuple[int, ...] = ()
    """Modes that were dithered far more weakly than the others: nothing of α depends on them."""

    unexplained: NDArray[np.float64] | None = None
    """``(n,)`` share of the power of each mode's answer that the model does not explain, the noise
    subtracted; None if not measured."""

    answers_as: tuple[int, ...] = ()
    """Mode of the model whose response each mode's answer certainly is, its own where that is not
    certain; empty: not looked at."""

    with_stretches: NDArray[np.float64] | None = None
    """``(6, 6)`` covariance of α and its anamorphosis together; None: that is not followed."""

    stretched: float = 0.0
    """Largest step of an anamorphosis from the linearisation to the estimate."""

    @property
    def strong(self) -> NDArray[np.bool_]:
        """Return ``(n,)`` True for gains of modes that contain information on α."""
        which = np.ones(len(self.optical_gain), dtype=bool)
        which[: len(self.modes)] = [mode not in self.weak for mode in self.modes]
        return which


def model_error(covariance: NDArray[Any], misfit: float) -> NDArray[Any]:
    """Return ``(4,)`` 1 σ of the error that the model causes in a window, numeric units.

    It is as large as what the model leaves unexplained: a bright star shows what the noise of a
    faint one hides, so the telescope need not be known. It does not average out, because the next
    window has the same error.
    """
    # Noise alone has a misfit of 1: only what is beyond it is the model's.
    return np.sqrt(MODEL_ERROR_VARIANCE_RATIO * max(misfit - 1.0, 0.0) * np.diag(covariance))
