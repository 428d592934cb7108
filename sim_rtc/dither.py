"""The dither: a known command added to the integrator's on request."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.wire import DitherKind, DitherRequest

Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherLimits:
    """What the RTC accepts."""

    largest_m: float = 50e-9
    """RMS of one mode, metres OPD."""

    most_modes: int = 594
    """Modes dithered at once."""

    longest_s: float = 3600.0
    """Duration, seconds."""


class Dither:
    """One accepted dither, from its first frame to its last."""

    def __init__(
        self,
        request: DitherRequest,
        *,
        start_seq: int,
        n_modes: int,
        frame_rate_hz: float,
        late_frames: int = 0,
    ) -> None:
        """Take what was asked for; ``late_frames`` after ``start_seq`` it really begins."""
        self.request = request
        self._late_frames = late_frames
        self.start_seq = start_seq
        self._n_modes = n_modes
        self._frame_rate_hz = frame_rate_hz
        self.stop_seq = start_seq + max(1, round((request.duration_s or 0.0) * frame_rate_hz))
        """First frame without it."""
        self._modes = np.array(request.modes, dtype=np.intp)
        self._amplitude_m = np.array(request.amplitude_m)
        self._rng = np.random.default_rng(request.seed or 0)

    def commands(self, seq0: int, n_frames: int) -> Array32 | None:
        """Return the dither of these frames ``(n_frames, n_modes)``, metres; None: it is silent.

        Frames must be asked for in order: a binary sequence is drawn as it is played.
        """
        seq = np.arange(seq0, seq0 + n_frames) - self._late_frames
        playing = (seq >= self.start_seq) & (seq < self.stop_seq)
        if not playing.any():
            return None
        out = np.zeros((n_frames, self._n_modes), dtype=np.float32)
        out[np.ix_(playing, self._modes)] = self._waveform(seq[playing] - self.start_seq)
        return out

    def _waveform(self, frame: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return ``(n_playing, n_dithered)`` metres, ``frame`` counted from the first one."""
        if self.request.kind is DitherKind.BINARY:
            signs = self._rng.integers(0, 2, (len(frame), len(self._modes))) * 2 - 1
            return np.asarray(signs * self._amplitude_m)
        frequency = np.array(self.request.frequency_hz)
        phase = 2 * np.pi * frequency * (frame[:, None] / self._frame_rate_hz)
        return np.asarray(self._amplitude_m * np.sqrt(2.0) * np.sin(phase))


def refusal(
    request: DitherRequest, limits: DitherLimits, *, n_modes: int, frame_rate_hz: float
) -> str:
    """Return why a dither cannot be played, in the wire's words; empty: it can."""
    modes, amplitude_m = request.modes or (), request.amplitude_m or ()
    if max(modes, default=0) >= n_modes:
        return f"range: mode {max(modes)}, expected 0 to {n_modes - 1}"
    if len(modes) > limits.most_modes:
        return f"range: {len(modes)} modes, expected at most {limits.most_modes}"
    if max(amplitude_m, default=0.0) > limits.largest_m:
        return f"range: amplitude_m {max(amplitude_m):.3g}, expected at most {limits.largest_m:.3g}"
    highest = max(request.frequency_hz or (), default=0.0)
    if highest >= frame_rate_hz / 2:
        return f"range: frequency_hz {highest:g}, expected below {frame_rate_hz / 2:g}"
    if (request.duration_s or 0.0) > limits.longest_s:
        return f"range: duration_s {request.duration_s:g}, expected at most {limits.longest_s:g}"
    return ""
