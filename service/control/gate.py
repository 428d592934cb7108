"""The stability gate: what keeps a bad matrix off the telescope."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.control.edge import Outer, edge_motion_m, why_slippery
from service.control.stability import pole_radius
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration


@dataclass(frozen=True, slots=True, kw_only=True)
class GateVerdict:
    """Whether a reconstructor would hold the loop, over the whole range α may be in."""

    accepted: bool
    """True only if every pole, everywhere within α ± 3σ, stays inside the bound."""

    worst_pole_radius: float
    """Largest closed-loop pole radius found; 1 is the edge of stability."""

    aligned_pole_radius: float
    """The same for a perfect reconstructor at these gains: nothing can do better."""

    bound: float
    """Largest radius that would have been accepted."""

    n_points: int
    """Registrations tried."""

    reason: str
    """What the operator should know, and do when it was refused."""

    edge_motion_m: float | None = None
    """Largest RMS motion of an outer actuator for slope noise of 1, metres; None: not known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopSettings:
    """The loop a reconstructor would run in."""

    gains: NDArray[np.float64]
    """``(n_controlled,)`` integrator gain of each mode the reconstructor commands."""

    leak: float
    delay_frames: float
    optical_gain: float | NDArray[np.float64] = 1.0
    """How much of the model's response the sensor shows, of all modes or ``(n_controlled,)``:
    below 1 on sky, up to 2 in double pass."""

    n_holding: int | None = None
    """Modes with which it is closed now, at these gains, and does not slip; None: it is not, or
    nobody knows."""

    outer: Outer | None = None
    """The mirror's outermost ring; None: the modes are measured, it is not known."""

    def of_first(self, n_modes: int) -> LoopSettings:
        """Return the same loop with only its first modes controlled."""
        gain = self.optical_gain
        return replace(
            self,
            gains=self.gains[:n_modes],
            optical_gain=gain if isinstance(gain, float) else gain[:n_modes],
        )


def judge(
    reconstructor: NDArray[np.float32],
    linearisation: Linearisation,
    registration: Misregistration,
    covariance: NDArray[np.float64],
    loop: LoopSettings,
    *,
    bound: float,
) -> GateVerdict:
    """Return whether the loop would hold everywhere within α ± 3σ.

    Tries the estimate and the eight ends of the axes of its 3σ ellipsoid; ``covariance``
    ``(4, 4)`` includes the model-error floor. The bound is never tighter than half-way between
    the aligned loop and the edge of stability, or a slow loop could never be served at all. A
    loop that is stable must not let its outer ring slip either (``service.control.edge``); as many
    modes as hold already may move it a little more, or the noise of α would cost modes. Modes
    without gain are not in the loop, and have no say: their command only fades.
    """
    holds = len(reconstructor) == loop.n_holding
    reconstructor, linearisation, loop = _moving(reconstructor, linearisation, loop)
    n = len(reconstructor)
    centre = reconstructor @ linearisation.matrix_at(registration)[:, :n]
    slopes = [reconstructor @ derivative[:, :n] for derivative in linearisation.derivatives]
    gains = (loop.gains * loop.optical_gain).astype(np.float32)
    couplings = (
        centre + np.tensordot(step.astype(np.float32), np.array(slopes), axes=1)
        for step in _ellipsoid_ends(covariance)
    )
    radii = [_worst_pole(coupling, gains, loop) for coupling in couplings]
    aligned = float(pole_radius(gains, leak=loop.leak, delay_frames=loop.delay_frames).max())
    stable = _verdict(max(radii), aligned, max(bound, (1.0 + aligned) / 2), len(radii))
    if loop.outer is None or not stable.accepted:
        return stable
    motion_m = edge_motion_m(
        reconstructor,
        centre,
        gains.astype(float),
        loop.outer,
        leak=loop.leak,
        delay_frames=loop.delay_frames,
    )
    slippery = why_slippery(motion_m, loop.leak, holds=holds)
    return replace(
        stable,
        accepted=slippery is None,
        reason=slippery or stable.reason,
        edge_motion_m=motion_m,
    )


def _moving(
    reconstructor: NDArray[np.float32], linearisation: Linearisation, loop: LoopSettings
) -> tuple[NDArray[np.float32], Linearisation, LoopSettings]:
    """Return what is left of them without the modes that have no gain; all have none: all."""
    modes = np.flatnonzero(loop.gains)
    if len(modes) in {0, len(loop.gains)}:
        return reconstructor, linearisation, loop
    gain, outer = loop.optical_gain, loop.outer
    loop = replace(
        loop,
        gains=loop.gains[modes],
        optical_gain=gain if isinstance(gain, float) else gain[modes],
        outer=outer and Outer(actuators=outer.actuators[:, modes]),
    )
    linearisation = replace(
        linearisation,
        matrix=linearisation.matrix[:, modes],
        derivatives=linearisation.derivatives[:, :, modes],
    )
    return reconstructor[modes], linearisation, loop


def _worst_pole(
    coupling: NDArray[np.float32], gains: NDArray[np.float32], loop: LoopSettings
) -> float:
    eigenvalues = np.linalg.eigvals(gains[:, None] * coupling)
    radii = pole_radius(eigenvalues, leak=loop.leak, delay_frames=loop.delay_frames)
    return float(radii.max())


def _ellipsoid_ends(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centre and the ends of the 3σ axes, ``(9, 4)``.

    The axes are those of the correlation matrix, so that units play no part.
    """
    sigma = np.sqrt(np.diag(covariance))
    power, axes = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    ends = 3.0 * (axes * np.sqrt(np.maximum(power, 0.0))).T * sigma
    return np.vstack([np.zeros(len(sigma)), ends, -ends])


def _verdict(worst: float, aligned: float, bound: float, n_points: int) -> GateVerdict:
    if worst >= 1.0:
        reason = (
            f"unstable: worst pole radius {worst:.3f} within 3 sigma; use fewer modes, a lower "
            "gain, or dither longer for a smaller sigma"
        )
    elif worst > bound:
        reason = (
            f"too little margin: worst pole radius {worst:.3f}, bound {bound:.3f}; use fewer "
            "modes, a lower gain, or dither longer for a smaller sigma"
        )
    else:
        reason = f"stable: worst pole radius {worst:.3f}, aligned {aligned:.3f}, bound {bound:.3f}"
    return GateVerdict(
        accepted=worst <= bound and worst < 1.0,
        worst_pole_radius=worst,
        aligned_pole_radius=aligned,
        bound=bound,
        n_points=n_points,
        reason=reason,
    )
