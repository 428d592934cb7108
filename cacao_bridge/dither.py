"""Play the dither frame by frame into a channel of the mirror.

What is written while the newest frame of slopes is k goes onto the mirror together with the loop's
answer to k. A frame that is seen too late finds the value of the one before still there, and that
is what is remembered of it: the columns hold what was played, not what was asked for.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import structlog
from numpy.typing import NDArray
from typing_extensions import override

from cacao_bridge.streams import Stream, StreamError
from service.wire import DitherRequest, DitherStatus
from sim_rtc.computer.feed import Background

Array32 = NDArray[np.float32]
_log = structlog.get_logger("cacao")

_LOOKS_PER_FRAME: Final = 8.0
_STANDS_S: Final = 0.5
"""Without a frame of slopes, until the dither is taken off the mirror and ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mirror:
    """The channel, and the command of one metre on each mode in it."""

    channel: Stream
    """Writable, the bridge's own."""

    per_metre: Array32
    """``(n_modes, n_values)``."""

    lead: int
    """Exposures between a frame and the one that its answer is on the mirror for."""

    frame_rate_hz: float


class Player(Background):
    """Plays one dither in a thread while a ``with`` block lasts."""

    def __init__(
        self,
        mirror: Mirror,
        slopes: Stream,
        status: DitherStatus,
        played: Callable[[int, int, Array32], None],
    ) -> None:
        """Take the request, and the receiver of what was played for which frames."""
        super().__init__("dither")
        self._mirror, self._slopes, self.status, self._played = mirror, slopes, status, played
        self.ended = threading.Event()
        self.seen = slopes.counter
        """The last frame of which it is known what was played in answer to it."""

    @override
    def _work(self) -> None:
        try:
            self._play()
        except StreamError as error:
            _log.error("dither.ended", reason=str(error))
        finally:
            self.ended.set()

    def _play(self) -> None:
        request = self.status.request
        last = self.status.start_seq + round(request.duration_s * self._mirror.frame_rate_hz)
        pause_s = 1.0 / (_LOOKS_PER_FRAME * self._mirror.frame_rate_hz)
        before, value_m = self._slopes.counter, self._value_m(0)
        moved_s = time.monotonic()
        while True:
            now = self._slopes.counter
            stands = time.monotonic() - moved_s > _STANDS_S
            if now == before and not stands and not self._stopped.is_set():
                time.sleep(pause_s)
                continue
            moved_s = time.monotonic()
            if now > before + 1:
                self._played(before + 1, now - 1, value_m)
            over = stands or now + self._mirror.lead >= last or now < before
            over = over or self._stopped.is_set()
            value_m = np.zeros_like(value_m) if over else self._value_m(now + self._mirror.lead)
            self._mirror.channel.write(value_m @ self._mirror.per_metre)
            self._played(now, now, value_m)
            self.seen = before = now
            if over:
                return

    def _value_m(self, seq: int) -> Array32:
        """Return ``(n_modes,)`` metres of frame ``seq``."""
        request, start = self.status.request, self.status.start_seq
        value_m = np.zeros(len(self._mirror.per_metre), dtype=np.float32)
        if request.frequency_hz is not None and seq >= start:
            turns = np.array(request.frequency_hz) * ((seq - start) / self._mirror.frame_rate_hz)
            strokes = np.array(request.amplitude_m) * math.sqrt(2.0)
            value_m[list(request.modes)] = strokes * np.sin(2.0 * np.pi * turns)
        return value_m


def refusal(request: DitherRequest, n_modes: int, frame_rate_hz: float, most_m: float) -> str:
    """Return why a dither cannot be played; empty: it can."""
    if request.frequency_hz is None:
        return "unsupported: random signs; only sines are played"
    if max(request.modes) >= n_modes:
        return f"range: mode {max(request.modes)}, expected 0 to {n_modes - 1}"
    if max(request.amplitude_m) > most_m:
        return f"range: amplitude_m {max(request.amplitude_m)}, expected at most {most_m}"
    if max(request.frequency_hz) >= frame_rate_hz / 2.0:
        half = f"below {frame_rate_hz / 2.0:g}"
        return f"range: frequency_hz {max(request.frequency_hz)}, expected {half}"
    return ""
