from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.heritier2018.loops import (
    FIELD,
    H_BAND_M,
    OVERSAMPLING,
    Camera,
    strehl,
)
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import SETS
from tests.support.numerics import small_basis, small_instrument


@pytest.fixture(scope="module")
def plant() -> DiffractivePlant:
    return DiffractivePlant(
        small_instrument(),
        small_basis(),
        rng=np.random.default_rng(1),
        imperfections=SETS["ideal"],
    )


def test_a_flat_wavefront_is_perfect(plant: DiffractivePlant) -> None:
    image = Camera(plant).image(np.zeros((2, len(plant.points_m))))
    assert strehl(image) == pytest.approx(1.0)
    assert np.unravel_index(image.argmax(), image.shape) == (FIELD // 2, FIELD // 2)


def test_a_tilt_of_one_wavelength_across_the_pupil_moves_the_image_by_lambda_over_d(
    plant: DiffractivePlant,
) -> None:
    x = plant.points_m[:, 0]
    diameter = plant.pitch_m * (np.ptp(x) / plant.pitch_m + 1)
    image = Camera(plant).image(H_BAND_M * x[None, :] / diameter)
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert row == FIELD // 2
    # the padded size is the next one that is quick to transform: within a sample
    assert column - FIELD // 2 == pytest.approx(OVERSAMPLING, abs=1)


def test_a_small_error_costs_what_marechal_says(plant: DiffractivePlant) -> None:
    rng = np.random.default_rng(2)
    residual = 50e-9 * rng.standard_normal((40, len(plant.points_m)))
    residual -= (residual @ plant.weights)[:, None]
    rms_nm = 1e9 * np.sqrt(np.mean(residual**2 @ plant.weights))
    found = strehl(Camera(plant).image(residual))
    marechal = np.exp(-((2e-9 * np.pi / H_BAND_M * rms_nm) ** 2))
    assert found == pytest.approx(marechal, abs=2e-3)
