"""Modulations down to none are fitted, to matrices of an FFT pyramid that is not the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.models import LOGARITHM_ABOVE, moved_sensor_number, sensor_coordinate
from pyrcal_studies.drawn_fits import Condition, Draw, instrument_of
from pyrcal_studies.drawn_fits import measured as drawn_matrices
from service.estimation.reference import Reference

KEY = "modulation_lambda_over_d"


def fitted(true, stated):
    """The fit of a matrix of the FFT pyramid, the error of α, and the modulation with its σ."""
    draw = Draw(code="fft", condition=Condition(modulation_lambda_over_d=true), seed=3)
    ((_, measured),) = drawn_matrices([draw])
    about = instrument_of(draw, measured)
    wfs = replace(about.wfs, **{KEY: 3.0 if stated is None else stated})
    unknown = (f"wfs.{KEY}",) if stated is None else ()
    found = fit_matrix(
        replace(about, wfs=wfs, unknown=unknown), Reference(matrix=measured.matrix), FitOptions()
    )
    (modulation,) = (one for one in found.optics if one.key == KEY)
    return found, found.alpha.vector - draw.alpha.vector, modulation


@pytest.mark.parametrize(
    ("true", "stated"),
    [(0.0, None), (0.5, None), (0.5, 0.0), pytest.param(0.0, 0.0, marks=pytest.mark.long)],
)
def test_a_modulation_below_one_is_found_whatever_the_file_says(true, stated):
    found, error, modulation = fitted(true, stated)
    assert found.accepted
    assert np.all(np.abs(error) < 3.0 * found.sigma)
    assert np.all(np.abs(error) < [0.003, 0.003, np.deg2rad(0.02), 0.003])
    assert modulation.found == pytest.approx(true, abs=0.15)
    assert 0.0 < modulation.found_sigma < 0.2


def test_a_stated_modulation_of_none_is_questioned():
    found, error, modulation = fitted(3.0, 0.0)
    assert modulation.found == pytest.approx(3.0, rel=0.03)
    assert np.all(np.abs(error) < [0.003, 0.003, np.deg2rad(0.02), 0.003])
    assert f"{KEY} = 3" in found.recommendation


def test_the_coordinate_is_the_logarithm_or_the_square_and_ends_at_none():
    for number in (0.0, 0.3, 0.999, 1.001, 3.0):
        assert moved_sensor_number(number, 0.0) == pytest.approx(number)
    assert moved_sensor_number(2.0, np.log(3.0)) == pytest.approx(6.0)
    assert moved_sensor_number(0.0, 0.02) == pytest.approx(LOGARITHM_ABOVE * 0.2)
    assert moved_sensor_number(3.0, -50.0) == 0.0
    step = 1e-6
    below, above = (
        (sensor_coordinate(LOGARITHM_ABOVE + side * step) - sensor_coordinate(LOGARITHM_ABOVE))
        for side in (-1.0, 1.0)
    )
    assert -below == pytest.approx(above, rel=1e-5)
