"""Windows cut out of full frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.model.kinds import Normalisation, Stop
from service.model.sensors.pyramid.description import FrameWindows, by_quadrant
from service.model.sensors.pyramid.detector_windows import (
    found_centres,
    frame_windows,
    locate_images,
    slopes_from_frames,
    slopes_per_unit,
)
from service.model.slopes import SlopeRecipe
from tests.support.discs import four_discs
from tests.support.numerics import small_instrument

RECTANGLE = np.array([[14.0, 15.0], [14.0, 45.0], [44.0, 15.0], [44.0, 45.0]])


def bench(centres, pixels=2):
    return replace(
        small_instrument(),
        frames=FrameWindows(centres_px=np.array(centres), pixels_per_subaperture=pixels),
    )


def smooth(shape=(60, 62)):
    """The light of a pixel of ``1.5 + cos`` in both directions, integrated over it."""

    def axis(n, period):
        k = 2 * np.pi / period
        edge = np.arange(n + 1) - 0.5
        return np.diff(1.5 * edge + np.sin(k * edge) / k)

    return np.outer(axis(shape[0], 11.0), axis(shape[1], 13.0))


def integral(low, high, period):
    k = 2 * np.pi / period
    return 1.5 * (high - low) + (np.sin(k * high) - np.sin(k * low)) / k


def test_windows_between_pixels_hold_the_integral_of_the_light():
    """1e-4 of what a spline through the running sum leaves at 11 pixels per period."""
    centres = RECTANGLE + np.array([[0.31, -0.17], [0.5, 0.0], [-0.44, 0.29], [0.08, 0.61]])
    images = frame_windows(bench(centres), smooth()).cut(smooth())
    for place, (row, column) in enumerate(centres):
        y, x = divmod(place, 2)
        rows = row + (np.arange(13) - 6) * 2
        columns = column + (np.arange(13) - 6) * 2
        expected = np.outer(
            integral(rows[:-1], rows[1:], 11.0), integral(columns[:-1], columns[1:], 13.0)
        )
        np.testing.assert_allclose(images[y, :, x], expected, rtol=1e-4)


def test_windows_on_whole_pixels_are_sums_of_pixels():
    frame = np.random.default_rng(2).normal(10.0, 1.0, (60, 62))
    images = frame_windows(bench(RECTANGLE + 0.5), frame).cut(frame)
    first = frame[3:27, 4:28].reshape(12, 2, 12, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(images[0, :, 0], first, rtol=1e-9)


def test_light_is_neither_lost_nor_counted_twice():
    """A star of one pixel well inside the window, wherever the window starts."""
    frame = np.zeros((60, 62))
    frame[14, 15] = 7.0
    for shift in np.linspace(0, 1, 7):
        images = frame_windows(bench(RECTANGLE + shift), frame).cut(frame)
        assert images[0, :, 0].sum() == pytest.approx(7.0, rel=1e-3)


def test_the_order_of_the_centres_does_not_matter():
    frame = np.random.default_rng(3).normal(10.0, 1.0, (60, 62))
    images = frame_windows(bench(RECTANGLE), frame).cut(frame)
    for order in ([3, 1, 0, 2], [2, 0, 3, 1]):
        again = frame_windows(bench(RECTANGLE[order]), frame).cut(frame)
        np.testing.assert_array_equal(again, images)


def test_centres_that_are_not_one_in_each_quadrant_are_refused():
    with pytest.raises(ModelError, match="expected one in each quadrant"):
        by_quadrant(np.array([[0.0, 0.0], [0.0, 1.0], [0.1, 9.0], [9.0, 9.0]]))


def test_a_window_that_leaves_the_frame_is_refused():
    with pytest.raises(ModelError, match="24 columns around 11, which leaves the frame of 62"):
        frame_windows(bench(RECTANGLE - [0, 4.0]), smooth())


def test_frames_of_another_shape_are_refused():
    windows = frame_windows(bench(RECTANGLE), smooth())
    with pytest.raises(ModelError, match=r"found \(61, 62\) pixels, expected \(60, 62\)"):
        windows.cut(np.ones((3, 61, 62)))
    with pytest.raises(ModelError, match=r"found shape \(60, 62\)"):
        slopes_from_frames(bench(RECTANGLE), smooth(), smooth())


def test_an_instrument_that_delivers_slopes_has_no_windows():
    with pytest.raises(ModelError, match="expected frames"):
        frame_windows(small_instrument(), smooth())


@pytest.mark.parametrize("normalisation", Normalisation)
def test_slopes_are_the_derivative_of_what_the_light_gives(normalisation):
    """Against a small step, flux included: second order in 1e-6."""
    rng = np.random.default_rng(4)
    rest, change = rng.uniform(5, 9, (2, 3, 2, 3)), rng.normal(size=(2, 3, 2, 3))
    valid = np.array([[1, 0, 1], [1, 1, 1], [0, 1, 1]], bool)

    def slopes(images):
        flux = images.sum(axis=(0, 2))
        flux = flux if normalisation is Normalisation.LOCAL else np.full((3, 3), flux[valid].mean())
        by_x, by_y = images.sum(axis=0), images.sum(axis=2)
        x, y = (by_x[:, 0] - by_x[:, 1]) / flux, (by_y[0] - by_y[1]) / flux
        return np.concatenate([x[valid], y[valid]])

    step = 1e-6
    expected = (slopes(rest + step * change) - slopes(rest - step * change)) / (2 * step)
    found = slopes_per_unit(rest, change[None], valid, SlopeRecipe(normalisation=normalisation))
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-6)


def test_a_dark_subaperture_is_refused_where_each_is_divided_by_its_own_light():
    rest = np.ones((2, 3, 2, 3))
    rest[:, 1, :, 1] = 0.0
    valid = np.ones((3, 3), bool)
    with pytest.raises(ModelError, match="found 0 counts in a valid subaperture"):
        slopes_per_unit(rest, rest[None], valid, SlopeRecipe(normalisation=Normalisation.LOCAL))
    slopes_per_unit(rest, rest[None], valid, SlopeRecipe())


def discs(centres, diameter, shape=(200, 210), fringes=0.0):
    """Grey discs with an obscured middle, spiders and fringes."""
    fine = 5
    line = [(np.arange(n * fine) - (fine - 1) / 2) / fine for n in shape]
    y, x = np.meshgrid(*line, indexing="ij")
    light = np.zeros_like(x)
    for row, column in centres:
        radius = np.hypot(y - row, x - column)
        spider = (np.abs(y - row) < 0.6) | (np.abs(x - column) < 0.6)
        inside = (radius < diameter / 2) & (radius > 0.11 * diameter) & ~spider
        light += inside * (1 + fringes * np.cos(0.4 * (x - column) + 0.3 * (y - row)))
    return light.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))


@pytest.mark.parametrize("fringes", [0.0, 0.3])
def test_pupils_of_74_pixels_34_pixels_off_a_rectangle_are_found(fringes):
    """To 0.02 pixel, spiders and 30 % of fringes notwithstanding; each light its own."""
    centres = np.array([[52.3, 51.1], [49.6, 152.4], [148.9, 54.5], [151.7, 149.0]])
    counts = 800 * discs(centres, 74.0, fringes=fringes)
    counts *= np.where(np.arange(210) < 100, 1.0, 0.8)
    found = found_centres(counts, 74.0).reshape(4, 2)
    np.testing.assert_allclose(found, centres, atol=0.02)


def test_pupils_of_another_size_are_refused():
    with pytest.raises(ModelError, match=r"as large as a disc of 7\d.*; expected four pupil .* 60"):
        found_centres(discs(RECTANGLE * 3.3, 74.0), 60.0)


def test_centres_half_a_subaperture_beside_the_light_are_said():
    """Slopes of such windows look like another instrument's."""
    about = bench(RECTANGLE)
    light = four_discs(60, RECTANGLE, about.wfs.pupil_diameter * 2)
    assert locate_images(about, light)[1] == ()
    moved = replace(bench(RECTANGLE + np.array([1.0, 0.0])), stop=Stop.TELESCOPE)
    (remark,) = locate_images(moved, light)[1]
    assert "up to 0.5" in remark
    assert "[14.0" in remark
    assert locate_images(replace(moved, stop=Stop.MIRROR), light)[1] == ()


def test_the_place_of_the_images_is_as_unsure_as_centres_in_the_file_are_beside_the_light():
    about = replace(bench(RECTANGLE + np.array([0.3, -0.1])), stop=Stop.TELESCOPE)
    light = four_discs(60, RECTANGLE, about.wfs.pupil_diameter * 2)
    assert locate_images(about, light)[2] == pytest.approx(0.3 / 2, abs=0.01)
    assert locate_images(replace(about, stop=Stop.MIRROR), light)[2] == 0.0


def test_uneven_light_makes_the_place_of_the_images_unsure():
    about = bench(RECTANGLE)
    light = four_discs(60, RECTANGLE, about.wfs.pupil_diameter * 2)
    assert locate_images(about, light)[2] == 0.0
    across = np.linspace(0.0, 3.0, 60) % 1.5  # brighter to the right in each image
    sigma = locate_images(about, light * (0.3 + across))[2]
    found = found_centres(light * (0.3 + across), about.wfs.pupil_diameter * 2).reshape(4, 2)
    error = np.hypot(*np.mean(found - RECTANGLE, axis=0)) / 2
    assert error / 3.0 < sigma < 3.0 * error
