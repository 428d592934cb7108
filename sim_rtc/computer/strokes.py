"""The strokes of a measurement, and the matrix computed from the response.

This module does not know the plant. The commands are those in the telemetry, not those that were
requested, so a slow, clipped or otherwise disturbed mirror is measured as well as a perfect one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_REST_FRAMES = 2
"""Frames with a flat mirror between two shapes: what is left of one must not meet the next."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PushPull:
    """Shapes pushed and pulled one after the other.

    The order is + - - + + - - +...: whatever is constant or changes at a constant rate meanwhile,
    turbulence included, cancels over two repetitions, and only every second frame follows a move.
    """

    shapes_m: Array32
    """``(n_shapes, n_modes)`` command of each shape, metres."""

    n_average: int
    """Pushes, and as many pulls, of each shape."""

    @property
    def n_frames(self) -> int:
        """Length of the whole sequence."""
        return len(self.shapes_m) * frames_per_shape(self.n_average)

    def commands(self, frame: NDArray[np.int64]) -> Array32:
        """Return the commands ``(n_frames, n_modes)``, metres, of frames counted from the first."""
        shape, turn = np.divmod(frame, frames_per_shape(self.n_average))
        # turn 0, 1, 2, 3, 4 gives + - - + +.
        signs = np.where((turn + 1) // 2 % 2 == 0, 1.0, -1.0)
        signs[turn >= 2 * self.n_average] = 0.0
        return (self.shapes_m[shape] * signs[:, None]).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tones:
    """Sinusoids on many modes at once, each at its own frequency."""

    modes: NDArray[np.intp]
    """0-based basis indices."""

    amplitude_m: Array
    """``(n_tones,)`` RMS of each mode, metres OPD."""

    cycles_per_frame: Array
    """``(n_tones,)`` frequency over the frame rate, below 1/2."""

    n_modes: int
    """Number of modes of the basis."""

    n_frames: int

    def commands(self, frame: NDArray[np.int64]) -> Array32:
        """Return the commands ``(n_frames, n_modes)``, metres, of frames counted from the first."""
        phase = 2 * np.pi * self.cycles_per_frame * frame[:, None]
        out = np.zeros((len(frame), self.n_modes), dtype=np.float32)
        out[:, self.modes] = self.amplitude_m * np.sqrt(2.0) * np.sin(phase)
        return out


def frames_per_shape(n_average: int) -> int:
    """Return how long one shape takes with so many pushes and pulls, frames."""
    return 2 * n_average + _REST_FRAMES


def modal(modes: tuple[int, ...], amplitude_m: tuple[float, ...], n_modes: int) -> Array32:
    """Return one shape for each mode ``(n_measured, n_modes)``, metres."""
    shapes = np.zeros((len(modes), n_modes), dtype=np.float32)
    shapes[np.arange(len(modes)), list(modes)] = amplitude_m
    return shapes


def hadamard_order(n_modes: int) -> int:
    """Return the number of shapes for so many modes: the next power of two."""
    return 1 << (n_modes - 1).bit_length()


def hadamard_shapes(
    modes: tuple[int, ...], amplitude_m: tuple[float, ...], n_modes: int
) -> Array32:
    """Return shapes in which every mode takes part with one sign or the other.

    With all modes always at work the noise of each is that of ``n`` times as many pushes.
    """
    signs = scipy.linalg.hadamard(hadamard_order(len(modes)))[:, : len(modes)]
    return np.asarray(signs @ modal(modes, amplitude_m, n_modes), dtype=np.float32)


def system_shapes(
    reconstructor: Array32, modes: tuple[int, ...], amplitude_m: float, n_modes: int
) -> Array32:
    """Return the eigenmodes of what the loop corrects with, each of this RMS OPD.

    ``reconstructor`` is ``(n_controlled, n_slopes)``. Its left singular vectors make slopes that
    are orthogonal to one another, so none is mistaken for a mixture of the others.
    """
    rows = reconstructor[list(modes)].astype(np.float64)
    # Of the small Gram matrix: its eigenvectors are the left singular vectors of the rows.
    _, vectors = scipy.linalg.eigh(rows @ rows.T)
    shapes = np.zeros((len(modes), n_modes), dtype=np.float32)
    shapes[:, list(modes)] = amplitude_m * vectors.T
    return shapes


def pokes(mode_to_actuator: Array, amplitude_m: float) -> Array32:
    """Return single actuators, as far as the modes can make them ``(n_actuators, n_modes)``.

    Every shape has the same RMS OPD: the modes are orthonormal over the pupil.
    """
    gram = scipy.linalg.cho_factor(mode_to_actuator.T @ mode_to_actuator)
    shapes = scipy.linalg.cho_solve(gram, mode_to_actuator.T).T
    shapes *= amplitude_m / np.linalg.norm(shapes, axis=1, keepdims=True)
    return np.asarray(shapes, dtype=np.float32)


_SILENT = 1e-6
"""A mode with less than this share of the mean power was not moved: it has no column."""


class Regression:
    """Least squares of slopes on commands: ``D = (sum s c^T) (sum c c^T)^-1``.

    All modes that moved are in the equations, including those that were not requested. A mirror
    that moves otherwise at the same time, like by turbulence that it plays, does not bias the
    columns.
    """

    def __init__(self, modes: tuple[int, ...], *, n_modes: int, n_slopes: int) -> None:
        self.n_slopes = n_slopes
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
            If a requested mode never moved.
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
        # Back from micrometres.
        every[moved] = columns * 1e6
        return np.ascontiguousarray(every[self._modes].T)


class Demodulation:
    """Slopes and commands at every tone's frequency, with the loop closed.

    The loop answers each tone in every mode, so at tone n the slopes are ``D c(f_n)``: as many
    equations as columns. Each is turned to the phase of its own mode's command and its real part
    taken, which is what can be in phase with the known dither (an instrumental variable).
    """

    def __init__(self, tones: Tones, *, n_slopes: int) -> None:
        self.n_slopes = n_slopes
        self._tones = tones
        n = len(tones.modes)
        self._slopes = np.zeros((2 * n, n_slopes), dtype=np.float32)
        self._commands_um = np.zeros((2 * n, n))

    def take(self, frame: NDArray[np.int64], slopes: Array32, commands_m: Array32) -> None:
        """Take consecutive frames."""
        phase = 2 * np.pi * self._tones.cycles_per_frame * frame[:, None]
        # Hann: the leakage of one tone at another falls with the cube of their distance.
        window = np.sin(np.pi * (frame + 0.5) / self._tones.n_frames)[:, None] ** 2
        # Real and imaginary part of exp(-i phase), kept apart because the sums are real products.
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
