"""Variance by mode, as the figures show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_WIDTH = 9
_EXACT = 10
"""First modes, shown as they are."""


def smoothed(variance_nm2: Array) -> tuple[NDArray[np.intp], Array]:
    """Return mode numbers from 1 and variances: as they are, then a running mean over 9 modes."""
    mean = np.convolve(variance_nm2, np.full(_WIDTH, 1 / _WIDTH), mode="same")
    high = len(variance_nm2) - _WIDTH // 2
    values = np.concatenate([variance_nm2[:_EXACT], mean[_EXACT:high]])
    return np.arange(1, high + 1), values
