"""The stability gate: refuse a matrix that may be unstable.

It asks two things of a loop, over the whole range in which α may be. Its poles must stay inside
the unit circle with a margin. And slope noise must not move the outer ring of the mirror too far:
poles do not see that the outermost actuators, half in the dark, are driven by noise. Where an
excursion reaches a quarter of the wavelength the pyramid may lose the edge to the next fringe, and
a loop without leak never brings it back. On the diffractive telescope every such loop slipped above
300 nm per unit of slope noise, one at 201 nm and none below (docs/results/edge_slip.md), while pole
radii said nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from service.control.loop import ControlLoop, loop_modes
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]
Coupling = NDArray[np.float32]
Symmetric = NDArray[np.floating]

NEAR = 0.02
"""Where everything is within the bound the largest radius is sought no closer than this: each point
costs as much as all bounds together."""

ROUNDING = 1e-3
"""Of eigenvalues in single precision, and of a radius between two points of a border."""

_BORDER = 24
"""Points on each side of a rectangle."""

_MANY = 1000
"""Modes from which on a proven bound is cheaper than all eigenvalues."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GateVerdict:
    """Whether a reconstructor would hold the loop, over the whole range α may be in."""

    accepted: bool
    """True only if every pole, everywhere within α ± 3σ, stays inside the bound."""

    worst_pole_radius: float
    """Largest closed-loop pole radius found; 1 is the edge of stability. Of what is accepted no
    pole is beyond the bound, and none more than ``NEAR`` above this."""

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

    @property
    def unstable(self) -> bool:
        """Whether a loop grows somewhere: 1 is the edge of stability."""
        return self.worst_pole_radius >= 1.0


def judge(
    reconstructor: NDArray[np.float32],
    linearisation: Linearisation,
    registration: Misregistration,
    covariance: NDArray[np.float64],
    loop: ControlLoop,
    *,
    bound: float,
) -> GateVerdict:
    """Return whether the loop would hold everywhere within α ± 3σ.

    Tries the estimate and the ends of the axes of its 3σ ellipsoid, eight, or twelve where the
    anamorphosis is followed: ``covariance`` ``(4, 4)`` or ``(6, 6)`` includes the model-error
    floor, and ``linearisation`` has as many derivatives. The bound is never tighter than half-way
    between the aligned loop and the edge of stability, or a slow loop could never be served at all.
    A loop that is stable must not let its outer ring slip either (:func:`edge_motion_m`); as many
    modes as hold already may move it a little more, or the noise of α would cost modes. Modes
    without gain are not in the loop, and have no say: their command only fades.
    """
    holds = len(reconstructor) == loop.n_holding
    reconstructor, linearisation, loop = _moving(reconstructor, linearisation, loop)
    n = len(reconstructor)
    centre = reconstructor @ linearisation.matrix_at(registration)[:, :n]
    rates = linearisation.rates[: len(covariance)]
    covariance = covariance[: len(rates), : len(rates)]  # of a matrix that knows no stretch
    slopes = [reconstructor @ rate[:, :n] for rate in rates]
    gains = (loop.gains * loop.optical_gain).astype(np.float32)
    steps = _ellipsoid_ends(covariance).astype(np.float32)
    aligned = float(loop.pole_radius(gains).max())
    bound = max(bound, (1.0 + aligned) / 2)
    worst = _worst_pole(centre, np.array(slopes), steps, gains, loop, min(bound, 1.0))
    stable = _verdict(worst, aligned, bound, 1 + 2 * len(steps))
    if loop.outer is None or not stable.accepted:
        return stable
    motion_m = edge_motion_m(reconstructor, centre, gains.astype(float), loop.outer, loop)
    slippery = why_slippery(motion_m, loop.leak, holds=holds)
    return replace(
        stable,
        accepted=slippery is None,
        reason=slippery or stable.reason,
        edge_motion_m=motion_m,
    )


def _moving(
    reconstructor: NDArray[np.float32], linearisation: Linearisation, loop: ControlLoop
) -> tuple[NDArray[np.float32], Linearisation, ControlLoop]:
    """Return what is left of them without the modes that have no gain; all have none: all."""
    modes = np.flatnonzero(loop.gains)
    if len(modes) in {0, len(loop.gains)}:
        return reconstructor, linearisation, loop
    linearisation = replace(
        linearisation,
        matrix=linearisation.matrix[:, modes],
        derivatives=linearisation.derivatives[:, :, modes],
        stretches=None if linearisation.stretches is None else linearisation.stretches[:, :, modes],
    )
    return reconstructor[modes], linearisation, loop.of(modes)


def _worst_pole(
    centre: Coupling,
    slopes: Coupling,
    steps: Coupling,
    gains: Coupling,
    loop: ControlLoop,
    limit: float,
) -> float:
    """Return the largest pole radius at the centre and at both ends of every step.

    Points are tried in the order of what :func:`_ceilings` says they may reach at most. The rest is
    left out when none of it can matter: it stays within the limit, and no more than ``NEAR`` above
    what was found; or one was found beyond the limit. Of many modes a point's own ceiling, lower
    than that of a sum, is asked before all of its eigenvalues.
    """
    moves = np.tensordot(steps, slopes, axes=1)
    ends = [np.zeros_like(centre), *moves, *-moves]
    ceilings = _ceilings(centre, moves, gains, loop)
    worst = 0.0
    for k in np.argsort(-ceilings):
        enough = max(worst, min(limit, worst + NEAR))
        if worst > limit or ceilings[k] <= enough:
            break
        there = centre + ends[k]
        if worst > 0.0 and len(there) >= _MANY:
            own, *_ = _ceilings(there, moves[:0], gains, loop)
            if own <= enough:
                continue
        radii = loop.pole_radius(np.linalg.eigvals(gains[:, None] * there))
        worst = max(worst, float(radii.max()))
    return worst


def _ceilings(
    centre: Coupling, moves: Coupling, gains: Coupling, loop: ControlLoop
) -> NDArray[np.float64]:
    """Return radii that no pole exceeds: at the centre, and at both ends of every move.

    Eigenvalues of ``g R D`` are those of ``B = √g R D √g``. They lie in a rectangle about its
    numerical range: real parts between the extreme eigenvalues of ``(B + B^T) / 2``, imaginary
    ones within the norm of ``(B - B^T) / 2``; of a sum of two it is at most the sum of both. The
    largest pole of a region lies on its border, for a spectral radius is subharmonic.
    """
    if gains.min() < 0.0:
        return np.full(1 + 2 * len(moves), np.inf)
    root = np.sqrt(gains)
    own, *parts = (_extent(root[:, None] * part * root) for part in (centre, *moves))
    extents = [own, *(own + part for part in parts)]
    extents += [own + np.array([-high, -low, turn]) for low, high, turn in parts]
    return np.array([_largest_on_border(extent, loop) for extent in extents])


def _extent(matrix: Coupling) -> NDArray[np.float64]:
    """Return least and largest real part and largest imaginary part of the numerical range.

    Of many modes they are bounds, about ``ROUNDING`` further out.
    """
    even, odd = (matrix + matrix.T) / 2, (matrix - matrix.T) / 2
    square = odd.T @ odd
    if len(matrix) < _MANY:
        (low, high), (_, most) = _ends(even), _ends(square)
    else:  # Lanczos hardly finds the least of a square: it takes thousands of steps
        (low, high), most = _proven_ends(even), _proven_largest(square)
    turn = np.sqrt(max(most, 0.0))
    slack = ROUNDING * max(abs(low), abs(high), turn)
    return np.array([low - slack, high + slack, turn + slack], dtype=np.float64)


def _ends(symmetric: Symmetric) -> tuple[float, float]:
    """Return the least and the largest eigenvalue."""
    values = np.linalg.eigvalsh(symmetric)
    return float(values[0]), float(values[-1])


def _proven_ends(symmetric: Symmetric) -> tuple[float, float]:
    """Return what no eigenvalue is below, and none above."""
    return -_proven_largest(-symmetric), _proven_largest(symmetric)


def _proven_largest(symmetric: Symmetric) -> float:
    """Return what no eigenvalue exceeds, at a tenth of the cost of all of them.

    Lanczos guesses the largest. That none lies beyond is proven: the matrix that is left of so many
    times the identity has a Cholesky factor. A guess that is too low is raised until it has, up to
    the largest sum of a row's sizes, which needs no proof.
    """
    surely = float(np.abs(symmetric).sum(axis=0).max())
    typical = float(np.linalg.norm(symmetric)) / len(symmetric) ** 0.5
    start = np.random.default_rng(0).standard_normal(len(symmetric)).astype(symmetric.dtype)
    try:
        largest = float(
            scipy.sparse.linalg.eigsh(
                symmetric, k=1, which="LA", v0=start, tol=ROUNDING, return_eigenvectors=False
            )[0]
        )
    except scipy.sparse.linalg.ArpackError:
        return surely
    margin: float = ROUNDING * max(abs(largest), typical)
    while largest + margin < surely:
        rest = -symmetric
        rest[np.diag_indices_from(rest)] += largest + margin
        try:
            scipy.linalg.cholesky(rest, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:
            margin *= 2.0
        else:
            return largest + margin
    return surely


def _largest_on_border(extent: NDArray[np.float64], loop: ControlLoop) -> float:
    low, high, turn = extent
    along, up = np.linspace(low, high, _BORDER), np.linspace(0.0, turn, _BORDER)
    border = np.concatenate([along + 1j * turn, low + 1j * up, high + 1j * up])
    radii = loop.pole_radius(border)
    return float(radii.max()) + ROUNDING


def _ellipsoid_ends(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return one end of each of the 3σ axes, a row each; the other is its negative.

    The axes are those of the correlation matrix, so that units play no part.
    """
    sigma = np.sqrt(np.diag(covariance))
    power, axes = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray(3.0 * (axes * np.sqrt(np.maximum(power, 0.0))).T * sigma)


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


LIMIT_M = 195e-9
"""Largest motion of an outer actuator per unit of slope noise that a loop without leak bears."""

HELD_LIMIT_M = 199e-9
"""The same of a loop that runs and holds with as many modes. No loop has slipped that close: the
limit is a round figure, and to turn back for a nanometre of it costs 24 nm of wavefront where 45
modes become 30."""

FORGIVING_LEAK = 0.99
"""A leak as strong as this brings a slipped segment back within a tenth of a second."""

_N_FREQUENCIES = 256


def edge_motion_m(
    reconstructor: NDArray[np.float32],
    coupling: NDArray[np.float32],
    gains: Array,
    outer: Array,
    loop: ControlLoop,
) -> float:
    """Return the largest RMS motion of an outer actuator for white slope noise of 1, metres.

    ``coupling`` ``(n, n)`` is R D(α); ``gains`` ``(n,)`` is integrator times optical gain;
    ``outer`` is as a ``ControlLoop`` has it. In the eigenbasis of ``g R D = V Λ V^-1`` the command
    answers noise by
    ``H_i = z^-d / (1 - leak z^-1 + λ_i z^-d)``, so that its covariance is ``V (N o <H H*>) V*``
    with ``N`` that of ``V^-1 g R n`` and the mean taken over the unit circle.
    """
    eigenvalues, vectors = loop_modes(gains[:, None] * coupling.astype(float))
    commanded = gains[:, None] * reconstructor.astype(float)
    # V^-1 S V^-H of the real n by n S: the slopes are many, and complex they would cost most of all
    driven = commanded @ commanded.T
    seen = outer[:, : len(gains)]
    if vectors is not None:
        driven = np.linalg.solve(vectors, np.linalg.solve(vectors, driven).conj().T)
        seen = seen @ vectors
    turns = np.pi * (np.arange(_N_FREQUENCIES) + 0.5) / _N_FREQUENCIES
    delayed = np.exp(-1j * turns * loop.delay_frames)[:, None]
    response = delayed / (1.0 - loop.leak * np.exp(-1j * turns)[:, None] + eigenvalues * delayed)
    # conjugate pairs of eigenvalues make the other half of the circle the conjugate of this one
    covariance = driven * (response.T @ response.conj() / _N_FREQUENCIES)
    power = np.einsum("ai,ai->a", seen @ covariance, seen.conj()).real
    return loop.noise * float(np.sqrt(power.max()))


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
