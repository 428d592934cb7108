"""Numbers of the page from records made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.heritier2018 import plan, results
from pyrcal_studies.heritier2018.illumination import Change, Feature, image_offsets, missing
from pyrcal_studies.heritier2018.loops import largest_pole, limit_of_stability
from pyrcal_studies.heritier2018.patterns import registration_by_set, sensitivities
from pyrcal_studies.heritier2018.registration import ROUGH_ESTIMATE
from service.model.misregistration import Misregistration


def a_curve(*errors_nm: float) -> results.Curve:
    values = tuple(float(k) for k in range(len(errors_nm)))
    return results.Curve(sweep=plan.ROTATION, n_modes=594, values=values, errors_nm=errors_nm)


def test_a_drop_is_where_50_nm_are_added_in_quadrature():
    limit = float(np.hypot(100.0, 50.0))
    assert a_curve(100.0, limit * 0.8, limit / 0.8).drop() == pytest.approx(1.5)
    assert a_curve(100.0, limit * 0.8, limit / 0.8).first_after() == 2.0
    assert a_curve(100.0, 101.0).drop() is None


def test_one_degree_moves_the_border_by_a_quarter_of_a_subaperture():
    """15 x 0.01745 = 0.26: the paper's own figure."""
    assert plan.ROTATION.border_subap(1.0) == pytest.approx(0.2618, abs=1e-4)
    assert plan.SHIFT.border_subap(40.0) == pytest.approx(0.4)
    assert plan.MAGNIFICATION.border_subap(2.0) == pytest.approx(0.3)


def test_the_condition_number_is_largest_over_smallest():
    assert results.condition(results.singular_values(np.diag([8.0, 2.0, 4.0]))) == pytest.approx(4)


def test_the_knee_is_where_the_spectrum_bends():
    flat_then_steep = np.exp(-np.concatenate([np.zeros(60), np.linspace(0.0, 3.0, 40)]))
    assert results.knee(flat_then_steep) in {60, 61}


def test_the_optimum_is_that_of_the_variances():
    cost = {value: float(np.sqrt(100.0 + (value - 0.5) ** 2)) for value in (-2.0, 0.0, 1.0, 3.0)}
    assert results.optimum(cost) == pytest.approx(0.5)
    assert results.optimum({-1.0: 1.0, 0.0: 2.0, 1.0: 1.0}) is None


def test_the_strength_that_reaches_a_target_is_interpolated():
    assert results.needed_for({0.2: 110.0, 0.4: 130.0}, 100.0, 120.0) == pytest.approx(0.3)
    assert results.needed_for({0.2: 110.0}, 100.0, 120.0) is None


def test_a_loop_without_delay_errors_has_the_poles_of_its_gain():
    """z^2 - 0.999 z + g = 0: unstable from g = 1 on."""
    assert largest_pole(np.array([1.0 + 0j]), 0.6) == pytest.approx(np.sqrt(0.6))
    record = {"eigenvalues": np.array([[1.0], [1.5], [2.5]], dtype=complex)}
    limit = limit_of_stability(record, (0.0, 1.0, 2.0), 0.5)
    assert limit is not None
    assert 1.0 < limit < 2.0
    assert limit_of_stability(record, (0.0, 1.0, 2.0), 0.1) is None


def test_the_rough_estimate_is_the_papers():
    assert ROUGH_ESTIMATE[:3] == pytest.approx([1.0, 1.0, np.deg2rad(2.0)])


@pytest.mark.usefixtures("small_telescope")
def test_signal_is_missing_where_figure_10_shows_it_missing():
    places = {feature: missing(feature) for feature in Feature}
    assert places[Feature.NONE].max() == 0.0
    for feature in (Feature.BOTTOM_LEFT, Feature.OBSCURATION, Feature.SPIDERS):
        assert 0.0 <= places[feature].min() < places[feature].max() <= 1.0
        assert np.all(places[Feature.ALL] >= places[feature])
    assert Change().feature is Feature.NONE


def test_displaced_pupil_images_have_no_common_displacement():
    offsets = image_offsets(0.25, np.random.default_rng(1)).reshape(2, 4)
    assert offsets.mean(axis=1) == pytest.approx([0.0, 0.0])
    assert np.sqrt(np.mean(offsets**2)) == pytest.approx(0.25)


@pytest.mark.usefixtures("small_telescope")
def test_an_error_along_a_derivative_is_found_as_that_step():
    alpha = Misregistration(shift_x_subap=0.1)
    derivatives = sensitivities(alpha, 24)
    exact = derivatives.sum(axis=0) + 1.0
    step = np.array([0.01, -0.02, 0.001, 0.0005])
    error = -np.tensordot(step, derivatives, axes=1)
    found = registration_by_set(error, exact, alpha, 3)
    np.testing.assert_allclose(found, np.tile(step, (3, 1)), atol=1e-6)
