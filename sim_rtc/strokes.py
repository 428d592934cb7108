"""What a measurement of the interaction matrix puts on the mirror, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh, hadamard

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
    """Of the whole basis."""

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
    signs = hadamard(hadamard_order(len(modes)))[:, : len(modes)]
    return np.asarray(signs @ modal(modes, amplitude_m, n_modes), dtype=np.float32)


def system_shapes(
    reconstructor: Array32, modes: tuple[int, ...], amplitude_m: float, n_modes: int
) -> Array32:
    """Return the eigenmodes of what the loop corrects with, each of this RMS OPD.

    ``reconstructor`` is ``(n_controlled, n_slopes)``. Its left singular vectors make slopes that
    are orthogonal to one another, so none is mistaken for a mixture of the others.
    """
    rows = reconstructor[list(modes)].astype(np.float64)
    _, vectors = eigh(rows @ rows.T)
    shapes = np.zeros((len(modes), n_modes), dtype=np.float32)
    shapes[:, list(modes)] = amplitude_m * vectors.T
    return shapes


def pokes(mode_to_actuator: Array, amplitude_m: float) -> Array32:
    """Return single actuators, as far as the modes can make them ``(n_actuators, n_modes)``.

    Every shape has the same RMS OPD: the modes are orthonormal over the pupil.
    """
    gram = cho_factor(mode_to_actuator.T @ mode_to_actuator)
    shapes = cho_solve(gram, mode_to_actuator.T).T
    shapes *= amplitude_m / np.linalg.norm(shapes, axis=1, keepdims=True)
    return np.asarray(shapes, dtype=np.float32)
