"""The poles of the loop that a reconstructor runs in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlLoop:
    """An integrator of modes: ``c[k+d] = leak c[k+d-1] - gain R s[k]``."""

    gains: NDArray[np.floating]
    """``(n_controlled,)`` integrator gain of each mode the reconstructor commands."""

    leak: float
    delay_frames: float
    frame_rate_hz: float
    optical_gain: float | NDArray[np.float64] = 1.0
    """How much of the model's response the sensor shows, of all modes or ``(n_modes,)``: below 1 on
    sky, up to 2 in double pass."""

    n_holding: int | None = None
    """Modes with which it is closed now, at these gains, and does not slip; None: it is not, or
    nobody knows."""

    outer: NDArray[np.float64] | None = None
    """``(n_outer, n_modes)`` position of each actuator of the mirror's outermost ring, metres, for
    a unit command of each mode; None: the modes are measured, it is not known."""

    noise: float = 1.0
    """1 σ of what the reconstructor multiplies where that of a slope is 1: half of it of pixels."""

    def of(self, modes: slice | NDArray[np.intp]) -> ControlLoop:
        """Return the same loop with only these modes controlled."""
        gain, outer = self.optical_gain, self.outer
        return replace(
            self,
            gains=self.gains[modes],
            optical_gain=gain if isinstance(gain, float) else gain[modes],
            outer=None if outer is None else outer[:, modes],
        )

    def pole_radius(self, eigenvalues: NDArray[Any]) -> NDArray[np.float64]:
        """Return the largest pole radius of each eigenvalue of ``gain R D G``, same shape."""
        return pole_radius(eigenvalues, leak=self.leak, delay_frames=self.delay_frames)


OFF_DIAGONAL = 1e-5
"""Of couplings computed in single precision, over the largest."""


def loop_modes(coupling: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Return eigenvalues ``(n,)`` and vectors ``(n, n)`` of g R D; None: the modes themselves.

    A new reconstructor leaves rounding beside the diagonal, and its eigenvectors mean nothing.
    """
    own = np.diag(coupling)
    beside = np.abs(coupling - np.diag(own)).max(initial=0.0)
    if beside <= OFF_DIAGONAL * np.abs(own).max(initial=0.0):
        return own, None
    return np.linalg.eig(coupling)


def pole_radius(
    loop_eigenvalues: NDArray[Any], *, leak: float = 1.0, delay_frames: float = 2.0
) -> NDArray[np.float64]:
    """Return the largest pole radius of each eigenvalue of ``gain R D G``, same shape.

    The loop ``c[k+d] = leak c[k+d-1] - R s[k]`` has its poles at the roots of
    ``z^d - leak z^(d-1) + λ``. A fractional delay is a share of each neighbouring whole one:
    ``z^(n+1) - leak z^n + λ ((1 - f) z + f)`` for ``d = n + f``.

    Raises
    ------
    ModelError
        If the delay is below one frame: no loop can answer an exposure before it ends.
    """
    if delay_frames < 1.0:
        raise ModelError(f"poles: found a delay of {delay_frames} frames; expected at least 1")
    whole = int(np.floor(delay_frames))
    share = delay_frames - whole
    values = np.asarray(loop_eigenvalues, dtype=complex)
    order = whole + (1 if share > 0.0 else 0)
    companion = np.zeros((*values.shape, order, order), dtype=complex)
    companion[..., range(1, order), range(order - 1)] = 1.0
    companion[..., 0, 0] = leak
    if share > 0.0:
        companion[..., 0, order - 2] -= values * (1.0 - share)
        companion[..., 0, order - 1] -= values * share
    else:
        companion[..., 0, order - 1] -= values
    return np.asarray(np.abs(np.linalg.eigvals(companion)).max(axis=-1))


def amplification(
    gain: NDArray[np.float64], frequency: NDArray[np.float64], *, leak: float, delay_frames: float
) -> NDArray[np.float64]:
    """Return what the loop makes of what is added to its commands, of the shape of both together.

    With ``c[k+d] = leak c[k+d-1] - gain (c + u)[k]`` the mirror moves by ``u / (1 + L)``,
    ``L = gain z^-d / (1 - leak z^-1)``; a fractional delay is shared as in ``pole_radius``.

    Parameters
    ----------
    gain
        Of the loop, the sensor's own included.
    frequency
        Over the frame rate.
    leak, delay_frames
        As a status tells them.
    """
    late = np.exp(-2j * np.pi * np.asarray(frequency))
    whole = int(np.floor(delay_frames))
    share = delay_frames - whole
    delayed = late**whole * ((1.0 - share) + share * late)
    return np.asarray(1.0 / np.abs(1.0 + gain * delayed / (1.0 - leak * late)))
