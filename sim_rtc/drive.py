"""What the mirror makes of its commands: limits of stroke and force, and a lag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from service.model.instrument import Mirror

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorLimits:
    """How far and how sharply the mirror may be bent, in OPD."""

    stroke_m: float = 30e-6
    """Largest stroke of an actuator either way."""

    bend_m: float = 4e-6
    """Largest distance of an actuator from the mean of its neighbours: a limit of its force."""


class MirrorDrive:
    """Turns the modes asked for into those on the mirror: limits first, then the lag.

    A first-order response spends part of every exposure on its way: what counts, and what the
    telemetry tells, is the mean over the exposure.
    """

    def __init__(
        self,
        mirror: Mirror,
        mode_to_actuator: Array,
        *,
        frame_rate_hz: float,
        rise_s: float = 0.0,
        limits: MirrorLimits | None = None,
    ) -> None:
        """Take the time from 10 to 90 % of a step as ``rise_s``; 0 moves at once."""
        self._limits = limits or MirrorLimits()
        self._to_actuators = mode_to_actuator.astype(np.float32)
        self._to_modes = np.linalg.pinv(mode_to_actuator).astype(np.float32)
        self._neighbour_mean = _neighbour_mean(mirror.positions_m, mirror.pitch_m)
        steps = frame_rate_hz * rise_s / np.log(9.0)
        self._left_at_end = np.float32(np.exp(-1.0 / steps)) if steps > 0.0 else np.float32(0.0)
        self._left_on_average = np.float32(steps * (1.0 - float(self._left_at_end)))
        n_modes = mode_to_actuator.shape[1]
        self._position = np.zeros(n_modes, dtype=np.float32)
        self._dither = np.zeros(n_modes, dtype=np.float32)

    def follow(self, command_m: Array32, dither_m: Array32 | None) -> int:
        """Replace a command and its dither part by what the mirror makes of them.

        Both are ``(n_modes,)``. Returns the number of actuators that met a limit.
        """
        n_limited = self._limit(command_m)
        self._move(self._position, command_m)
        if dither_m is None:
            self._dither *= self._left_at_end
        else:
            self._move(self._dither, dither_m)
        return n_limited

    def _limit(self, command_m: Array32) -> int:
        strokes = self._to_actuators @ command_m
        n_limited = 0
        bend = strokes - self._neighbour_mean @ strokes
        excess = bend - np.clip(bend, -self._limits.bend_m, self._limits.bend_m)
        beyond = np.count_nonzero(excess)
        if beyond:
            strokes -= excess
            n_limited += int(beyond)
        clipped = np.clip(strokes, -self._limits.stroke_m, self._limits.stroke_m)
        n_limited += int(np.count_nonzero(clipped != strokes))
        if n_limited:
            command_m[:] = self._to_modes @ clipped
        return n_limited

    def _move(self, position: Array32, command: Array32) -> None:
        """Advance ``position`` to the end of the frame and put its mean over it in ``command``."""
        distance = position - command
        np.add(command, distance * self._left_at_end, out=position)
        command += distance * self._left_on_average


def _neighbour_mean(positions_m: Array, pitch_m: float) -> csr_array:
    """Return ``(n, n)`` averages over the neighbours of each actuator within two pitches."""
    n = len(positions_m)
    near = np.zeros((n, n), dtype=bool)
    for corners in Delaunay(positions_m).simplices:
        near[np.ix_(corners, corners)] = True
    distance = np.hypot(*(positions_m[:, None] - positions_m).transpose(2, 0, 1))
    near &= (distance > 0.0) & (distance < 2 * pitch_m)
    share = near / np.maximum(near.sum(axis=1, keepdims=True), 1)
    return csr_array(share.astype(np.float32))
