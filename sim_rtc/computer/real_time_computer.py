"""The real-time computer, batch by batch.

Everything that may change (matrix, gains, dither, loop state) changes between two batches, under
one lock, so a batch has one reconstructor and one session, and no frame is ever skipped.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.dither import check_dither
from pyrcal.rtc.identity import Identity, Reconstructor, new_session
from pyrcal.rtc.references import RAMP_SUFFIX, ReferenceOffset
from pyrcal.rtc.staging import Terms
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.wire import (
    Command,
    DitherRequest,
    DitherStop,
    Loop,
    LoopRequest,
    MeasureRequest,
    OffloadRequest,
    RampRequest,
    ReferencesInUse,
    ReferencesRequest,
    Reply,
    Status,
    checksum,
)
from sim_rtc.computer.activities import (
    MAX_DITHER_AMPLITUDE_M,
    MAX_DITHER_DURATION_S,
    Activities,
)
from sim_rtc.computer.feed import BATCH_FRAMES, BLOCK_FRAMES, Block
from sim_rtc.computer.gains import LARGEST_GAIN, GainRamp, ramp_refusal
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.computer.measure import Measurement, MeasurementRules
from sim_rtc.computer.reconstructors import ReferenceSchedule
from sim_rtc.computer.telemetry import Batch, LoopSettings
from sim_rtc.telescope.mirror import MirrorDrive
from sim_rtc.telescope.plant import Optics

Array32 = NDArray[np.float32]

_LEAD_BATCHES = 1
"""Whole batches between a command's acceptance and the first frame that contains it: its answer
is there before them."""

_SETTLING_FRAMES = 20
"""Frames between the opening of the loop and the first stroke, in which the mirror comes to rest.
"""


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
        optics: Optics,
        stroke_m: float,
        drive: MirrorDrive | None = None,
        reports_asked: bool = False,
        mode_to_actuator: NDArray[np.float64] | None = None,
        move: Callable[[NDArray[np.float64]], float] | None = None,
        references: ReferenceSchedule | None = None,
    ) -> None:
        self._blocks = blocks
        self._schedule = references
        self._move = move
        self.identity = self._first_identity = identity
        self._references: Array32 | None = None
        self._ramp: Array32 | None = None
        """Offset of the reference slopes, ``(n_slopes,)``, or of each frame; None: zero."""
        self._hides_references = False
        self._settings = settings
        self._n_slopes, self._n_modes = optics.n_slopes, optics.opd_per_command.shape[1]
        self._loop = ModalLoop(
            n_modes=self._n_modes,
            delay_frames=settings.delay_frames,
            stroke_m=stroke_m,
            drive=drive,
            reports_asked=reports_asked,
        )
        self._offset = ReferenceOffset(self._n_slopes)
        self._spoil_references: Callable[[Array32, Array32], Array32] | None = None
        self._reported_references: ReferencesRequest | None = None
        self._lock = threading.Lock()
        self._session = new_session()
        self._seq = 0
        self._first = self._active = reconstructor
        self._stroke_m = stroke_m
        self._staged: deque[Reconstructor] = deque()
        self._swaps: deque[tuple[str, int]] = deque(maxlen=16)
        self._activities = Activities(n_modes=self._n_modes, frame_rate_hz=settings.frame_rate_hz)
        self._rules = MeasurementRules(
            n_modes=self._n_modes,
            n_slopes=self._n_slopes,
            frame_rate_hz=settings.frame_rate_hz,
            mode_to_actuator=mode_to_actuator,
        )
        self._terms: LoopTerms | None = None
        self._block: Block | None = None
        self._row = 0
        self._hides_dithers = False
        self.batch_frames = BATCH_FRAMES
        """Frames of a batch."""
        self._optics = optics

    def prepare(self) -> None:
        """Wait for the first frames of the feed, so that the first batch does not."""
        self._block, self._row = next(self._blocks), 0
        self.batch_frames = self._block.batch_frames

    def next_batch(self) -> Batch:
        """Process the next frames, whatever the clock says."""
        block, row = self._next_rows()
        n_frames = self.batch_frames = block.batch_frames
        frame_rate_hz = self._settings.frame_rate_hz
        due = self._schedule and self._schedule.next((block.first_frame + row) / frame_rate_hz)
        if due:
            self.use_references(due[0], **due[1])
        with self._lock:
            self._swap()
            self._follow_references(n_frames)
            terms = self._current_terms(block.optics)
            activities = self._activities
            added = activities.commands(self._seq, n_frames)
            hidden = added if self._hides_dithers and activities.telemetry_dithers else None
            result = block.run(row, self._loop, terms, added if hidden is None else None)
            if hidden is not None:
                # The telemetry contains the dither although the mirror never got it.
                result.commands_m, result.dither_m = result.commands_m + hidden, hidden
            batch = Batch(
                session=self._session,
                seq0=self._seq,
                slopes=result.slopes,
                commands_m=result.commands_m,
                dither_m=result.dither_m if activities.telemetry_dithers else None,
                cm_id=self._active.manifest.id,
                identity=self.identity,
                n_clipped=result.n_clipped,
                closed=self._settings.closed,
                n_controlled=len(terms.gains),
                optics=block.optics,
                phase_m=block.phase_at(row),
            )
            self._set(activities.look(batch, self._active.matrix, self._settings))
            self._seq += n_frames
            return batch

    def stage(self, reconstructor: Reconstructor) -> None:
        """Take a checked matrix; it is swapped in before the next batch."""
        with self._lock:
            self._staged.append(reconstructor)

    def use_references(
        self, references: Array32, *, reference_id: str | None = None, config_id: str | None = None
    ) -> None:
        """Subtract other reference slopes ``(n_slopes,)`` from the next batch on, under a new name.

        An RTC of version 1 has no name for them but ``config_id``.
        """
        with self._lock:
            self._references, self._terms = references.astype(np.float32), None
            self.identity = replace(
                self.identity,
                reference_id=reference_id or self.identity.reference_id,
                config_id=config_id or self.identity.config_id,
            )

    def references_in_use(self) -> ReferencesInUse:
        """Return the offset that the service has set, as it is subtracted now."""
        with self._lock:
            name = self.identity.reference_id or self.identity.config_id
            in_use, reported = self._offset.in_use(name), self._reported_references
        if reported is None:
            return in_use
        return replace(in_use, slopes=reported.slopes, sha256=reported.sha256)

    def spoil_references(
        self, spoil: Callable[[Array32, Array32], Array32] | None, *, hidden: bool = False
    ) -> None:
        """Subtract another offset than requested from the next request on.

        Parameters
        ----------
        spoil
            Function of the offset that is subtracted and the one requested, ``(n_slopes,)`` each;
            None to obey again.
        hidden
            True to read back the offset requested.
        """
        with self._lock:
            self._spoil_references, self._hides_references = spoil, hidden

    def restart(self) -> None:
        """Begin a session from frame 0 with the matrix of the start, as a new process would."""
        with self._lock:
            self._start_over()
            self._seq, self._active, self._terms = 0, self._first, None
            self._offset, self._reported_references = ReferenceOffset(self._n_slopes), None
            self.identity, self._references, self._ramp = self._first_identity, None, None
            n_controlled = len(self._first.matrix)
            self._set(replace(self._settings, closed=True, n_controlled_next=n_controlled))
            self._swaps.clear()

    def limit_stroke(self, stroke_m: float | None) -> None:
        """Clip commands at this, metres RMS of a mode; None: as at the start."""
        with self._lock:
            self._loop.limit(self._stroke_m if stroke_m is None else stroke_m)

    def delay_dithers(self, n_frames: int) -> None:
        """Let dithers to come begin so many frames after the announced one."""
        with self._lock:
            self._activities.late_dither_frames = n_frames

    def hide_dithers(self, *, hidden: bool = True) -> None:
        """Report dithers in the telemetry that never reach the mirror."""
        with self._lock:
            self._hides_dithers = hidden

    @property
    def has_news(self) -> bool:
        """Return True if a swap or a measured matrix is not reported yet."""
        return bool(self._swaps or self._activities.ended)

    def take_swaps(self) -> list[tuple[str, int]]:
        """Return ids and first frames of the matrices swapped in since the last call."""
        with self._lock:
            swaps = list(self._swaps)
            self._swaps.clear()
        return swaps

    def take_measured(self) -> list[Measurement]:
        """Return the measurements that have ended since the last call."""
        with self._lock:
            ended = list(self._activities.ended)
            self._activities.ended.clear()
        return ended

    def terms(self) -> Terms:
        """Return what a new reconstructor must fit at present."""
        with self._lock:
            # A dict keeps the order and drops the second of two equal numbers.
            rows = {self._settings.n_controlled_next: None, len(self._active.matrix): None}
        return Terms(
            session=self._session,
            identity=self.identity,
            n_slopes=self._n_slopes,
            n_controlled=tuple(rows),
        )

    @property
    def largest_matrix_bytes(self) -> int:
        """Bytes of a matrix for all modes."""
        return int(4 * self._n_modes * self._n_slopes)

    @property
    def session(self) -> str:
        """Session of the frames to come."""
        return self._session

    @property
    def settings(self) -> LoopSettings:
        """The loop's settings."""
        return self._settings

    @property
    def reconstructor(self) -> Reconstructor:
        """The matrix that multiplies the slopes now."""
        return self._active

    @property
    def images(self) -> NDArray[np.float64]:
        """``(2, n, 2, n)`` share of the light in every pixel."""
        return self._optics.images

    def status(self) -> Status:
        """Return the computer's part of the status; time, light and pointing follow later."""
        with self._lock:
            settings = self._settings
            return Status(
                session=self._session,
                seq=self._seq - 1 if self._seq else None,
                t_ns=0,
                loop=self._loop_state(),
                frame_rate_hz=settings.frame_rate_hz,
                delay_frames=float(settings.delay_frames),
                gains=self._effective_gains(),
                leak=settings.leak,
                n_slopes=self._n_slopes,
                n_modes=self._n_modes,
                n_controlled=len(self._active.matrix),
                cm_id=self._active.manifest.id,
                basis_id=self.identity.basis_id,
                config_id=self.identity.config_id,
                reference_id=self.identity.reference_id,
                dither=self._activities.dither,
                max_dither_m=MAX_DITHER_AMPLITUDE_M,
                max_dither_modes=self._n_modes,
                magnitude=None,
                flux=None,
            )

    def execute(self, command: Command) -> Reply:
        """Carry out a command, or say why not."""
        match command:
            case DitherStop():
                return self._stop_dither(command)
            case DitherRequest():
                return self._start_dither(command)
            case LoopRequest():
                return self._change_loop(command)
            case MeasureRequest():
                return self._start_measurement(command)
            case RampRequest():
                return self._start_ramp(command)
            case OffloadRequest():
                return self._offload(command)
            case ReferencesRequest():
                return self._change_references(command)

    def _next_rows(self) -> tuple[Block, int]:
        if self._block is None or self._row >= self._block.n_frames:
            self._block, self._row = next(self._blocks), 0
        row = self._row
        self._row += self._block.batch_frames
        return self._block, row

    def _swap(self) -> None:
        if not self._staged:
            return
        fewer = len(self._staged[0].matrix) < len(self._active.matrix)
        self._active = self._staged.popleft()
        self._terms = None
        if fewer:
            # The contract requires it: what no row corrects any more must not stay on the
            # mirror.
            self._loop.release(len(self._active.matrix))
            self._set(self._activities.end_ramp(self._settings, "fewer modes are controlled"))
        self._swaps.append((self._active.manifest.id, self._seq))

    def _follow_references(self, n_frames: int) -> None:
        """Subtract the offset that the next frames have."""
        if self._offset.is_steady(self._seq):
            return
        offsets = self._offset.advance(self._seq, n_frames)
        name = self._offset.name
        if name != self.identity.reference_id:
            self.identity = replace(self.identity, reference_id=name)
        self._ramp = offsets if name is not None and name.endswith(RAMP_SUFFIX) else offsets[-1]
        if self._terms is not None:
            self._terms = replace(self._terms, references=self._subtracted())

    def _subtracted(self) -> Array32 | None:
        """Return what is subtracted from the slopes, ``(n_slopes,)`` or of each frame."""
        if self._references is None or self._ramp is None:
            return self._references if self._ramp is None else self._ramp
        return self._references + self._ramp

    def _current_terms(self, optics: Optics) -> LoopTerms:
        matrix = self._active.matrix
        if self._terms is None or self._optics is not optics:
            leak, references = self._settings.leak, self._subtracted()
            self._terms = LoopTerms.of(optics, matrix, self._gains(), leak, references)
            self._optics = optics
        return self._terms

    def _set(self, settings: LoopSettings) -> None:
        """Put settings in force from the next batch on."""
        if settings == self._settings:
            return
        self._settings = settings
        if self._terms is not None:
            self._terms = replace(self._terms, gains=self._gains(), leak=settings.leak)

    def _gains(self) -> Array32:
        """Return the gains of the modes that the matrix in use controls."""
        controlled = self._effective_gains()[: len(self._active.matrix)]
        return np.array(controlled, dtype=np.float32)

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
        reason = check_dither(
            request,
            n_modes=self._n_modes,
            frame_rate_hz=rate_hz,
            max_amplitude_m=MAX_DITHER_AMPLITUDE_M,
            max_duration_s=MAX_DITHER_DURATION_S,
        )
        with self._lock:
            reason = reason or self._activities.on_the_mirror()
            if reason:
                return refuse(request.id, reason)
            start_seq = self._seq + _LEAD_BATCHES * self.batch_frames
            self._activities.begin_dither(request, start_seq)
        return accept(request.id, start_seq)

    def _stop_dither(self, request: DitherStop) -> Reply:
        with self._lock:
            self._activities.end_dither()
            return accept(request.id, self._seq)

    def _start_measurement(self, request: MeasureRequest) -> Reply:
        in_use = self._active.matrix
        reason = self._rules.refusal(request, len(in_use))
        if reason:
            return refuse(request.id, reason)
        # Before the lock: the decomposition for system modes would hold up the loop.
        measurement = self._rules.measurement(request, in_use)
        with self._lock:
            activities, was_closed = self._activities, self._settings.closed
            reason = activities.on_the_mirror() or activities.in_the_loops_way()
            if not reason and not measurement.needs_open_loop and not was_closed:
                reason = f"unsupported: {request.pattern} while the loop is open; close it first"
            if reason:
                return refuse(request.id, reason)
            if measurement.needs_open_loop and was_closed:
                self._set(replace(self._settings, closed=False))
                self._start_over()
            start_seq = self._seq + _LEAD_BATCHES * self.batch_frames + _SETTLING_FRAMES
            measurement.start_seq = start_seq
            activities.begin_measurement(measurement, closes_again=was_closed)
        return accept(request.id, start_seq)

    def _start_ramp(self, request: RampRequest) -> Reply:
        with self._lock:
            settings = self._settings
            reason = self._activities.in_the_loops_way() or ramp_refusal(
                request, settings, len(self._active.matrix)
            )
            if reason:
                return refuse(request.id, reason)
            rate_hz = settings.frame_rate_hz
            ramp = GainRamp(settings.gains, request, frame_rate_hz=rate_hz)
            self._set(self._activities.begin_ramp(ramp, settings))
            return accept(request.id, self._seq)

    def _offload(self, request: OffloadRequest) -> Reply:
        if self._move is None:
            return refuse(request.id, "unsupported: nothing moves the mirror's image (--stage)")
        asked = [getattr(request, name) for name in PARAMETERS]
        there_s = self._move(np.array(asked) / BOUNDARY_SCALE)
        there = round(there_s * self._settings.frame_rate_hz)
        return accept(request.id, there + BLOCK_FRAMES)  # the block that is under way then ends

    def _change_references(self, request: ReferencesRequest) -> Reply:
        with self._lock:
            offset = self._offset
            reason = (
                offset.check(request, self.identity.config_id)
                or self._activities.explain_measuring()
            )
            if reason:
                return refuse(request.id, reason)
            start_seq = self._seq + _LEAD_BATCHES * self.batch_frames
            played, self._reported_references = request, None
            if self._spoil_references is not None:
                slopes = self._spoil_references(offset.slopes, request.offset).astype("<f4")
                played = replace(request, slopes=slopes.tobytes(), sha256=checksum(slopes))
                self._reported_references = request if self._hides_references else None
            offset.begin(played, start_seq, self._settings.frame_rate_hz)
            return accept(request.id, start_seq)

    def _change_loop(self, request: LoopRequest) -> Reply:
        reason = loop_refusal(request, self._n_modes)
        with self._lock:
            reason = reason or self._activities.forbids(request)
            if reason:
                return refuse(request.id, reason)
            was_closed = self._settings.closed
            if was_closed and request.loop is Loop.OPEN:
                self._start_over()
            self._set(change_settings(self._settings, request))
            return accept(request.id, self._seq)

    def _start_over(self) -> None:
        """Zero the integrator, which by the wire's rules begins a new session."""
        self._set(self._activities.end_all(self._settings, self._session))
        self._loop.reset()
        self._session = new_session()
        # They were checked against the session that has ended.
        self._staged.clear()


def accept(request_id: str, start_seq: int) -> Reply:
    """Return the reply to an order that is carried out from this frame on."""
    return Reply(id=request_id, accepted=True, reason="", start_seq=start_seq)


def refuse(request_id: str, reason: str) -> Reply:
    """Return the reply to an order that is not carried out."""
    return Reply(id=request_id, accepted=False, reason=reason, start_seq=None)


def loop_refusal(request: LoopRequest, n_modes: int) -> str:
    """Return why the loop cannot be changed so, in the wire's words; empty: it can."""
    gains = request.gains
    if gains is not None and len(gains) != n_modes:
        return f"range: {len(gains)} gains, expected {n_modes}"
    if gains is not None and max(gains) > LARGEST_GAIN:
        return f"range: gain {max(gains):g}, expected at most {LARGEST_GAIN:g}"
    if request.n_controlled is not None and not 1 <= request.n_controlled <= n_modes:
        return f"range: n_controlled {request.n_controlled}, expected 1 to {n_modes}"
    if request.loop is Loop.PARTIAL:
        return "unsupported: loop 'partial', ask for 'closed' with some gains 0"
    return ""


def change_settings(settings: LoopSettings, request: LoopRequest) -> LoopSettings:
    """Return the settings after a request that :func:`loop_refusal` accepts."""
    return replace(
        settings,
        closed=settings.closed if request.loop is None else request.loop is not Loop.OPEN,
        gains=settings.gains if request.gains is None else request.gains,
        leak=settings.leak if request.leak is None else request.leak,
        n_controlled_next=request.n_controlled or settings.n_controlled_next,
    )
