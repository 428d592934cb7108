"""Play the dither frame by frame into a channel of the mirror.

A value written while the newest frame of slopes is k goes onto the mirror together with the loop's
answer to k. If a frame is noticed too late, the value of the previous frame is still in the
channel, and that value is recorded for it: the telemetry contains what was played, not what was
requested.
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
from pyrcal.rtc.background import Background
from pyrcal.rtc.dither import Dither, check_dither
from service.wire import DitherRequest, DitherStatus

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
        self._dither = Dither(
            status.request,
            start_seq=status.start_seq,
            n_modes=len(mirror.per_metre),
            frame_rate_hz=mirror.frame_rate_hz,
        )
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
        last = self._dither.stop_seq
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
            # Frames that were missed had the value that was still in the channel.
            if now > before + 1:
                self._played(before + 1, now - 1, value_m)
            # ``lead`` is added because the answer to this frame is on the mirror that much later.
            # A counter that goes back is another stream: the dither does not continue there.
            over = stands or now + self._mirror.lead >= last or now < before
            over = over or self._stopped.is_set()
            value_m = np.zeros_like(value_m) if over else self._value_m(now + self._mirror.lead)
            # Zeros are written at the end: cacao keeps adding what a channel holds.
            self._mirror.channel.write(value_m @ self._mirror.per_metre)
            self._played(now, now, value_m)
            self.seen = before = now
            if over:
                return

    def _value_m(self, seq: int) -> Array32:
        """Return the dither of frame ``seq``, ``(n_modes,)`` metres of OPD."""
        commands = self._dither.commands(seq, 1)
        if commands is None:
            return np.zeros(len(self._mirror.per_metre), dtype=np.float32)
        return np.asarray(commands[0])


def check_request(
    request: DitherRequest, n_modes: int, frame_rate_hz: float, max_amplitude_m: float
) -> str:
    """Return the reason to reject a dither, in the contract's words, or an empty string."""
    if request.frequency_hz is None:
        return "unsupported: random signs; only sines are played"
    return check_dither(
        request,
        n_modes=n_modes,
        frame_rate_hz=frame_rate_hz,
        max_amplitude_m=max_amplitude_m,
        max_duration_s=math.inf,
    )
