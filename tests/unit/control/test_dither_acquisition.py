"""Which modes are dithered and controlled on the way from nothing to everything."""

from itertools import combinations

import numpy as np
import pytest

from service.control.dither import (
    CLEARANCE_HZ,
    COARSE_BAND,
    FINE_BAND,
    LINE_BAND_RATIO,
    MAX_LINES,
    MIN_LINES,
    spread_lines,
    spread_modes,
)


@pytest.mark.parametrize("n_modes", [16, 30, 60, 224, 594])
def test_the_modes_that_confirm_are_others_than_those_that_lead(n_modes):
    lead, confirm = (spread_modes(reach, n_modes, 8) for reach in (COARSE_BAND, FINE_BAND))
    assert not set(lead) & set(confirm)
    assert max(lead) < min(confirm)
    assert max(confirm) < n_modes
    assert len(lead) >= MIN_LINES
    assert len(confirm) >= MIN_LINES


def test_in_a_long_basis_the_bands_are_those_that_were_studied():
    assert spread_modes(COARSE_BAND, 594, 8) == (0, 4, 8, 12, 16, 20, 24, 28)
    assert spread_modes(FINE_BAND, 594, 8) == (36, 45, 54, 63, 72, 81, 90, 99)


@pytest.mark.parametrize("rate_hz", [300.0, 500.0, 990.0, 1000.0, 2000.0])
def test_every_line_has_whole_periods_and_room_for_its_noise(rate_hz):
    lines = spread_lines(rate_hz, 2.0, 8)
    assert MIN_LINES <= len(lines) <= MAX_LINES
    assert all((2.0 * line) % 1.0 == 0.0 for line in lines)
    assert min(b - a for a, b in combinations(sorted(lines), 2)) >= CLEARANCE_HZ
    assert LINE_BAND_RATIO[0] * rate_hz <= min(lines)
    assert max(lines) <= LINE_BAND_RATIO[1] * rate_hz


def test_no_line_is_made_by_three_others():
    lines = spread_lines(1000.0, 2.0, 8)
    for a, b in combinations(lines, 2):
        for c in set(lines) - {a, b}:
            rest = set(lines) - {a, b, c}
            assert all(abs(a + b - c - line) >= 2.0 for line in rest)


def test_a_slow_camera_has_fewer_lines_and_a_very_slow_one_none():
    assert len(spread_lines(500.0, 2.0, 8)) < len(spread_lines(1000.0, 2.0, 8))
    assert spread_lines(150.0, 2.0, 8) == ()


def test_an_rtc_that_plays_few_modes_gets_few():
    assert len(spread_lines(1000.0, 2.0, 4)) == 4
    assert spread_lines(1000.0, 2.0, 2) == ()


def test_finer_modes_are_the_more_precise_ones():
    assert np.all(FINE_BAND.floor < COARSE_BAND.floor)
