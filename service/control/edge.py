"""The edge term of the gate: how strongly slope noise moves the outer ring in closed loop.

Poles say whether a loop is stable; they do not see that the outermost actuators, half in the dark,
are driven by noise. Where an excursion reaches a quarter of the wavelength the pyramid may lose
the edge to the next fringe, and a loop without leak never brings it back. On the diffractive
telescope every such loop slipped above 300 nm per unit of slope noise, one at 201 nm and none below
(docs/results/edge_slip.md), while pole radii said nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.control.stability import loop_modes

Array = NDArray[np.float64]

LIMIT_M = 195e-9
"""Largest motion of an outer actuator per unit of slope noise that a loop without leak bears."""

HELD_LIMIT_M = 199e-9
"""The same of a loop that runs and holds with as many modes. No loop has slipped that close: the
limit is a round figure, and to turn back for a nanometre of it costs 24 nm of wavefront where 45
modes become 30."""

FORGIVING_LEAK = 0.99
"""A leak as strong as this brings a slipped segment back within a tenth of a second."""

_N_FREQUENCIES = 256


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outer:
    """The outermost ring of the mirror."""

    actuators: NDArray[np.float64]
    """``(n_outer, n_modes)`` position of each, metres, for a unit command of each mode."""


def edge_motion_m(
    reconstructor: NDArray[np.float32],
    coupling: NDArray[np.float32],
    gains: Array,
    outer: Outer,
    *,
    leak: float,
    delay_frames: float,
) -> float:
    """Return the largest RMS motion of an outer actuator for white slope noise of 1, metres.

    ``coupling`` ``(n, n)`` is R D(α); ``gains`` ``(n,)`` is integrator times optical gain. In the
    eigenbasis of ``g R D = V Λ V^-1`` the command answers noise by
    ``H_i = z^-d / (1 - leak z^-1 + λ_i z^-d)``, so that its covariance is ``V (N o <H H*>) V*``
    with ``N`` that of ``V^-1 g R n`` and the mean taken over the unit circle.
    """
    eigenvalues, vectors = loop_modes(gains[:, None] * coupling.astype(float))
    commanded = gains[:, None] * reconstructor.astype(float)
    # V^-1 S V^-H of the real n by n S: the slopes are many, and complex they would cost most of all
    driven = commanded @ commanded.T
    seen = outer.actuators[:, : len(gains)]
    if vectors is not None:
        driven = np.linalg.solve(vectors, np.linalg.solve(vectors, driven).conj().T)
        seen = seen @ vectors
    turns = np.pi * (np.arange(_N_FREQUENCIES) + 0.5) / _N_FREQUENCIES
    delayed = np.exp(-1j * turns * delay_frames)[:, None]
    response = delayed / (1.0 - leak * np.exp(-1j * turns)[:, None] + eigenvalues * delayed)
    # conjugate pairs of eigenvalues make the other half of the circle the conjugate of this one
    covariance = driven * (response.T @ response.conj() / _N_FREQUENCIES)
    power = np.einsum("ai,ai->a", seen @ covariance, seen.conj()).real
    return float(np.sqrt(power.max()))


def why_slippery(motion_m: float, leak: float, *, holds: bool = False) -> str | None:
    """Return why a loop with this motion of its edge must not be closed, or None.

    ``holds``: it is closed already with as many modes and these gains, and does not slip.
    """
    limit_m = HELD_LIMIT_M if holds else LIMIT_M
    if motion_m <= limit_m or leak <= FORGIVING_LEAK:
        return None
    return (
        f"its outer ring would slip: {motion_m * 1e9:.0f} nm of motion per unit of slope noise, "
        f"{limit_m * 1e9:.0f} at most without a leak of {FORGIVING_LEAK}; use fewer modes, a lower "
        "gain or more leak"
    )
