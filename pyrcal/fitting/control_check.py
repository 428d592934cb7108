"""Check whether a reconstructor of the fitted model is stable with the measured matrix.

The reconstructor is the one that ``pyrcal reconstruct`` computes from the fit: the least-squares
inverse of D(α), with columns multiplied by the calibration gains. The plant is the measured matrix
itself. The loop ``c[k+d] = leak c[k+d-1] - g R s[k]`` is stable if every eigenvalue of ``g R M``
has its poles inside the unit circle. A stroke that is calibrated wrongly is one global gain, which
the loop gain absorbs.

Noise of the measured matrix also moves the eigenvalues, and more so with more modes. Its effect is
estimated by adding the same noise to the model: if that alone makes a loop unstable, the matrix
cannot show more, and the result is a lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.noise import noise_sigma
from service.control.loop import pole_radius
from service.control.reconstructor import MAX_CONDITION

Array = NDArray[np.float64]

GAIN = 0.5
"""Default integrator gain of the loop."""

DELAY_FRAMES = 2.0

CHECKED = np.array([1.0, 1.7, 3.5])
"""Divisors of the number of modes; the loop is checked at each before all are reported stable."""

RESOLUTION = 0.03
"""Relative distance of a stable and an unstable number of modes at which the search for the largest
stable number ends."""

CORNER_FRAMES = 50.0
"""Correlation time of the turbulence used for the loss, frames."""

N_FREQUENCIES = 64

MIN_PART = 0.05
"""Share of an eigenvector above which a mode is listed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructorVerdict:
    """Stability of the measured matrix in closed loop with the model's reconstructor."""

    stable_modes: int
    """Largest number of modes, in fitted order, with which every tried loop is stable."""

    n_modes: int
    """Number of modes checked: all fitted modes, at most the number of slopes."""

    gain: float
    """Integrator gain."""

    pole_radius: float
    """Largest pole radius with ``stable_modes``; 1 is the limit of stability."""

    pole_radius_all: float
    """Largest pole radius with all modes."""

    aligned_pole_radius: float
    """Pole radius of a perfect reconstructor."""

    loss_ratio: float | None
    """Wavefront error of the controlled modes over that of a reconstructor from the measured matrix
    itself, with ``stable_modes``; None if no loop is stable."""

    noise_limited: bool
    """True if noise of the measured matrix limits the result, so that more modes may be stable."""

    weakest_modes: tuple[int, ...]
    """Basis indices of the modes with the largest share in the worst pole beyond ``stable_modes``.
    """

    reason: str
    """Result in one sentence."""

    @property
    def holds(self) -> bool:
        """True if the loop is stable with all fitted modes."""
        return self.stable_modes >= self.n_modes

    @property
    def usable(self) -> bool:
        """True if the loop is stable with at least one mode."""
        return self.stable_modes > 0


def check_control(
    measured: NDArray[np.floating],
    model: NDArray[np.floating],
    gains: Array,
    modes: NDArray[np.intp],
    rows: NDArray[np.bool_],
    *,
    gain: float = GAIN,
    noise: Array | None = None,
) -> ReconstructorVerdict:
    """Return the closed-loop stability of the measured plant with the model's reconstructor.

    Parameters
    ----------
    measured, model
        ``(n_slopes, n_modes)``; the model without gains.
    gains
        ``(n_modes,)`` calibration gain of each mode.
    modes
        ``(n_modes,)`` basis index of each mode.
    rows
        ``(n_slopes,)`` slopes that count.
    gain
        Integrator gain.
    noise
        ``(n_modes,)`` 1 σ of an element of each measured column; None to estimate it from the
        residual.
    """
    order = np.argsort(modes, kind="stable")
    # The plant is divided by the gains, so modes without a positive gain have no plant.
    order = order[gains[order] > 0.0]
    plant = np.asarray(measured, dtype=np.float64)[rows][:, order] / gains[order]
    synthetic = np.asarray(model, dtype=np.float64)[rows][:, order]
    n_most = min(synthetic.shape)
    loops = _Loops(synthetic, plant, gain)
    stable = _most_stable(loops, n_most)
    noise_limited = False
    weakest: tuple[int, ...] = ()
    # Noise of the matrix alone may make a loop unstable; the result is then a lower bound.
    if stable < n_most:
        beyond = min(n_most, 2 * stable + 1)
        left = plant - synthetic
        level = noise_sigma(left) if noise is None else noise[order] / gains[order]
        # the noise of a column cannot exceed its residual
        level = np.minimum(level, np.sqrt(np.mean(left**2, axis=0)))
        # A fixed seed, so that the same matrix always has the same verdict.
        added = level * np.random.default_rng(0).standard_normal(synthetic.shape)
        noise_limited = _Loops(synthetic, synthetic + added, gain).radius(beyond) >= 1.0
        weakest = loops.worst_modes(beyond)
    found = ReconstructorVerdict(
        stable_modes=stable,
        n_modes=n_most,
        gain=gain,
        pole_radius=loops.radius(stable or n_most) if n_most else float("inf"),
        pole_radius_all=loops.radius(n_most) if n_most else float("inf"),
        aligned_pole_radius=float(pole_radius(np.array([gain]), delay_frames=DELAY_FRAMES)[0]),
        loss_ratio=loops.loss_ratio(stable) if stable else None,
        noise_limited=noise_limited,
        weakest_modes=tuple(int(mode) for mode in modes[order][list(weakest)]),
        reason="",
    )
    return replace(found, reason=_reason(found))


class _Loops:
    """Loops of the first modes of a model on a plant, for any number of them."""

    def __init__(self, model: Array, plant: Array, gain: float) -> None:
        # Products of all modes once: those of fewer modes are their leading blocks.
        self._normal, self._cross, self._gain = model.T @ model, model.T @ plant, gain
        self._radii: dict[int, float] = {}
        self._eigenmodes: dict[int, tuple[NDArray[Any], NDArray[Any], int]] = {}

    def coupling(self, n: int) -> tuple[Array, int]:
        """Return R M ``(n, n)`` of the first ``n`` modes, and the singular values left out."""
        power, axes = np.linalg.eigh(self._normal[:n, :n])
        # Eigenvalues of the normal matrix are squares of singular values, and so is the limit.
        kept = power * MAX_CONDITION**2 > power[-1]
        inverse = (axes[:, kept] / power[kept]) @ axes[:, kept].T
        return inverse @ self._cross[:n, :n], int(np.sum(~kept))

    def radius(self, n: int) -> float:
        """Return the largest pole radius with ``n`` modes; combinations left out do not move."""
        if n not in self._radii:
            eigenvalues: NDArray[Any]
            if n == len(self._normal):
                # with all modes the eigenvectors are needed as well, for the loss
                eigenvalues, _, n_left_out = self.eigenmodes(n)
            else:
                coupling, n_left_out = self.coupling(n)
                eigenvalues = np.linalg.eigvals(coupling)
            # Combinations left out have eigenvalues of 0 and poles on the unit circle: they would
            # make every truncated loop look unstable.
            moving = np.argsort(np.abs(eigenvalues))[n_left_out:]
            radii = pole_radius(self._gain * eigenvalues[moving], delay_frames=DELAY_FRAMES)
            self._radii[n] = float(radii.max())
        return self._radii[n]

    def eigenmodes(self, n: int) -> tuple[NDArray[Any], NDArray[Any], int]:
        """Return eigenvalues and eigenvectors of R M, and the singular values left out."""
        if n not in self._eigenmodes:
            coupling, n_left_out = self.coupling(n)
            self._eigenmodes[n] = (*np.linalg.eig(coupling), n_left_out)
        return self._eigenmodes[n]

    def worst_modes(self, n: int) -> tuple[int, ...]:
        """Return which modes take part most in the eigenvector of the largest pole."""
        eigenvalues, vectors, n_left_out = self.eigenmodes(n)
        radii = pole_radius(self._gain * eigenvalues, delay_frames=DELAY_FRAMES)
        # The same for the worst pole, which must be one that the loop controls.
        radii[np.argsort(np.abs(eigenvalues))[:n_left_out]] = 0.0
        share = np.abs(vectors[:, int(np.argmax(radii))]) ** 2
        strongest = np.argsort(-share)[:4]
        return tuple(int(k) for k in strongest if share[k] > MIN_PART * share.sum())

    def loss_ratio(self, n: int) -> float:
        """Return the wavefront error of the loop over that of a reconstructor with R M = 1.

        Every mode is driven alike, with a spectrum that is flat up to one over the correlation time
        and falls as that of Kolmogorov turbulence beyond.
        """
        frequency = np.geomspace(1e-3, 0.5, N_FREQUENCIES)
        # The factor of the frequency is the width of a step of ``geomspace``, so that sums are
        # integrals.
        spectrum = frequency / (1.0 + (frequency * CORNER_FRAMES) ** (17.0 / 3.0))
        z = np.exp(-2j * np.pi * frequency)
        integrator = self._gain * z**DELAY_FRAMES / (1.0 - z)
        eigenvalues, vectors, n_left_out = self.eigenmodes(n)
        back = np.linalg.inv(vectors)
        # |V diag(h) V^-1|^2 is a quadratic form in h
        form = (vectors.conj().T @ vectors) * (back @ back.conj().T).T
        rejected = 1.0 / (1.0 + integrator[:, None] * eigenvalues)
        power = np.einsum("fi,ij,fj->f", rejected.conj(), form, rejected, optimize=True).real / n
        # truncated combinations are controlled by neither reconstructor
        ideal = (np.abs(1.0 / (1.0 + integrator)) ** 2 * (n - n_left_out) + n_left_out) / n
        return float(np.sqrt((power @ spectrum) / (ideal @ spectrum)))


def _most_stable(loops: _Loops, n_most: int) -> int:
    """Return the number of modes up to which loops are stable."""
    checked = np.unique(np.round(n_most / CHECKED).astype(int))
    unstable = [int(n) for n in checked if n and loops.radius(int(n)) >= 1.0]
    if not unstable:
        return n_most
    most, fewest_unstable = 0, min(unstable)
    while fewest_unstable - most > max(1.0, RESOLUTION * most):
        # bisect in the logarithm: loops with few modes are cheap to check
        middle = max(most + 1, round(float(np.sqrt(most * fewest_unstable))))
        middle = min(middle, fewest_unstable - 1)
        if loops.radius(middle) < 1.0:
            most = middle
        else:
            fewest_unstable = middle
    return most


def _reason(found: ReconstructorVerdict) -> str:
    if found.holds:
        return (
            f"stable with {found.stable_modes} of {found.n_modes} modes at gain {found.gain:g}, "
            f"worst pole radius {found.pole_radius:.3f} (a perfect reconstructor has "
            f"{found.aligned_pole_radius:.3f})"
        )
    if found.noise_limited:
        bound = "noise of the measured matrix bounds the answer: average more to know of more modes"
    else:
        named = ", ".join(str(mode) for mode in found.weakest_modes)
        of_modes = f" (modes {named})" if named else ""
        bound = (
            f"beyond it the model differs too much from the measured matrix{of_modes}: control "
            "fewer modes, lower the gain, or use the measured matrix"
        )
    modes = f"{found.stable_modes} of {found.n_modes} modes"
    return f"stable up to {modes} at gain {found.gain:g}; {bound}"
