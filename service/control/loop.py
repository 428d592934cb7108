"""Model of the integrator loop: its poles, eigenmodes and amplification."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlLoop:
    """Modal integrator ``c[k+d] = leak c[k+d-1] - gain R s[k]``."""

    gains: NDArray[np.floating]
    """``(n_controlled,)`` integrator gain of each mode that the reconstructor commands."""

    leak: float
    """Leak factor per frame; 1 is a pure integrator."""

    delay_frames: float
    """Delay d from an exposure to the command that corrects it, at least 1."""

    frame_rate_hz: float
    optical_gain: float | NDArray[np.float64] = 1.0
    """Response of the sensor over that of the model, one for all modes or ``(n_modes,)``: below 1
    on sky, up to 2 in double pass."""

    n_holding: int | None = None
    """Number of modes with which the loop runs now, at these gains, without edge slip; None if it
    does not, or that is unknown."""

    outer: NDArray[np.float64] | None = None
    """``(n_outer, n_modes)`` position of each actuator of the mirror's outermost ring, metres, for
    a unit command of each mode; None if unknown because the modes were measured."""

    noise: float = 1.0
    """1 σ of the inputs of the reconstructor in units of slope noise; 0.5 for pixels."""

    def select_modes(self, modes: slice | NDArray[np.intp]) -> ControlLoop:
        """Return a copy of the loop that controls only these modes."""
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


MAX_ROUNDING_RATIO = 1e-5
"""Rounding error of couplings in single precision, over the largest coupling."""


def find_eigenmodes(coupling: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Return eigenvalues ``(n,)`` and eigenvectors ``(n, n)`` of the coupling g R D.

    The eigenvectors are None if the coupling is diagonal, so that they are the modes themselves.
    """
    own = np.diag(coupling)
    largest_other = np.abs(coupling - np.diag(own)).max(initial=0.0)
    # R of the present D leaves only rounding errors off the diagonal. Their eigenvectors would be
    # arbitrary and badly conditioned.
    if largest_other <= MAX_ROUNDING_RATIO * np.abs(own).max(initial=0.0):
        return own, None
    return np.linalg.eig(coupling)


def pole_radius(
    loop_eigenvalues: NDArray[Any], *, leak: float = 1.0, delay_frames: float = 2.0
) -> NDArray[np.float64]:
    """Return the largest pole radius of each eigenvalue of ``gain R D G``, same shape.

    The poles of ``c[k+d] = leak c[k+d-1] - R s[k]`` are the roots of ``z^d - leak z^(d-1) + λ``.
    A fractional delay ``d = n + f`` is the weighted mean of the neighbouring whole ones, which
    gives ``z^(n+1) - leak z^n + λ ((1 - f) z + f)``.

    Raises
    ------
    ModelError
        If the delay is below one frame, since no loop can correct an exposure before it ends.
    """
    if delay_frames < 1.0:
        raise ModelError(f"poles: found a delay of {delay_frames} frames; expected at least 1")
    whole = int(np.floor(delay_frames))
    share = delay_frames - whole
    values = np.asarray(loop_eigenvalues, dtype=complex)
    # the roots of a polynomial are the eigenvalues of its companion matrix
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


def compute_amplification(
    gain: NDArray[np.float64], frequency: NDArray[np.float64], *, leak: float, delay_frames: float
) -> NDArray[np.float64]:
    """Return the amplitude on the mirror of a sine added to the commands, over that added.

    With ``c[k+d] = leak c[k+d-1] - gain (c + u)[k]`` the mirror moves by ``u / (1 + L)``,
    ``L = gain z^-d / (1 - leak z^-1)``. A fractional delay is treated as in ``pole_radius``.

    Parameters
    ----------
    gain
        Loop gain, optical gain included.
    frequency
        Frequency of the sine over the frame rate, of a shape that broadcasts with ``gain``.
    leak, delay_frames
        As in the status of the RTC.
    """
    late = np.exp(-2j * np.pi * np.asarray(frequency))
    whole = int(np.floor(delay_frames))
    share = delay_frames - whole
    delayed = late**whole * ((1.0 - share) + share * late)
    return np.asarray(1.0 / np.abs(1.0 + gain * delayed / (1.0 - leak * late)))
