"""Matrices of pixels: four signals for each subaperture are fitted as two slopes are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.models import FitModels
from pyrcal.fitting.solver import nuisances_of
from service.errors import MatrixError
from service.estimation.orientation import Pose, find_orientation
from service.estimation.reference import Reference
from service.estimation.slope_convention import identify_from_response
from service.model.kinds import SignalKind, SlopeOrder
from service.model.pupil import valid_subapertures
from service.model.slopes import Orientation, SlopeRecipe, slopes_of
from tests.support.bench import ELSEWHERE, GRID, PLAIN, error, fit, instrument, listed, matrix
from tests.support.numerics import small_basis

PIXELS = instrument(PLAIN, SlopeOrder.IMAGES)
ODD = Orientation(swap_xy=True, flip_x=True, sign_y=-1)


def test_pixels_tell_the_registration_as_slopes_do():
    found = fit(matrix(about=PIXELS), PIXELS)
    assert found.accepted, found.verdict
    assert np.all(np.abs(error(found)) < GRID)
    assert found.residual_map.shape[0] == 4


@pytest.mark.slow
def test_noise_is_no_worse_for_pixels_than_for_slopes_and_within_what_the_fit_says():
    exact = matrix(about=PIXELS)
    spread = 0.3 * np.random.default_rng(3).normal(size=exact.shape) * exact.std(axis=0)
    found = fit(exact + spread, PIXELS)
    assert np.all(np.abs(error(found)) < 4.0 * np.sqrt(np.diag(found.covariance)))
    # the same light: a slope has the noise of its four pixels
    slopes = slopes_of(exact + spread, SignalKind.INTENSITY).reshape(-1, exact.shape[1])
    beside = fit(slopes, instrument())
    assert np.all(np.diag(found.covariance) < 1.3 * np.diag(beside.covariance))


@pytest.mark.parametrize("order", [SlopeOrder.IMAGES_YX, SlopeOrder.DETECTOR])
def test_how_the_images_lie_is_found_where_it_is_not_told(order):
    """But for quarter turns of everything, which nobody can see."""
    rows = listed(matrix(about=PIXELS), order, ODD)
    reported = SlopeOrder.IMAGES if order is SlopeOrder.IMAGES_YX else order
    search = find_orientation(instrument(None, reported), Reference(matrix=rows), small_basis())
    assert search.refusal == ""
    expected = Pose(
        slopes=SlopeRecipe(order=order, orientation=ODD), rotation_rad=0.0, correlation=1.0
    )
    assert search.best.turned_class == expected.turned_class
    assert search.best.correlation > 0.9


def test_a_turn_of_the_pyramids_edges_is_no_rotation_of_the_mirror():
    turn = np.deg2rad(1.0)
    rows = matrix(about=PIXELS)
    alone = nuisances_of(valid_subapertures(PIXELS), SignalKind.INTENSITY)
    models = FitModels(instrument=PIXELS, basis=small_basis())
    turned = rows + turn * alone.derivatives(models, ELSEWHERE, rows)[0]
    slopes, before = (slopes_of(one, SignalKind.INTENSITY) for one in (turned, rows))
    np.testing.assert_allclose(slopes[0], before[0] - turn * before[1], rtol=1e-9)
    assert np.all(np.abs(error(fit(turned, PIXELS))) < 2 * GRID)


def test_slopes_where_pixels_are_expected_are_named_and_the_other_way_round():
    with pytest.raises(MatrixError, match=r'x and y slopes: is it slopes.kind = "xy"'):
        fit(matrix(), PIXELS)
    with pytest.raises(MatrixError, match=r'pixels: is it slopes.kind = "intensity"'):
        fit(matrix(about=PIXELS), instrument())


def test_the_answer_to_a_dither_tells_images_that_lie_otherwise_than_told():
    rows = matrix(about=PIXELS)[:, 2:6].T
    seen = listed(rows.T, SlopeOrder.IMAGES, Orientation(sign_x=-1, sign_y=-1)).T
    told = replace(PIXELS, slopes=replace(PIXELS.slopes, orientation=PLAIN))
    found = identify_from_response(
        seen.astype(complex), rows.astype(complex), np.full(4, 0.1), told
    )
    assert "other sign" in found.wrong
    assert (
        identify_from_response(
            rows.astype(complex), rows.astype(complex), np.full(4, 0.1), told
        ).wrong
        == ""
    )
