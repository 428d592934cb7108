"""Subapertures without light tell how wide the pupil's image is."""

import numpy as np
import pytest

from pyrcal.fitting.pupil_width import compute_responses, measure_pupil

WIDE = 14
ROWS, COLUMNS = np.mgrid[:WIDE, :WIDE] - (WIDE - 1) / 2
AWAY = np.hypot(ROWS, COLUMNS)


def disc(diameter, silent=0.05):
    """Answers of a mask of 14 with a pupil inside."""
    return np.where(AWAY < WIDE / 2, np.where(diameter / 2 > AWAY, 1.0, silent), np.nan)


@pytest.mark.parametrize("diameter", [8.0, 10.0, 12.0])
def test_a_ring_that_hardly_answers_tells_the_diameter(diameter):
    seen = measure_pupil(disc(diameter), stated_subap=WIDE)
    as_many = 2.0 * np.sqrt(np.sum(diameter / 2 > AWAY) / np.pi)  # a disc of whole cells is rough
    assert seen.diameter_subap == pytest.approx(as_many, abs=0.3)
    assert f"{seen.diameter_subap:.0f} subapertures wide" in seen.words


def test_dead_pixels_a_spider_or_faint_ones_inside_are_no_narrow_pupil():
    inside = disc(WIDE)
    inside[6:9, 2:12] = 0.0
    for answers in (disc(WIDE), inside, disc(10, silent=0.4)):
        assert measure_pupil(answers, stated_subap=WIDE) is None


def test_a_pupil_as_wide_as_it_is_said_to_be_is_not_named():
    assert measure_pupil(disc(12), stated_subap=12.5) is None
    assert measure_pupil(np.full((3, 3), np.nan), stated_subap=3.0) is None


def test_subapertures_of_which_nothing_is_expected_do_not_count():
    valid = np.ones((2, 2), bool)
    measured = np.array([4.0, 4.0, 0.0, 1.0] * 2)
    expected = np.array([4.0, 1.0, 1e-4, np.nan] * 2)
    np.testing.assert_array_equal(
        compute_responses(measured, expected, valid), [[1.0, 2.0], [np.nan, np.nan]]
    )
