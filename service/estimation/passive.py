"""Registration from ordinary telemetry, without a dither.

Turbulence sits below a tenth of the frame rate, and there commands and slopes have it in common: a
regression of one on the other is biased, by a third of a subaperture on a bright star in 20 m/s.
Above it moves mostly the sensor's own noise, which the loop returns as commands ``d`` frames later:
a dither that costs nothing. A filter that lets only that pass makes an instrument (in the sense of
instrumental variables) of the commands, and sums over every frame make a noisy interaction matrix
of it: a measurement to fit a model to, never a matrix to control with.

The turbulence that is left in the filtered commands biases the shifts by the wind, steadily, and no
integration removes it: docs/results/tracking.md has by how much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming
from service.estimation.frames import FrameBlock, join_frames
from service.estimation.loop import explain_open_loop
from service.estimation.solver import Columns
from service.estimation.windows import CHUNK_FRAMES
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.records.estimates import PassiveEstimate

Array = NDArray[Any]

PASSIVE_MEMORY_S = 10.0

PASSIVE_INTERVAL_S = 4.0
"""Duration of telemetry in a passive estimate, and interval between two: a jump must be detected
within 5 s."""

MIN_PASSIVE_S = 3.0
"""Shortest telemetry for an estimate next to a dither."""

RESTS, LONG_RESTS = 1, 3
"""Intervals skipped after an estimate next to a dither, and while its windows are accepted: windows
detect a jump sooner than a passive estimate."""

MIN_FRAMES_PER_MODE = 5
"""Fewer effective frames leave the command covariance too noisy to invert."""

N_TAPS = 11
"""Longer filters know turbulence from noise no better, and lose more frames at every gap."""

CORNER_RATIO = 0.08
"""Corner of the high-pass filter as a fraction of the frame rate. Above 0.1 a bright star leaves
too little signal; below 0.06 turbulence in a wind of 20 m/s passes."""

FILTER_BLOCK_FRAMES = 32
"""Filtered in one product: more are mostly products with nothing, fewer mostly calls."""

MIN_DELAY_FRAMES = 2
"""With less the instrument may not look ahead, and a tenth of the signal is left."""

_LOOP_GAIN = 0.35
"""Gain of a loop with gain 0.6 and optical gain 0.6: frequencies at which its noise is amplified.
"""

_TURBULENCE_SLOPE = 34.0 / 3.0
"""Slope of the squared temporal power spectrum of a mode above its corner frequency: twice 17/3
(Conan et al. 1995)."""

_LOWEST_FREQUENCY_RATIO = 0.015
"""Lowest frequency as a fraction of the frame rate. Below it turbulence is assumed to be as strong
as at it."""

TAPER_FRAMES = 32
"""Frames over which a run of telemetry fades in after a gap, and out before the next. Turbulence is
a thousand times stronger than the noise that is looked for: a sum of their products that is cut off
is worse than none. Runs of less than twice as many frames are left out."""

MAX_OTHER_MODES = 8
"""Modes outside the loop that a dither of sines may move; where more move it is turbulence or
random signs, which the filtered commands have nothing in common with."""

SAMPLES_KEPT = 64
"""Filtered frames kept, from which the fit learns how noisy slopes are."""

SAMPLE_FRAMES = 128
"""One sample in as many frames."""

CORRELATION_SHRINKAGE = 0.2
"""Fraction by which correlations between parameters are reduced. They are estimated from the few
independent errors of columns, so directions that appear best known are partly known by chance: one
estimate in 60 was 5 σ off in such a direction."""

MIN_SAMPLES = 8
"""Smallest number of filtered frames from which the noise of the slopes is estimated."""

_FILTER_SPAN_FRAMES = N_TAPS - 1
"""Frames besides its own that a filtered one is made of."""

_RANK_TOLERANCE = 1e-6
"""Singular values below this fraction of the largest are rounding errors."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HighPass:
    """A finite filter of commands: ``z_k = sum_j taps_j c_{k + ahead - j}``."""

    taps: NDArray[np.float32]
    """``(n_taps,)``, the largest 1 either way; they add up to 0."""

    ahead: int
    """Frames after k that z_k depends on: their commands do not know the noise of frame k."""

    band: NDArray[np.float32]
    """Taps, one column further in each row.

    ``(FILTER_BLOCK_FRAMES, FILTER_BLOCK_FRAMES + n_taps - 1)``
    """

    def __call__(self, commands: Array) -> Array:
        """Return ``(n_rows - n_taps + 1, n_modes)`` of contiguous commands ``(n_rows, n_modes)``.

        Row i belongs to frame ``i + behind``.
        """
        reach = len(self.taps) - 1
        out = np.empty((len(commands) - reach, commands.shape[1]), np.float32)
        for start in range(0, len(out), FILTER_BLOCK_FRAMES):
            part = out[start : start + FILTER_BLOCK_FRAMES]
            n = len(part)
            np.matmul(self.band[:n, : n + reach], commands[start : start + n + reach], out=part)
        return out

    @property
    def behind(self) -> int:
        """Frames before k that z_k depends on."""
        return len(self.taps) - 1 - self.ahead


@cache
def high_pass(delay_frames: float) -> HighPass:
    """Return the filter for a loop of this delay.

    It makes ``E[z c]``, the response to the sensor's noise, as large as it can be for the noise of
    ``sum z s``. Turbulence counts as noise, as strong as the sensor's at ``CORNER_RATIO``. With a
    loop's response to white noise, ``P = 1 / |1 - z^-1 + g z^-d|^2``, the taps solve ``M a = v``,
    where ``v`` is the inverse transform of P and ``M`` that of ``P (1 + W)``.

    Raises
    ------
    ModelError
        If the delay is shorter than ``MIN_DELAY_FRAMES``.
    """
    if delay_frames < MIN_DELAY_FRAMES:
        raise ModelError(
            f"passive estimate: found a delay of {delay_frames:g} frames, expected at least "
            f"{MIN_DELAY_FRAMES}: a faster loop answers noise in the frames in which its "
            "response is measured"
        )
    # A delay of d frames: commands up to d - 1 frames after k do not know the noise of frame k.
    ahead = int(delay_frames) - 1
    # Frequencies in cycles per frame, up to half of the frame rate.
    turns = (np.arange(4096) + 0.5) / 8192
    z = np.exp(-2j * np.pi * turns)
    power = 1.0 / np.abs(1.0 - 0.999 * z + _LOOP_GAIN * z ** round(delay_frames)) ** 2
    turbulence = (CORNER_RATIO / np.maximum(turns, _LOWEST_FREQUENCY_RATIO)) ** _TURBULENCE_SLOPE
    shifted = np.exp(-2j * np.pi * np.outer(np.arange(N_TAPS) - ahead, turns))
    signal = (shifted * power).real.mean(axis=1)
    noise = ((shifted * power * (1.0 + turbulence)) @ shifted.conj().T).real / len(turns)
    taps = np.linalg.solve(noise, signal)
    # A static command must not pass: the taps sum to 0.
    taps -= taps.mean()
    taps = (taps / np.abs(taps).max()).astype(np.float32)
    band = np.zeros((FILTER_BLOCK_FRAMES, FILTER_BLOCK_FRAMES + N_TAPS - 1), np.float32)
    for k, row in enumerate(band):
        # Reversed, because a convolution is written as a product of matrices.
        row[k : k + N_TAPS] = taps[::-1]
    return HighPass(taps=taps, ahead=ahead, band=band)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Passive(Streaming):
    """Forgetting sums over filtered commands of one loop, closed every few seconds for a fit."""

    resets = Change.GONE | Change.LOOP | Change.STANDSTILL
    unless = Mark.STANDS
    only_closed = True

    n_modes: int
    """Controlled modes: the only ones that move by themselves."""

    memory_frames: float
    """Frames after which a sample's weight has fallen to 1/e."""

    delay_frames: float = 2.0
    """Delay of the loop. Below two frames nothing is summed."""

    n_effective: float = 0.0
    """Frames in the sums, forgetting included."""

    sums: tuple[NDArray[np.float32], ...] = ()
    """Sums of s z^T ``(n_slopes, n_instruments)``, metres, of c z^T ``(n_modes, n_instruments)``
    and of z z^T, metres²; z are the filtered commands of the instruments. Empty if there are no
    frames."""

    samples: tuple[tuple[Array, Array], ...] = ()
    """Filtered slopes ``(n_slopes,)`` and commands ``(n_modes,)`` of single frames."""

    tail: FrameBlock | None = None
    """The last frames, as many as the filter reaches back."""

    waiting: tuple[FrameBlock, ...] = ()
    """Frames that are not multiplied yet and, before them, those that the filter reaches back to;
    each block follows the one before."""

    n_others: int = 0
    """Modes outside the loop that move in them."""

    begun: bool = False
    """True if frames of this run have been multiplied."""

    from_seq: int = 0
    """Frames before this one are left out."""

    since_ns_utc: int = 0
    """No frame in the sums is older, by the RTC's clock; 0: not known."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> Passive:
        """Return sums of the loop that have begun with nothing."""
        rtc = loop.rtc
        if rtc is None:
            return cls(n_modes=0, memory_frames=1.0)
        return cls(
            n_modes=rtc.n_controlled,
            memory_frames=PASSIVE_MEMORY_S * rtc.frame_rate_hz,
            delay_frames=rtc.delay_frames,
        )

    @override
    def restart(self, loop: LoopContext, why: Change) -> Passive:
        """Return sums that have begun with nothing, for another loop or after a standstill."""
        from_seq = loop.settled_seq if Change.STANDSTILL in why else 0
        return replace(self.begin(loop), since_ns_utc=loop.received_ns_utc, from_seq=from_seq)

    @override
    def update(self, frames: FrameContext) -> Passive:
        """Return them with one more block."""
        return accumulate(self, frames.moving)

    @property
    def n_waiting(self) -> int:
        """Frames that the filter reaches both ends of and that are not multiplied yet."""
        return max(sum(block.n_frames for block in self.waiting) - _FILTER_SPAN_FRAMES, 0)

    @property
    def explain_unusable(self) -> str | None:
        """Return the reason for which this loop's telemetry cannot be used, or None."""
        if self.delay_frames >= N_TAPS:
            return f"no passive estimate: the delay of {self.delay_frames:g} frames is too long"
        if self.delay_frames < MIN_DELAY_FRAMES:
            return (
                f"no passive estimate: the loop's delay is {self.delay_frames:g} frames, "
                f"{MIN_DELAY_FRAMES} are needed to separate the response of the mirror from noise"
            )
        return None

    @property
    def instruments(self) -> NDArray[np.intp]:
        """Return the modes whose filtered commands are correlated with everything, increasing.

        ``(n_instruments,)``. All modes, as long as the memory suffices. Otherwise modes evenly
        spread over the basis, half as many as the frames of an estimate could support: thousands
        would use two cores without improving α, and low modes alone contain little information on
        the shift.
        """
        every = np.arange(self.n_modes)
        if self.memory_frames + CHUNK_FRAMES >= MIN_FRAMES_PER_MODE * self.n_modes:
            return every
        n_look = self.memory_frames * PASSIVE_INTERVAL_S / PASSIVE_MEMORY_S
        n_kept = max(int(n_look / (2 * MIN_FRAMES_PER_MODE)), 1)
        return every[np.arange(n_kept) * self.n_modes // n_kept]

    def close(
        self, loop: LoopContext, marks: Mark, *, has_windows: bool
    ) -> tuple[Passive, Passive | str | None]:
        """Return reset sums with the finished ones, or the reason why there is no estimate yet.

        ``marks`` are those of the last block; ``has_windows`` is True if dithered windows have
        recently measured α. Two estimates never share telemetry, so that their errors are
        independent and an estimate entirely after a jump shows it. Next to a dither some telemetry
        is skipped, more if windows have recently measured α; the reason is then None. The pause
        ends early when they stop.
        """
        dithered, now_ns, sums = Mark.WINDOWS in marks, loop.received_ns_utc, self
        ahead_ns = self.since_ns_utc - now_ns
        # A rest that would last longer than any: the clock went back.
        oversleeps = ahead_ns > 2 * LONG_RESTS * PASSIVE_INTERVAL_S * 1e9
        if ahead_ns > 0 and (oversleeps or not (has_windows and dithered)):
            sums = replace(self, from_seq=0, since_ns_utc=now_ns)
        since_ns = sums.since_ns_utc if dithered else 0
        if now_ns - since_ns < MIN_PASSIVE_S * 1e9 and since_ns:
            return sums, None
        why = sums.check_fittable(loop)
        if loop.rtc is None or why is not None:
            return sums, why
        rate_hz = loop.rtc.frame_rate_hz
        begun = replace(sums, sums=(), n_effective=0.0)
        if not dithered or sums.tail is None:
            # Frames that wait are kept for the next estimate, which therefore began earlier.
            waiting_ns = round(sums.n_waiting * 1e9 / rate_hz)
            return replace(begun, since_ns_utc=now_ns - waiting_ns), sums
        rest_s = PASSIVE_INTERVAL_S * (LONG_RESTS if has_windows else RESTS)
        begun = replace(
            begun,
            waiting=(),
            begun=False,
            # The pause is counted in frames for the sums, and by the clock for the decision to wake
            # up.
            from_seq=sums.tail.next_seq + round(rest_s * rate_hz),
            since_ns_utc=now_ns + round(rest_s * 1e9),
        )
        return begun, sums

    def check_fittable(self, loop: LoopContext) -> str | None:
        """Return why the sums cannot be fitted, or None."""
        if loop.rtc is None:
            return "no passive estimate: there is no telemetry that could be used"
        if not loop.rtc.in_loop:
            return f"no passive estimate: {explain_open_loop(loop.rtc)}"
        if self.explain_unusable is not None:
            return self.explain_unusable
        n_instruments = len(self.instruments)
        least = MIN_FRAMES_PER_MODE * n_instruments
        if self.n_effective >= least:
            return None
        return (
            f"no passive estimate yet: {self.n_effective:.0f} frames in runs without gaps, "
            f"{least} are needed for {n_instruments} modes"
        )


def accumulate(state: Passive, block: FrameBlock) -> Passive:
    """Add a block of frames.

    What moves outside the loop is taken out of the instrument, where its response would pass for
    that of controlled modes; and so is a dither of sines of modes in the loop. Windows read that,
    and a look that did so too would have another bias than one of the loop's own noise.
    """
    if state.explain_unusable is not None or block.first_seq < state.from_seq:
        return state
    n_columns, block = block.commands_m.shape[1], _append_dither_columns(state, block)
    tail = state.tail
    n_moved = block.commands_m.shape[1]
    if tail is not None and not (block.follows(tail) and n_moved == tail.commands_m.shape[1]):
        state = replace(_end_run(state), tail=None)
    before = () if state.tail is None else (state.tail,)
    n_others = len(_others(state, *before, block))
    if state.n_waiting and n_others != state.n_others:
        # a dither begins or ends: what it is taken out of must hold it from end to end
        state = _end_run(state)
    if n_moved == n_columns:  # a dither of the loop's modes is no noise
        state = _keep_sample(state, *before, block)
    tail = block if block.n_frames >= _FILTER_SPAN_FRAMES else join_frames((*before, block))
    waiting = (*(state.waiting or before), block)
    state = replace(state, tail=tail.last(_FILTER_SPAN_FRAMES), waiting=waiting, n_others=n_others)
    if state.n_waiting < CHUNK_FRAMES + TAPER_FRAMES:
        return state
    frames = join_frames(waiting)
    state = _sum_frames(state, frames.rows(0, frames.n_frames - TAPER_FRAMES), last=False)
    return replace(state, waiting=(frames.last(_FILTER_SPAN_FRAMES + TAPER_FRAMES),), begun=True)


def _append_dither_columns(state: Passive, block: FrameBlock) -> FrameBlock:
    """Return a block whose commands have the dither of controlled modes as further columns."""
    dither, block = block.dither_m, replace(block, dither_m=None)
    if dither is None:
        return block
    moved = np.flatnonzero(dither[:, : state.n_modes].any(axis=0))
    if not 0 < len(moved) <= MAX_OTHER_MODES:
        return block
    return replace(block, commands_m=np.hstack([block.commands_m, dither[:, moved]]))


def _of(commands: Array, modes: NDArray[np.intp]) -> Array:
    """Return the last axis of these modes: of the first ones, as usual, without a copy."""
    n = len(modes)
    return commands[..., :n] if n and modes[-1] == n - 1 else commands[..., modes]


def _end_run(state: Passive) -> Passive:
    """Return the state after the end of a run: what waits fades out, or was too short to count."""
    if state.n_waiting >= (1 if state.begun else 2 * TAPER_FRAMES):
        state = _sum_frames(state, join_frames(state.waiting), last=True)
    return replace(state, waiting=(), begun=False)


def _others(state: Passive, *blocks: FrameBlock) -> NDArray[np.intp]:
    """Return which modes outside the loop move; none where more do than any dither of sines."""
    moves = [block.commands_m[:, state.n_modes :].any(axis=0) for block in blocks]
    others = state.n_modes + np.flatnonzero(np.any(moves, axis=0))
    return others[:0] if len(others) > MAX_OTHER_MODES else others


def _keep_sample(state: Passive, *blocks: FrameBlock) -> Passive:
    """Keep one filtered frame in ``SAMPLE_FRAMES``; all blocks but the last are short."""
    first, n_rows = (
        blocks[0].first_seq,
        sum(block.n_frames for block in blocks) - _FILTER_SPAN_FRAMES,
    )
    n_due = (first + n_rows) // SAMPLE_FRAMES - first // SAMPLE_FRAMES
    if n_rows < 1 or not n_due:
        return state
    head = join_frames(tuple(block.rows(0, N_TAPS) for block in blocks)).rows(0, N_TAPS)
    chosen = high_pass(state.delay_frames)
    n_before = n_rows + _FILTER_SPAN_FRAMES - blocks[-1].n_frames
    later = range(SAMPLE_FRAMES - n_before, n_rows - n_before, SAMPLE_FRAMES)[: n_due - 1]
    samples = list(state.samples)
    for rows in (head, *(blocks[-1].rows(start, start + N_TAPS) for start in later)):
        filtered = chosen(rows.commands_m[:, : state.n_modes])[0]
        samples.append((chosen.taps[::-1] @ rows.slopes, filtered))
    return replace(state, samples=tuple(samples[-SAMPLES_KEPT:]))


def _sum_frames(state: Passive, frames: FrameBlock, *, last: bool) -> Passive:
    """Add frames to the sums: the first of a run, the last, or some between."""
    chosen, commands = high_pass(state.delay_frames), frames.commands_m
    # those that the filter reaches both ends of
    now = slice(chosen.behind, frames.n_frames - chosen.ahead)
    before = slice(now.start - 1, now.stop - 1)
    filtered, n = chosen(_of(commands, state.instruments)), frames.n_frames - _FILTER_SPAN_FRAMES
    others = _others(state, frames)
    if len(others):
        moving = np.hstack([commands[now][:, others], commands[before][:, others]])
        shapes, size, _ = np.linalg.svd(moving.astype(float), full_matrices=False)
        # The columns may be linearly dependent. Only the directions that they span are projected
        # out of the instrument; the others are rounding errors.
        known = shapes[:, size > _RANK_TOLERANCE * size[0]].astype(np.float32)
        filtered -= known @ (known.T @ filtered)
    weight = np.ones((n, 1), np.float32)
    rise = np.sin(np.pi / 2 * (np.arange(TAPER_FRAMES) + 0.5) / TAPER_FRAMES)[:, None] ** 2
    if not state.begun:
        weight[:TAPER_FRAMES] *= rise[:n]
    if last:
        weight[-TAPER_FRAMES:] *= rise[::-1][-n:]
    filtered *= weight
    with_z = (frames.slopes[now], commands[now, : state.n_modes], filtered)
    sums = tuple(rows.T @ filtered for rows in with_z)
    fade = np.float32(np.exp(-n / state.memory_frames))
    # Not strict: before the first chunk there are no old sums.
    for new, old in zip(sums, state.sums, strict=False):
        new += fade * old
    n_effective = float(fade) * state.n_effective + float(weight.sum())
    return replace(state, sums=sums, n_effective=n_effective)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveMatrix:
    """The interaction matrix that ordinary telemetry shows."""

    matrix: NDArray[np.float64]
    """``(n_slopes, n_instruments)``, slope per metre OPD: the columns of the instruments and, where
    not all modes are, what moves with them of the others."""

    shape: NDArray[np.float64]
    """Covariance of the columns' errors, square, for slopes with noise of 1."""

    carried: NDArray[np.float64]
    """``(n_others, n_instruments)`` how far modes that are no instruments move with each."""


def passive_matrix(state: Passive) -> PassiveMatrix | None:
    """Return the noisy interaction matrix, or None when the telemetry is too young.

    ``D = (sum s z^T) (sum c z^T)^-1``, as z is independent of the noise of its frame. The errors of
    its columns go as ``X^-T (sum z z^T) X^-1`` with ``X = sum c z^T``. Where some modes alone are
    instruments, the columns are ``D_z + D_o (sum o z^T) X^-1``, with o the commands of the others.
    """
    if not state.sums or state.n_effective < MIN_FRAMES_PER_MODE * len(state.instruments):
        return None
    cross, moved, power = (part.astype(np.float64) for part in state.sums)
    others, moved = np.delete(moved, state.instruments, axis=0), _of(moved.T, state.instruments).T
    own = np.diag(power)
    if not own.any():
        return None
    # relative to each mode's own power, or the strongest would drown the weakest, with just
    # enough of the mean for a mode that never moves
    ridge = np.diag(1e-6 * own + 1e-9 * own.mean())
    inverse = np.linalg.inv(moved + ridge)
    return PassiveMatrix(
        matrix=cross @ inverse,
        shape=inverse.T @ power @ inverse,
        carried=others @ inverse,
    )


def fit(state: Passive, linearisation: Linearisation) -> PassiveEstimate | None:
    """Fit α and a free gain per mode to the noisy matrix; None if there are too few frames.

    Uses :mod:`service.estimation.solver`, each mode weighted by its noise. The errors of the
    columns are correlated (Q), and so are those of the slopes (S), because fast turbulence
    resembles modes. With both, ``Cov = A^-1 (J w) (S x Q) (J w)^T A^-1``; S is estimated from the
    residual. Its correlations are reduced by ``CORRELATION_SHRINKAGE``.
    """
    found = passive_matrix(state)
    if found is None:
        return None
    some, carried = state.instruments, found.carried
    estimate = fit_matrix(
        found,
        _project_instruments(linearisation.matrix, some, carried),
        _project_instruments(linearisation.derivatives, some, carried),
        linearisation.alpha,
    )
    whole = found.matrix
    if len(carried):
        # the responses of the other modes in one frame differ from their mean: they are modelled
        gain = float(np.mean(estimate.optical_gain))
        whole = gain * linearisation.matrix[:, : state.n_modes].astype(np.float64)
        whole[:, some] = found.matrix - np.delete(whole, some, axis=1) @ carried
        estimate = replace(estimate, optical_gain=np.full(state.n_modes, gain))
    return replace(estimate, misfit=estimate.misfit / _slope_variance(state, whole))


def _project_instruments(matrix: Array, some: NDArray[np.intp], carried: Array) -> Array:
    """Return columns of instruments ``(..., n_instruments)`` with what moves with them."""
    own = _of(matrix, some)
    if not len(carried):
        return own
    n_modes = len(some) + len(carried)
    others = np.delete(matrix[..., :n_modes], some, axis=-1)
    return np.asarray(own + others @ carried.astype(matrix.dtype))


def fit_matrix(
    found: PassiveMatrix, model: Array, derivatives: Array, near: Misregistration
) -> PassiveEstimate:
    """Fit α and a free gain per column to a noisy matrix, near ``near``.

    ``model`` is the model's matrix there, ``derivatives`` ``(4, ...)`` its derivatives by α. The
    misfit is the variance of the errors in units of the given shape, because their noise is
    unknown.
    """
    noise = np.diag(found.shape)
    # a mode that never moves has no noise, and no weight
    least = noise[noise > 0.0].min()
    weights = np.where(noise > 0.0, least / np.maximum(noise, least), 0.0)
    every = np.ones(len(found.matrix), dtype=np.bool_)
    measured = Columns(matrix=found.matrix, weights=weights, rows=every)
    seen = measured.project(model, derivatives)
    normal = np.linalg.inv(seen.normal)
    step = normal @ seen.scores.sum(axis=1)
    left = seen.residual - np.tensordot(step, seen.jacobian, axes=1)
    # Each column has one gain fitted, and all columns together the four of α. weights @ noise is
    # ``least`` for each column that moves.
    freedom = (len(left) - 1) * (weights @ noise) - 4 * least
    variance = float(np.sum(left**2, axis=0) @ weights / freedom)
    # What is left of every column as patterns P of the slopes' errors, S = P P^T. Their trace is
    # the number of slopes: errors without correlation would make the unit matrix.
    moving = noise > 0.0
    patterns = left[:, moving] / np.sqrt(noise[moving])
    patterns = patterns * np.sqrt(len(left) / np.sum(patterns**2))
    scores = patterns.T @ (seen.jacobian * weights)
    spread = (scores @ found.shape).reshape(4, -1) @ scores.reshape(4, -1).T
    covariance = variance * normal @ spread @ normal
    return PassiveEstimate(
        alpha=near.add_step(step),
        # Shrinks the correlations only: the variances on the diagonal are unchanged.
        covariance=(1.0 - CORRELATION_SHRINKAGE) * covariance
        + CORRELATION_SHRINKAGE * np.diag(np.diag(covariance)),
        optical_gain=seen.gains,
        misfit=variance,
        step=step,
    )


def _slope_variance(state: Passive, matrix: Array) -> float:
    """Return the variance of a slope's noise at the frequencies of the filter."""
    if len(state.samples) < MIN_SAMPLES:
        return float("nan")
    slopes = np.array([slopes for slopes, _ in state.samples])
    commands = np.array([commands for _, commands in state.samples])
    # The gain of the filter for the power of white noise.
    passed = float(np.sum(high_pass(state.delay_frames).taps ** 2))
    return float(np.mean((slopes - commands @ matrix.T) ** 2)) / passed
