"""Compute what the sensor will see without the mirror, ahead of the loop.

Of a linear telescope it is slopes, half a second at a time: frames are interpolated between the
steps of the screens. Of a diffractive one it is the phase of every frame; slopes follow one frame
at a time, when the loop knows what the mirror is doing. A thread of its own makes them, so that
nothing holds a frame up.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Self, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from sim_rtc.computer.loop import LoopBlock, LoopTerms, ModalLoop
from sim_rtc.telescope.detector import Detector, PixelDetector
from sim_rtc.telescope.diffractive import DiffractiveOptics
from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.telescope.plant import Optics
from sim_rtc.telescope.registration import MovingOptics
from sim_rtc.telescope.sky import Sky

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

BATCH_FRAMES = 10
"""Frames that the loop processes together by default: one message on the link."""

_MESSAGE_S = 0.05
"""Duration of telemetry in a message at high frame rates; a longer message costs less per frame."""

_MOST_MESSAGE_FRAMES = 50
"""More are refused by the wire."""

BLOCK_FRAMES = 500
"""Frames that are made at once, at most."""

_PHASE_BLOCK_FRAMES = 200
_AHEAD_BLOCKS = 3
"""One of them under way."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block(ABC):
    """Consecutive frames through one set of optics, the mirror still to be added."""

    first_frame: int
    """Number of row 0 since the start of the run."""

    optics: Optics
    """Valid for all of it."""

    phases_m: Array32
    """OPD ``(..., n_points)`` that comes in, what is stuck on the mirror included."""

    played_m: Array32 | None = None
    """``(n_frames, n_modes)`` turbulence played on the mirror; None: none is."""

    batch_frames: int = BATCH_FRAMES

    @property
    @abstractmethod
    def n_frames(self) -> int:
        """Frames of the block, a multiple of the batch."""

    @abstractmethod
    def phase_at(self, row: int) -> Array32:
        """Return the OPD ``(n_points,)`` of a batch's first frame, commands left out."""

    @abstractmethod
    def run(
        self, row: int, loop: ModalLoop, terms: LoopTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""

    def _read_played_rows(self, row: int) -> Array32 | None:
        """Return the rows of the batch that begins at ``row``."""
        return None if self.played_m is None else self.played_m[row : row + self.batch_frames]


class OpenModes:
    """The reconstructor times a block's slopes, computed for all that are left of it.

    For ten frames the library's copy of the matrix costs four times the product.
    """

    def __init__(self) -> None:
        self._reconstructor: Array32 | None = None
        self._first = 0
        self._modes = np.empty((0, 0), dtype=np.float32)

    def rows(self, slopes: Array32, row: int, n_frames: int, reconstructor: Array32) -> Array32:
        """Return ``(n_frames, n_controlled)`` of the block's ``slopes`` from ``row`` on."""
        if self._reconstructor is not reconstructor:
            self._reconstructor, self._first = reconstructor, row
            # Only what is left of the block: another matrix came in the middle of it.
            self._modes = slopes[row:] @ reconstructor.T
        return self._modes[row - self._first : row - self._first + n_frames]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenLoopBlock(Block):
    """Slopes of a linear telescope; ``phases_m`` has a row for each batch, of its first frame."""

    slopes: Array32
    """``(n_frames, n_slopes)`` what comes in, and noise."""

    open_modes: OpenModes = field(default_factory=OpenModes)

    @property
    @override
    def n_frames(self) -> int:
        return len(self.slopes)

    @override
    def phase_at(self, row: int) -> Array32:
        return np.asarray(self.phases_m[row // self.batch_frames])

    @override
    def run(
        self, row: int, loop: ModalLoop, terms: LoopTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        slopes = self.slopes[row : row + self.batch_frames]
        modes = self.open_modes.rows(self.slopes, row, len(slopes), terms.reconstructor)
        return loop.run(slopes, terms, dither_m, self._read_played_rows(row), modes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhaseBlock(Block):
    """Phases of a diffractive telescope; ``phases_m`` has a row for each frame."""

    optics: DiffractiveOptics
    detector: PixelDetector
    rng: np.random.Generator
    """Random numbers of the photons; used by the loop's thread only."""

    @property
    @override
    def n_frames(self) -> int:
        return len(self.phases_m)

    @override
    def phase_at(self, row: int) -> Array32:
        return np.asarray(self.phases_m[row])

    @override
    def run(
        self, row: int, loop: ModalLoop, terms: LoopTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        def sense(k: int, command_m: Array32) -> Array32:
            opd_m = self.optics.mirror_opd_m(command_m)
            opd_m += self.phases_m[row + k]
            return self.optics.slopes(opd_m, self.detector, self.rng)

        return loop.run_frames(
            self.batch_frames, sense, terms, dither_m, self._read_played_rows(row)
        )


class Source(TypedDict):
    """The sources of a feed."""

    sky: Sky
    optics: MovingOptics
    frame_rate_hz: float
    jump_times_s: tuple[float, ...]
    rng: np.random.Generator
    """Random numbers of the detector's noise."""


class Feed(ABC):
    """Blocks, one after the other for ever."""

    def __init__(self, batch_frames: int, block_frames: int, source: Source) -> None:
        self.batch_frames = batch_frames
        """Frames of a batch."""
        # Whole batches only: a batch never spans two blocks.
        self._block_frames = block_frames // batch_frames * batch_frames
        self._sky, self._optics, self._rng = source["sky"], source["optics"], source["rng"]
        self._frame_rate_hz = source["frame_rate_hz"]
        self._jump_frames = [
            batch_boundary(time_s, self._frame_rate_hz, batch_frames)
            for time_s in source["jump_times_s"]
        ]

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks; one ends where a jump falls."""
        frame = 0
        while True:
            jumps = [jump - frame for jump in self._jump_frames if jump > frame]
            n_frames = min([self._block_frames, *jumps])
            time_s = (frame + np.arange(n_frames)) / self._frame_rate_hz
            yield self._block(frame, time_s, self._optics.at(float(time_s[0])))
            frame += n_frames

    @abstractmethod
    def _block(self, first_frame: int, time_s: Array, optics: Optics) -> Block:
        """Return the block of these times."""


class OpenLoopFeed(Feed):
    """Blocks of open-loop slopes."""

    def __init__(
        self,
        *,
        sensor_opd_m: Array32,
        detector: Detector,
        batch_frames: int = BATCH_FRAMES,
        **source: Unpack[Source],
    ) -> None:
        """Take the static OPD ``(n_points,)`` that only the sensor sees."""
        super().__init__(batch_frames, BLOCK_FRAMES, source)
        self._sources = np.column_stack([self._sky.vibrations.phase_per_line, sensor_opd_m])
        self._source_slopes = np.empty((0, 0), dtype=np.float32)
        """``(n_lines + 1, n_slopes)`` of the vibrations, and what is static."""
        self._detector = detector
        self._seen: LinearOptics | None = None

    @override
    def _block(self, first_frame: int, time_s: Array, optics: Optics) -> OpenLoopBlock:
        if not isinstance(optics, LinearOptics):
            raise TypeError(f"feed: found {type(optics).__name__}; expected LinearOptics")
        self._look(optics)
        slopes = self._detector.noise(len(time_s), self._rng)
        vibrations = self._sky.vibrations
        strength = vibrations.frames(len(time_s))
        if strength.any():
            slopes += strength @ self._source_slopes[:-1]
        if self._source_slopes[-1].any():
            slopes += self._source_slopes[-1]
        phases = strength[:: self.batch_frames] @ vibrations.phase_per_line.T
        turbulence, played = self._sky.turbulence.at(time_s), self._sky.played
        if played is None:
            for share, response in optics.responses:
                part = turbulence.through(response)
                part *= np.float32(share)
                slopes += part
            phases += turbulence.phases_m(self.batch_frames)
        phases += optics.stuck_opd_m
        return OpenLoopBlock(
            first_frame=first_frame,
            optics=optics,
            slopes=slopes,
            phases_m=phases,
            played_m=None if played is None else turbulence.through(played.response),
            batch_frames=self.batch_frames,
        )

    def _look(self, optics: LinearOptics) -> None:
        """Project vibrations and static wavefronts through these optics."""
        if optics is not self._seen:
            self._seen, self._source_slopes = optics, optics.slopes_of(self._sources).T
            if optics.stuck_opd_m.any():
                self._source_slopes[-1] += optics.slopes_of(optics.stuck_opd_m)


class PhaseFeed(Feed):
    """Blocks of phases: each frame takes milliseconds, so a message has few of them."""

    def __init__(self, *, detector: PixelDetector, **source: Unpack[Source]) -> None:
        super().__init__(BATCH_FRAMES, _PHASE_BLOCK_FRAMES, source)
        self._detector = detector

    @override
    def _block(self, first_frame: int, time_s: Array, optics: Optics) -> PhaseBlock:
        if not isinstance(optics, DiffractiveOptics):
            raise TypeError(f"feed: found {type(optics).__name__}; expected DiffractiveOptics")
        phases, played = self._sky.sample(time_s)
        phases += optics.stuck_opd_m
        return PhaseBlock(
            first_frame=first_frame,
            optics=optics,
            phases_m=phases,
            played_m=played,
            detector=self._detector,
            rng=self._rng,
        )


class Ahead:
    """Blocks computed ahead by a thread of its own while a ``with`` block lasts."""

    def __init__(self, blocks: Iterator[Block]) -> None:
        self._blocks = blocks
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="open-loop")

    def __enter__(self) -> Self:
        self._coming = deque(self._next() for _ in range(_AHEAD_BLOCKS))
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks; re-raise the error that kept one from being made."""
        while True:
            block = self._coming.popleft().result()
            self._coming.append(self._next())
            yield block

    def _next(self) -> Future[Block]:
        # One thread, so that blocks are made in order: sky and noise are sequences of random
        # numbers.
        return self._thread.submit(next, self._blocks)


def message_frames(frame_rate_hz: float) -> int:
    """Return how many frames a message of a loop in real time should have."""
    return min(max(round(_MESSAGE_S * frame_rate_hz), BATCH_FRAMES), _MOST_MESSAGE_FRAMES)


def batch_boundary(time_s: float, frame_rate_hz: float, batch_frames: int = BATCH_FRAMES) -> int:
    """Return the first frame of the first batch that begins at this time or later."""
    return int(np.ceil(time_s * frame_rate_hz / batch_frames)) * batch_frames
