"""The real-time computer itself: one batch of frames after the other, and what may change between.

Everything that may change (matrix, gains, dither, loop state) changes between two batches, under
one lock, so a batch has one reconstructor and one session, and no frame is ever skipped.
"""

from __future__ import annotations

import threading
import uuid
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.wire import (
    Command,
    DitherAction,
    DitherRequest,
    DitherStatus,
    Loop,
    LoopRequest,
    MeasureRequest,
    RampRequest,
    Reply,
)
from sim_rtc.dither import Dither, DitherLimits, refusal
from sim_rtc.drive import MirrorDrive
from sim_rtc.feed import BATCH_FRAMES, Block
from sim_rtc.loop import ControlTerms, ModalLoop
from sim_rtc.measure import Bench, Measured, Measurements
from sim_rtc.plant import TelescopeOptics
from sim_rtc.reconstructors import Reconstructor, Terms

Array32 = NDArray[np.float32]

_LEAD_BATCHES = 1
"""Whole batches between a command's acceptance and the first frame that contains it."""

_LARGEST_GAIN = 2.0

_SETTLING_FRAMES = 20
"""Between the opening of the loop and the first stroke: the mirror comes to rest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """How the loop is run; replaced as a whole."""

    frame_rate_hz: float
    delay_frames: int
    """Frames from an exposure to the first command that answers it."""

    gains: tuple[float, ...]
    """One per mode of the basis; the controlled ones are used."""

    leak: float
    """Per frame; 1 forgets nothing."""

    closed: bool = True
    n_controlled_next: int
    """What a command has asked for; takes effect with the next matrix of that many rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Names the telemetry carries."""

    system: str
    basis_id: str
    config_id: str
    double_pass: bool = False
    """Whether the light sees the mirror twice, as with a retro-reflector by day."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """One batch of frames as it leaves the loop, and what only the simulator knows of it."""

    session: str
    seq0: int
    slopes: Array32
    """``(n_frames, n_slopes)``."""

    commands_m: Array32
    """``(n_frames, n_modes)``, dither included, after clipping."""

    dither_m: Array32 | None
    """``(n_frames, n_modes)``; None without dither."""

    cm_id: str
    """The matrix that multiplied these slopes."""

    n_clipped: int
    """Commands that met the stroke limit."""

    closed: bool
    n_controlled: int
    optics: TelescopeOptics
    """The truth: never on the wire."""

    phase_m: Array32
    """``(n_points,)`` turbulence OPD during the first frame: never on the wire."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """What the computer says about itself."""

    session: str
    seq: int
    """Last frame processed; -1 before the first."""

    settings: LoopSettings
    loop: Loop
    gains: tuple[float, ...]
    """One per mode, 0 where uncontrolled."""

    reconstructor: Reconstructor
    dither: DitherStatus | None
    limits: DitherLimits
    images: NDArray[np.float64]
    """``(2, n, 2, n)`` share of the light in every pixel."""


class RealTimeComputer:
    """The loop over a feed of open-loop blocks.

    ``next_batch`` is for one thread, everything else for any.
    """

    def __init__(
        self,
        blocks: Iterator[Block],
        *,
        identity: Identity,
        settings: LoopSettings,
        reconstructor: Reconstructor,
        optics: TelescopeOptics,
        stroke_m: float,
        limits: DitherLimits,
        drive: MirrorDrive | None = None,
        mode_to_actuator: NDArray[np.float64] | None = None,
    ) -> None:
        self._blocks = blocks
        self.identity = identity
        self._settings = settings
        self._limits = limits
        self._n_slopes, self._n_modes = optics.n_slopes, optics.opd_per_command.shape[1]
        self._loop = ModalLoop(
            n_modes=self._n_modes,
            delay_frames=settings.delay_frames,
            stroke_m=stroke_m,
            drive=drive,
        )
        self._lock = threading.Lock()
        self._session = new_session()
        self._seq = 0
        self._first = self._active = reconstructor
        self._stroke_m = stroke_m
        self._late_dithers = 0
        self._staged: deque[Reconstructor] = deque()
        self._swaps: deque[tuple[str, int]] = deque(maxlen=16)
        self._dither: Dither | None = None
        self._measurements = Measurements()
        self._bench = Bench(
            n_modes=self._n_modes,
            n_slopes=self._n_slopes,
            frame_rate_hz=settings.frame_rate_hz,
            mode_to_actuator=mode_to_actuator,
        )
        self._terms: ControlTerms | None = None
        self._block: Block | None = None
        self._row = 0
        self._optics = optics

    def prepare(self) -> None:
        """Wait for the first frames of the feed, so that the first batch does not."""
        self._block, self._row = next(self._blocks), 0

    def next_batch(self) -> Batch:
        """Process the next frames, whatever the clock says."""
        block, row = self._next_rows()
        with self._lock:
            self._swap()
            terms = self._current_terms(block.optics)
            measuring = self._measurements.current
            added_m = self._next_dither()
            if measuring is not None:
                added_m = measuring.commands(self._seq, BATCH_FRAMES)
            result = block.run(row, self._loop, terms, added_m)
            open_strokes = measuring is not None and measuring.needs_open_loop
            batch = Batch(
                session=self._session,
                seq0=self._seq,
                slopes=result.slopes,
                commands_m=result.commands_m,
                dither_m=None if open_strokes else result.dither_m,
                cm_id=self._active.manifest.id,
                n_clipped=result.n_clipped,
                closed=self._settings.closed,
                n_controlled=len(terms.gains),
                optics=block.optics,
                phase_m=block.phase_at(row),
            )
            self._read_back(batch)
            self._seq += BATCH_FRAMES
            return batch

    def stage(self, reconstructor: Reconstructor) -> None:
        """Take a checked matrix; it is swapped in before the next batch."""
        with self._lock:
            self._staged.append(reconstructor)

    def restart(self) -> None:
        """Begin a session from frame 0 with the matrix of the start, as a new process would."""
        with self._lock:
            self._start_over()
            self._seq, self._active, self._terms = 0, self._first, None
            self._settings = replace(
                self._settings, closed=True, n_controlled_next=len(self._first.matrix)
            )
            self._swaps.clear()

    def limit_stroke(self, stroke_m: float | None) -> None:
        """Clip commands at this, metres RMS of a mode; None: as at the start."""
        with self._lock:
            self._loop.limit(self._stroke_m if stroke_m is None else stroke_m)

    def delay_dithers(self, n_frames: int) -> None:
        """Let dithers to come begin so many frames after the announced one."""
        with self._lock:
            self._late_dithers = n_frames

    def take_swaps(self) -> list[tuple[str, int]]:
        """Return ids and first frames of the matrices swapped in since the last call."""
        with self._lock:
            swaps = list(self._swaps)
            self._swaps.clear()
        return swaps

    def take_measured(self) -> list[Measured]:
        """Return the measurements that have ended since the last call."""
        with self._lock:
            return self._measurements.take_ended()

    def terms(self) -> Terms:
        """Return what a new reconstructor must fit at present."""
        with self._lock:
            rows = {self._settings.n_controlled_next: None, len(self._active.matrix): None}
        return Terms(
            n_slopes=self._n_slopes,
            n_controlled=tuple(rows),
            basis_id=self.identity.basis_id,
            config_id=self.identity.config_id,
            system=self.identity.system,
        )

    @property
    def largest_matrix_bytes(self) -> int:
        """Bytes of a matrix for all modes."""
        return int(4 * self._n_modes * self._n_slopes)

    def snapshot(self) -> Snapshot:
        """Return what a status message tells."""
        with self._lock:
            dither = self._dither
            return Snapshot(
                session=self._session,
                seq=max(self._seq - 1, 0),
                settings=self._settings,
                loop=self._loop_state(),
                gains=self._effective_gains(),
                reconstructor=self._active,
                dither=None
                if dither is None
                else DitherStatus(request=dither.request, start_seq=dither.start_seq),
                limits=self._limits,
                images=self._optics.images,
            )

    def execute(self, command: Command) -> Reply:
        """Carry out a command, or say why not."""
        match command:
            case DitherRequest(action=DitherAction.STOP):
                return self._stop_dither(command)
            case DitherRequest():
                return self._start_dither(command)
            case LoopRequest():
                return self._change_loop(command)
            case MeasureRequest():
                return self._start_measurement(command)
            case RampRequest():
                reason = "unsupported: no gain ramp here"
                return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)

    def _next_rows(self) -> tuple[Block, int]:
        if self._block is None or self._row >= self._block.n_frames:
            self._block, self._row = next(self._blocks), 0
        row = self._row
        self._row += BATCH_FRAMES
        return self._block, row

    def _swap(self) -> None:
        if not self._staged:
            return
        fewer = len(self._staged[0].matrix) < len(self._active.matrix)
        self._active = self._staged.popleft()
        if fewer:
            self._loop.release(len(self._active.matrix))
        self._terms = None
        self._swaps.append((self._active.manifest.id, self._seq))

    def _current_terms(self, optics: TelescopeOptics) -> ControlTerms:
        matrix = self._active.matrix
        if self._terms is None or self._optics is not optics:
            gains = np.array(self._effective_gains()[: len(matrix)], dtype=np.float32)
            self._terms = optics.terms(matrix, gains, self._settings.leak)
            self._optics = optics
        return self._terms

    def _next_dither(self) -> Array32 | None:
        dither = self._dither
        if dither is None:
            return None
        commands = dither.commands(self._seq, BATCH_FRAMES)
        if self._seq + BATCH_FRAMES >= dither.stop_seq:
            self._dither = None
        return commands

    def _read_back(self, batch: Batch) -> None:
        ended = self._measurements.take(batch.session, batch.seq0, batch.slopes, batch.commands_m)
        if ended and self._measurements.closes_again:
            self._settings = replace(self._settings, closed=True)
            self._terms = None

    def _effective_gains(self) -> tuple[float, ...]:
        n_controlled = len(self._active.matrix) if self._settings.closed else 0
        unused = (0.0,) * int(self._n_modes - n_controlled)
        return self._settings.gains[:n_controlled] + unused

    def _loop_state(self) -> Loop:
        if not self._settings.closed:
            return Loop.OPEN
        controlled = self._settings.gains[: len(self._active.matrix)]
        return Loop.CLOSED if all(controlled) else Loop.PARTIAL

    def _start_dither(self, request: DitherRequest) -> Reply:
        rate_hz = self._settings.frame_rate_hz
        reason = refusal(request, self._limits, n_modes=self._n_modes, frame_rate_hz=rate_hz)
        if reason:
            return Reply(id=request.id, accepted=False, reason=reason, start_seq=None)
        with self._lock:
            reason = self._busy()
            if reason:
                return Reply(id=request.id, accepted=False, reason=reason, start_seq=None)
            start_seq = self._seq + _LEAD_BATCHES * BATCH_FRAMES
            self._dither = Dither(
                request,
                start_seq=start_seq,
                n_modes=self._n_modes,
                frame_rate_hz=rate_hz,
                late_frames=self._late_dithers,
            )
        return Reply(id=request.id, accepted=True, reason="", start_seq=start_seq)

    def _stop_dither(self, request: DitherRequest) -> Reply:
        with self._lock:
            self._dither = None
            return Reply(id=request.id, accepted=True, reason="", start_seq=self._seq)

    def _busy(self) -> str:
        """Return what occupies the mirror, in the wire's words; empty: nothing."""
        if self._dither is not None:
            return (
                f"busy: dither {self._dither.request.id} is on until frame "
                f"{self._dither.stop_seq}; stop it first"
            )
        return self._measurements.busy()

    def _start_measurement(self, request: MeasureRequest) -> Reply:
        reason = self._bench.refusal(request)
        if reason:
            return Reply(id=request.id, accepted=False, reason=reason, start_seq=None)
        measurement = self._bench.measurement(request)
        with self._lock:
            reason = self._busy()
            if not reason and not measurement.needs_open_loop and not self._settings.closed:
                reason = f"unsupported: {request.pattern} while the loop is open; close it first"
            if reason:
                return Reply(id=request.id, accepted=False, reason=reason, start_seq=None)
            self._measurements.closes_again = self._settings.closed
            if measurement.needs_open_loop and self._settings.closed:
                self._settings = replace(self._settings, closed=False)
                self._terms = None
                self._start_over()
            start_seq = self._seq + _LEAD_BATCHES * BATCH_FRAMES + _SETTLING_FRAMES
            measurement.start_seq = start_seq
            self._measurements.current = measurement
        return Reply(id=request.id, accepted=True, reason="", start_seq=start_seq)

    def _change_loop(self, request: LoopRequest) -> Reply:
        reason = self._loop_refusal(request)
        with self._lock:
            reason = reason or self._measurements.busy()
            if reason:
                return Reply(id=request.id, accepted=False, reason=reason, start_seq=None)
            was_closed, old = self._settings.closed, self._settings
            self._settings = replace(
                old,
                closed=was_closed if request.loop is None else request.loop is not Loop.OPEN,
                gains=old.gains if request.gains is None else request.gains,
                leak=old.leak if request.leak is None else request.leak,
                n_controlled_next=request.n_controlled or old.n_controlled_next,
            )
            self._terms = None
            if was_closed and not self._settings.closed:
                self._start_over()
            return Reply(id=request.id, accepted=True, reason="", start_seq=self._seq)

    def _loop_refusal(self, request: LoopRequest) -> str:
        gains = request.gains
        if gains is not None and len(gains) != self._n_modes:
            return f"range: {len(gains)} gains, expected {self._n_modes}"
        if gains is not None and max(gains) > _LARGEST_GAIN:
            return f"range: gain {max(gains):g}, expected at most {_LARGEST_GAIN:g}"
        if request.n_controlled is not None and not 1 <= request.n_controlled <= self._n_modes:
            return f"range: n_controlled {request.n_controlled}, expected 1 to {self._n_modes}"
        if request.loop is Loop.PARTIAL:
            return "unsupported: loop 'partial', ask for 'closed' with some gains 0"
        return ""

    def _start_over(self) -> None:
        """Zero the integrator, which by the wire's rules begins a new session."""
        reason = "the loop started over during the measurement"
        self._measurements.end(self._session, self._n_slopes, reason)
        self._loop.reset()
        self._session = new_session()
        self._staged.clear()
        self._dither = None


def new_session() -> str:
    """Return a name no other session has."""
    return uuid.uuid4().hex[:16]
