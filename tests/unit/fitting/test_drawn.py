"""What the figures of a fit are drawn from."""

import json

import numpy as np
import pytest

from pyrcal.fitting import figures
from service.model.slopes import as_maps
from tests.support.made import GAINS, SYNTHETIC, VALID, a_fit


def test_slopes_become_maps_side_by_side():
    found = as_maps(np.arange(10.0), VALID)
    assert found.shape == (3, 6)
    assert found[0].tolist()[1] == 0.0
    assert found[0].tolist()[4] == 5.0
    assert np.isnan(found[0, 0])


def test_the_papers_modes_are_shown_where_they_were_used():
    fit = a_fit(modes=np.array([0, 3, 4]))
    assert fit.modes[figures.shown_modes(fit)].tolist() == [0, 4], "1 and 5, as the paper counts"
    assert figures.shown_modes(a_fit(modes=np.array([1, 2, 3]))).tolist() == [0, 1, 2]


def test_a_browser_is_given_json_with_nothing_in_the_place_of_holes():
    found = json.loads(json.dumps(figures.numbers(a_fit()), allow_nan=False))
    assert found["modes"] == [0, 1, 4]
    nothing = None
    assert found["residual_map"] == [
        [nothing, 2, nothing, nothing, 2, nothing],
        [2, 2, 2, 2, 2, 2],
        [nothing, 2, nothing, nothing, 2, nothing],
    ]
    expected = np.linalg.svd(SYNTHETIC * GAINS, compute_uv=False)
    assert found["singular_values"]["measured"] == pytest.approx(expected / expected[0], abs=1e-5)


def test_a_mode_is_shown_on_one_scale_measured_and_synthetic():
    fit = a_fit()
    shown = figures.numbers(fit)["maps"]
    assert [one["mode"] for one in shown] == [0, 4], "the paper's, where they were used"
    for one, column in zip(shown, (0, 2), strict=True):
        assert one["measured"] == one["synthetic"], "these differ by nothing but the gain"
        slopes = fit.measured[:, column]
        assert one["measured"][0][1] == round(100 * slopes[0] / (3 * np.std(slopes)))


def test_a_mode_without_any_slope_is_no_division_by_zero():
    fit = a_fit(measured=np.zeros((10, 3)))
    with np.errstate(invalid="ignore"):
        found = figures.numbers(fit)
    assert found["maps"][0]["measured"][1] == [0] * 6
    assert found["singular_values"]["measured"] == [None] * 3
