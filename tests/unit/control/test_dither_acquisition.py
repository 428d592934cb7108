"""Which modes are dithered and controlled on the way from nothing to everything."""

from itertools import combinations

import numpy as np
import pytest

from service.control.dither import (
    CLEARANCE_HZ,
    FEWEST_LINES,
    FINER,
    LINE_BAND,
    MAX_LINES,
    SMOOTH,
    lines_of,
    modes_of,
)


@pytest.mark.parametrize("n_modes", [16, 30, 60, 224, 594])
def test_the_modes_that_confirm_are_others_than_those_that_lead(n_modes):
    lead, confirm = (modes_of(reach, n_modes, 8) for reach in (SMOOTH, FINER))
    assert not set(lead) & set(confirm)
    assert max(lead) < min(confirm)
    assert max(confirm) < n_modes
    assert len(lead) >= FEWEST_LINES
    assert len(confirm) >= FEWEST_LINES


def test_in_a_long_basis_the_bands_are_those_that_were_studied():
    assert modes_of(SMOOTH, 594, 8) == (0, 4, 8, 12, 16, 20, 24, 28)
    assert modes_of(FINER, 594, 8) == (36, 45, 54, 63, 72, 81, 90, 99)


@pytest.mark.parametrize("rate_hz", [300.0, 500.0, 990.0, 1000.0, 2000.0])
def test_every_line_has_whole_periods_and_room_for_its_noise(rate_hz):
    lines = lines_of(rate_hz, 2.0, 8)
    assert FEWEST_LINES <= len(lines) <= MAX_LINES
    assert all((2.0 * line) % 1.0 == 0.0 for line in lines)
    assert min(b - a for a, b in combinations(sorted(lines), 2)) >= CLEARANCE_HZ
    assert LINE_BAND[0] * rate_hz <= min(lines)
    assert max(lines) <= LINE_BAND[1] * rate_hz


def test_no_line_is_made_by_three_others():
    lines = lines_of(1000.0, 2.0, 8)
    for a, b in combinations(lines, 2):
        for c in set(lines) - {a, b}:
            rest = set(lines) - {a, b, c}
            assert all(abs(a + b - c - line) >= 2.0 for line in rest)


def test_a_slow_camera_has_fewer_lines_and_a_very_slow_one_none():
    assert len(lines_of(500.0, 2.0, 8)) < len(lines_of(1000.0, 2.0, 8))
    assert lines_of(150.0, 2.0, 8) == ()


def test_an_rtc_that_plays_few_modes_gets_few():
    assert len(lines_of(1000.0, 2.0, 4)) == 4
    assert lines_of(1000.0, 2.0, 2) == ()


def test_finer_modes_are_the_more_precise_ones():
    assert np.all(FINER.floor < SMOOTH.floor)
