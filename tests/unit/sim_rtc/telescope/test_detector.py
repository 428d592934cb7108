from dataclasses import replace

import numpy as np
import pytest

from service.model.kinds import SlopeOrder
from service.model.slopes import SlopeRecipe
from sim_rtc.telescope.detector import Camera, Detector

N = 10


@pytest.fixture
def light():
    """Images four of whose hundred subapertures are dim, and the mask of those that count."""
    images = np.ones((2, N, 2, N))
    images[:, 0, :, :4] = 0.5
    valid = np.ones((N, N), dtype=bool)
    valid[-1] = False
    return images / images.sum(), valid


def detector(instrument, light, magnitude, **camera):
    images, valid = light
    return Detector(
        instrument,
        images=images,
        valid=valid,
        magnitude=magnitude,
        frame_rate_hz=1000.0,
        camera=Camera(**camera),
    )


def test_photons_follow_the_magnitude_and_the_pupil(small_instrument, light):
    bright = detector(small_instrument, light, 0.0)
    # 2.1e10 photons / (s m²) x 0.25 x 52.4 m² x 1 ms.
    assert bright.electrons_per_frame == pytest.approx(2.75e8, rel=0.01)
    faint = detector(small_instrument, light, 5.0)
    assert faint.electrons_per_frame == pytest.approx(bright.electrons_per_frame / 100)


def test_noise_is_that_of_photons_and_four_reads(small_instrument, light):
    made = detector(small_instrument, light, 8.0, read_noise_electrons=3.0)
    images, valid = light
    own = (images.sum(axis=(0, 2)) * made.electrons_per_frame)[valid]
    expected = np.sqrt(own + 4 * 9.0) / own.mean()
    np.testing.assert_allclose(made.sigma[: len(own)], expected, rtol=1e-6)
    np.testing.assert_allclose(made.sigma[len(own) :], expected, rtol=1e-6)


def test_noise_has_its_sigma_and_nothing_in_common_between_slopes(small_instrument, light):
    made = detector(small_instrument, light, 9.0)
    noise = made.noise(20_000, np.random.default_rng(1))
    # 4 standard errors of an RMS over 20 000 frames.
    np.testing.assert_allclose(noise.std(axis=0), made.sigma, rtol=4 / np.sqrt(40_000))
    correlation = np.corrcoef(noise[:, 0], noise[:, noise.shape[1] // 2])[0, 1]
    assert abs(correlation) < 4 / np.sqrt(20_000)


def test_counts_keep_the_place_of_the_images(small_instrument, light):
    images, _ = light
    images = images.copy()
    images[0, :, 1] *= 2
    flux = detector(small_instrument, light, 8.0).flux(images)
    counts = np.frombuffer(flux, "<f4").reshape(4, N, N)
    assert counts[1].sum() == pytest.approx(2 * counts[0].sum(), rel=1e-5)


def test_the_noise_of_pixels_is_each_pixels_own_and_makes_that_of_slopes(small_instrument, light):
    pixels = replace(small_instrument, slopes=SlopeRecipe(order=SlopeOrder.IMAGES))
    made = detector(pixels, light, 8.0, read_noise_electrons=3.0)
    slopes = detector(small_instrument, light, 8.0, read_noise_electrons=3.0)
    images, valid = light
    own = images.sum(axis=(0, 2))[valid].mean()
    first = images[0, :, 0][valid] * made.electrons_per_frame
    expected = np.sqrt(first + 9.0) / (own * made.electrons_per_frame)
    np.testing.assert_allclose(made.sigma[: len(first)], expected, rtol=1e-6)
    variance = (made.sigma.reshape(4, -1) ** 2).sum(axis=0)
    np.testing.assert_allclose(variance, slopes.sigma[: len(first)] ** 2, rtol=1e-5)
