"""What the sensor would see without the mirror: turbulence and noise, half a second at a time.

The slopes of every screen step are one large matrix product; frames are interpolated between
steps. It runs in its own thread, ahead of the loop, so the product never holds a frame up.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_rtc.detector import Detector
from sim_rtc.loop import ControlTerms, LoopBlock, LoopTerms, ModalLoop
from sim_rtc.motion import MovingOptics
from sim_rtc.plant import Optics, TelescopeOptics
from sim_rtc.sky import Sky

Array32 = NDArray[np.float32]

BATCH_FRAMES = 10
"""Frames the loop processes together unless told otherwise: one message on the wire."""

_MESSAGE_S = 0.05
"""Of telemetry in a message where frames come fast: the longer, the less a frame costs."""

_MOST_MESSAGE_FRAMES = 50
"""More are refused by the wire."""

_BLOCK_FRAMES = 500
_MODES_FRAMES = 250
"""Frames reconstructed at a time: for ten, the library's copy of the matrix costs four times the
product."""

_AHEAD_BLOCKS = 2
_POLL_S = 0.2


class OpenModes:
    """What the reconstructor makes of a block's slopes, computed for many frames at a time."""

    def __init__(self) -> None:
        self._reconstructor: Array32 | None = None
        self._first = 0
        self._modes = np.empty((0, 0), dtype=np.float32)

    def rows(self, slopes: Array32, row: int, n_frames: int, reconstructor: Array32) -> Array32:
        """Return ``(n_frames, n_controlled)`` of the block's ``slopes`` from ``row`` on."""
        known = self._first <= row and row + n_frames <= self._first + len(self._modes)
        if not known or self._reconstructor is not reconstructor:
            self._reconstructor, self._first = reconstructor, row
            self._modes = slopes[row : row + max(n_frames, _MODES_FRAMES)] @ reconstructor.T
        return self._modes[row - self._first : row - self._first + n_frames]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenLoopBlock:
    """Consecutive frames seen through one set of optics, mirror left out."""

    first_frame: int
    """Number of row 0 since the start of the run."""

    optics: Optics
    """Valid for all of it."""

    slopes: Array32
    """``(n_frames, n_slopes)`` what comes in, and noise; n_frames is a multiple of the batch."""

    phases_m: Array32
    """``(n_batches, n_points)`` OPD that comes in at the first frame of each batch, what is stuck
    on the mirror included."""

    played_m: Array32 | None = None
    """``(n_frames, n_modes)`` turbulence played on the mirror; None: none is."""

    batch_frames: int = BATCH_FRAMES
    open_modes: OpenModes = field(default_factory=OpenModes)

    @property
    def n_frames(self) -> int:
        """Frames of the block."""
        return len(self.slopes)

    def phase_at(self, row: int) -> Array32:
        """Return the turbulence OPD ``(n_points,)`` of a batch's first frame."""
        return np.asarray(self.phases_m[row // self.batch_frames])

    def run(
        self, row: int, loop: ModalLoop, terms: ControlTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""
        if not isinstance(terms, LoopTerms):
            raise TypeError(f"loop: found {type(terms).__name__}; a linear plant needs LoopTerms")
        n_frames = self.batch_frames
        modes = self.open_modes.rows(self.slopes, row, n_frames, terms.reconstructor)
        played = batch_rows(self.played_m, row, n_frames)
        return loop.run(self.slopes[row : row + n_frames], terms, dither_m, played, modes)


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

    @property
    def batch_frames(self) -> int:
        """Frames of a batch."""

    def phase_at(self, row: int) -> Array32:
        """Return the turbulence OPD ``(n_points,)`` of a batch's first frame."""

    def run(
        self, row: int, loop: ModalLoop, terms: ControlTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""


class Feed(Protocol):
    """What makes blocks for ever."""

    @property
    def batch_frames(self) -> int:
        """Frames of a batch."""

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks; one ends where a jump falls."""


class OpenLoopFeed:
    """Blocks of open-loop slopes, one after the other for ever."""

    def __init__(
        self,
        *,
        sky: Sky,
        optics: MovingOptics,
        sensor_opd_m: Array32,
        detector: Detector,
        frame_rate_hz: float,
        jump_times_s: tuple[float, ...],
        rng: np.random.Generator,
        batch_frames: int = BATCH_FRAMES,
    ) -> None:
        """Take among others the static OPD ``(n_points,)`` that only the sensor sees."""
        self.batch_frames = batch_frames
        self._sky = sky
        self._optics = optics
        self._sources = np.column_stack([sky.vibrations.phase_per_line, sensor_opd_m])
        self._detector = detector
        self._frame_rate_hz = frame_rate_hz
        self._jump_frames = [
            batch_boundary(time, frame_rate_hz, batch_frames) for time in jump_times_s
        ]
        self._rng = rng

    def blocks(self) -> Iterator[OpenLoopBlock]:
        """Yield the blocks; one ends where a jump falls."""
        optics, source_slopes = None, np.empty((0, 0), dtype=np.float32)
        frame = 0
        while True:
            n_frames = min(
                [_BLOCK_FRAMES // self.batch_frames * self.batch_frames]
                + [jump - frame for jump in self._jump_frames if jump > frame]
            )
            time_s = (frame + np.arange(n_frames)) / self._frame_rate_hz
            now = _linear(self._optics.at(float(time_s[0])))
            if now is not optics:
                optics, source_slopes = now, now.slopes_of(self._sources).T
                if now.stuck_opd_m is not None:
                    source_slopes[-1] += now.slopes_of(now.stuck_opd_m)
            yield self._block(frame, time_s, optics, source_slopes)
            frame += n_frames

    def _block(
        self,
        first_frame: int,
        time_s: NDArray[np.float64],
        optics: Optics,
        source_slopes: Array32,
    ) -> OpenLoopBlock:
        """Return the block of these times; ``source_slopes`` are vibrations' and static slopes."""
        slopes = self._detector.noise(len(time_s), self._rng)
        vibrations = self._sky.vibrations
        strength = vibrations.frames(len(time_s))
        if strength.any():
            slopes += strength @ source_slopes[:-1]
        if source_slopes[-1].any():
            slopes += source_slopes[-1]
        phases = strength[:: self.batch_frames] @ vibrations.phase_per_line.T
        turbulence, played = self._sky.turbulence.at(time_s), self._sky.played
        if played is None:
            for share, response in optics.responses:
                part = turbulence.through(response)
                part *= np.float32(share)
                slopes += part
            phases += turbulence.phases_m(self.batch_frames)
        if optics.stuck_opd_m is not None:
            phases += optics.stuck_opd_m
        return OpenLoopBlock(
            first_frame=first_frame,
            optics=optics,
            slopes=slopes,
            phases_m=phases,
            played_m=None if played is None else turbulence.through(played.response),
            batch_frames=self.batch_frames,
        )


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


def message_frames(frame_rate_hz: float) -> int:
    """Return how many frames a message of a loop in real time should have."""
    return min(max(round(_MESSAGE_S * frame_rate_hz), BATCH_FRAMES), _MOST_MESSAGE_FRAMES)


def batch_rows(played_m: Array32 | None, row: int, n_frames: int) -> Array32 | None:
    """Return the rows of the batch that begins at ``row`` of the block."""
    return None if played_m is None else played_m[row : row + n_frames]


def batch_boundary(time_s: float, frame_rate_hz: float, batch_frames: int = BATCH_FRAMES) -> int:
    """Return the first frame of the first batch that begins at this time or later."""
    return int(np.ceil(time_s * frame_rate_hz / batch_frames)) * batch_frames


def _linear(optics: TelescopeOptics) -> Optics:
    if not isinstance(optics, Optics):
        raise TypeError(f"feed: found {type(optics).__name__}; slopes need a linear plant's Optics")
    return optics
