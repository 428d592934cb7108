"""Batches of frames, status, and time of each frame."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.identity import Identity
from service.wire import FrameHeader, Status
from sim_rtc.telescope.plant import Optics

Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """The loop's settings; replaced as a whole."""

    frame_rate_hz: float
    delay_frames: int
    """Frames from an exposure to the first command that answers it."""

    gains: tuple[float, ...]
    """One per mode of the basis; the controlled ones are used."""

    leak: float
    """Per frame; 1 forgets nothing."""

    closed: bool = True
    n_controlled_next: int
    """Number of modes requested by a command; takes effect with the next matrix of that many rows.
    """


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """One batch of frames as it leaves the loop, with the simulator's own truth."""

    session: str
    seq0: int
    slopes: Array32
    """``(n_frames, n_slopes)``, the reference slopes subtracted."""

    commands_m: Array32
    """``(n_frames, n_modes)``, dither included, after clipping."""

    dither_m: Array32 | None
    """``(n_frames, n_modes)``; None without dither."""

    cm_id: str
    """The matrix that multiplied these slopes."""

    identity: Identity
    """Names of basis, sensor and reference slopes of these frames."""

    n_clipped: int
    """Commands that met the stroke limit."""

    closed: bool
    n_controlled: int
    optics: Optics
    """The truth: never on the wire."""

    phase_m: Array32
    """``(n_points,)`` turbulence OPD during the first frame: never on the wire."""


def frames_of(batch: Batch, t0_ns: int, dt_ns: int) -> tuple[FrameHeader, NDArray[np.float32]]:
    """Return header and rows of a batch whose first exposure ended at ``t0_ns``."""
    columns, identity = [batch.slopes, batch.commands_m], batch.identity
    if batch.dither_m is not None:
        columns.append(batch.dither_m)
    header = FrameHeader(
        session=batch.session,
        seq0=batch.seq0,
        n=len(batch.slopes),
        t0_ns=t0_ns,
        dt_ns=dt_ns,
        n_slopes=batch.slopes.shape[1],
        n_modes=batch.commands_m.shape[1],
        dither=batch.dither_m is not None,
        cm_id=batch.cm_id,
        basis_id=identity.basis_id,
        config_id=identity.config_id,
        reference_id=identity.reference_id,
    )
    return header, np.hstack(columns)


@dataclass(slots=True, kw_only=True)
class FrameClock:
    """Timestamps of the frames: they follow the sequence, never the machine's clock.

    Only the loop's thread changes it, between two batches.
    """

    start_ns_utc: int
    """Start of the exposure of frame 0."""

    dt_ns: int
    """Frame period, nanoseconds."""

    def end_of_exposure_ns(self, seq: int) -> int:
        """Return the end of exposure of frame ``seq``, nanoseconds since the Unix epoch, UTC."""
        return self.start_ns_utc + (seq + 1) * self.dt_ns

    def stamp_status(self, status: Status) -> Status:
        """Return a status with the time of its last frame."""
        return replace(status, t_ns=self.end_of_exposure_ns(status.seq or 0))

    def step(self, by_ns: int) -> None:
        """Let all frames to come be later by this much."""
        self.start_ns_utc += by_ns

    def restart(self, now_ns_utc: int) -> None:
        """Begin the exposure of frame 0 again, now."""
        self.start_ns_utc = now_ns_utc


class Pace:
    """Holds the loop to real time, or to a multiple of it; late frames are made up for."""

    def __init__(self, *, batch_s: float, batch_frames: int = 1) -> None:
        """Take a batch's wall-clock duration, 0: as fast as it goes; and how many frames it has."""
        self._batch_s = batch_s
        self._batch_frames = batch_frames
        self._start_s: float | None = None
        self._batches = 0
        self.late_frames = 0
        """Frames of batches that were finished after the next one was due."""

        self.behind_s = 0.0
        """Delay of the last batch, seconds."""

    def wait(self, stopped: threading.Event) -> None:
        """Wait until the next batch has been exposed."""
        if self._start_s is None:
            self._start_s = time.perf_counter()
        self._batches += 1
        if self._batch_s > 0.0:
            left_s = self._start_s + self._batches * self._batch_s - time.perf_counter()
            if left_s > 0.0:
                # Not sleep(), so that a signal ends the wait.
                stopped.wait(left_s)

    def forgive(self, seconds: float) -> None:
        """Make up for nothing of the last ``seconds``."""
        if self._start_s is not None:
            self._start_s += seconds

    def done(self) -> None:
        """Note that the batch is finished."""
        if self._batch_s == 0.0 or self._start_s is None:
            return
        due_s = self._start_s + self._batches * self._batch_s
        self.behind_s = time.perf_counter() - due_s
        if self.behind_s > self._batch_s:
            self.late_frames += self._batch_frames
