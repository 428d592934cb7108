"""Registration from windows of sinusoidal dither.

Telemetry is demodulated as it arrives, at the frequencies of the dither and at frequencies next to
them, where the noise is measured. The command contains turbulence, so a regression of slopes on
commands is biased (by 6 % of a subaperture on a faint star). The response of the closed loop to the
known dither is therefore used as instrumental variable: only its correlation with the slopes
enters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.estimation.demodulation import SIDE_OFFSETS_HZ, DemodulationBank
from service.estimation.frames import FrameBlock
from service.estimation.windows import ClosedLoop, Telemetry, Window, WindowCutter, WindowPlan
from service.model.interaction import Linearisation
from service.records.estimates import LockInEstimate, WindowRefused

Array = NDArray[Any]

MAX_CUT_PERIODS = 0.01
"""Fraction of a period by which a window may be too long or too short, when the frame rate differs
from its nominal value by parts per million. The Hann window keeps the error below 1e-4 of the
amplitude."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LockInPlan(WindowPlan):
    """The lines to demodulate: one sinusoid on each of a few modes.

    A window is an integer number of periods of every frequency.
    """

    frequencies_hz: tuple[float, ...]
    """One for each mode."""

    frame_rate_hz: float

    def __post_init__(self) -> None:
        """Refuse a plan with lines or side bins outside the spectrum or between its bins.

        Raises
        ------
        ModelError
            If the lists differ in length, a frequency leaves (20 Hz, Nyquist - 20 Hz), two lines
            are within 4 bins of one another, or the window cuts a period.
        """
        lines = np.array(self.frequencies_hz)
        edge = SIDE_OFFSETS_HZ.max()
        if not len(self.modes) == len(lines) == len(self.amplitude_m) > 0:
            raise ModelError("lock-in: modes, frequencies and amplitudes differ in length")
        highest = self.frame_rate_hz / 2 - edge
        if highest <= edge:
            raise ModelError(
                f"lock-in: found {self.frame_rate_hz:.4g} frames a second; expected more than "
                f"{4 * edge:g}, room for the side bins of a line"
            )
        if lines.min() <= edge or lines.max() >= highest:
            raise ModelError(
                f"lock-in: found lines at {lines.min():.4g} to {lines.max():.4g} Hz; expected "
                f"between {edge:g} and {highest:.4g} Hz, room for the side bins"
            )
        periods = lines * self.n_frames / self.frame_rate_hz
        if np.abs(periods - np.round(periods)).max() > MAX_CUT_PERIODS:
            raise ModelError(
                f"lock-in: {self.n_frames} frames cut a period of {lines} Hz; expected whole ones"
            )
        # The main lobe of a Hann window is four bins wide.
        gaps = np.diff(np.sort(lines)) * self.n_frames / self.frame_rate_hz
        if gaps.size and gaps.min() < 4:
            raise ModelError(f"lock-in: lines {lines} Hz closer than 4 bins in one window")

    @property
    def demodulation(self) -> DemodulationBank:
        """The demodulation of a window."""
        return DemodulationBank(
            lines_hz=self.frequencies_hz, frame_rate_hz=self.frame_rate_hz, n_frames=self.n_frames
        )

    @property
    def bins_hz(self) -> NDArray[np.float64]:
        """``(n_lines, 1 + n_side)`` frequencies: each line, then its side bins."""
        lines = np.array(self.frequencies_hz)[:, None]
        return np.hstack([lines, lines + SIDE_OFFSETS_HZ])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectra(Telemetry):
    """One window of telemetry at the plan's bins: sums of ``h_k x_k exp(-i w k)``, Hann h.

    Missing frames count as zeros, which raises the noise in the side bins. Joined windows are
    averaged.
    """

    plan: LockInPlan
    slopes: NDArray[np.complex64]
    """``(n_lines, 1 + n_side, n_slopes)``."""

    commands: NDArray[np.complex64]
    """``(n_lines, 1 + n_side, n_modes)`` total command on the mirror, metres."""

    dither: NDArray[np.complex64]
    """``(n_lines, n_modes)`` its known dither part at the lines, metres."""

    @property
    def window_s(self) -> float:
        """Seconds of telemetry in it."""
        return self.n_windows * self.plan.n_frames / self.plan.frame_rate_hz


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LockInSums:
    """Sums over the frames of a window so far."""

    slopes: Array
    """Sums in the layout of :meth:`DemodulationBank.empty`, like those of the commands; modified in
    place."""

    commands: Array
    dither: Array
    """``(2 * n_lines, n_modes)``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LockIn(WindowCutter[LockInPlan, LockInSums, Spectra]):
    """Cuts telemetry into windows and sums them at the plan's bins."""

    @override
    def begin(self, block: FrameBlock) -> LockInSums:
        """Return empty sums for frames like these."""
        bank, n_modes = self.plan.demodulation, block.commands_m.shape[1]
        return LockInSums(
            slopes=bank.empty(block.slopes.shape[1]),
            commands=bank.empty(n_modes),
            dither=np.zeros((2 * len(self.plan.modes), n_modes), np.float32),
        )

    @override
    def add(self, sums: LockInSums, block: FrameBlock, place: int) -> LockInSums:
        """Return the sums with a block that begins at this place of the window."""
        bank = self.plan.demodulation
        # Blocks without dither columns were refused before.
        dither = block.commands_m if block.dither_m is None else block.dither_m
        bank.add(sums.slopes, block.slopes, place)
        bank.add(sums.commands, block.commands_m, place)
        return replace(sums, dither=sums.dither + bank.at_lines(dither, place))

    @override
    def close(self, window: Window[LockInSums]) -> Spectra | WindowRefused:
        """Return the finished window, or the reason why its dither differs from the request."""
        plan, sums = self.plan, window.sums
        real, imaginary = np.split(sums.dither, 2)
        dither = (real + 1j * imaginary).astype(np.complex64)
        # The Hann window has a mean of 0.5, and a sine of RMS 1 appears at its frequency with half
        # of its amplitude √2. So ``applied`` is an RMS, as in the request.
        weight = 0.5 * plan.n_frames / np.sqrt(2.0)
        applied = np.abs(dither[np.arange(len(plan.modes)), list(plan.modes)]) / weight
        reason = plan.refusal(applied, tuple(f"{line} Hz" for line in plan.frequencies_hz))
        if reason is not None:
            return WindowRefused(reason=reason, t_ns_utc=window.next_t_ns)
        return Spectra(
            plan=plan,
            slopes=plan.demodulation.at_bins(sums.slopes),
            commands=plan.demodulation.at_bins(sums.commands),
            dither=dither,
            **window.telemetry,
        )


def join_windows(one: Spectra, other: Spectra) -> Spectra | None:
    """Return two windows of the same dither, one right after the other, as a longer one.

    It is their mean, with each bin of the second turned to its phase in the first. The response
    to a line is the same in both; the noise falls in the side bins as it does at the lines. None
    if they are of different loops or dithers, or too far apart. The mean replaces the slopes and
    commands of the second in memory, because three windows of a hundred lines have 170 MB.
    """
    later = other.first_seq - one.first_seq
    follows = later // one.plan.n_frames in {one.n_windows, one.n_windows + 1}
    if not follows or not one.is_like(other):
        return None
    turns = np.exp(-2j * np.pi * later * one.plan.bins_hz / one.plan.frame_rate_hz)
    n_windows = one.n_windows + other.n_windows
    share = np.float32(one.n_windows / n_windows)
    turned = ((1 - share) * turns).astype(np.complex64)[:, :, None]
    for before, after in ((one.slopes, other.slopes), (one.commands, other.commands)):
        for first, turn, mean in zip(before, turned, after, strict=True):
            mean *= turn
            mean += share * first
    return replace(
        other,
        first_seq=one.first_seq,
        n_missing=one.n_missing + other.n_missing,
        dither=share * one.dither + turned[:, 0] * other.dither,
        n_windows=n_windows,
    )


N_STEPS = 5
"""Gauss-Newton steps within one linearisation; the model is bilinear in gains and α."""

_MAX_TERMS = 40
"""Largest number of terms of a series. If more are needed, the loop's equations are solved instead.
"""

_DIVERGENCE_RATIO = 10.0
"""Ratio of a term to the first one above which the series counts as divergent."""

_ROUNDING = 1e-7
"""Relative rounding error of single precision."""

OTHER_MODE_POWER_RATIO = 3.0
"""Another mode explains more of a line than the line's own by this factor, if it is that mode."""

IDENTIFICATION_RATIO = 6.0
"""A mode is identified if it explains this many times the root mean square next to the line."""

WEAK_LINE_RATIO = 0.3
"""Lines weaker than this fraction of the strongest have less than a tenth of its weight."""

MAX_LAG_FRAMES = 0.2
"""A larger lag between slopes and commands: the columns are not aligned as the wire demands."""


def fit_window(spectra: Spectra, linearisation: Linearisation, loop: ClosedLoop) -> LockInEstimate:
    """Estimate α from one window, to first order about the linearisation.

    Solves ``Re(F(Z)* F(C)^T) x = Re(F(Z)* r)`` by Gauss-Newton for α and one complex gain per line.
    C is the command at the line, Z the instrument, ``F(v) = [γ S_j v, D v, i D v]``, ``r = S - γ
    D(α) C``. If the slopes have different noise, Z is weighted by their variance. If ``step`` is
    not small, the caller linearises again at the estimate.
    """
    window, every_mode = spectra, linearisation.matrix
    spectra, linearisation = _select_moved_modes(spectra, linearisation, loop)
    matrix = linearisation.matrix
    coupling = loop.reconstructor @ matrix
    slopes = spectra.slopes[:, 0]
    seen = _images(linearisation, spectra.commands[:, 0])
    # The commands that the dither of each line alone causes, for gains of the sensor.
    respond = partial(
        compute_total_commands, spectra.dither, coupling, loop, spectra.plan.frequencies_hz
    )
    known = _apply(matrix, respond(np.ones(len(slopes))))
    # First guess of the gains: <D Z, S> / <D Z, D C>.
    gains = np.sum(known.conj() * slopes, axis=1) / np.sum(known.conj() * seen[:, 0], axis=1)
    known = _images(linearisation, respond(gains))
    # An instrumental variable may have any weight; the inverse variance gives the smallest σ.
    if linearisation.noise_shape is not None:
        known /= linearisation.noise_shape**2
    n = known.shape[1] - 1
    step = np.zeros(n)
    for _ in range(N_STEPS):
        normal, score = _normal_equations(slopes, seen, known, gains, step)
        change = np.linalg.solve(normal, score)
        step = step + change[:n]
        # After the numbers of α come real and imaginary part of each line's gain in turn.
        gains = gains + change[n::2] + 1j * change[n + 1 :: 2]
    normal, _ = _normal_equations(slopes, seen, known, gains, step)
    spread, misfit, unexplained = _side_bins(spectra, linearisation, seen, known, gains, step)
    inverse = np.linalg.inv(normal)
    every = inverse @ spread @ inverse.T
    # Rounding leaves the product slightly asymmetric.
    every = (every + every.T) / 2
    turns = 2 * np.pi * np.array(spectra.plan.frequencies_hz) / loop.frame_rate_hz
    size = np.abs(window.dither).max(axis=1)
    rms_m = size * np.sqrt(2.0) / (0.5 * spectra.plan.n_frames)  # see ``LockIn.close``
    return LockInEstimate(
        alpha=linearisation.add_step(step),
        covariance=every[:4, :4],
        with_stretches=every[:n, :n] if n > 4 else None,
        stretched=float(np.abs(step[4:]).max(initial=0.0)),
        optical_gain=gains,
        # Slopes that are late by n frames turn a line of w radians per frame by -n w.
        lag_frames=-np.angle(gains) / turns,
        misfit=misfit,
        unexplained=unexplained,
        step=step[:4],
        t_ns_utc=spectra.t_end_ns_utc,
        cm_id=spectra.cm_id,
        session=spectra.session,
        modes=spectra.plan.modes,
        gain_sigma=_modulus_sigma(gains, every[n:, n:]),
        weak=tuple(np.array(spectra.plan.modes)[size < WEAK_LINE_RATIO * size.max()].tolist()),
        answers_as=_match_modes(window, every_mode),
        dither_m=float(np.sqrt(np.sum(rms_m**2))),
        window_s=spectra.window_s,
    )


_FEW_MOVED_RATIO = 6
"""If fewer than one mode in this many moves, the others are left out of the products."""


def _select_moved_modes(
    spectra: Spectra, linearisation: Linearisation, loop: ClosedLoop
) -> tuple[Spectra, Linearisation]:
    """Return both without the modes that are never commanded, if these are most modes."""
    moves = np.any(spectra.commands, axis=(0, 1)) | np.any(spectra.dither, axis=0)
    # The loop responds to every line with all modes that it controls.
    moves[: len(loop.reconstructor)] = True
    if _FEW_MOVED_RATIO * np.count_nonzero(moves) > len(moves):
        return spectra, linearisation
    moved = np.flatnonzero(moves)
    few = replace(spectra, commands=spectra.commands[:, :, moved], dither=spectra.dither[:, moved])
    return few, linearisation.of_modes(moved)


def compute_total_commands(
    dither: Array,
    coupling: Array,
    loop: ClosedLoop,
    frequencies_hz: tuple[float, ...],
    gains: Array,
) -> Array:
    """Return the total commands ``(n_lines, n_modes)`` that dithers of these amplitudes lead to.

    ``Z = [I + g R D γ e^{-iwd} / (1 - leak e^{-iw})]^{-1} U``, solved in the controlled modes;
    ``coupling`` is R D ``(n_controlled, n_modes)``, ``gains`` ``(n_lines,)`` the sensor's.

    Single precision is enough, because D is not known better. Where the series
    ``1 - F + F^2 - ...`` converges, which it does above a sixth of the frame rate, it replaces the
    solution.
    """
    n = len(coupling)
    w = 2 * np.pi * np.array(frequencies_hz) / loop.frame_rate_hz
    # Transfer function of the leaky integrator with its delay, at the lines.
    integrator = np.exp(-1j * w * loop.delay_frames) / (1.0 - loop.leak * np.exp(-1j * w))
    answer = (np.outer(loop.gains[:n], integrator * gains)).astype(np.complex64)
    own = np.ascontiguousarray(coupling[:, :n])
    # Minus: the loop counteracts what the sensor sees of the dither.
    first = -answer * _apply(coupling, dither).T
    reply = _sum_series(first, answer, own)
    if reply is None:
        around = answer.T[:, :, None] * own + np.eye(n, dtype=np.complex64)
        reply = np.linalg.solve(around, first.T[:, :, None])[:, :, 0].T
    total = dither.astype(complex)
    total[:, :n] += reply.T
    return total


def _sum_series(first: Array, answer: Array, coupling: Array) -> Array | None:
    """Return ``(1 + F)^-1 first`` as a series, ``F = answer * coupling``; None if it diverges."""
    reply, largest = first, np.abs(first).max(initial=0.0)
    for _ in range(_MAX_TERMS):
        before, reply = reply, first - answer * _apply(coupling, reply.T).T
        change, size = (np.abs(x).max(initial=0.0) for x in (reply - before, reply))
        if change <= _ROUNDING * size:  # "<=" because zeros have converged, too
            return np.asarray(reply)
        # "not <" because NaN ends the series as well.
        if not change < _DIVERGENCE_RATIO * largest:
            return None
    return None


def _images(linearisation: Linearisation, vectors: Array) -> Array:
    """Return the sensor's response to modal vectors, ``(n_lines, 5 or 7, n_slopes)``.

    Index 0 is D v, then the derivatives of D applied to v.
    """
    operators = (linearisation.matrix, *linearisation.rates)
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
        # To first order only the noise along the gain's own phase changes its modulus.
        along = np.array([gain.real, gain.imag]) / abs(gain)
        found.append(np.sqrt(along @ covariance[part, part] @ along))
    return np.array(found)


def _match_modes(spectra: Spectra, matrix: Array) -> tuple[int, ...]:
    """Return the mode of the model that the slopes of each line resemble most.

    A mode other than the line's own is returned only if it explains far more, and far more than
    next to the line. Empty if the matrix contains the dithered modes alone.
    """
    slopes, own = spectra.slopes, np.argmax(np.abs(spectra.dither), axis=1)
    if tuple(own.tolist()) != spectra.plan.modes:
        return ()
    unit = matrix / np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(np.float32).tiny)
    size = np.abs(_apply(unit.T, slopes[:, 0]))
    best = np.argmax(size, axis=1)
    lines = np.arange(len(own))
    for line in np.flatnonzero(size[lines, best] > OTHER_MODE_POWER_RATIO * size[lines, own]):
        # Turbulence resembles low modes at all frequencies: the resemblance must be one of the
        # line.
        side_bins = np.abs(slopes[line, 1:] @ unit[:, best[line]])
        if size[line, best[line]] < IDENTIFICATION_RATIO * np.sqrt(np.mean(side_bins**2)):
            best[line] = own[line]
    clear = size[lines, best] > OTHER_MODE_POWER_RATIO * size[lines, own]
    return tuple(np.where(clear, best, own).tolist())


def _regressors(images: Array, gain: complex, step: Array) -> Array:
    """Return ``(n + 2, n_slopes)``: derivatives by α, then by the two parts of the gain."""
    response = images[0] + step @ images[1:]
    return np.vstack([gain * images[1:], response, 1j * response])


def _unknowns(line: int, n: int) -> Array:
    """Return the indices of a line's unknowns: ``n`` are common to all, its gain is its own."""
    return np.array([*range(n), n + 2 * line, n + 1 + 2 * line])


def _normal_equations(
    slopes: Array, seen: Array, known_gains: Array, gains: Array, step: Array
) -> tuple[Array, Array]:
    """Return ``M`` and ``b`` of the instrumental-variable step over all lines."""
    n = len(step) + 2 * len(gains)
    normal, score = np.zeros((n, n)), np.zeros(n)
    for line, gain in enumerate(gains):
        conjugate = _regressors(known_gains[line], gain, step).conj()
        response = _regressors(seen[line], gain, step)
        residual = slopes[line] - gain * response[-2]
        at = _unknowns(line, len(step))
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
) -> tuple[Array, float, Array]:
    """Return the covariance of the score, from the bins next to the lines, and the misfit.

    The residual of the same model there is noise with the spectrum that the lines have. The third
    value is the fraction ``(n_lines,)`` of each line's power that is neither noise nor model.
    """
    n = len(step) + 2 * len(gains)
    spread = np.zeros((n, n))
    misfit, unexplained = [], []
    matrix = linearisation.matrix_by(step)
    for line, gain in enumerate(gains):
        explained = gain * _apply(matrix, spectra.commands[line, 1:])
        residual = spectra.slopes[line, 1:] - explained
        score = _regressors(known[line], gain, step).conj() @ residual.T
        at = _unknowns(line, len(step))
        # Half of the power of a complex bin is in its real part, which the score takes.
        spread[np.ix_(at, at)] += 0.5 * (score @ score.conj().T).real / score.shape[1]
        left = spectra.slopes[line, 0] - gain * _regressors(seen[line], gain, step)[-2]
        power, noise = np.sum(np.abs(left) ** 2), np.mean(np.sum(np.abs(residual) ** 2, axis=1))
        misfit.append(power / noise)
        # The noise may exceed the line: a share above 1 has no meaning.
        seen_power = max(float(np.sum(np.abs(spectra.slopes[line, 0]) ** 2) - noise), power)
        unexplained.append(max(float(power - noise), 0.0) / seen_power)
    return spread, float(np.mean(misfit)), np.array(unexplained)
