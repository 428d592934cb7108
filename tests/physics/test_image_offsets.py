"""Pupil images beside the pixel grid: the model and the fit against an FFT pyramid.

The reference shares no code with the model. A small bench of 12 subapertures and 40 modes; its
four images are displaced by 0.1 subaperture RMS along either axis.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pyrcal.offline.matrix import FitOptions, fit_matrix
from service.estimation.reference import Reference
from service.model.instrument import Instrument, Mirror
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, InfluenceShape, KarhunenLoeve, Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis, modal_basis
from service.model.sensors.pyramid.description import FrameWindows, Pyramid
from service.model.sensors.pyramid.detector_windows import found_centres, frame_windows
from service.model.slopes import Orientation, SlopeRecipe
from tests.physics.fft_pyramid import DisplacedPyramid

N = 12
SEPARATION = 17.0
TRUTH = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.15, rotation_rad=np.deg2rad(0.7), magnification=1.005
)
RMS = 0.1
TOLERANCE = 0.01
"""Subapertures: what the fit must reach with images 0.1 subaperture off."""


def bench(stop: Stop) -> Instrument:
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
            wavelength_m=750e-9,
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
    return modal_basis(bench(Stop.MIRROR))


def displacements(seed: int, rms: float = RMS) -> np.ndarray:
    """Displacements ``(2, 2, 2)`` of mean zero: side along y, side along x, (x, y)."""
    drawn = np.random.default_rng(seed).normal(size=(2, 2, 2))
    drawn -= drawn.mean(axis=(0, 1))
    return drawn * rms / np.sqrt(np.mean(drawn**2))


def model_of(instrument: Instrument) -> InteractionModel:
    return InteractionModel(instrument, basis(), pupil_sampling=4, detector_nodes=3)


def measured(instrument: Instrument, offsets: np.ndarray) -> np.ndarray:
    """The matrix of the FFT pyramid at the true registration."""
    model = model_of(instrument)
    reference = DisplacedPyramid(
        amplitude=model.pupil.amplitude,
        sampling=4,
        wavelength_m=750e-9,
        n_subapertures=N,
        image_separation_subap=SEPARATION,
        modulation_lambda_over_d=3.0,
        n_nodes=3,
        padded_subap=6 * N,
        offsets=offsets,
    )
    u = reference.coordinates
    points = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    shift = TRUTH.vector[:2] if instrument.stop is Stop.MIRROR else np.zeros(2)
    carried = shift + offsets.mean(axis=(0, 1))  # the mirror moves with the images, α with neither
    on_mirror = TRUTH.on_mirror(points - (TRUTH.vector[:2] - carried))
    maps = basis().render(on_mirror).T.reshape(-1, len(u), len(u))
    return reference.jacobian(maps, model.valid, tuple(shift))


def as_told(instrument: Instrument, offsets: np.ndarray) -> Instrument:
    places = tuple((float(x), float(y)) for x, y in offsets.reshape(4, 2))
    return replace(instrument, wfs=replace(instrument.wfs, image_offsets_subap=places))


@pytest.mark.parametrize("stop", list(Stop))
def test_the_model_with_displaced_images_is_the_fft_pyramid(stop):
    instrument, offsets = bench(stop), displacements(1)
    expected = measured(instrument, offsets)
    left = [
        np.linalg.norm(model_of(about).interaction_matrix(TRUTH) - expected)
        / np.linalg.norm(expected)
        for about in (as_told(instrument, offsets), instrument)
    ]
    assert left[0] < 0.01  # the reference's padding of 72 subapertures leaves 0.5 %
    assert left[1] > 0.05  # and displaced images that nobody mentions ten times as much


@pytest.mark.parametrize("stop", list(Stop))
@pytest.mark.parametrize("told", [True, False], ids=["told", "not told"])
def test_a_fit_is_right_with_images_a_tenth_of_a_subaperture_off(stop, told):
    instrument, offsets = bench(stop), displacements(2)
    matrix = measured(instrument, offsets)
    about = as_told(instrument, offsets) if told else instrument
    fit = fit_matrix(about, Reference(matrix=matrix), FitOptions(), basis=basis())
    error = fit.alpha.vector - TRUTH.vector
    assert fit.accepted
    assert np.all(np.abs(error) < 3.0 * np.sqrt(np.diag(fit.covariance)))
    assert np.abs(error[:2]).max() < TOLERANCE
    assert np.sqrt(np.diag(fit.covariance))[:2].max() < TOLERANCE
    assert (fit.image_offsets_px is None) is told


def test_a_pupil_beside_the_middle_of_the_grid_is_found_with_a_telescope_as_stop():
    instrument = bench(Stop.TELESCOPE)
    offsets = np.broadcast_to([0.3, -0.2], (2, 2, 2)).copy()
    fit = fit_matrix(
        instrument, Reference(matrix=measured(instrument, offsets)), FitOptions(), basis=basis()
    )
    assert fit.accepted
    assert np.all(np.abs(fit.alpha.vector - TRUTH.vector) < 3.0 * np.sqrt(np.diag(fit.covariance)))
    assert fit.image_offsets_px is not None
    assert fit.image_offsets_px.mean(axis=0) == pytest.approx([0.3, -0.2], abs=0.02)


@pytest.mark.parametrize("unevenness", [0.0, 0.3])
def test_centres_in_a_flux_frame_are_found_to_a_hundredth_of_a_pixel(unevenness):
    wide = int(SEPARATION)  # the quadrants of the frame touch each other
    instrument = replace(bench(Stop.TELESCOPE), frames=FrameWindows())
    pupil = model_of(instrument).pupil
    slope = pupil.coordinates / (N / 2)
    light = 1.0 + unevenness * slope + 0.5 * unevenness * slope[:, None] ** 2
    rough, errors = [], []
    for seed in range(3):
        offsets = np.random.default_rng(seed).uniform(-0.5, 0.5, size=(2, 2, 2))
        camera = DisplacedPyramid(
            amplitude=pupil.amplitude * np.sqrt(light),
            sampling=4,
            wavelength_m=750e-9,
            n_subapertures=wide,
            image_separation_subap=SEPARATION,
            modulation_lambda_over_d=3.0 * wide / N,
            n_nodes=3,
            padded_subap=6 * N,
            offsets=offsets,
        )
        frame = camera.images(np.zeros_like(pupil.amplitude)).reshape(2 * wide, 2 * wide)
        sides = np.array([0.0, wide]) + (wide - 1) / 2
        nominal = np.stack(np.meshgrid(sides, sides, indexing="ij"), axis=-1)
        centres = nominal + offsets[..., ::-1]
        rough.append(found_centres(frame, float(N)) - centres)
        errors.append(frame_windows(instrument, frame).centres_px - centres)
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert np.abs(errors).max() < 0.03
    assert np.sqrt(np.mean(np.square(rough))) > 0.03  # which the middle of what is lit is not
