"""A bench of 12 subapertures whose four pupil images lie beside the pixel grid.

Displacements of the images are drawn at random, and a matrix of slopes or of detector frames is
measured with an FFT pyramid that shares no code with the model. ``pyrcal_studies.drawn_fits`` fits
such matrices.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.fft_pyramid import DisplacedPyramid
from service.model.instrument import Instrument, Mirror
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, InfluenceShape, KarhunenLoeve, Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis, modal_basis
from service.model.sensors.pyramid.description import Pyramid
from service.model.slopes import Orientation, SlopeRecipe

Array = NDArray[np.float64]

N = 12
SEPARATION = 17.0
WAVELENGTH_M = 750e-9
TRUTH = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.15, rotation_rad=np.deg2rad(0.7), magnification=1.005
)

STROKE_M = 1e-9
"""Stroke of a push and of a pull."""


def bench(stop: Stop) -> Instrument:
    """Return a telescope of 12 subapertures with 13 x 13 Gaussian actuators and 40 modes."""
    side = np.linspace(-2.0, 2.0, N + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    inside = np.hypot(x, y) < 2.2
    return Instrument(
        name="bench",
        diameter_m=4.0,
        obscuration_ratio=0.2,
        stop=stop,
        double_pass=False,
        wfs=Pyramid(
            n_subapertures=N,
            wavelength_m=WAVELENGTH_M,
            modulation_lambda_over_d=3.0,
            pupil_separation_subap=SEPARATION,
        ),
        mirror=Mirror(
            positions_m=np.column_stack([x, y])[inside],
            pitch_m=4.0 / N,
            shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=0.35),
            nominal_rotation_rad=0.0,
            parity=1,
        ),
        modes=KarhunenLoeve(n_modes=40),
        slopes=SlopeRecipe(orientation=Orientation()),
    )


@cache
def basis() -> Basis:
    """Return the modes of the bench."""
    return modal_basis(bench(Stop.MIRROR))


def displacements(seed: int, rms: float = 0.1) -> Array:
    """Return displacements ``(2, 2, 2)`` of mean zero: side along y, side along x, (x, y)."""
    drawn = np.random.default_rng(seed).normal(size=(2, 2, 2))
    drawn -= drawn.mean(axis=(0, 1))
    return np.asarray(drawn * rms / np.sqrt(np.mean(drawn**2)))


def model_of(instrument: Instrument) -> InteractionModel:
    """Return the model whose pupil the FFT pyramid has."""
    return InteractionModel(instrument, basis(), pupil_sampling=4, detector_nodes=3)


def measured(instrument: Instrument, offsets: Array, every: int = 1) -> Array:
    """Return the slopes ``(n_slopes, n_modes)`` of every so many modes at the true registration."""
    model = model_of(instrument)
    pyramid = camera(model, offsets, N)
    shift = _shift(instrument)
    maps = _maps(pyramid, shift + offsets.mean(axis=(0, 1)), every)
    return pyramid.jacobian(maps, model.valid, shift)


def filmed(instrument: Instrument, offsets: Array, every: int) -> tuple[Array, Array]:
    """Return detector frames per metre of every so many modes, and the mean frame."""
    wide = int(SEPARATION)  # the quadrants of the frame touch each other
    pyramid = camera(model_of(instrument), offsets, wide)
    shift = _shift(instrument)
    maps = _maps(pyramid, shift + offsets.mean(axis=(0, 1)), every)
    side = 2 * wide
    rest = pyramid.images(np.zeros_like(maps[0]), shift).reshape(side, side)
    pushed = [
        (pyramid.images(STROKE_M * one, shift) - pyramid.images(-STROKE_M * one, shift))
        / (2 * STROKE_M)
        for one in maps
    ]
    return np.array(pushed).reshape(-1, side, side), rest


def camera(
    model: InteractionModel, offsets: Array, n: int, modulation_lambda_over_d: float = 3.0
) -> DisplacedPyramid:
    """Return the FFT pyramid, each image ``n`` subapertures wide."""
    return DisplacedPyramid(
        amplitude=model.pupil.amplitude,
        sampling=4,
        wavelength_m=WAVELENGTH_M,
        n_subapertures=n,
        image_separation_subap=SEPARATION,
        modulation_lambda_over_d=modulation_lambda_over_d * n / N,
        n_nodes=3,
        padded_subap=6 * N,
        offsets=offsets,
    )


def _shift(instrument: Instrument) -> tuple[float, float]:
    """Return how far the pupil images move with the mirror."""
    x, y = TRUTH.vector[:2] if instrument.stop is Stop.MIRROR else (0.0, 0.0)
    return float(x), float(y)


def _maps(pyramid: DisplacedPyramid, carried: Array, every: int) -> Array:
    """Return the modes ``(n_modes, n, n)``; the mirror moves with the images, α with neither."""
    u = pyramid.coordinates
    points = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    on_mirror = TRUTH.on_mirror(points - (TRUTH.vector[:2] - carried))
    rendered = basis().render(on_mirror)[:, ::every]
    return rendered.T.reshape(-1, len(u), len(u))


def as_told(instrument: Instrument, offsets: Array) -> Instrument:
    """Return the instrument with the places of its images in its file."""
    places = tuple((float(x), float(y)) for x, y in offsets.reshape(4, 2))
    return replace(instrument, wfs=replace(instrument.wfs, image_offsets_subap=places))
