"""What the sensor would see without the mirror: turbulence and noise, half a second at a time.

The slopes of every screen step are one large matrix product; frames are interpolated between
steps. It runs in its own thread, ahead of the loop, so the product never holds a frame up.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_rtc.atmosphere import FrozenLayer, cubic_weights
from sim_rtc.detector import Detector
from sim_rtc.loop import ControlTerms, LoopBlock, LoopTerms, ModalLoop
from sim_rtc.motion import MovingOptics
from sim_rtc.plant import Optics, TelescopeOptics

Array32 = NDArray[np.float32]

BATCH_FRAMES = 10
"""Frames the loop processes together: one message on the wire."""

_BLOCK_BATCHES = 50
_AHEAD_BLOCKS = 2
_POLL_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenLoopBlock:
    """Consecutive frames seen through one set of optics, mirror left out."""

    first_frame: int
    """Number of row 0 since the start of the run."""

    optics: Optics
    """Valid for all of it."""

    slopes: Array32
    """``(n_frames, n_slopes)`` turbulence and noise; n_frames is a multiple of the batch."""

    phases_m: Array32
    """``(n_batches, n_points)`` turbulence OPD at the first frame of each batch."""

    @property
    def n_frames(self) -> int:
        """Frames of the block."""
        return len(self.slopes)

    def phase_at(self, row: int) -> Array32:
        """Return the turbulence OPD ``(n_points,)`` of a batch's first frame."""
        return np.asarray(self.phases_m[row // BATCH_FRAMES])

    def run(
        self, row: int, loop: ModalLoop, terms: ControlTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""
        if not isinstance(terms, LoopTerms):
            raise TypeError(f"loop: found {type(terms).__name__}; a linear plant needs LoopTerms")
        return loop.run(self.slopes[row : row + BATCH_FRAMES], terms, dither_m)


class Block(Protocol):
    """Consecutive frames through one set of optics, the mirror still to be added."""

    @property
    def first_frame(self) -> int:
        """Number of row 0 since the start of the run."""

    @property
    def optics(self) -> TelescopeOptics:
        """Valid for all of it."""

    @property
    def n_frames(self) -> int:
        """Frames of the block, a multiple of the batch."""

    def phase_at(self, row: int) -> Array32:
        """Return the turbulence OPD ``(n_points,)`` of a batch's first frame."""

    def run(
        self, row: int, loop: ModalLoop, terms: ControlTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""


class Feed(Protocol):
    """What makes blocks for ever."""

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks; one ends where a jump falls."""


class LayerHistory:
    """The last steps of one layer: phases and the slopes they make."""

    def __init__(self, layer: FrozenLayer, n_points: int, n_slopes: int) -> None:
        self._layer = layer
        self._first_step = 0
        self._phases = np.empty((0, n_points), dtype=np.float32)
        self._slopes = np.empty((0, n_slopes), dtype=np.float32)
        self._optics: Optics | None = None

    def frames(self, time_s: NDArray[np.float64], optics: Optics) -> tuple[Array32, Array32]:
        """Return slopes ``(n_frames, n_slopes)`` and the phases of each batch's first frame."""
        position = time_s * self._layer.steps_per_second + 1.0
        self._cover(int(position[0]) - 1, int(position[-1]) + 2, optics)
        step = position.astype(np.intp)
        weights = np.zeros((len(time_s), len(self._phases)), dtype=np.float32)
        rows = np.arange(len(time_s))[:, None]
        weights[rows, step[:, None] - self._first_step + np.arange(-1, 3)] = cubic_weights(
            position - step
        )
        return weights @ self._slopes, weights[::BATCH_FRAMES] @ self._phases

    def _cover(self, first_step: int, last_step: int, optics: Optics) -> None:
        known = self._first_step + len(self._phases)
        new = self._layer.advance(last_step + 1 - known)
        kept = slice(first_step - self._first_step, None)
        self._phases = np.concatenate([self._phases, new])[kept]
        if optics is self._optics:
            self._slopes = np.concatenate([self._slopes, new @ optics.slopes_per_phase.T])[kept]
        else:
            self._slopes = self._phases @ optics.slopes_per_phase.T
        self._first_step, self._optics = first_step, optics


class OpenLoopFeed:
    """Blocks of open-loop slopes, one after the other for ever."""

    def __init__(
        self,
        *,
        layers: tuple[FrozenLayer, ...],
        optics: MovingOptics,
        detector: Detector,
        frame_rate_hz: float,
        jump_times_s: tuple[float, ...],
        rng: np.random.Generator,
    ) -> None:
        self._layers = layers
        self._optics = optics
        self._detector = detector
        self._frame_rate_hz = frame_rate_hz
        self._jump_frames = [_batch_boundary(time, frame_rate_hz) for time in jump_times_s]
        self._rng = rng

    def blocks(self) -> Iterator[OpenLoopBlock]:
        """Yield the blocks; one ends where a jump falls."""
        first = _linear(self._optics.at(0.0))
        n_slopes, n_points = first.slopes_per_phase.shape
        histories = [LayerHistory(layer, n_points, n_slopes) for layer in self._layers]
        frame = 0
        while True:
            n_frames = min(
                [_BLOCK_BATCHES * BATCH_FRAMES]
                + [jump - frame for jump in self._jump_frames if jump > frame]
            )
            time_s = (frame + np.arange(n_frames)) / self._frame_rate_hz
            optics = _linear(self._optics.at(float(time_s[0])))
            parts = [history.frames(time_s, optics) for history in histories]
            slopes = self._detector.noise(n_frames, self._rng)
            for part, _ in parts:
                slopes += part
            phases = np.sum([phase for _, phase in parts], axis=0, dtype=np.float32)
            yield OpenLoopBlock(
                first_frame=frame, optics=optics, slopes=slopes, phases_m=np.asarray(phases)
            )
            frame += n_frames


class Ahead:
    """Blocks computed ahead in a thread of their own; two at most, then the thread waits."""

    def __init__(self, blocks: Iterator[Block]) -> None:
        self._blocks = blocks
        self._queue: queue.Queue[Block | BaseException] = queue.Queue(_AHEAD_BLOCKS)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._work, name="open-loop", daemon=True)

    def __enter__(self) -> Ahead:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks until the ``with`` block ends; re-raise what stopped the thread."""
        while not self._stopped.is_set():
            try:
                item = self._queue.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if isinstance(item, BaseException):
                raise item
            yield item

    def _work(self) -> None:
        try:
            for block in self._blocks:
                if not self._put(block):
                    return
        except Exception as error:  # noqa: BLE001 - handed to the loop, which re-raises it
            self._put(error)

    def _put(self, item: Block | BaseException) -> bool:
        while not self._stopped.is_set():
            try:
                self._queue.put(item, timeout=_POLL_S)
            except queue.Full:
                continue
            return True
        return False


def _batch_boundary(time_s: float, frame_rate_hz: float) -> int:
    return int(np.ceil(time_s * frame_rate_hz / BATCH_FRAMES)) * BATCH_FRAMES


def _linear(optics: TelescopeOptics) -> Optics:
    if not isinstance(optics, Optics):
        raise TypeError(f"feed: found {type(optics).__name__}; slopes need a linear plant's Optics")
    return optics
