"""The pupil's place, from nothing but light."""

from __future__ import annotations

import numpy as np
import pytest

from service.errors import ModelError
from service.model.sensors.pyramid.light import find_pupil, repair_pixels
from service.model.sensors.sensor import CannotTell, PupilPosition
from tests.unit.estimation.lamps import (
    beam,
    counts_of,
    flao,
    fringes,
    gaussian,
    small,
    with_diameter,
)


def found_in(counts, instrument=None) -> PupilPosition:
    found = find_pupil(counts, instrument or flao())
    assert isinstance(found, PupilPosition), found
    return found


@pytest.mark.parametrize("shift", [(-0.92, 0.35), (2.3, -1.3)])
def test_an_even_pupil_is_found_to_a_fiftieth_of_a_subaperture(shift):
    found = found_in(counts_of(flao(), shift))
    assert found.at == pytest.approx(shift, abs=0.02)


@pytest.mark.parametrize("light", [gaussian, fringes])
def test_uneven_light_moves_it_by_less_than_a_tenth(light):
    shift = (-0.62, 0.41)
    found = found_in(counts_of(flao(), shift, beam(light)))
    assert found.at == pytest.approx(shift, abs=0.1)


def test_dead_and_hot_pixels_are_named_and_do_no_harm():
    shift = (0.3, -0.7)
    counts = counts_of(flao(), shift)
    counts[0, 8, 9], counts[1, 14, 3], counts[3, 20, 21] = 0.0, 60_000.0, np.nan
    _, bad = repair_pixels(counts, flao())
    assert bad.sum() == 3
    found = found_in(counts)
    assert found.at == pytest.approx(shift, abs=0.03)


def test_a_faint_map_is_found_within_its_own_uncertainty():
    """3.5 σ: not one in 2000 beyond it."""
    pulls = []
    for seed in range(5):
        found = found_in(counts_of(small(), (0.4, -0.2), n_frames=1, seed=seed), small())
        pulls.append((found.at[0] - 0.4) / found.sigma[0])
        pulls.append((found.at[1] + 0.2) / found.sigma[1])
    assert np.abs(pulls).max() < 3.5
    assert np.std(pulls) > 0.2


def test_images_that_disagree_widen_the_uncertainty():
    counts = counts_of(small(), (0.0, 0.0))
    apart = counts.copy()
    apart[0] = np.roll(apart[0], 1, axis=1)
    assert found_in(apart, small()).sigma[0] > 2 * found_in(counts, small()).sigma[0]


def test_darkness_tells_nothing():
    found = find_pupil(np.zeros((4, 30, 30)), flao())
    assert isinstance(found, CannotTell)
    assert "no light" in found.reason


def test_frames_of_nan_tell_nothing():
    assert isinstance(find_pupil(np.full((4, 30, 30), np.nan), flao()), CannotTell)


def test_another_instruments_pupil_is_not_taken_for_this_ones():
    counts = counts_of(with_diameter(flao(), 18.0))
    found = find_pupil(counts, flao())
    assert isinstance(found, CannotTell)
    assert "unexplained" in found.reason


def test_light_without_a_pupil_tells_nothing():
    noise = np.random.default_rng(3).exponential(100.0, size=(30, 30))
    assert isinstance(find_pupil(np.tile(noise, (4, 1, 1)), flao()), CannotTell)


def test_counts_of_another_size_are_refused():
    with pytest.raises(ModelError, match=r"found counts \(4, 12, 12\); expected \(4, 30, 30\)"):
        find_pupil(np.ones((4, 12, 12)), flao())
