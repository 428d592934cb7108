"""From what was read back to a matrix: slopes against the commands the mirror has really had.

Nothing here knows the plant, and the commands that count are not those that were asked for but
those in the telemetry: a slow, clipped or otherwise disturbed mirror measures as well as a
perfect one.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_rtc.strokes import Tones

Array32 = NDArray[np.float32]

_SILENT = 1e-6
"""A mode with less than this share of the mean power was not moved: it has no column."""


class Solver(Protocol):
    """Turns what was read back into a matrix."""

    def take(self, frame: NDArray[np.int64], slopes: Array32, commands_m: Array32) -> None:
        """Take consecutive frames, counted from the first of the measurement."""

    def matrix(self) -> Array32:
        """Return ``(n_slopes, n_measured)``, slope per metre OPD."""


class Regression:
    """Least squares of slopes on commands: ``D = (sum s c^T) (sum c c^T)^-1``.

    All modes that moved are in the equations, those that were not asked for as well: a mirror that
    does something else at the same time, like a disturbance it plays, does not bias the columns.
    """

    def __init__(self, modes: tuple[int, ...], *, n_modes: int, n_slopes: int) -> None:
        self._modes = np.array(modes)
        self._products = np.zeros((n_modes, n_slopes), dtype=np.float32)
        self._powers = np.zeros((n_modes, n_modes))

    def take(self, frame: NDArray[np.int64], slopes: Array32, commands_m: Array32) -> None:
        """Take consecutive frames."""
        moved = np.flatnonzero(commands_m.any(axis=0))
        # metres are tiny: a power of a nanometre would be lost in float32
        commands_um = commands_m[:, moved] * np.float32(1e6)
        self._products[moved] += commands_um.T @ slopes
        self._powers[np.ix_(moved, moved)] += commands_um.T @ commands_um

    def matrix(self) -> Array32:
        """Return ``(n_slopes, n_measured)``, slope per metre OPD.

        Raises
        ------
        numpy.linalg.LinAlgError
            If a mode that was asked for never moved.
        """
        power = np.diag(self._powers)
        moved = np.flatnonzero(power > _SILENT * power[self._modes].mean())
        still = np.setdiff1d(self._modes, moved)
        if still.size:
            raise np.linalg.LinAlgError(f"{still.size} modes never moved, mode {still[0]} first")
        columns, *_ = np.linalg.lstsq(
            self._powers[np.ix_(moved, moved)], self._products[moved].astype(np.float64), rcond=None
        )
        every = np.zeros_like(self._products)
        every[moved] = columns * 1e6
        return np.ascontiguousarray(every[self._modes].T)


class Demodulation:
    """Slopes and commands at every tone's frequency, with the loop closed.

    The loop answers each tone in every mode, so at tone n the slopes are ``D c(f_n)``: as many
    equations as columns. Each is turned to the phase of its own mode's command and its real part
    taken, which is what can be in phase with the known dither (an instrumental variable).
    """

    def __init__(self, tones: Tones, *, n_slopes: int) -> None:
        self._tones = tones
        n = len(tones.modes)
        self._slopes = np.zeros((2 * n, n_slopes), dtype=np.float32)
        self._commands_um = np.zeros((2 * n, n))

    def take(self, frame: NDArray[np.int64], slopes: Array32, commands_m: Array32) -> None:
        """Take consecutive frames."""
        phase = 2 * np.pi * self._tones.cycles_per_frame * frame[:, None]
        window = np.sin(np.pi * (frame + 0.5) / self._tones.n_frames)[:, None] ** 2
        waves = (np.hstack([np.cos(phase), -np.sin(phase)]) * window).astype(np.float32)
        self._slopes += waves.T @ slopes
        self._commands_um += waves.T @ (commands_m[:, self._tones.modes] * np.float32(1e6))

    def matrix(self) -> Array32:
        """Return ``(n_slopes, n_measured)``, slope per metre OPD."""
        n = len(self._tones.modes)
        commands = self._commands_um[:n] + 1j * self._commands_um[n:]
        slopes = self._slopes[:n].astype(np.float64) + 1j * self._slopes[n:]
        turn = np.exp(-1j * np.angle(np.diag(commands)))[:, None]
        columns = np.linalg.solve((commands * turn).real, (slopes * turn).real)
        return np.ascontiguousarray(columns.T * 1e6, dtype=np.float32)
