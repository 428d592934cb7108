"""One estimate of the registration, from any estimator.

Every estimator cuts telemetry into windows, or forgets old telemetry, in constant memory. Its fit
gives α, a covariance from the scatter of the data themselves, and how well the model explains them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MODEL_ERROR_VARIANCE_RATIO = 15.0
"""Variance of α per unit of misfit above 1, over that of its scatter: what the model leaves over is
smooth across the pupil and pulls at α more than noise of the same power. From campaigns on the
diffractive telescope, two truths and two models (docs/results/tracking.md)."""


BIAS_WANDER = np.array([0.0, 0.0, 2.0, 4.0])
"""Multiples of its own scatter by which the bias may change from one estimate to the next."""


def model_error(covariance: NDArray[Any], misfit: float) -> NDArray[Any]:
    """Return ``(4,)`` 1 σ of the error that the model causes in a window, numeric units.

    It is as large as what the model leaves unexplained: a bright star shows what the noise of a
    faint one hides, so the telescope need not be known. It does not average out, because the next
    window has the same error.
    """
    # Noise alone has a misfit of 1: only what is beyond it is the model's.
    return np.sqrt(MODEL_ERROR_VARIANCE_RATIO * max(misfit - 1.0, 0.0) * np.diag(covariance))
