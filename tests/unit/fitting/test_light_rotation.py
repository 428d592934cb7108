"""A rotation from spider arms or uneven light."""

from __future__ import annotations

import numpy as np
import pytest

from pyrcal.fitting.light_rotation import Arms, LightRotation, find_rotation
from service.errors import ModelError
from service.model.sensors.pyramid.light import PyramidLight
from service.model.sensors.sensor import CannotTell, PupilPosition
from tests.unit.estimation.lamps import beam, counts_of, flao, gaussian
from tests.unit.model.sensors.test_pyramid_light_illumination import at

LIGHT = PyramidLight(instrument=flao())

SHIFT = (-0.4, 0.3)
HERE = at(*SHIFT)
TRIPOD = np.deg2rad([90.0, 210.0, 330.0])
WIDTH_SUBAP = 0.9
"""25 cm at FLAO, as a large telescope's."""

LOPSIDED = np.deg2rad([90.0, 200.0, 300.0])


def arms(angles, turn_deg: float = 0.0) -> Arms:
    return Arms(
        angles_rad=tuple(np.asarray(angles) + np.deg2rad(turn_deg)), width_subap=WIDTH_SUBAP
    )


def turned(function, turn_deg: float):
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return beam(lambda x, y: function(cosine * x + sine * y, cosine * y - sine * x))


def shaded(angles, turn_deg: float, width: float = WIDTH_SUBAP):
    """Light behind arms, itself uneven; drawn by distance, as grey as a pupil point is wide."""

    def light(x, y):
        left = gaussian(x, y)
        for angle in np.asarray(angles) + np.deg2rad(turn_deg):
            along = x * np.cos(angle) + y * np.sin(angle)
            beside = np.abs(y * np.cos(angle) - x * np.sin(angle))
            hidden = np.clip((width / 2 - beside) * 3 + 0.5, 0.0, 1.0)
            left = left * np.where(along > 0, 1.0 - hidden, 1.0)
        return left

    return beam(light, size=320, step=0.125)


def seen_through(light):
    return LIGHT.relative(counts_of(flao(), SHIFT, light), HERE)


@pytest.mark.parametrize("turn_deg", [0.0, -11.0, 24.7])
def test_three_arms_tell_the_rotation_within_a_degree(turn_deg):
    light, known = seen_through(shaded(TRIPOD, turn_deg))
    found = find_rotation(light, known, HERE, arms(TRIPOD), within_rad=np.deg2rad(40))
    assert isinstance(found, LightRotation), found
    assert np.rad2deg(found.rotation_rad) == pytest.approx(turn_deg, abs=1.0)
    assert np.rad2deg(found.sigma_rad) < 2.0


def test_arms_evenly_spread_are_ambiguous_over_a_full_turn():
    light, known = seen_through(shaded(TRIPOD, 5.0))
    found = find_rotation(light, known, HERE, arms(TRIPOD))
    assert isinstance(found, CannotTell)
    assert "ambiguous" in found.reason


@pytest.mark.parametrize("turn_deg", [64.5, 180.0])
def test_arms_unevenly_spread_tell_it_over_a_full_turn(turn_deg):
    light, known = seen_through(shaded(LOPSIDED, turn_deg))
    found = find_rotation(light, known, HERE, arms(LOPSIDED))
    assert isinstance(found, LightRotation), found
    error = np.rad2deg(found.rotation_rad) - turn_deg
    assert (error + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("turn_deg", [-30.0, 65.0])
def test_uneven_light_tells_it_against_a_map_of_another_day(turn_deg):
    before = LIGHT.illumination(counts_of(flao(), light=beam(gaussian)), at())
    light, known = seen_through(turned(gaussian, turn_deg))
    found = find_rotation(light, known, HERE, before)
    assert isinstance(found, LightRotation), found
    assert np.rad2deg(found.rotation_rad) == pytest.approx(turn_deg, abs=2.0)


def test_an_even_pupil_tells_no_rotation():
    light, known = seen_through(None)
    found = find_rotation(light, known, HERE, arms(TRIPOD))
    assert isinstance(found, CannotTell)


def test_arms_beyond_the_range_searched_are_not_invented():
    light, known = seen_through(shaded(TRIPOD, 30.0))
    found = find_rotation(light, known, HERE, arms(TRIPOD), within_rad=np.deg2rad(10))
    assert isinstance(found, CannotTell)


def test_maps_that_do_not_match_are_refused():
    with pytest.raises(ModelError, match="same square map"):
        find_rotation(np.ones((5, 5)), np.ones((4, 4), dtype=bool), HERE, arms(TRIPOD))


def test_the_position_is_taken_into_account():
    """Turned about the wrong point, arms do not fit."""
    light, known = seen_through(shaded(TRIPOD, 0.0))
    right = find_rotation(light, known, HERE, arms(TRIPOD), within_rad=0.5)
    wrong_place = PupilPosition(at=(1.5, -1.5), sigma=(0.1, 0.1))
    wrong = find_rotation(light, known, wrong_place, arms(TRIPOD), within_rad=0.5)
    assert isinstance(right, LightRotation)
    assert isinstance(wrong, CannotTell) or wrong.correlation < 0.9 * right.correlation
