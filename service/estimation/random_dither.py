"""Registration from random signs, by a noisy interaction matrix.

White dither on some modes, or on all: what the slopes have in common with it is the interaction
matrix (DO-CRIME, Lai et al. 2021). It is a measurement to fit a model to, never one to control
with. Only the response at lag 0, the first the wire's columns allow, is clean: later ones hold the
loop's own reply, which pulls the fit toward the old geometry.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.estimation.frames import FrameBlock
from service.estimation.solver import Columns
from service.estimation.windows import Telemetry, Window, WindowCutter, WindowPlan
from service.model.interaction import Linearisation
from service.records.estimates import (
    RandomEstimate,
    RefusalKind,
    Why,
    WindowRefused,
)
from service.records.messages import compose

Array = NDArray[Any]

FRAMES_PER_MODE = 4
"""A window with fewer frames per dithered mode than this cannot separate the modes."""

N_BATCHES = 24
"""Parts of a window whose scatter gives the covariance."""

MIN_MODES_WITHOUT_BATCHES = 96
"""With more, the scatter of the modes themselves gives it, for their dithers are independent, and
the sums of batches need not be kept apart."""

N_DELAY_MODES = 16
"""Number of modes with which a response one frame late is searched for; more add nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomPlan(WindowPlan):
    """The random dither to correlate with: one amplitude, a random sign per frame and mode."""

    def __post_init__(self) -> None:
        """Refuse a window that is too short for its modes.

        Raises
        ------
        ModelError
            If there is no mode, the lists differ in length or the frames are too few.
        """
        if not len(self.modes) == len(self.amplitude_m) > 0:
            raise ModelError("random dither: modes and amplitudes differ in length or are none")
        least = max(FRAMES_PER_MODE * len(self.modes), 8 * self.n_batches)
        if self.n_frames < least:
            raise ModelError(
                f"random dither: found windows of {self.n_frames} frames, expected at least "
                f"{least} for {len(self.modes)} modes"
            )

    @property
    def n_batches(self) -> int:
        """Parts of a window whose sums are kept apart."""
        return 1 if len(self.modes) > MIN_MODES_WITHOUT_BATCHES else N_BATCHES

    @property
    def late_columns(self) -> NDArray[np.intp]:
        """Return the dithered modes that also respond one frame later, ``(n_late,)``."""
        n_late = min(len(self.modes), N_DELAY_MODES)
        return np.linspace(0, len(self.modes) - 1, n_late).astype(np.intp)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlations:
    """Sums over consecutive frames: slopes against the dither of the same frame and of the last.

    ``e[k] = s[k] - ρ s[k-1]`` are the slopes without most of the turbulence, which outlasts a
    frame. Any ρ leaves the response to the dither alone, for that is white.
    """

    response: NDArray[np.float32]
    """``(n_batches, n_slopes, n_dithered)`` sum of e[k] u[k]^T."""

    late: NDArray[np.float32]
    """``(n_slopes, n_late)`` sum of s[k] u[k-1]^T: the second lag that could respond."""

    dither_power: NDArray[np.float64]
    """``(n_batches, n_dithered, n_dithered)`` sum of u[k] u[k]^T, metres²."""

    noise_power: NDArray[np.float64]
    """``(n_slopes,)`` sum of e[k]²."""

    slope_power: NDArray[np.float64]
    """``(n_slopes,)`` sum of s[k]²."""

    memory: float
    """ρ: lag-1 correlation of the slopes, as the window's first frames had it."""

    n_pairs: int
    """Consecutive frames summed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlated(Telemetry):
    """One finished window, or several joined to one."""

    plan: RandomPlan
    sums: Correlations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomDither(WindowCutter[RandomPlan, Correlations | None, Correlated]):
    """The window of random signs under way; no sums: no two frames have come."""

    overlap: ClassVar[int] = 1

    @override
    def begin(self, block: FrameBlock) -> None:
        """Return empty sums."""
        return

    @override
    def add(self, sums: Correlations | None, block: FrameBlock, place: int) -> Correlations | None:
        """Return the sums with a block that begins at this place of the window.

        They are updated in place: the window is the only one that holds them, and copying a matrix
        of all modes would cost more than the product.
        """
        n_frames, n_batches = self.plan.n_frames, self.plan.n_batches
        start = self.overlap
        while start < block.n_frames:
            batch = (place + start) * n_batches // n_frames
            # Rounded up: the first frame that the line above assigns to the next batch.
            next_batch = -(-(batch + 1) * n_frames // n_batches)
            end = min(block.n_frames, next_batch - place)
            sums = self._sum_batch(sums, block.rows(start - self.overlap, end), batch)
            start = end
        return sums

    @override
    def close(self, window: Window[Correlations | None]) -> Correlated | WindowRefused:
        """Return the finished window, or the reason why its dither differs from the request."""
        sums = window.sums
        if sums is None:
            return WindowRefused(reason=compose("window.no-pairs"), t_ns_utc=window.next_t_ns)
        power = np.diag(sums.dither_power.sum(axis=0)) / max(sums.n_pairs, 1)
        refusal = self.plan.refusal(np.sqrt(power))
        if refusal is not None:
            return WindowRefused(reason=refusal, t_ns_utc=window.next_t_ns)
        return Correlated(plan=self.plan, sums=sums, **window.telemetry)

    def _sum_batch(self, sums: Correlations | None, block: FrameBlock, batch: int) -> Correlations:
        """Return the sums with the frames of a batch, the last one before them included."""
        if block.dither_m is None:
            raise ValueError("no block without dither columns comes this far")
        plan, slopes, dither = self.plan, block.slopes, block.dither_m[:, list(self.plan.modes)]
        done = sums or _empty_sums(plan, slopes)
        fresh = slopes[1:] - np.float32(done.memory) * slopes[:-1]
        done.response[batch] += fresh.T @ dither[1:]
        done.late[...] += slopes[1:].T @ dither[:-1, plan.late_columns]
        done.dither_power[batch] += dither[1:].T @ dither[1:]
        done.noise_power[...] += np.einsum("ks,ks->s", fresh, fresh)
        done.slope_power[...] += np.einsum("ks,ks->s", slopes[1:], slopes[1:])
        return replace(done, n_pairs=done.n_pairs + len(fresh))


def join_random_windows(one: Correlated, other: Correlated) -> Correlated:
    """Return two windows of the same dither as one.

    Raises
    ------
    ModelError
        If they are of two sessions or of different modes.
    """
    if (one.session, one.plan.modes) != (other.session, other.plan.modes):
        raise ModelError(
            f"random dither: found windows of {len(one.plan.modes)} modes in session {one.session} "
            f"and {len(other.plan.modes)} in {other.session}, expected the same modes and session"
        )
    a, b = one.sums, other.sums
    both = {part.name: getattr(a, part.name) + getattr(b, part.name) for part in fields(a)}
    # All other fields are sums and have been added; this one is a mean.
    both["memory"] = (a.memory * a.n_pairs + b.memory * b.n_pairs) / both["n_pairs"]
    return replace(
        other,
        sums=Correlations(**both),
        first_seq=one.first_seq,
        n_missing=one.n_missing + other.n_missing,
        n_windows=one.n_windows + other.n_windows,
    )


def _empty_sums(plan: RandomPlan, slopes: Array) -> Correlations:
    """Return empty sums, with the lag-1 correlation of these first rows of slopes."""
    n_slopes, n_dithered = slopes.shape[1], len(plan.modes)
    power = float(np.vdot(slopes, slopes))
    together = float(np.vdot(slopes[1:], slopes[:-1]))
    return Correlations(
        response=np.zeros((plan.n_batches, n_slopes, n_dithered), np.float32),
        late=np.zeros((n_slopes, len(plan.late_columns)), np.float32),
        dither_power=np.zeros((plan.n_batches, n_dithered, n_dithered)),
        noise_power=np.zeros(n_slopes),
        slope_power=np.zeros(n_slopes),
        memory=together / power if power > 0.0 else 0.0,
        n_pairs=0,
    )


N_STEPS = 4
"""Gauss-Newton steps inside one linearisation: gains and α are multiplied with one another."""

RESPONSE_SIGMA = 5.0
"""σ of a response that counts as seen."""

WHITE_PRIOR_PARTS = 24
"""Weight, in parts, of the prior that the noise is nearly white."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyMatrix:
    """An interaction matrix as measured, with the noise of each of its elements.

    For fits and for looking at: at magnitude 10 its elements are no larger than their noise.
    """

    modes: tuple[int, ...]
    """0-based basis index of each column."""

    matrix: NDArray[np.float64]
    """``(n_slopes, n_dithered)`` slope per metre OPD, optical gain included."""

    noise: NDArray[np.float64]
    """``(n_slopes, n_dithered)`` 1 σ of each element, from the slopes' own scatter."""

    @property
    def snr_of_modes(self) -> NDArray[np.float64]:
        """``(n_dithered,)`` RMS signal of a column's elements over their noise; 0: none seen."""
        # Noise alone has a mean square of 1. Its scatter may make the difference negative.
        power = np.mean((self.matrix / self.noise) ** 2, axis=0) - 1.0
        return np.asarray(np.sqrt(np.maximum(power, 0.0)))

    @property
    def snr(self) -> float:
        """RMS signal of an element over its noise, over the whole matrix."""
        power = float(np.mean((self.matrix / self.noise) ** 2)) - 1.0
        return float(np.sqrt(max(power, 0.0)))


def noisy_matrix(window: Correlated) -> NoisyMatrix:
    """Return the interaction matrix that a window's correlations hold.

    ``D = sum e[k] u[k]^T (sum u u^T)^-1`` with ``e[k] = s[k] - ρ s[k-1]``, in which most of the
    turbulence is gone.
    """
    sums = window.sums
    power = np.linalg.inv(sums.dither_power.sum(axis=0))
    noise = np.sqrt(np.outer(_noise_variance(sums), np.diag(power)))
    return NoisyMatrix(
        modes=window.plan.modes,
        matrix=sums.response.sum(axis=0, dtype=float) @ power,
        noise=noise,
    )


def fit_random(window: Correlated, linearisation: Linearisation) -> RandomEstimate | WindowRefused:
    """Estimate α and a free gain per mode from one window, to first order.

    Variable projection (Kaufman 1975) on the noisy matrix, each slope weighted by its noise. The
    covariance is from the scatter of the scores of the window's batches or, where there are many
    modes, of the modes, which includes turbulence that is correlated over slopes. The window is
    refused if the mirror responds one frame late, because the columns are then misaligned.
    """
    noisy, sums = noisy_matrix(window), window.sums
    columns = list(noisy.modes)
    parted = np.linalg.inv(sums.dither_power.sum(axis=0))
    power = 1.0 / np.diag(parted)
    noise = np.sqrt(_noise_variance(sums))[:, None]
    # in units of the slopes' noise a mode's weight is the power of its dither
    matrix = linearisation.matrix[:, columns] / noise
    derivatives = linearisation.rates[:, :, columns] / noise
    measured = Columns(
        matrix=noisy.matrix / noise, weights=power, rows=np.ones(len(noise), dtype=np.bool_)
    )
    lag_frames, trouble = _measure_lag(window, measured, matrix, noise)
    if trouble is not None:
        kind, reason = trouble
        return window.refuse(reason, kind)
    step = np.zeros(len(derivatives))
    seen = measured.project(matrix, derivatives)
    for _ in range(N_STEPS):
        normal = seen.normal
        step = step + np.linalg.solve(normal, seen.scores.sum(axis=1))
        response = matrix + np.tensordot(step, derivatives, axes=1)
        seen = measured.project(response, derivatives)
    n_free = seen.residual.size - len(seen.gains) - len(step)
    inverse = np.linalg.inv(normal)
    parts = [seen.residual]
    if window.plan.n_batches > 1:
        # Each batch's part of the residual of the whole window.
        of_batches = zip(sums.response, sums.dither_power, strict=True)
        explained = seen.gains * response
        parts = [(answer / noise - explained @ sent) @ parted for answer, sent in of_batches]
    # Independent parts of the score, of the batches or of the modes.
    scores = seen.scores.T
    if len(parts) > 1:
        weighted = seen.jacobian * seen.weights
        scores = np.array([np.einsum("jsm,sm->j", weighted, part) for part in parts])
    spread = _scatter(scores, normal)
    every = inverse @ spread @ inverse.T
    return RandomEstimate(
        alpha=linearisation.add_step(step),
        covariance=every[:4, :4],
        with_stretches=every if len(step) > 4 else None,
        stretched=float(np.abs(step[4:]).max(initial=0.0)),
        optical_gain=seen.gains,
        gain_sigma=_gain_sigma(parts, response, power),
        lag_frames=np.array([lag_frames]),
        misfit=seen.chi / n_free,
        step=step[:4],
        t_ns_utc=window.t_end_ns_utc,
        cm_id=window.cm_id,
        session=window.session,
        modes=noisy.modes,
    )


def _measure_lag(
    window: Correlated, measured: Columns, matrix: Array, noise: Array
) -> tuple[float, Why | None]:
    """Return the lag of the response in frames, and the reason if there is no usable response.

    Responses in the dither's own row and in the next are compared, on a few of the modes. A loop
    with less than two frames of delay counteracts the dither in the next row: a negative share is
    the loop's, and no lag.
    """
    sums, some = window.sums, window.plan.late_columns
    along = measured.weights * matrix
    norm = float(np.vdot(along[:, some], matrix[:, some]))
    at_once = float(np.vdot(along[:, some], measured.matrix[:, some])) / norm
    sent = np.diag(sums.dither_power.sum(axis=0))[some]
    later = float(np.vdot(along[:, some], sums.late / noise / sent)) / norm
    seen = float(np.vdot(along, measured.matrix)) / np.sqrt(float(np.vdot(along, matrix)))
    # the late response was not whitened: its noise is that of the slopes as they are
    louder = np.sqrt(sums.slope_power.sum() / sums.noise_power.sum())
    late = later * np.sqrt(norm) / louder
    # A negative share is the loop's own reply, and no lag.
    lag = max(later / (at_once + later), 0.0) if at_once + later > 0.0 else 0.0
    lag = min(lag, 1.0)
    if seen > RESPONSE_SIGMA:
        return lag, None
    if late > RESPONSE_SIGMA:
        return lag, (
            RefusalKind.MISALIGNED,
            compose("window.answered-late", late_sigma=late, same_row_sigma=seen),
        )
    return lag, (RefusalKind.OTHER, compose("window.dither-not-seen", seen_sigma=seen))


def _noise_variance(sums: Correlations) -> Array:
    """Return ``(n_slopes,)`` variance of what the dither does not explain of ``s[k] - ρ s[k-1]``.

    A silent slope gets the mean.
    """
    power, response = sums.dither_power.sum(axis=0), sums.response.sum(axis=0, dtype=float)
    explained = np.einsum("sm,ms->s", response, np.linalg.solve(power, response.T))
    left = sums.noise_power - explained
    # of a noise-free sensor nothing but rounding is left
    left = np.maximum(left, 1e-12 * sums.noise_power)
    # One response per dithered mode has been fitted to each slope.
    variance = np.where(left > 0.0, left, left.mean()) / max(sums.n_pairs - len(power), 1)
    return np.asarray(variance)


def _scatter(scores: Array, normal: Array) -> Array:
    """Return the covariance ``(4, 4)`` of the sum of independent scores ``(n, 4)``.

    The shape of the covariance of so few is itself uncertain: it is drawn toward that of white
    noise, which is ``normal``.
    """
    n, own = len(scores), scores - scores.mean(axis=0)
    # The mean of the scores has been removed; the sum of n has n times the variance of one.
    found = own.T @ own * n / (n - 1)
    # White noise of variance 1 has a scatter equal to the normal matrix: inflation is how much
    # louder the noise is on average.
    inflation = float(np.trace(np.linalg.solve(normal, found))) / len(normal)
    return np.asarray(
        (WHITE_PRIOR_PARTS * inflation * normal + n * found) / (WHITE_PRIOR_PARTS + n)
    )


def _gain_sigma(parts: list[Array], response: Array, power: Array) -> Array:
    """Return 1 σ of each mode's gain, ``(n_dithered,)``.

    Turbulence looks like modes: along a mode's own slopes it is stronger than its white part.
    The noise of every column is of the same kind, so all of them show how loud it is there.
    """
    root = np.sqrt(power)
    seen = np.zeros((len(root), len(root)))
    for part in parts:
        seen += (response.T @ (part * root)) ** 2
    if len(parts) == 1:
        # a column's own gain has taken out what it had along its own slopes
        np.fill_diagonal(seen, np.nan)
    norm = np.sum(response**2, axis=0)
    return np.asarray(np.sqrt(np.nanmean(seen, axis=1)) / (root * norm))
