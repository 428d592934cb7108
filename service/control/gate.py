"""Stability gate: accept or refuse a reconstructor before it is sent to the RTC.

A reconstructor has to pass two tests over the whole range α ± 3σ.

**Poles.** All closed-loop poles must be inside the unit circle with a margin.

**Edge slip.** Slope noise must not move the outermost ring of actuators too far. These actuators
are hardly illuminated, so noise drives them, which pole radii do not show. If such a motion
reaches a quarter of the wavelength, a pyramid may lock the edge of the mirror on the next fringe,
and a loop without leak never recovers. The motion is computed with the largest optical gains that
the loop may have. On the simulated diffractive telescope loops without leak slipped from 490 nm per
unit of slope noise on, and none up to 326 nm (docs/results/reliability.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from service.control.loop import ControlLoop, find_eigenmodes
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.records.products import GateVerdict

Array = NDArray[np.float64]
Coupling = NDArray[np.float32]
Symmetric = NDArray[np.floating]

RADIUS_TOLERANCE = 0.02
"""Accuracy of the largest pole radius of an accepted reconstructor.

The eigenvalues of one registration cost as much as the bounds of all of them, so registrations
that cannot raise the result by more than this are skipped.
"""

EIGENVALUE_TOLERANCE = 1e-3
"""Relative error of eigenvalues in single precision; also of a radius between two border points."""

_N_SIDE_POINTS = 24
"""Number of points on each side of the rectangle on whose border the pole radius is evaluated."""

_N_MODES_FOR_BOUNDS = 1000
"""Number of modes from which a proven bound is cheaper than all eigenvalues."""


def judge(
    reconstructor: NDArray[np.float32],
    linearisation: Linearisation,
    registration: Misregistration,
    covariance: NDArray[np.float64],
    loop: ControlLoop,
    *,
    bound: float,
) -> GateVerdict:
    """Return the verdict on a reconstructor for all registrations within α ± 3σ.

    The loop is evaluated at α and at both ends of the axes of the 3σ ellipsoid.

    Parameters
    ----------
    reconstructor
        ``(n_controlled, n_slopes)``.
    linearisation
        The model's D(α) with its derivatives.
    registration
        Estimate of α.
    covariance
        Covariance of α, model error included: ``(4, 4)``, or ``(6, 6)`` with anamorphosis.
    loop
        The loop in which the reconstructor will run.
    bound
        Largest pole radius to accept. If a perfect reconstructor in a slow loop already comes
        close to it, the limit is half-way between its radius and 1.
    """
    # The limit of edge motion is a round figure. A loop that runs with as many modes and does not
    # slip may exceed it slightly; otherwise the noise of α would take modes away at every update.
    holds = len(reconstructor) == loop.n_holding
    reconstructor, linearisation, loop = _drop_modes_without_gain(
        reconstructor, linearisation, loop
    )
    n = len(reconstructor)
    centre = reconstructor @ linearisation.matrix_at(registration)[:, :n]
    rates = linearisation.rates[: len(covariance)]
    # A linearisation without stretches has four derivatives, even if six parameters are tracked.
    covariance = covariance[: len(rates), : len(rates)]
    slopes = [reconstructor @ rate[:, :n] for rate in rates]
    gains = (loop.gains * loop.optical_gain).astype(np.float32)
    steps = _ellipsoid_ends(covariance).astype(np.float32)
    aligned = float(loop.pole_radius(gains).max())
    bound = max(bound, (1.0 + aligned) / 2)
    # Above the bound the verdict is certain, so that the search ends there.
    worst = _worst_pole(centre, np.array(slopes), steps, gains, loop, min(bound, 1.0))
    stable = _make_verdict(worst, aligned, bound, 1 + 2 * len(steps))
    if loop.outer is None or not stable.accepted:
        return stable
    motion_m = compute_edge_motion_m(reconstructor, centre, gains.astype(float), loop.outer, loop)
    refusal = check_edge_motion(motion_m, loop.leak, holds=holds)
    return replace(
        stable,
        accepted=refusal is None,
        reason=refusal or stable.reason,
        edge_motion_m=motion_m,
    )


def _drop_modes_without_gain(
    reconstructor: NDArray[np.float32], linearisation: Linearisation, loop: ControlLoop
) -> tuple[NDArray[np.float32], Linearisation, ControlLoop]:
    """Return the arguments restricted to modes with a gain, or unchanged if no mode has one.

    A mode without gain is not in the loop: its command only decays with the leak.
    """
    modes = np.flatnonzero(loop.gains)
    if len(modes) in {0, len(loop.gains)}:
        return reconstructor, linearisation, loop
    linearisation = replace(
        linearisation,
        matrix=linearisation.matrix[:, modes],
        derivatives=linearisation.derivatives[:, :, modes],
        stretches=None if linearisation.stretches is None else linearisation.stretches[:, :, modes],
    )
    return reconstructor[modes], linearisation, loop.select_modes(modes)


def _worst_pole(
    centre: Coupling,
    slopes: Coupling,
    steps: Coupling,
    gains: Coupling,
    loop: ControlLoop,
    limit: float,
) -> float:
    """Return the largest pole radius at the centre and at both ends of every step.

    The points are taken in falling order of the upper bounds from :func:`_bound_radii`. The search
    ends when a radius exceeds ``limit``, or when no remaining point can exceed it or be more than
    ``RADIUS_TOLERANCE`` above the largest radius so far.
    """
    moves = np.tensordot(steps, slopes, axes=1)
    ends = [np.zeros_like(centre), *moves, *-moves]
    upper_bounds = _bound_radii(centre, moves, gains, loop)
    worst = 0.0
    for k in np.argsort(-upper_bounds):
        irrelevant = max(worst, min(limit, worst + RADIUS_TOLERANCE))
        if worst > limit or upper_bounds[k] <= irrelevant:
            break
        coupling = centre + ends[k]
        if worst > 0.0 and len(coupling) >= _N_MODES_FOR_BOUNDS:
            # The bound of the sum itself is tighter than the sum of two bounds, and for many modes
            # it is still much cheaper than all eigenvalues.
            own, *_ = _bound_radii(coupling, moves[:0], gains, loop)
            if own <= irrelevant:
                continue
        radii = loop.pole_radius(np.linalg.eigvals(gains[:, None] * coupling))
        worst = max(worst, float(radii.max()))
    return worst


def _bound_radii(
    centre: Coupling, moves: Coupling, gains: Coupling, loop: ControlLoop
) -> NDArray[np.float64]:
    """Return upper bounds of the pole radius at the centre and at both ends of every move.

    The eigenvalues of ``g R D`` are those of ``B = √g R D √g``. They are inside a rectangle around
    the numerical range of B: real parts between the extreme eigenvalues of ``(B + B^T) / 2``,
    imaginary parts within the norm of ``(B - B^T) / 2``. The rectangle of a sum of two matrices is
    within the sum of their rectangles. The pole radius is a subharmonic function of the eigenvalue,
    so its maximum over a rectangle is on the border.
    """
    if gains.min() < 0.0:  # √g does not exist
        return np.full(1 + 2 * len(moves), np.inf)
    root = np.sqrt(gains)
    own, *parts = (_bound_numerical_range(root[:, None] * part * root) for part in (centre, *moves))
    extents = [own, *(own + part for part in parts)]
    extents += [own + np.array([-high, -low, turn]) for low, high, turn in parts]
    return np.array([_largest_radius_on_border(extent, loop) for extent in extents])


def _bound_numerical_range(matrix: Coupling) -> NDArray[np.float64]:
    """Return smallest and largest real part and largest imaginary part of the numerical range.

    For many modes these are bounds that are wider by about ``EIGENVALUE_TOLERANCE``.
    """
    even, odd = (matrix + matrix.T) / 2, (matrix - matrix.T) / 2
    # The eigenvalues of an antisymmetric matrix are imaginary: those of its square are their
    # squares.
    square = odd.T @ odd
    if len(matrix) < _N_MODES_FOR_BOUNDS:
        (low, high), (_, most) = _extreme_eigenvalues(even), _extreme_eigenvalues(square)
    else:  # the smallest eigenvalue of a square is not needed and costs Lanczos thousands of steps
        (low, high), most = _bound_eigenvalues(even), _bound_largest_eigenvalue(square)
    turn = np.sqrt(max(most, 0.0))
    slack = EIGENVALUE_TOLERANCE * max(abs(low), abs(high), turn)
    return np.array([low - slack, high + slack, turn + slack], dtype=np.float64)


def _extreme_eigenvalues(symmetric: Symmetric) -> tuple[float, float]:
    """Return the smallest and the largest eigenvalue."""
    values = np.linalg.eigvalsh(symmetric)
    return float(values[0]), float(values[-1])


def _bound_eigenvalues(symmetric: Symmetric) -> tuple[float, float]:
    """Return a lower bound of all eigenvalues and an upper one."""
    return -_bound_largest_eigenvalue(-symmetric), _bound_largest_eigenvalue(symmetric)


def _bound_largest_eigenvalue(symmetric: Symmetric) -> float:
    """Return a proven upper bound of all eigenvalues, at a tenth of the cost of computing them.

    Lanczos iterations estimate the largest eigenvalue, but may miss it. An estimate λ is proven by
    a Cholesky factorisation of ``λ I - A``, which exists only if no eigenvalue of A exceeds λ. If
    it fails, λ is raised, at most to the largest absolute row sum (Gershgorin), which needs no
    proof.
    """
    row_sum = float(np.abs(symmetric).sum(axis=0).max())
    typical = float(np.linalg.norm(symmetric)) / len(symmetric) ** 0.5
    # A fixed start, so that the same matrix always has the same verdict.
    start = np.random.default_rng(0).standard_normal(len(symmetric)).astype(symmetric.dtype)
    try:
        largest = float(
            scipy.sparse.linalg.eigsh(
                symmetric,
                k=1,
                which="LA",
                v0=start,
                tol=EIGENVALUE_TOLERANCE,
                return_eigenvectors=False,
            )[0]
        )
    except scipy.sparse.linalg.ArpackError:
        return row_sum
    margin: float = EIGENVALUE_TOLERANCE * max(abs(largest), typical)
    while largest + margin < row_sum:
        rest = -symmetric
        rest[np.diag_indices_from(rest)] += largest + margin
        try:
            scipy.linalg.cholesky(rest, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:
            margin *= 2.0
        else:
            return largest + margin
    return row_sum


def _largest_radius_on_border(extent: NDArray[np.float64], loop: ControlLoop) -> float:
    low, high, turn = extent
    along, up = np.linspace(low, high, _N_SIDE_POINTS), np.linspace(0.0, turn, _N_SIDE_POINTS)
    # The upper half only: the pole radius of a conjugate eigenvalue is the same.
    border = np.concatenate([along + 1j * turn, low + 1j * up, high + 1j * up])
    radii = loop.pole_radius(border)
    return float(radii.max()) + EIGENVALUE_TOLERANCE


def _ellipsoid_ends(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return one end of each axis of the 3σ ellipsoid, one per row; the other is its negative.

    The axes are those of the correlation matrix, so that they do not depend on units.
    """
    sigma = np.sqrt(np.diag(covariance))
    power, axes = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray(3.0 * (axes * np.sqrt(np.maximum(power, 0.0))).T * sigma)


def _make_verdict(worst: float, aligned: float, bound: float, n_points: int) -> GateVerdict:
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


MAX_EDGE_MOTION_M = 240e-9
"""Largest motion of an outer actuator per unit of slope noise in a loop without leak, metres.

It is computed with the largest optical gains that the loop may have. Computed like this, a loop
with 490 nm slipped after 2 s, and none up to 326 nm did within 4 s (docs/results/reliability.md). A
slip within 2,000 frames of Gaussian noise is an excursion of 3.5 σ, which is 7 σ at half of that
motion: less than once in a hundred nights.
"""

MAX_HELD_EDGE_MOTION_M = 250e-9
"""The same for a loop that runs with as many modes and does not slip.

The estimates of α and of the optical gains move the motion by a few nanometres from window to
window. To refuse a matrix for a nanometre cost 24 nm of wavefront error where 45 modes became 30.
"""

MAX_SLIP_SAFE_LEAK = 0.99
"""Largest leak factor with which a slipped segment recovers, within a tenth of a second."""

_N_NOISE_FREQUENCIES = 256
"""Number of frequencies in the mean over half of the unit circle."""


def compute_edge_motion_m(
    reconstructor: NDArray[np.float32],
    coupling: NDArray[np.float32],
    gains: Array,
    outer: Array,
    loop: ControlLoop,
) -> float:
    """Return the largest RMS motion of an outer actuator for white slope noise of 1, metres.

    ``coupling`` ``(n, n)`` is R D(α), ``gains`` ``(n,)`` integrator gain times optical gain, and
    ``outer`` the field of :class:`ControlLoop`. In the eigenbasis of ``g R D = V Λ V^-1`` the
    transfer function from noise to command is ``H_i = z^-d / (1 - leak z^-1 + λ_i z^-d)``. The
    covariance of the command is ``V (N o <H H*>) V*``, with N that of ``V^-1 g R n`` and the mean
    taken over the unit circle.
    """
    eigenvalues, vectors = find_eigenmodes(gains[:, None] * coupling.astype(float))
    commanded = gains[:, None] * reconstructor.astype(float)
    # N = V^-1 S V^-H from the real (n, n) S. There are more slopes than modes, so the product with
    # complex V^-1 would be the most expensive step if it came first.
    driven = commanded @ commanded.T
    ring = outer[:, : len(gains)]
    if vectors is not None:
        driven = np.linalg.solve(vectors, np.linalg.solve(vectors, driven).conj().T)
        ring = ring @ vectors
    turns = np.pi * (np.arange(_N_NOISE_FREQUENCIES) + 0.5) / _N_NOISE_FREQUENCIES
    delayed = np.exp(-1j * turns * loop.delay_frames)[:, None]
    response = delayed / (1.0 - loop.leak * np.exp(-1j * turns)[:, None] + eigenvalues * delayed)
    # Half of the circle is enough: eigenvalues come in conjugate pairs, so that the other half is
    # the complex conjugate of this one.
    covariance = driven * (response.T @ response.conj() / _N_NOISE_FREQUENCIES)
    power = np.einsum("ai,ai->a", ring @ covariance, ring.conj()).real
    return loop.noise * float(np.sqrt(power.max()))


def check_edge_motion(motion_m: float, leak: float, *, holds: bool = False) -> str | None:
    """Return the reason to refuse a loop whose edge moves by ``motion_m``, None if there is none.

    ``holds`` is True if the loop runs already with as many modes and these gains and does not slip.
    """
    limit_m = MAX_HELD_EDGE_MOTION_M if holds else MAX_EDGE_MOTION_M
    # A leak does not prevent a slip, but brings the segment back within a tenth of a second.
    if motion_m <= limit_m or leak <= MAX_SLIP_SAFE_LEAK:
        return None
    return (
        f"its outer ring would slip: noise moves it by {motion_m * 1e9:.0f} nm per unit of slope "
        f"noise, the limit is {limit_m * 1e9:.0f} nm; use fewer modes, a lower gain, or a leak of "
        f"{MAX_SLIP_SAFE_LEAK} or less"
    )
