"""What a loop's commands do too fast for turbulence: the part of them that the passive fit trusts.

Turbulence sits below a tenth of the frame rate, and there commands and slopes have it in common: a
regression of one on the other is biased, by a third of a subaperture on a bright star in 20 m/s.
Above it moves mostly the sensor's own noise, which the loop returns as commands ``d`` frames later:
a dither that costs nothing. A filter that lets only that pass makes an instrument (in the sense of
instrumental variables) of the commands.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError

N_TAPS = 11
"""Longer filters know turbulence from noise no better, and lose more frames at every gap."""

CORNER = 0.08
"""Of the frame rate. Above 0.1 a bright star leaves too little signal; below 0.06 a wind of 20 m/s
is let in."""

LEAST_DELAY_FRAMES = 2
"""With less the instrument may not look ahead, and a tenth of the signal is left."""

_LOOP_GAIN = 0.35
"""Of a loop at gain 0.6 and an optical gain of 0.6: where its noise is amplified."""

_TURBULENCE_SLOPE = 34.0 / 3.0
"""Of the squared temporal spectrum of a mode above its corner: twice 17/3 (Conan et al. 1995)."""

_LOWEST = 0.015
"""Of the frame rate: below it turbulence is as strong as here."""

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HighPass:
    """A finite filter of commands: ``z_k = sum_j taps_j c_{k + ahead - j}``."""

    taps: NDArray[np.float32]
    """``(n_taps,)``, the largest 1 either way; they add up to 0."""

    ahead: int
    """Frames after k that z_k depends on: their commands do not know the noise of frame k."""

    def __call__(self, commands: Array) -> Array:
        """Return ``(n_rows - n_taps + 1, n_modes)`` of contiguous commands ``(n_rows, n_modes)``.

        Row i belongs to frame ``i + behind``.
        """
        n_rows = len(commands) - len(self.taps) + 1
        newest = len(self.taps) - 1
        out = self.taps[0] * commands[newest : newest + n_rows]
        for j in range(1, len(self.taps)):
            out += self.taps[j] * commands[newest - j : newest - j + n_rows]
        return np.asarray(out)

    @property
    def behind(self) -> int:
        """Frames before k that z_k depends on."""
        return len(self.taps) - 1 - self.ahead


@cache
def high_pass(delay_frames: float) -> HighPass:
    """Return the filter for a loop of this delay.

    It makes ``E[z c]``, the response to the sensor's noise, as large as it can be for the noise of
    ``sum z s``, turbulence counted as noise that is ``CORNER`` away from being as strong: with a
    loop's reply to white noise, ``P = 1 / |1 - z^-1 + g z^-d|^2``, taps solve ``M a = v``, where
    ``v`` is the inverse transform of P and ``M`` that of ``P (1 + W)``.

    Raises
    ------
    ModelError
        If the delay is shorter than ``LEAST_DELAY_FRAMES``.
    """
    if delay_frames < LEAST_DELAY_FRAMES:
        raise ModelError(
            f"passive estimate: found a delay of {delay_frames:g} frames, expected at least "
            f"{LEAST_DELAY_FRAMES}: a loop as quick answers noise before it can be told from the "
            "response"
        )
    ahead = int(delay_frames) - 1
    turns = (np.arange(4096) + 0.5) / 8192
    z = np.exp(-2j * np.pi * turns)
    power = 1.0 / np.abs(1.0 - 0.999 * z + _LOOP_GAIN * z ** round(delay_frames)) ** 2
    turbulence = (CORNER / np.maximum(turns, _LOWEST)) ** _TURBULENCE_SLOPE
    shifted = np.exp(-2j * np.pi * np.outer(np.arange(N_TAPS) - ahead, turns))
    signal = (shifted * power).real.mean(axis=1)
    noise = ((shifted * power * (1.0 + turbulence)) @ shifted.conj().T).real / len(turns)
    taps = np.linalg.solve(noise, signal)
    taps -= taps.mean()
    return HighPass(taps=(taps / np.abs(taps).max()).astype(np.float32), ahead=ahead)
