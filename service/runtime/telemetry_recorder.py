"""Record telemetry on request."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import structlog
from annotated_types import Ge, Le, MaxLen, MinLen
from numpy.typing import NDArray

from service.archive import Archive, AuditEntry
from service.archive.index import by_service
from service.archive.nights import TREND_S, TrendSample
from service.archive.products import RUNNING, STORED, RecordingRecord
from service.archive.retention import GIGABYTE, RetentionPolicy, low_on_space
from service.errors import (
    CommandError,
    ConfigurationError,
    PyrcalError,
    StorageError,
    UnknownIdError,
)
from service.estimation.frames import FrameBlock
from service.files.recording import RecordingWriter
from service.records.commands import Instruction
from service.records.events import new_id
from service.records.state import TrackerState
from service.runtime.snapshot import present_gains

MAX_RECORDING_S = 3600.0

MAX_RECORDING_GB = 20.0
"""Largest recording in units of 1e9 bytes: half an hour of 1400 slopes and 600 modes at 1 kHz."""

PROGRESS_CHECK_INTERVAL_S = 0.5
"""Interval between two checks of its progress."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingChoice(Instruction):
    """Duration of a recording of telemetry."""

    duration_s: Annotated[float, Ge(0.0), Le(MAX_RECORDING_S)] = 60.0
    """From now on; 0: nothing of what comes."""

    before_s: Annotated[float, Ge(0.0), Le(MAX_RECORDING_S)] = 0.0
    """Duration of earlier telemetry to include, as far as the service holds it: 60 s unless the
    settings say otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnnotationChoice(Instruction):
    """An operator's note about a moment."""

    note: Annotated[str, MinLen(1), MaxLen(2000)]
    """Reason of the recording."""

    t_ns_utc: Annotated[int, Ge(0), Le((1 << 63) - 1)] | None = None
    """Time that it concerns, nanoseconds since the Unix epoch; None for now."""


class TelemetryRecorder:
    """Writes one recording at a time; belongs to the event loop, the disk is waited for in threads.

    Parameters
    ----------
    archive
        Open.
    keeping
        Says how much of the disk is to stay free.
    system
        Whose telemetry it is.
    tap
        Has everything that the RTC sends put into a recorder, and what came in so many seconds
        before; returns how many of them it still had. None: no more.
    audit
        Takes a line when one has ended.
    """

    def __init__(
        self,
        *,
        archive: Archive,
        retention: RetentionPolicy,
        system: str,
        tap: Callable[[RecordingWriter | None, float], float],
        audit: Callable[[AuditEntry], None],
    ) -> None:
        self._archive = archive
        self._retention = retention
        self._system = system
        self._tap = tap
        self._audit = audit
        self._guard = asyncio.Lock()
        self._recorder: RecordingWriter | None = None
        self._record: RecordingRecord | None = None
        self._ends_s = 0.0

    async def begin(
        self, duration_s: float, who: str, why: str, before_s: float = 0.0
    ) -> RecordingRecord:
        """Begin a recording, with what came in the last seconds as far as it is still held.

        Raises
        ------
        CommandError
            If one is under way, there would be nothing in it, or the disk is almost full.
        StorageError
            If the disk refuses.
        """
        async with self._guard:
            if self._record is not None:
                raise CommandError(f"{self._record.id} is under way; end it first")
            if not duration_s and not before_s:
                raise CommandError("found 0 s before and 0 s from now on, expected some of them")
            full = await asyncio.to_thread(self._full)
            if full is not None:
                raise CommandError(f"nothing is recorded: {full}")
            now_ns = time.time_ns()
            record = RecordingRecord(
                id=new_id("tm", now_ns),
                state=RUNNING,
                created_ns_utc=now_ns,
                duration_s=duration_s,
                who=who,
                why=why,
            )
            recorder = RecordingWriter(
                self._archive.recordings.path_of(record.id), system=self._system
            )
            # Opened before the tap, because the frames that the link still holds are put in at
            # once.
            await asyncio.to_thread(self._open, recorder, record)
            held_s = self._tap(recorder, before_s)
            record = replace(record, before_s=round(held_s, 3))
            self._recorder, self._record = recorder, record
            self._ends_s = time.monotonic() + duration_s
            return record

    def _open(self, recorder: RecordingWriter, record: RecordingRecord) -> None:
        """Begin to write; what cannot be noted is not begun.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        try:
            recorder.__enter__()
        except ConfigurationError as error:
            raise StorageError(str(error)) from error
        try:
            self._archive.recordings.write(record)
        except StorageError:
            recorder.__exit__()
            raise

    async def end(self, reason: str, recording_id: str | None = None) -> RecordingRecord:
        """End the recording under way; what is in it is kept.

        Raises
        ------
        CommandError
            If there is none, or not that one.
        """
        async with self._guard:
            recorder, record = self._recorder, self._record
            if recorder is None or record is None or recording_id not in {None, record.id}:
                raise CommandError(f"{recording_id or 'no recording'} is not under way")
            self._recorder = self._record = None
            # The tap is closed first, so that nothing is put into a recorder whose file is closed.
            self._tap(None, 0.0)
            await asyncio.to_thread(recorder.__exit__)
            record = replace(
                record,
                state=STORED,
                reason=recorder.trouble or reason,
                n_bytes=recorder.n_bytes,
                n_dropped=recorder.n_dropped,
            )
            text = f"{record.id}: {record.n_bytes / 1e6:.0f} MB, {record.n_dropped} dropped"
            why = f": {record.reason}" if record.reason else ""
            self._audit(by_service("recording.ended", f"{text}{why}"))
            try:
                await asyncio.to_thread(self._archive.recordings.write, record)
            except StorageError as error:
                structlog.get_logger().warning("recording.not-noted", text=str(error))
            return record

    def all(self) -> tuple[RecordingRecord, ...]:
        """Return what is known of each, oldest first; reads the disk."""
        recorder, running = self._recorder, self._record
        return tuple(
            replace(one, n_bytes=recorder.n_bytes, n_dropped=recorder.n_dropped)
            if recorder is not None and running is not None and one.id == running.id
            else one
            for one in self._archive.recordings.records()
        )

    async def remove(self, recording_id: str) -> None:
        """Remove one that has ended.

        Raises
        ------
        CommandError
            If it is under way.
        UnknownIdError
            If there is none of this id.
        StorageError
            If the disk refuses.
        """
        async with self._guard:
            # Looked up for its errors only: a recording under way, or an unknown one, is refused.
            await asyncio.to_thread(self.file, recording_id)
            await asyncio.to_thread(self._archive.recordings.remove, recording_id)

    def file(self, recording_id: str) -> Path:
        """Return the file of one that has ended.

        Raises
        ------
        CommandError, UnknownIdError
            As :meth:`remove`.
        """
        if self._record is not None and self._record.id == recording_id:
            raise CommandError(f"{recording_id} is under way; end it first")
        if recording_id not in self._archive.recordings.stored():
            raise UnknownIdError(f"unknown recording {recording_id}")
        return self._archive.recordings.path_of(recording_id)

    async def run(self) -> None:
        """End recordings in their time until cancelled, and the last one then."""
        try:
            while True:
                await asyncio.sleep(PROGRESS_CHECK_INTERVAL_S)
                await self._end_if_due()
        finally:
            if self._recorder is not None:
                await self.end("the service was ended")

    async def _end_if_due(self) -> None:
        """End the recording under way where it is time; somebody may end it meanwhile."""
        recorder, record = self._recorder, self._record
        if recorder is None or record is None:
            return
        reason = await asyncio.to_thread(self._check_recording_end, recorder)
        if reason is not None:
            with suppress(CommandError):
                await self.end(reason, record.id)

    def _full(self) -> str | None:
        """Return a warning if the disk has little room, else None."""
        try:
            return low_on_space(self._archive.directory, self._retention, low=False)
        except OSError as error:
            return str(error)

    def _check_recording_end(self, recorder: RecordingWriter) -> str | None:
        """Return why a recording ends now, None: it goes on; empty: its time is up."""
        if time.monotonic() >= self._ends_s:
            return ""
        if recorder.trouble:
            return recorder.trouble
        if recorder.n_bytes > MAX_RECORDING_GB * GIGABYTE:
            return f"it holds {MAX_RECORDING_GB:g} GB, the most there may be"
        return self._full()


# --- a sample every few seconds, for a chart of the whole night


PIECE_S = 1.0
"""Time between two pieces of telemetry of which a sample's residual is taken. The residual of
0.01 to 0.1 s varies by 15 % with the turbulence, that of 15 pieces by 2 to 3 %."""

N_PIECE_FRAMES = 10
"""Frames of a piece."""


class TrendSampler:
    """Takes a sample every ``TREND_S``, in a thread.

    Parameters
    ----------
    state
        Returns what is known now.
    frames
        Returns the last telemetry that came; None: none has.
    matrix
        Returns a reconstructor by its id; may wait for the disk.
    keep
        Takes each sample.
    """

    def __init__(
        self,
        *,
        state: Callable[[], TrackerState],
        frames: Callable[[], FrameBlock | None],
        matrix: Callable[[str], NDArray[np.float32]],
        keep: Callable[[TrendSample], None],
    ) -> None:
        self._state = state
        self._frames = frames
        self._matrix = matrix
        self._keep = keep
        self._seen_ns: int | None = None
        self._gains_ns: int | None = None
        self._cm_id: str | None = None
        self._pieces: list[NDArray[np.float32]] = []
        """Slopes of the loop that this matrix closes, since the last sample."""

        self._last: FrameBlock | None = None

    async def run(self) -> None:
        """Take samples until cancelled."""
        while True:
            try:
                self._keep(await asyncio.to_thread(self.take))
            except Exception:  # noqa: BLE001 - a bug must not end the service
                structlog.get_logger().exception("trend.not-taken")
            for _ in range(round(TREND_S / PIECE_S)):
                await asyncio.sleep(PIECE_S)
                self.add_piece()

    def add_piece(self) -> None:
        """Add the newest slopes to those of the next sample; another loop's are dropped."""
        frames, rtc = self._frames(), self._state().loop.rtc
        if frames is None or frames is self._last:
            return
        cm_id = frames.cm_id if rtc is not None and rtc.in_loop else None
        if cm_id != self._cm_id:
            self._pieces.clear()
        self._last, self._cm_id = frames, cm_id
        if cm_id:
            self._pieces.append(frames.slopes[-N_PIECE_FRAMES:].copy())

    def take(self) -> TrendSample:
        """Return the sample of the time since the last one."""
        state, frames = self._state(), self._frames()
        end_ns = None if frames is None else frames.t0_ns_utc + frames.n_frames * frames.dt_ns
        # The last block stays after telemetry has stopped: it must not be drawn again as new.
        is_new, self._seen_ns = end_ns != self._seen_ns, end_ns
        residual_m, pieces = None, self._pieces.copy()
        self._pieces.clear()
        if pieces and self._cm_id:
            # None if nobody has its numbers
            with suppress(PyrcalError):
                residual_m = residual_of(np.concatenate(pieces), self._matrix(self._cm_id))
        found = present_gains(state)
        # The same gains are not kept again, or a dither's end would fill the archive.
        gains_ns, self._gains_ns = self._gains_ns, None if found is None else found.t_ns_utc
        sample = sample_of(state, time.time_ns(), end_ns if is_new else None, residual_m)
        return replace(sample, gains=None if self._gains_ns == gains_ns else found)


def sample_of(
    state: TrackerState, now_ns: int, telemetry_ns: int | None, residual_m: float | None
) -> TrendSample:
    """Return what is known at this moment of what goes into a chart."""
    registration, rtc, margin, pointing = (
        state.alpha.registration,
        state.loop.rtc,
        state.matrices.margin,
        state.alpha.pointing,
    )
    gains = () if registration is None else registration.optical_gains
    flux = None if rtc is None else rtc.flux_images
    return TrendSample(
        t_ns_utc=now_ns,
        telemetry_ns_utc=telemetry_ns,
        alpha=None if registration is None else registration.alpha,
        sigma=None if registration is None else registration.shown_sigma,
        wavefront_m=_wavefront_m(state),
        residual_m=residual_m,
        margin=None if margin is None else _finite(margin.worst_pole_radius / margin.bound),
        optical_gain=float(np.mean([one.gain for one in gains])) if gains else None,
        n_controlled=None if rtc is None else rtc.n_controlled,
        magnitude=None if rtc is None else rtc.magnitude,
        flux=None if flux is None else _finite(float(np.mean(flux))),
        elevation_deg=None if pointing is None else pointing.elevation_deg,
        azimuth_deg=None if pointing is None else pointing.azimuth_deg,
    )


def residual_of(slopes: NDArray[np.float32], matrix: NDArray[np.float32]) -> float | None:
    """Return what a reconstructor reads in slopes ``(n, n_slopes)``, metres RMS over its modes."""
    if slopes.shape[1] != matrix.shape[1]:
        return None
    modes_m = slopes @ matrix.T
    # Modes have unit RMS over the pupil: the sum of their squares is the variance of the wavefront.
    return _finite(math.sqrt(np.square(modes_m, dtype=np.float64).sum() / len(slopes)))


def _wavefront_m(state: TrackerState) -> float | None:
    found = state.matrices.assessment
    if found is None or found.id != state.matrices.in_use:
        return None
    return _finite(found.expected.wavefront_m + found.expected.loss_m)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
