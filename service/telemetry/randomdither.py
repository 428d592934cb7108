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
from service.telemetry.frames import FrameBlock
from service.telemetry.lockin import MAX_AMPLITUDE_RATIO, MIN_AMPLITUDE_RATIO
from service.telemetry.span import Steps, Window, WindowRefused, advanced, cut

Array = NDArray[Any]

FRAMES_PER_MODE = 4
"""A window shorter than this many frames per dithered mode cannot tell the modes apart."""

N_BATCHES = 24
"""Parts of a window whose scatter gives the covariance."""

MANY_MODES = 96
"""With more, the scatter of the modes themselves gives it, for their dithers are independent, and
the sums of batches need not be kept apart."""

LATE_MODES = 16
"""Modes on which a mirror that answers a frame late is looked for; more say nothing more."""

CHUNK_FRAMES = 512
"""Frames that go into one product: fewer, and reading the sums costs more than adding to them."""


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
        return 1 if len(self.modes) > MANY_MODES else N_BATCHES

    @property
    def late_columns(self) -> NDArray[np.intp]:
        """Which of the dithered modes also show a response one frame late, ``(n_late,)``."""
        n_late = min(len(self.modes), LATE_MODES)
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
class Correlated:
    """One finished window, or several joined to one."""

    plan: RandomPlan
    sums: Correlations
    session: str
    cm_id: str | None
    """Of the last window, where several are joined."""

    first_seq: int
    t_end_ns_utc: int
    """End of exposure of the last frame."""

    n_missing: int
    n_windows: int = 1
    """Windows, one after the other, that are joined here."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomDither:
    """The window under way: feed it blocks with ``accumulate``."""

    plan: RandomPlan
    window: Window[_Sums] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sums:
    """What a window has so far, and the rows that wait to be added to it."""

    done: Correlations | None = None
    """None: nothing yet."""

    batch: int = 0
    """The rows that wait belong to it, but for one that was the last before them."""

    slopes: tuple[Array, ...] = ()
    dither: tuple[Array, ...] = ()
    """Of the dithered modes."""

    follows: tuple[bool, ...] = ()
    """Whether the first row of each run came right after the last of the run before."""

    @property
    def n_waiting(self) -> int:
        """Rows that wait, and the one before them."""
        return sum(len(run) for run in self.slopes)


def accumulate(
    state: RandomDither, block: FrameBlock
) -> tuple[RandomDither, list[Correlated | WindowRefused]]:
    """Add a block of frames; return the new state and the windows that ended in it."""
    window, ended = cut(state.plan, state.window, block, _STEPS)
    return replace(state, window=window), ended


def joined(one: Correlated, other: Correlated) -> Correlated:
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
    n_pairs = a.n_pairs + b.n_pairs
    return replace(
        other,
        sums=Correlations(
            response=a.response + b.response,
            late=a.late + b.late,
            dither_power=a.dither_power + b.dither_power,
            noise_power=a.noise_power + b.noise_power,
            slope_power=a.slope_power + b.slope_power,
            memory=(a.memory * a.n_pairs + b.memory * b.n_pairs) / n_pairs,
            n_pairs=n_pairs,
        ),
        first_seq=one.first_seq,
        n_missing=one.n_missing + other.n_missing,
        n_windows=one.n_windows + other.n_windows,
    )


def _begin(_plan: RandomPlan, _block: FrameBlock) -> _Sums:
    return _Sums()


def _add(plan: RandomPlan, window: Window[_Sums], block: FrameBlock, rows: slice) -> Window[_Sums]:
    """Return the window with these rows in it, each with the batch it belongs to."""
    first, columns = window.span.first_seq, list(plan.modes)
    # no block without dither columns comes this far
    dither = block.commands_m[:0] if block.dither_m is None else block.dither_m
    start = rows.start
    while start < rows.stop:
        seq, sums = block.first_seq + start, window.sums
        batch = (seq - first) * plan.n_batches // plan.n_frames
        end_of_batch = first + -(-(batch + 1) * plan.n_frames // plan.n_batches)
        part = slice(start, min(rows.stop, end_of_batch - block.first_seq))
        if batch != sums.batch or sums.n_waiting >= CHUNK_FRAMES:
            sums = replace(_summed(plan, sums), batch=batch)
        sums = replace(
            sums,
            slopes=(*sums.slopes, block.slopes[part]),
            dither=(*sums.dither, dither[part, columns]),
            follows=(*sums.follows, seq == window.span.next_seq),
        )
        window = replace(window, span=advanced(window.span, block, part), sums=sums)
        start = part.stop
    return window


def _summed(plan: RandomPlan, sums: _Sums) -> _Sums:
    """Return the sums with the rows that waited added, the last of them kept for the next one."""
    return replace(
        sums,
        done=_total(plan, sums),
        slopes=(sums.slopes[-1][-1:].copy(),),
        dither=(sums.dither[-1][-1:].copy(),),
        follows=(False,),
    )


def _total(plan: RandomPlan, sums: _Sums) -> Correlations:
    """Return the correlations of all frames so far, those that waited included.

    They are updated in place: the window is the only one that holds them, and copying a matrix of
    all modes would cost more than the product.
    """
    slopes, dither = np.concatenate(sums.slopes), np.concatenate(sums.dither)
    paired = np.ones(len(slopes), dtype=bool)
    starts = np.cumsum([0, *(len(run) for run in sums.slopes[:-1])])
    paired[starts] = sums.follows
    paired[0] = False
    done = sums.done or _nothing(plan, slopes)
    now, before = np.flatnonzero(paired), np.flatnonzero(paired) - 1
    if len(now) == len(slopes) - 1:  # views instead of copies
        _correlate(plan, done, sums.batch, slopes[1:], slopes[:-1], dither[1:], dither[:-1])
    else:
        _correlate(plan, done, sums.batch, slopes[now], slopes[before], dither[now], dither[before])
    return replace(done, n_pairs=done.n_pairs + len(now))


def _nothing(plan: RandomPlan, slopes: Array) -> Correlations:
    """Return empty sums; these first rows say how the slopes remember the frame before."""
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


def _correlate(
    plan: RandomPlan,
    done: Correlations,
    batch: int,
    slopes: Array,
    before: Array,
    dither: Array,
    dither_before: Array,
) -> None:
    """Add pairs of frames, ``(n_pairs, ...)`` each, to the sums."""
    fresh = slopes - np.float32(done.memory) * before
    done.response[batch] += fresh.T @ dither
    done.late[...] += slopes.T @ dither_before[:, plan.late_columns]
    done.dither_power[batch] += dither.T @ dither
    done.noise_power[...] += np.einsum("ks,ks->s", fresh, fresh)
    done.slope_power[...] += np.einsum("ks,ks->s", slopes, slopes)


def _close(plan: RandomPlan, window: Window[_Sums]) -> Correlated | WindowRefused:
    """Return the finished window, or why its dither is not the one asked for."""
    sums = _total(plan, window.sums)
    power = np.diag(sums.dither_power.sum(axis=0)) / max(sums.n_pairs, 1)
    applied = np.sqrt(power)
    ratio = applied / np.array(plan.amplitude_m)
    if ratio.min() < MIN_AMPLITUDE_RATIO or ratio.max() > MAX_AMPLITUDE_RATIO:
        weak = ratio.min() < MIN_AMPLITUDE_RATIO
        worst = int(ratio.argmin() if weak else ratio.argmax())
        see = "see whether the RTC clips it" if weak else "see the RTC's units"
        return WindowRefused(
            reason=f"mode {plan.modes[worst]} carries {applied[worst] * 1e9:.2f} nm of dither, "
            f"{plan.amplitude_m[worst] * 1e9:.2f} nm were asked for: {see}",
            t_ns_utc=window.span.next_t_ns,
        )
    return Correlated(
        plan=plan,
        sums=sums,
        session=window.span.session,
        cm_id=window.span.cm_id,
        first_seq=window.span.first_seq,
        t_end_ns_utc=window.span.next_t_ns - window.dt_ns,
        n_missing=window.span.n_missing,
    )


_STEPS = Steps(begin=_begin, add=_add, close=_close)
