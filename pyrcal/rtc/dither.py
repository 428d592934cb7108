"""Dither waveforms: sines, or random signs, on several modes at the same time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.wire import DitherKind, DitherRequest, DitherStatus

Array32 = NDArray[np.float32]


class Dither:
    """One accepted dither, from its first frame to its last.

    Parameters
    ----------
    request
        Modes, amplitudes (metres of OPD, RMS of a mode), frequencies and duration.
    start_seq
        Sequence number of the first frame whose exposure contains the dither.
    n_modes
        Number of modes of the basis.
    frame_rate_hz
        Frame rate of the loop.
    delay_frames
        The dither begins this many frames after ``start_seq``: the simulator's fault of an RTC that
        does not play what it announces. 0 in every real RTC.
    """

    def __init__(
        self,
        request: DitherRequest,
        *,
        start_seq: int,
        n_modes: int,
        frame_rate_hz: float,
        delay_frames: int = 0,
    ) -> None:
        self.request = request
        self.start_seq = start_seq
        self.stop_seq = start_seq + max(1, round(request.duration_s * frame_rate_hz))
        """Sequence number of the first frame after the dither."""
        self._delay_frames = delay_frames
        self._n_modes = n_modes
        self._frame_rate_hz = frame_rate_hz
        self._modes = np.array(request.modes, dtype=np.intp)
        self._amplitude_m = np.array(request.amplitude_m)
        self._rng = np.random.default_rng(request.seed or 0)

    @property
    def status(self) -> DitherStatus:
        """The dither as an RTC reports it in its status."""
        return DitherStatus(request=self.request, start_seq=self.start_seq)

    def commands(self, seq0: int, n_frames: int) -> Array32 | None:
        """Return the dither of frames ``seq0`` to ``seq0 + n_frames - 1``.

        Frames must be requested in order, because random signs are drawn as they are played.

        Returns
        -------
        ``(n_frames, n_modes)``, metres of OPD; None if none of these frames has a dither.
        """
        seq = np.arange(seq0, seq0 + n_frames) - self._delay_frames
        # A batch may begin before the dither and end after it.
        playing = (seq >= self.start_seq) & (seq < self.stop_seq)
        if not playing.any():
            return None
        out = np.zeros((n_frames, self._n_modes), dtype=np.float32)
        out[np.ix_(playing, self._modes)] = self._waveform(seq[playing] - self.start_seq)
        return out

    def _waveform(self, frame: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return ``(n_playing, n_dithered)``, metres; ``frame`` counts from the first one."""
        if self.request.kind is DitherKind.BINARY:
            signs = self._rng.integers(0, 2, (len(frame), len(self._modes))) * 2 - 1
            return np.asarray(signs * self._amplitude_m)
        frequency = np.array(self.request.frequency_hz)
        phase = 2 * np.pi * frequency * (frame[:, None] / self._frame_rate_hz)
        # the amplitude of a sine whose RMS is amplitude_m
        return np.asarray(self._amplitude_m * np.sqrt(2.0) * np.sin(phase))


def check_dither(
    request: DitherRequest,
    *,
    n_modes: int,
    frame_rate_hz: float,
    max_amplitude_m: float,
    max_duration_s: float,
    max_modes: int | None = None,
) -> str:
    """Return the reason to reject a dither, in the contract's words, or an empty string.

    Parameters
    ----------
    request
        The dither.
    n_modes
        Number of modes of the basis.
    frame_rate_hz
        Frame rate; frequencies must be below half of it.
    max_amplitude_m
        Largest amplitude of a mode, metres of OPD RMS.
    max_duration_s
        Longest dither, seconds.
    max_modes
        Largest number of modes at the same time; None if there is no limit.
    """
    largest_m, highest_hz = max(request.amplitude_m), max(request.frequency_hz or (0.0,))
    if max_modes is not None and len(request.modes) > max_modes:
        return f"range: {len(request.modes)} modes, expected at most {max_modes}"
    if max(request.modes) >= n_modes:
        return f"range: mode {max(request.modes)}, expected 0 to {n_modes - 1}"
    if largest_m > max_amplitude_m:
        return f"range: amplitude_m {largest_m:.3g}, expected at most {max_amplitude_m:.3g}"
    if highest_hz >= frame_rate_hz / 2:
        return f"range: frequency_hz {highest_hz:g}, expected below {frame_rate_hz / 2:g}"
    if request.duration_s > max_duration_s:
        return f"range: duration_s {request.duration_s:g}, expected at most {max_duration_s:g}"
    return ""
