from dataclasses import replace

import numpy as np
import pytest

from service.model.kinds import SlopeOrder
from service.model.slopes import SlopeRecipe
from sim_rtc.telescope.detector import (
    Camera,
    Detector,
    PixelDetector,
)

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


# --- pixels


N_DRAWS = 40_000


@pytest.mark.parametrize("electrons", [0.0, 0.3, 3.0, 25.0, 60.0, 500.0])
@pytest.mark.parametrize("excess", [1.0, 2.0])
def test_counts_have_the_mean_and_variance_of_photons_and_reading(electrons, excess):
    camera = Camera(read_noise_electrons=2.0, excess_noise=excess)
    detector = PixelDetector(electrons_per_light=10.0, camera=camera)
    light = np.full(N_DRAWS, electrons / 10.0, dtype=np.float32)
    read = detector.read(light, np.random.default_rng(1)).astype(np.float64)
    variance = excess * electrons + 4.0
    assert read.mean() == pytest.approx(electrons, abs=4 * np.sqrt(variance / N_DRAWS))
    # 4 σ of a variance; few photons have heavier tails than a normal law.
    assert read.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / N_DRAWS) * (1 + excess))


def test_bright_and_dark_pixels_of_one_frame_each_get_their_own_noise():
    detector = PixelDetector(electrons_per_light=1.0, camera=Camera(read_noise_electrons=0.0))
    light = np.tile(np.array([1.0, 1000.0], dtype=np.float32), (N_DRAWS, 1))
    read = detector.read(light, np.random.default_rng(2))
    assert set(np.unique(read[:, 0])) <= set(range(20))
    assert read[:, 1].std() == pytest.approx(np.sqrt(1000.0), rel=0.02)


def test_light_is_left_as_it_was():
    light = np.full((2, 3), 5.0, dtype=np.float32)
    PixelDetector(electrons_per_light=1.0).read(light, np.random.default_rng(3))
    np.testing.assert_array_equal(light, 5.0)


def test_five_magnitudes_are_a_factor_of_a_hundred(small_instrument):
    bright, faint = (
        Camera().electrons_per_frame(small_instrument, magnitude=m, frame_rate_hz=500.0)
        for m in (5.0, 10.0)
    )
    assert bright / faint == pytest.approx(100.0)
