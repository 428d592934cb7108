"""Closed-loop poles of a modal integrator behind a mis-registered reconstructor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError

ROUNDING = 1e-5
"""Of couplings computed in single precision, over the largest."""


def loop_modes(coupling: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Return eigenvalues ``(n,)`` and vectors ``(n, n)`` of g R D; None: the modes themselves.

    A new reconstructor leaves rounding beside the diagonal, and its eigenvectors mean nothing.
    """
    own = np.diag(coupling)
    beside = np.abs(coupling - np.diag(own)).max(initial=0.0)
    if beside <= ROUNDING * np.abs(own).max(initial=0.0):
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


def integrator_limit(eigenvalue_argument_rad: NDArray[Any]) -> NDArray[np.float64]:
    """Return the largest stable ``gain |λ|`` for two frames of delay and no leak.

    ``2 sin((π/2 - |arg λ|) / 3)``; negative where no gain is stable. The closed form of
    ``pole_radius`` < 1, kept as its check and for explaining a refusal.
    """
    return np.asarray(2.0 * np.sin((np.pi / 2 - np.abs(eigenvalue_argument_rad)) / 3.0))
