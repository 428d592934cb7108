"""OOPAO model of a bench, with the values that a fit of its interaction matrix found.

``make_model()`` returns OOPAO's telescope, source, deformable mirror and pyramid. ``MODES`` are the
commands of the bench's modes, and ``list_signals(sensor.signal)`` lists signals as the bench does.
``python FILE matrix.npz [MODE ...]`` measures the interaction matrix. Needs OOPAO and NumPy.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from OOPAO.DeformableMirror import DeformableMirror
from OOPAO.MisRegistration import MisRegistration
from OOPAO.Pyramid import Pyramid
from OOPAO.Source import Source
from OOPAO.Telescope import Telescope

BENCH = ""
RESOLUTION = 0
"""Points across the pupil's array."""

WIDTH_M = 0.0
"""Width of the pupil's array, metres."""

WAVELENGTH_M = 0.0
N_PIXELS = 0
"""Detector pixels across the pupil's array."""

N_PIX_SEPARATION = 0.0
N_PIX_EDGE = 0.0
POST_PROCESSING = ""
MODULATION = 0.0
"""Radius of the modulation in OOPAO's unit; the longer semi-axis of an ellipse."""

ELLIPSE: tuple[float, float, float] | None = None
"""Semi-axes in the same unit, and degrees from +x to the first one; None for a circle."""

ROOFTOP = 0.0
"""Rooftop in OOPAO's unit."""

SHIFT_X = [0.0, 0.0, 0.0, 0.0]
SHIFT_Y = [0.0, 0.0, 0.0, 0.0]
"""Arguments of ``apply_shift_wfs``, pixels: the faces of the pyramid, +y against the rows."""

SIGN = 0
"""Sign of the mirror: OOPAO's slopes have the other sign than those of the bench, or the same."""

COUPLING: float | None = None
"""Height of a Gaussian influence function at one pitch; None if functions are given."""

PITCH_M = 0.0
MISREGISTRATION: dict[str, float] = {}
"""Attributes of OOPAO's ``MisRegistration``; empty if the given functions are registered."""

SHAPE: tuple[int, ...] = ()
"""Shape of the bench's signals: slopes, or rows and columns of its frames."""

ARRAYS = dict(np.load(Path(__file__).with_suffix(".npz")))
MODES = ARRAYS["mode_to_actuator"]
"""``(n_actuators, n_modes)`` coefficients of the mirror, metres, for a unit of the bench."""

ABERRATION_M = ARRAYS.get("aberration_m", np.zeros((RESOLUTION, RESOLUTION)))
"""OPD of the static aberration with which the matrix was measured, metres."""


def make_model(*, sky: bool = False) -> tuple[Telescope, Source, DeformableMirror, Pyramid]:
    """Return the telescope, its source, the mirror and the sensor.

    ``sky`` takes the pupil of the sky, where the bench has another one than for calibrations.
    """
    amplitude = ARRAYS["sky_amplitude" if sky else "amplitude"]
    telescope = Telescope(
        resolution=RESOLUTION,
        diameter=WIDTH_M,
        pupil=amplitude > 0.0,
        pupilReflectivity=amplitude**2,
    )
    star = Source(optBand="R", magnitude=0)
    star.wavelength = WAVELENGTH_M
    star**telescope
    sensor = Pyramid(
        nSubap=N_PIXELS,
        telescope=telescope,
        modulation=MODULATION,
        lightRatio=0.0,
        postProcessing=POST_PROCESSING,
        n_pix_separation=N_PIX_SEPARATION,
        n_pix_edge=N_PIX_EDGE,
        userValidSignal=ARRAYS["valid"],
        rooftop=ROOFTOP,
        user_modulation_path=None if ELLIPSE is None else make_path(*ELLIPSE),
    )
    if any(SHIFT_X) or any(SHIFT_Y):
        sensor.apply_shift_wfs(sx=SHIFT_X, sy=SHIFT_Y)
    return telescope, star, make_mirror(telescope), sensor


def make_mirror(telescope: Telescope) -> DeformableMirror:
    """Return the mirror with its registration: Gaussian functions, or those in the arrays."""
    if COUPLING is None:
        return DeformableMirror(
            telescope=telescope, nSubap=N_PIXELS, modes=ARRAYS["functions"], sign=SIGN
        )
    moved = MisRegistration()
    for name, value in MISREGISTRATION.items():
        setattr(moved, name, value)
    return DeformableMirror(
        telescope=telescope,
        nSubap=N_PIXELS,
        coordinates=ARRAYS["coordinates"],
        pitch=PITCH_M,
        mechCoupling=COUPLING,
        misReg=moved,
        sign=SIGN,
    )


def make_path(first: float, second: float, angle_deg: float) -> list[list[float]]:
    """Return points on an ellipse, as many as OOPAO takes on the circle of its longer axis."""
    n_points = 4 * int(np.ceil(2 * np.pi * max(first, second) / 4))
    t = 2 * np.pi * np.arange(n_points) / n_points
    path = np.exp(1j * np.deg2rad(angle_deg)) * (first * np.cos(t) + 1j * second * np.sin(t))
    return [[float(point.real), float(point.imag)] for point in path]


def list_signals(signal: np.ndarray) -> np.ndarray:
    """Return a signal of the sensor in the order and with the signs of the bench."""
    listed = ARRAYS["signal_sign"] * signal[ARRAYS["signal_index"]]
    return np.reshape(listed, SHAPE)


def measure_matrix(modes: list[int], stroke_m: float = 1e-9) -> tuple[np.ndarray, np.ndarray]:
    """Return signals per unit command, one mode after the other, and the signal without one."""
    _, star, mirror, sensor = make_model()
    sensor.compute_focal_plane = False
    lit = ARRAYS["amplitude"].ravel() > 0.0
    radians = 2 * np.pi / star.wavelength
    sensor.wfs_measure(phase_in=radians * ABERRATION_M)
    reference = np.ravel(sensor.referenceSignal) + sensor.signal
    found = []
    for shape in (mirror.modes @ MODES[:, modes]).T:
        stroke = stroke_m / np.std(shape[lit])
        push_m = stroke * shape.reshape(RESOLUTION, RESOLUTION)
        both = []
        for sign in (1, -1):
            sensor.wfs_measure(phase_in=radians * (ABERRATION_M + sign * push_m))
            both.append(np.array(sensor.signal, dtype=float))
        found.append(list_signals(both[0] - both[1]) / (2 * stroke))
    return np.array(found), list_signals(reference)


if __name__ == "__main__":
    numbers = [int(mode) for mode in sys.argv[2:]] or list(range(MODES.shape[1]))
    matrix, reference = measure_matrix(numbers)
    np.savez(sys.argv[1], matrix=matrix, reference=reference)
