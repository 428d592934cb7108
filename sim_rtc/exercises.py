"""What is done with a loop besides closing it: dithers, measurements of its matrix, gain ramps.

At most one of each at a time. What may be on the mirror together is decided here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.wire import DitherRequest, DitherStatus, Loop, LoopRequest
from sim_rtc.dither import Dither
from sim_rtc.measure import Measured, Measurement, Measurements
from sim_rtc.telemetry import Batch, LoopSettings
from sim_rtc.tuning import Tuning

Array32 = NDArray[np.float32]


class Exercises:
    """What is under way; not for two threads at once."""

    def __init__(self, *, n_modes: int, n_slopes: int, frame_rate_hz: float) -> None:
        self._n_modes, self._n_slopes = n_modes, n_slopes
        self._frame_rate_hz = frame_rate_hz
        self._dither: Dither | None = None
        self._measurements = Measurements()
        self._tuning: Tuning | None = None
        self.late_dither_frames = 0
        """After the announced frame, that dithers to come really begin."""

    @property
    def dither(self) -> DitherStatus | None:
        """The dither that is on, as a status tells it."""
        if self._dither is None:
            return None
        return DitherStatus(request=self._dither.request, start_seq=self._dither.start_seq)

    @property
    def telemetry_dithers(self) -> bool:
        """Whether what is added to commands is told as a dither; strokes in open loop are not."""
        current = self._measurements.current
        return current is None or not current.needs_open_loop

    def in_the_loops_way(self) -> str:
        """Return what needs the loop as it is, in the wire's words; empty: nothing."""
        if self._tuning is not None:
            return f"busy: gain ramp {self._tuning.name} is under way; open the loop to end it"
        return self._measurements.busy()

    def forbids(self, request: LoopRequest) -> str:
        """Return why the loop is not to be changed so now; a ramp lets it be opened."""
        if request.loop is Loop.OPEN:
            return self._measurements.busy()
        return self.in_the_loops_way()

    def on_the_mirror(self) -> str:
        """Return what occupies the mirror, in the wire's words; empty: nothing."""
        if self._dither is not None:
            return (
                f"busy: dither {self._dither.request.id} is on until frame "
                f"{self._dither.stop_seq}; stop it first"
            )
        return self._measurements.busy()

    def begin_dither(self, request: DitherRequest, start_seq: int) -> None:
        """Let a dither begin at this frame."""
        self._dither = Dither(
            request,
            start_seq=start_seq,
            n_modes=self._n_modes,
            frame_rate_hz=self._frame_rate_hz,
            late_frames=self.late_dither_frames,
        )

    def end_dither(self) -> None:
        """Let the dither, if any, end now."""
        self._dither = None

    def begin_measurement(self, measurement: Measurement, *, closes_again: bool) -> None:
        """Let a measurement begin at its frame; the loop may have to be closed after it."""
        self._measurements.current = measurement
        self._measurements.closes_again = closes_again

    def begin_ramp(self, tuning: Tuning, settings: LoopSettings) -> LoopSettings:
        """Let a gain ramp begin; return the settings that it asks for."""
        self._tuning = tuning
        return replace(settings, gains=tuning.gains)

    def end_ramp(self, settings: LoopSettings, reason: str) -> LoopSettings:
        """Give up the ramp, if any; return settings with what it has chosen so far."""
        tuning, self._tuning = self._tuning, None
        if tuning is None:
            return settings
        tuning.give_up(reason)
        return replace(settings, gains=tuning.settled)

    def end_all(self, settings: LoopSettings, session: str) -> LoopSettings:
        """End everything, for the loop starts over; return the settings that are left."""
        self._measurements.end(
            session, self._n_slopes, "the loop started over during the measurement"
        )
        self._dither = None
        return self.end_ramp(settings, "the loop started over")

    def commands(self, seq0: int, n_frames: int) -> Array32 | None:
        """Return what is added to the commands of the batch ``(n_frames, n_modes)``, metres."""
        dither, measuring = self._dither, self._measurements.current
        commands = None
        if dither is not None:
            commands = dither.commands(seq0, n_frames)
            if seq0 + n_frames >= dither.stop_seq:
                self._dither = None
        return commands if measuring is None else measuring.commands(seq0, n_frames)

    def look(self, batch: Batch, matrix: Array32, settings: LoopSettings) -> LoopSettings:
        """Read a batch back; return the settings of the next one.

        ``matrix`` is what multiplied its slopes.
        """
        ended = self._measurements.take(batch.session, batch.seq0, batch.slopes, batch.commands_m)
        if ended and self._measurements.closes_again:
            settings = replace(settings, closed=True)
        tuning = self._tuning
        if tuning is not None and batch.closed and tuning.look(batch, matrix):
            settings = replace(settings, gains=tuning.gains)
            if tuning.done:
                self._tuning = None
        return settings

    def take_measured(self) -> list[Measured]:
        """Return the measurements that have ended since the last call."""
        return self._measurements.take_ended()
