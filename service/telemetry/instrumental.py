"""Registration from one dithered window, with the known dither as instrumental variable.

The command carries turbulence, so regressing slopes on commands is biased (by 6 % of a subaperture
on a faint star). The instrument is what the closed loop makes of the known dither alone; only its
correlation with the slopes is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.telemetry.estimator import LOCK_IN, Determines
from service.telemetry.lockin import Spectra

Array = NDArray[Any]

N_STEPS = 5
"""Gauss-Newton steps inside one linearisation: gains and α are multiplied with one another."""

_MOST_TERMS = 40
"""Of a series; one that needs more is given up, and the loop's equations are solved."""

_GROWN = 10.0
"""A term this much larger than the first is one of a series that does not end."""

_ROUNDING = 1e-7
"""Of single precision."""

MAX_LAG_FRAMES = 0.2
"""A larger lag between slopes and commands: the columns are not aligned as the wire demands."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Loop:
    """The control loop that was running: ``c[k+d] = leak c[k+d-1] - gain R s[k]``."""

    reconstructor: NDArray[np.float32]
    """``(n_controlled, n_slopes)`` metres per slope; row i commands mode i."""

    gains: NDArray[np.float64]
    """``(n_modes,)`` 0 where uncontrolled."""

    leak: float
    delay_frames: float
    frame_rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowEstimate:
    """What one window says of the registration."""

    alpha: Misregistration
    covariance: NDArray[np.float64]
    """``(4, 4)`` numeric units, from the scatter at the side bins; no model error in it."""

    optical_gain: NDArray[np.complex128]
    """``(n_lines,)`` complex gain of the sensor at each dithered mode, against the model."""

    lag_frames: NDArray[np.float64]
    """``(n_lines,)`` lag of the slopes behind the commands; 0 when the columns are aligned."""

    misfit: float
    """Residual power at the lines over that at the side bins; 1: the model explains the data."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation to the estimate, numeric units."""

    t_ns_utc: int
    """End of the window."""

    cm_id: str | None
    session: str
    modes: tuple[int, ...] = ()
    """Dithered mode of each line; empty: not known."""

    gain_sigma: NDArray[np.float64] | None = None
    """``(n_lines,)`` 1 σ of each gain's modulus, from the side bins; None: not known."""

    dither_m: float = 0.0
    """RMS of all lines together as they were on the mirror, metres OPD; 0: not known."""

    window_s: float = 0.0
    """Length of the window, seconds; 0: not known."""

    @property
    def determines(self) -> Determines:
        """Which of the four parameters it can tell."""
        return LOCK_IN


def fit_window(spectra: Spectra, linearisation: Linearisation, loop: Loop) -> WindowEstimate:
    """Estimate α from one window, to first order about the linearisation.

    Solves ``Re(F(Z)* F(C)^T) x = Re(F(Z)* r)`` by Gauss-Newton for α and one complex gain per
    line; C the command at the line, Z the instrument, ``F(v) = [γ S_j v, D v, i D v]``,
    ``r = S - γ D(α) C``. When ``step`` is not small the caller linearises anew at the estimate.
    """
    matrix = linearisation.matrix
    coupling = loop.reconstructor @ matrix
    slopes = spectra.slopes[:, 0]
    seen = _images(linearisation, spectra.commands[:, 0])
    known = _apply(matrix, _instrument(spectra, coupling, loop, np.ones(len(slopes))))
    gains = np.array(
        [_projected_gain(s, c[0], z) for s, c, z in zip(slopes, seen, known, strict=True)]
    )
    known = _images(linearisation, _instrument(spectra, coupling, loop, gains))
    step = np.zeros(4)
    for _ in range(N_STEPS):
        normal, score = _normal_equations(slopes, seen, known, gains, step)
        change = np.linalg.solve(normal, score)
        step = step + change[:4]
        gains = gains + change[4::2] + 1j * change[5::2]
    normal, _ = _normal_equations(slopes, seen, known, gains, step)
    spread, misfit = _side_bins(spectra, linearisation, seen, known, gains, step)
    inverse = np.linalg.inv(normal)
    every = inverse @ spread @ inverse.T
    covariance = every[:4, :4]
    turns = 2 * np.pi * np.array(spectra.plan.frequencies_hz) / loop.frame_rate_hz
    return WindowEstimate(
        alpha=Misregistration.from_vector(linearisation.alpha.vector + step),
        covariance=(covariance + covariance.T) / 2,
        optical_gain=gains,
        lag_frames=-np.angle(gains) / turns,
        misfit=misfit,
        step=step,
        t_ns_utc=spectra.t_end_ns_utc,
        cm_id=spectra.cm_id,
        session=spectra.session,
        modes=spectra.plan.modes,
        gain_sigma=_modulus_sigma(gains, every[4:, 4:]),
        dither_m=_total_dither_m(spectra),
        window_s=spectra.window_s,
    )


def closed_loop_response(
    dither: Array, matrix: Array, loop: Loop, frequency_hz: float, gain: complex
) -> Array:
    """Return the total command ``(n_modes,)`` that a dither of this complex amplitude leads to.

    ``Z = [I + g R D γ e^{-iwd} / (1 - leak e^{-iw})]^{-1} U``, solved in the controlled modes.
    """
    coupling = loop.reconstructor @ matrix
    found = _responses(dither[None], coupling, loop, (frequency_hz,), np.array([gain]))
    return np.asarray(found[0])


def _instrument(spectra: Spectra, coupling: Array, loop: Loop, gains: Array) -> Array:
    """Return ``(n_lines, n_modes)`` the command each line's dither alone would cause."""
    return _responses(spectra.dither, coupling, loop, spectra.plan.frequencies_hz, gains)


def _responses(
    dither: Array, coupling: Array, loop: Loop, frequencies_hz: tuple[float, ...], gains: Array
) -> Array:
    """Return ``closed_loop_response`` of every line from R D ``(n_controlled, n_modes)``.

    The instrument need not be better known than D: single precision is enough, and so is the
    series ``1 - F + F^2 - ...`` where it converges, as it does above a sixth of the frame rate.
    """
    n = len(coupling)
    w = 2 * np.pi * np.array(frequencies_hz) / loop.frame_rate_hz
    integrator = np.exp(-1j * w * loop.delay_frames) / (1.0 - loop.leak * np.exp(-1j * w))
    answer = (np.outer(loop.gains[:n], integrator * gains)).astype(np.complex64)
    own = np.ascontiguousarray(coupling[:, :n])
    first = -answer * _apply(coupling, dither).T
    reply = _summed(first, answer, own)
    if reply is None:
        around = answer.T[:, :, None] * own + np.eye(n, dtype=np.complex64)
        reply = np.linalg.solve(around, first.T[:, :, None])[:, :, 0].T
    total = dither.astype(complex)
    total[:, :n] += reply.T
    return total


def _summed(first: Array, answer: Array, coupling: Array) -> Array | None:
    """Return ``(1 + F)^-1 first`` as a series, ``F = answer * coupling``; None: not that way."""
    reply, largest = first, np.abs(first).max(initial=0.0)
    for _ in range(_MOST_TERMS):
        before, reply = reply, first - answer * _apply(coupling, reply.T).T
        change, size = (np.abs(x).max(initial=0.0) for x in (reply - before, reply))
        if change <= _ROUNDING * size:  # zeros are settled, too
            return np.asarray(reply)
        if not change < _GROWN * largest:
            return None
    return None


def _images(linearisation: Linearisation, vectors: Array) -> Array:
    """Return what the sensor makes of modal vectors, ``(n_lines, 5, n_slopes)``.

    Index 0 is D v, then the four derivatives of D applied to v.
    """
    operators = (linearisation.matrix, *linearisation.derivatives)
    return np.stack([_apply(operator, vectors) for operator in operators], axis=1, dtype=complex)


def _apply(operator: Array, vectors: Array) -> Array:
    """Return ``operator @ v`` for complex rows v and a real operator, ``(n_vectors, n_slopes)``."""
    single = vectors.astype(np.complex64)
    both = operator @ np.concatenate([single.real, single.imag]).T
    return np.asarray((both[:, : len(single)] + 1j * both[:, len(single) :]).T)


def _modulus_sigma(gains: Array, covariance: Array) -> Array:
    """Return ``(n_lines,)`` 1 σ of ``|γ|``, from the covariance of every gain's two parts."""
    found = []
    for line, gain in enumerate(gains):
        part = slice(2 * line, 2 * line + 2)
        along = np.array([gain.real, gain.imag]) / abs(gain)
        found.append(np.sqrt(along @ covariance[part, part] @ along))
    return np.array(found)


def _total_dither_m(spectra: Spectra) -> float:
    """Return the RMS of all lines together, from the dither columns of the window."""
    amplitudes = np.abs(spectra.dither).max(axis=1) * np.sqrt(2.0) / (0.5 * spectra.plan.n_frames)
    return float(np.sqrt(np.sum(amplitudes**2)))


def _projected_gain(slopes: Array, seen: Array, known: Array) -> complex:
    """Return ``<D Z, S> / <D Z, D C>``: the first guess of the complex gain."""
    return complex(np.vdot(known, slopes) / np.vdot(known, seen))


def _regressors(images: Array, gain: complex, step: Array) -> Array:
    """Return ``(6, n_slopes)``: four derivatives by α, then by the two parts of the gain."""
    response = images[0] + step @ images[1:]
    return np.vstack([gain * images[1:], response, 1j * response])


def _unknowns(line: int) -> Array:
    """Return where the six unknowns of a line stand among all: α is common, the gain its own."""
    return np.array([0, 1, 2, 3, 4 + 2 * line, 5 + 2 * line])


def _normal_equations(
    slopes: Array, seen: Array, known: Array, gains: Array, step: Array
) -> tuple[Array, Array]:
    """Return ``M`` and ``b`` of the instrumental-variable step over all lines."""
    n = 4 + 2 * len(gains)
    normal, score = np.zeros((n, n)), np.zeros(n)
    for line, gain in enumerate(gains):
        conjugate = _regressors(known[line], gain, step).conj()
        response = _regressors(seen[line], gain, step)
        residual = slopes[line] - gain * response[4]
        at = _unknowns(line)
        normal[np.ix_(at, at)] += (conjugate @ response.T).real
        score[at] += (conjugate @ residual).real
    return normal, score


def _side_bins(
    spectra: Spectra,
    linearisation: Linearisation,
    seen: Array,
    known: Array,
    gains: Array,
    step: Array,
) -> tuple[Array, float]:
    """Return the covariance of the score, from the bins beside the lines, and the misfit.

    What remains there after the same model is noise with the very spectrum the lines suffer from.
    """
    n = 4 + 2 * len(gains)
    spread = np.zeros((n, n))
    misfit = []
    matrix = linearisation.matrix_by(step)
    for line, gain in enumerate(gains):
        explained = gain * _apply(matrix, spectra.commands[line, 1:])
        residual = spectra.slopes[line, 1:] - explained
        score = _regressors(known[line], gain, step).conj() @ residual.T
        at = _unknowns(line)
        spread[np.ix_(at, at)] += 0.5 * (score @ score.conj().T).real / score.shape[1]
        left = spectra.slopes[line, 0] - gain * _regressors(seen[line], gain, step)[4]
        misfit.append(np.sum(np.abs(left) ** 2) / np.mean(np.sum(np.abs(residual) ** 2, axis=1)))
    return spread, float(np.mean(misfit))
