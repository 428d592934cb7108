"""The registration: now, window by window, and as ordinary telemetry sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The current estimate of α and how sure the service is of it."""

    alpha: Misregistration
    """The estimate."""

    covariance: NDArray[np.float64]
    """``(4, 4)``, numeric units (subapertures, radians, ratio), model-error floor not included."""

    floor: NDArray[np.float64]
    """``(4,)`` 1 σ of the model error that no integration removes, numeric units."""

    t_ns_utc: int
    """End of the last window that entered the estimate."""

    arrived_ns_utc: int
    """The same by the service's clock: age is judged by arrival, never by comparing clocks."""

    n_windows: int
    """Windows that entered the estimate."""

    optical_gain: float | None = None
    """Mean modulus of the measured complex gain of the dithered modes; None: not measured."""

    @property
    def total_covariance(self) -> NDArray[np.float64]:
        """``(4, 4)`` covariance with the model-error floor added."""
        return self.covariance + np.diag(self.floor**2)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """``(4,)`` 1 σ including the floor, numeric units (rotation in radians)."""
        return np.sqrt(np.diag(self.total_covariance))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HistoryEntry:
    """One window's own estimate and the filtered one after it."""

    t_ns_utc: int
    """End of the window."""

    measured: Misregistration
    """What this window alone says."""

    measured_sigma: NDArray[np.float64]
    """``(4,)`` its 1 σ from the data, numeric units."""

    filtered: Misregistration
    """The Kalman estimate after it."""

    filtered_sigma: NDArray[np.float64]
    """``(4,)`` 1 σ of the filtered estimate, floor included, numeric units."""

    innovation: float
    """Normalised innovation squared (4 degrees of freedom); 0 for the first window."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watchdog:
    """The passive estimate, from ordinary telemetry, beside the dithered one."""

    alpha: Misregistration
    sigma: NDArray[np.float64]
    """``(4,)`` numeric units; shifts carry the wind bias and are never below 0.1 subaperture."""

    t_ns_utc: int
    consistent: bool
    """False when it disagrees with the current α by more than its own uncertainty allows."""

    text: str
    """What the operator should know."""
