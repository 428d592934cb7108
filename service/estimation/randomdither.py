"""A noisy interaction matrix from a random binary dither, and the registration it says.

White dither on some modes, or on all: what the slopes have in common with it is the interaction
matrix (DO-CRIME, Lai et al. 2021). It is a measurement to fit a model to, never one to control
with. Only the response at lag 0, the first the wire's columns allow, is clean: later ones hold the
loop's own reply, which pulls the fit toward the old geometry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.frames import FrameBlock
from service.estimation.lockin import MIN_AMPLITUDE_RATIO, WindowRefused
from service.estimation.span import Span, advanced, opened, why_broken

Array = NDArray[Any]

FRAMES_PER_MODE = 4
"""A window shorter than this many frames per dithered mode cannot tell the modes apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomPlan:
    """What is correlated: the same amplitude, a random sign per frame, on each mode."""

    modes: tuple[int, ...]
    """0-based basis indices."""

    amplitude_m: tuple[float, ...]
    """Of each mode, metres OPD RMS."""

    n_frames: int
    """Length of a window."""

    first_seq: int
    """No window starts before this frame: the dither is on and the loop has settled."""

    n_batches: int = 24
    """Parts of a window whose scatter gives the covariance."""

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
                f"{least} for {len(self.modes)} modes and {self.n_batches} batches"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlations:
    """Sums over consecutive frames: slopes against the dither of the same frame and its neighbours.

    Sums of a batch are kept apart where the covariance needs them.
    """

    same: NDArray[np.float32]
    """``(n_batches, n_slopes, n_dithered)`` sum of s[k] u[k]^T."""

    before: NDArray[np.float32]
    """``(n_batches, n_slopes, n_dithered)`` sum of s[k-1] u[k]^T: it cannot hold a response."""

    after: NDArray[np.float32]
    """``(n_slopes, n_dithered)`` sum of s[k] u[k-1]^T: the second responding lag."""

    dither_power: NDArray[np.float64]
    """``(n_batches, n_dithered, n_dithered)`` sum of u[k] u[k]^T, metres²."""

    slope_power: NDArray[np.float64]
    """``(n_slopes,)`` sum of s[k]²."""

    slope_memory: NDArray[np.float64]
    """``(n_slopes,)`` sum of s[k] s[k-1]."""

    n_pairs: int
    """Consecutive frames summed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlated:
    """One finished window."""

    plan: RandomPlan
    sums: Correlations
    session: str
    cm_id: str | None
    first_seq: int
    t_end_ns_utc: int
    """End of exposure of the last frame."""

    n_missing: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomDither:
    """The window under way: feed it blocks with ``accumulate``."""

    plan: RandomPlan
    window: _Window | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    span: Span
    dt_ns: int
    last_slopes: Array | None
    """Of the last row that came."""

    last_dither: Array | None
    sums: Correlations


def accumulate(
    state: RandomDither, block: FrameBlock
) -> tuple[RandomDither, list[Correlated | WindowRefused]]:
    """Add a block of frames; return the new state and the windows that ended in it."""
    ended: list[Correlated | WindowRefused] = []
    done = 0
    while done < block.n_frames:
        state, used, outcome = _advance(state, block, done)
        done += used
        if outcome is not None:
            ended.append(outcome)
    return state, ended


def _advance(
    state: RandomDither, block: FrameBlock, start: int
) -> tuple[RandomDither, int, Correlated | WindowRefused | None]:
    plan, window, seq = state.plan, state.window, block.first_seq + start
    if window is None:
        if seq < plan.first_seq:
            return state, min(plan.first_seq - seq, block.n_frames - start), None
        if block.dither_m is None:
            return state, block.n_frames - start, None
        window = _open(plan, block, start)
    reason = why_broken(window.span, plan.n_frames, block, start)
    if reason is not None:
        refused = WindowRefused(reason=reason, t_ns_utc=window.span.next_t_ns)
        return replace(state, window=None), 0, refused
    first = window.span.first_seq
    if seq >= first + plan.n_frames:  # the window's last frames never came
        return replace(state, window=None), 0, _close(plan, window)
    batch = (seq - first) * plan.n_batches // plan.n_frames
    # up to the end of this batch, so that every product belongs to one of them
    end_of_batch = first + -(-(batch + 1) * plan.n_frames // plan.n_batches)
    stop = min(block.n_frames, end_of_batch - block.first_seq)
    window = _add(plan, window, block, slice(start, stop), batch)
    if window.span.next_seq < first + plan.n_frames:
        return replace(state, window=window), stop - start, None
    return replace(state, window=None), stop - start, _close(plan, window)


def _open(plan: RandomPlan, block: FrameBlock, start: int) -> _Window:
    n_slopes, n_dithered = block.slopes.shape[1], len(plan.modes)
    return _Window(
        span=opened(block, start),
        dt_ns=block.dt_ns,
        last_slopes=None,
        last_dither=None,
        sums=Correlations(
            same=np.zeros((plan.n_batches, n_slopes, n_dithered), np.float32),
            before=np.zeros((plan.n_batches, n_slopes, n_dithered), np.float32),
            after=np.zeros((n_slopes, n_dithered), np.float32),
            dither_power=np.zeros((plan.n_batches, n_dithered, n_dithered)),
            slope_power=np.zeros(n_slopes),
            slope_memory=np.zeros(n_slopes),
            n_pairs=0,
        ),
    )


def _add(plan: RandomPlan, window: _Window, block: FrameBlock, rows: slice, batch: int) -> _Window:
    """Return the window with these rows, all of one batch, in its sums.

    The sums are updated in place: the window is the only one that holds them, and copying a matrix
    of all modes for every block would cost more than the product.
    """
    unbroken = block.first_seq + rows.start == window.span.next_seq
    columns = list(plan.modes)
    # why_broken lets no block without dither columns come this far
    all_dither = block.commands_m[:0] if block.dither_m is None else block.dither_m
    slopes, dither = block.slopes[rows], all_dither[rows, columns]
    if window.last_slopes is not None and window.last_dither is not None and unbroken:
        slopes = np.vstack([window.last_slopes, slopes])
        dither = np.vstack([window.last_dither, dither])
    now, earlier, sums = slopes[1:], slopes[:-1], window.sums
    sums.same[batch] += now.T @ dither[1:]
    sums.before[batch] += earlier.T @ dither[1:]
    sums.after[...] += now.T @ dither[:-1]
    sums.dither_power[batch] += (dither[1:].T @ dither[1:]).astype(float)
    sums.slope_power[...] += np.einsum("ks,ks->s", now, now)
    sums.slope_memory[...] += np.einsum("ks,ks->s", now, earlier)
    return replace(
        window,
        span=advanced(window.span, block, rows),
        last_slopes=slopes[-1:],
        last_dither=dither[-1:],
        sums=replace(sums, n_pairs=sums.n_pairs + len(now)),
    )


def _close(plan: RandomPlan, window: _Window) -> Correlated | WindowRefused:
    """Return the finished window, or why its dither is not the one asked for."""
    power = np.diag(window.sums.dither_power.sum(axis=0)) / max(window.sums.n_pairs, 1)
    applied = np.sqrt(power)
    ratio = applied / np.array(plan.amplitude_m)
    if ratio.min() < MIN_AMPLITUDE_RATIO:
        weakest = int(ratio.argmin())
        return WindowRefused(
            reason=f"mode {plan.modes[weakest]} carries {applied[weakest] * 1e9:.2f} nm of dither, "
            f"{plan.amplitude_m[weakest] * 1e9:.2f} nm were asked for: see whether the RTC clips "
            "it",
            t_ns_utc=window.span.next_t_ns,
        )
    return Correlated(
        plan=plan,
        sums=window.sums,
        session=window.span.session,
        cm_id=window.span.cm_id,
        first_seq=window.span.first_seq,
        t_end_ns_utc=window.span.next_t_ns - window.dt_ns,
        n_missing=window.span.n_missing,
    )
