"""Operations that occupy the loop: dithers, measurements, gain ramps.

At most one of each at a time. What may be on the mirror together is decided here.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.dither import Dither
from service.wire import DitherRequest, DitherStatus, Loop, LoopRequest
from sim_rtc.computer.gains import GainRamp
from sim_rtc.computer.measure import Measurement
from sim_rtc.computer.telemetry import Batch, LoopSettings

Array32 = NDArray[np.float32]


MAX_DITHER_AMPLITUDE_M = 50e-9
"""Largest RMS of one mode, metres of OPD."""

MAX_DITHER_DURATION_S = 3600.0

_MOST_ENDED = 4
"""Finished measurements kept until they are sent."""


class Activities:
    """Operations under way; for one thread at a time."""

    def __init__(self, *, n_modes: int, frame_rate_hz: float) -> None:
        self._n_modes = n_modes
        self._frame_rate_hz = frame_rate_hz
        self._dither: Dither | None = None
        self._measurement: Measurement | None = None
        self._closes_again = False
        self.ended: deque[Measurement] = deque(maxlen=_MOST_ENDED)
        """Finished measurements that are not sent yet."""
        self._ramp: GainRamp | None = None
        self.late_dither_frames = 0
        """Frames by which future dithers begin after the announced frame."""

    @property
    def dither(self) -> DitherStatus | None:
        """The dither that plays, as a status has it."""
        if self._dither is None:
            return None
        return self._dither.status

    @property
    def telemetry_dithers(self) -> bool:
        """Return True if added commands are a dither; strokes in open loop are not."""
        return self._measurement is None or not self._measurement.needs_open_loop

    def in_the_loops_way(self) -> str:
        """Return the operation that needs the loop unchanged, in the wire's words; empty: none."""
        if self._ramp is not None:
            return f"busy: gain ramp {self._ramp.name} is under way; open the loop to end it"
        return self.explain_measuring()

    def forbids(self, request: LoopRequest) -> str:
        """Return why the loop must not be changed so now; a ramp lets it be opened."""
        if request.loop is Loop.OPEN:
            return self.explain_measuring()
        return self.in_the_loops_way()

    def on_the_mirror(self) -> str:
        """Return the operation that occupies the mirror, in the wire's words; empty: none."""
        if self._dither is not None:
            return (
                f"busy: dither {self._dither.request.id} is on until frame "
                f"{self._dither.stop_seq}; stop it first"
            )
        return self.explain_measuring()

    def explain_measuring(self) -> str:
        """Return the measurement under way, in the wire's words; empty: none."""
        if self._measurement is None:
            return ""
        name, stop_seq = self._measurement.request.id, self._measurement.stop_seq
        return f"busy: matrix {name} is being measured until frame {stop_seq}"

    def begin_dither(self, request: DitherRequest, start_seq: int) -> None:
        """Begin a dither at this frame."""
        self._dither = Dither(
            request,
            start_seq=start_seq,
            n_modes=self._n_modes,
            frame_rate_hz=self._frame_rate_hz,
            delay_frames=self.late_dither_frames,
        )

    def end_dither(self) -> None:
        """End the dither, if any."""
        self._dither = None

    def begin_measurement(self, measurement: Measurement, *, closes_again: bool) -> None:
        """Begin a measurement at its frame; the loop may have to be closed after it."""
        self._measurement, self._closes_again = measurement, closes_again

    def begin_ramp(self, ramp: GainRamp, settings: LoopSettings) -> LoopSettings:
        """Begin a gain ramp; return the settings that it asks for."""
        self._ramp = ramp
        return replace(settings, gains=ramp.gains)

    def end_ramp(self, settings: LoopSettings, reason: str) -> LoopSettings:
        """Give up the ramp, if any; return settings with the gains chosen so far."""
        ramp, self._ramp = self._ramp, None
        if ramp is None:
            return settings
        ramp.give_up(reason)
        return replace(settings, gains=ramp.settled)

    def end_all(self, settings: LoopSettings, session: str) -> LoopSettings:
        """End everything, for the loop starts over; return the remaining settings."""
        self._end_measurement(session, "the loop started over during the measurement")
        self._dither = None
        return self.end_ramp(settings, "the loop started over")

    def _end_measurement(self, session: str, failure: str = "") -> None:
        measurement, self._measurement = self._measurement, None
        if measurement is not None:
            measurement.session, measurement.failure = session, failure
            self.ended.append(measurement)

    def commands(self, seq0: int, n_frames: int) -> Array32 | None:
        """Return the commands added to the batch, ``(n_frames, n_modes)``, metres."""
        dither, measuring = self._dither, self._measurement
        commands = None
        if dither is not None:
            commands = dither.commands(seq0, n_frames)
            if seq0 + n_frames >= dither.stop_seq:
                self._dither = None
        return commands if measuring is None else measuring.commands(seq0, n_frames)

    def look(self, batch: Batch, matrix: Array32, settings: LoopSettings) -> LoopSettings:
        """Take a batch; return the settings of the next one.

        ``matrix`` is what multiplied its slopes.
        """
        measuring = self._measurement
        if measuring is not None:
            measuring.take(batch.seq0, batch.slopes, batch.commands_m)
            if batch.seq0 + len(batch.slopes) >= measuring.stop_seq:
                self._end_measurement(batch.session)
                # The service may have closed the loop during the last batch.
                settings = replace(settings, closed=settings.closed or self._closes_again)
        ramp = self._ramp
        if ramp is not None and batch.closed and ramp.look(batch, matrix):
            settings = replace(settings, gains=ramp.gains)
            if ramp.done:
                self._ramp = None
        return settings
