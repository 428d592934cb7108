"""What optics alone let one know of a registration."""

import numpy as np
import pytest

import pyrcal
from pyrcal.fitting.design import dither_sigma, interaction_matrix
from service.errors import ModelError
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration

INSTRUMENT = load_instrument("tests/system/small.toml")
MODES = (40, 52, 60, 71)
A_M, N, NOISE = 20e-9, 1000, 0.02


@pytest.fixture(scope="module")
def near():
    model = RtcInteractionModel(INSTRUMENT, pyrcal.modal_basis(INSTRUMENT))
    return model.linearise(Misregistration(shift_x_subap=0.1))


def test_d_is_that_of_the_model():
    alpha = Misregistration(shift_x_subap=0.1, rotation_rad=0.01)
    model = RtcInteractionModel(INSTRUMENT, pyrcal.modal_basis(INSTRUMENT))
    found = interaction_matrix(INSTRUMENT, alpha)
    np.testing.assert_array_equal(found, model.interaction_matrix(alpha).astype(np.float32))
    assert found.shape == (224, 90)


def test_sigma_is_what_fits_of_noisy_columns_scatter_by(near):
    """Sines are read from white noise, then α and a gain of each mode are fitted to the columns."""
    rng, t, found = np.random.default_rng(1), np.arange(N), []
    columns = near.matrix[:, MODES].astype(float)
    sines = np.sqrt(2.0) * A_M * np.sin(2 * np.pi * np.outer(t, [0.21, 0.25, 0.29, 0.33]))
    rates = near.derivatives[:, :, MODES].astype(float).reshape(4, -1).T
    gains = np.zeros((columns.size, 4))
    for k in range(4):
        gains.reshape(-1, 4, 4)[:, k, k] = columns[:, k]
    design = np.hstack([rates, gains])
    for _ in range(200):
        slopes = sines @ columns.T + NOISE * rng.normal(size=(N, len(columns)))
        read = np.linalg.lstsq(sines, slopes, rcond=None)[0].T
        found.append(np.linalg.lstsq(design, (read - columns).ravel(), rcond=None)[0][:4])
    sigma = dither_sigma(near, MODES, A_M, N, NOISE)
    # 200 trials tell a scatter to 5 %, 1 σ
    np.testing.assert_allclose(np.std(found, axis=0), sigma, rtol=0.15)
    assert np.all(np.abs(np.mean(found, axis=0)) < 4.0 * sigma / np.sqrt(200))


def test_it_falls_with_amplitude_and_the_root_of_time_and_rises_with_noise(near):
    one = dither_sigma(near, MODES, A_M, N, NOISE)
    np.testing.assert_allclose(dither_sigma(near, MODES, 2 * A_M, N, NOISE), one / 2)
    np.testing.assert_allclose(dither_sigma(near, MODES, A_M, 4 * N, NOISE), one / 2)
    np.testing.assert_allclose(dither_sigma(near, MODES, A_M, N, 3 * NOISE), 3 * one)


@pytest.mark.parametrize(
    ("modes", "numbers", "text"),
    [
        ((40, 90), (A_M, N, NOISE), r"found \[90\], expected some of 0 to 89"),
        ((), (A_M, N, NOISE), "found none"),
        (MODES, (0.0, N, NOISE), "an amplitude of 0 m"),
        (MODES, (A_M, N, -1.0), "a noise of -1"),
    ],
)
def test_what_makes_no_sense_is_refused(near, modes, numbers, text):
    with pytest.raises(ModelError, match=text):
        dither_sigma(near, modes, *numbers)
