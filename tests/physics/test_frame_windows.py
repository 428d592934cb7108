"""Full detector frames of an FFT pyramid, cut into four sub-pixel windows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pyrcal_studies.fft_pyramid import FftPyramid
from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.kinds import Normalisation
from service.model.misregistration import Misregistration
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows
from service.model.sensors.pyramid.detector_windows import (
    frame_windows,
    slopes_from_frames,
    slopes_per_unit,
)
from service.model.slopes import SlopeRecipe
from tests.support.numerics import small_basis, small_instrument

SEPARATION_SUBAP = 18
N = 12
"""Subapertures across."""

SAMPLING = 4
"""Pupil points per subaperture."""

OFFSETS_SUBAP = np.array([[0.37, -0.21], [-0.44, 0.13], [0.08, 0.49], [-0.29, -0.35]])
"""Of the four images from a rectangle, rows and columns: -y -x, -y +x, +y -x, +y +x."""

MODES = [0, 39]
STROKE_M = 1e-9


def instrument(pixels=1, offsets=OFFSETS_SUBAP, normalisation=Normalisation.GLOBAL):
    small = small_instrument()
    side = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    centres = pixels * (SEPARATION_SUBAP * (side + 0.5) + offsets) - 0.5
    return replace(
        small,
        wfs=replace(small.wfs, pupil_separation_subap=float(SEPARATION_SUBAP)),
        frames=FrameWindows(centres_px=centres, pixels_per_subaperture=pixels),
        slopes=SlopeRecipe(normalisation=normalisation),
    )


class Camera:
    """An FFT pyramid with windows as wide as the distance of the images: together, a frame.

    Its unit of length is a pixel. Each of the four images is moved by an offset of its own.
    """

    def __init__(self, pixels, width_subap=SEPARATION_SUBAP, offsets=OFFSETS_SUBAP):
        self.model = InteractionModel(instrument(pixels), small_basis(), pupil_sampling=SAMPLING)
        self.offsets_px = offsets * pixels
        self.sensor = FftPyramid(
            amplitude=self.model.pupil.amplitude,
            sampling=SAMPLING // pixels,
            wavelength_m=750e-9,
            n_subapertures=width_subap * pixels,
            image_separation_subap=SEPARATION_SUBAP * pixels,
            modulation_lambda_over_d=3.0 * width_subap / N,
            padded_subap=64 * pixels,
            n_nodes=2,
        )

    def images(self, opd_m):
        """``(2, width, 2, width)`` pixels."""
        width = self.sensor.n_subapertures
        images = np.empty((2, width, 2, width))
        seen = {at: self.sensor.images(opd_m, at) for at in {(x, y) for y, x in self.offsets_px}}
        for place, (row, column) in enumerate(self.offsets_px):
            y, x = divmod(place, 2)
            images[y, :, x] = seen[column, row][y, :, x]
        return images

    def differential(self):
        """``(n_modes, 2, width, 2, width)`` per metre, push-pull."""
        maps = np.zeros((len(MODES), *self.model.pupil.amplitude.shape))
        shapes = small_basis().render(self.model.pupil.points)[:, MODES]
        maps[:, self.model.pupil.lit] = STROKE_M * shapes.T
        return np.array([self.images(m) - self.images(-m) for m in maps]) / (2 * STROKE_M)

    def rest(self):
        return self.images(np.zeros_like(self.model.pupil.amplitude))


def binned(images, pixels):
    """Whole pixels added up to subapertures."""
    shape = (*images.shape[:-4], 2, N, pixels, 2, N, pixels)
    return images.reshape(shape).sum(axis=(-4, -1))


@cache
def filmed(pixels):
    """Mean and differential frames ``(..., 2 * width, 2 * width)``."""
    camera = Camera(pixels)
    side = 2 * camera.sensor.n_subapertures
    return camera.rest().reshape(side, side), camera.differential().reshape(-1, side, side)


@cache
def exact(pixels):
    """What the windows should hold: the same pyramid with the pixels where they ought to be."""
    camera = Camera(pixels, width_subap=N, offsets=np.zeros((4, 2)))
    return binned(camera.rest(), pixels), binned(camera.differential(), pixels)


def relative(found, expected):
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("normalisation", Normalisation)
@pytest.mark.parametrize(("pixels", "allowed"), [(1, 0.06), (2, 0.005)])
def test_slopes_from_frames_are_those_of_pixels_in_the_right_place(pixels, allowed, normalisation):
    """One pixel per subaperture undersamples the light of modes as fine as these: 3 % of the
    matrix, 5 % with local normalisation. With two it is 0.3 %.
    """
    bench = instrument(pixels, normalisation=normalisation)
    rest, differential = filmed(pixels)
    found = slopes_from_frames(bench, differential, rest)
    valid = rtc_valid_subapertures(bench)
    expected = slopes_per_unit(*exact(pixels), valid, bench.slopes)
    assert relative(found, expected) < allowed


@pytest.mark.parametrize("normalisation", Normalisation)
def test_they_have_the_sign_order_and_scale_of_the_models_matrix(normalisation):
    """1.5 %: the light that so small an FFT wraps around."""
    bench = instrument(2, normalisation=normalisation)
    rest, differential = filmed(2)
    model = InteractionModel(bench, small_basis(), pupil_sampling=SAMPLING, detector_nodes=3)
    expected = model.interaction_matrix(Misregistration())[:, MODES]
    assert relative(slopes_from_frames(bench, differential, rest), expected) < 0.015


@pytest.mark.parametrize("pixels", [1, 2])
def test_images_are_found_in_the_light_to_a_tenth_of_a_pixel(pixels):
    rest, _ = filmed(pixels)
    bench = instrument(pixels)
    unknown = replace(bench, frames=replace(bench.frames, centres_px=None))
    found = frame_windows(unknown, rest).centres_px.reshape(4, 2)
    np.testing.assert_allclose(found, bench.frames.centres_px, atol=0.1)


def test_frames_over_their_sum_need_no_mean_frame():
    """The model's own light stands in for it, to a factor of 0.995: some light falls beside this
    detector, or is wrapped around by so small an FFT.
    """
    camera = Camera(2, offsets=np.zeros((4, 2)))
    side = 2 * camera.sensor.n_subapertures
    rest, differential = (
        images.reshape(-1, side, side) for images in (camera.rest(), camera.differential())
    )
    bench = instrument(2, offsets=np.zeros((4, 2)))
    expected = slopes_from_frames(bench, differential, rest[0])
    found = slopes_from_frames(bench, differential / rest.sum(), None)
    assert relative(found, expected) < 0.01
    with pytest.raises(ModelError, match="neither a mean frame nor"):
        slopes_from_frames(replace(bench, frames=FrameWindows()), differential, None)
