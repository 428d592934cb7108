"""From the user's settings to the tracker's policy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.config import load_settings
from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.runtime.policy import AT_WORK, FLAT, floor_of, policy_of

LENSLETS = Path(__file__).parents[1] / "data" / "lenslets.toml"


def policy(**tracking):
    return policy_of(load_settings(None, {}, {f"tracking.{k}": v for k, v in tracking.items()}))


def test_rates_per_minute_become_a_walk_after_a_second_in_numeric_units():
    found = policy(drift_subap_per_minute=0.06, drift_deg_per_minute=0.12)
    np.testing.assert_allclose(found.drift_rate[:3] * np.sqrt(60.0), [0.06, 0.06, np.deg2rad(0.12)])


def test_flexure_slew_and_the_limits_of_a_stale_alpha_are_the_users():
    found = policy(
        flexure_subap_per_degree=0.03,
        flexure_deg_per_degree=0.02,
        flexure_magnification_per_degree=3e-4,
        slew_limit_deg=7.0,
        stale_shift_subap=0.04,
        stale_rotation_deg=0.2,
        stale_magnification=0.004,
        bias_memory_s=600.0,
    )
    np.testing.assert_allclose(found.flexure_per_degree, [0.03, 0.03, np.deg2rad(0.02), 3e-4])
    np.testing.assert_allclose(found.stale_sigma, [0.04, 0.04, np.deg2rad(0.2), 0.004])
    assert (found.slew_limit_deg, found.bias_memory_s) == (7.0, 600.0)


@pytest.mark.parametrize(
    ("key", "value"),
    [("flexure_subap_per_degree", -0.1), ("slew_limit_deg", 0.0), ("passive", "modes")],
)
def test_what_cannot_be_is_refused_by_its_key(key, value):
    with pytest.raises(ConfigurationError, match=key):
        policy(**{key: value})


# --- the floor


@pytest.mark.parametrize(
    ("environment", "expected"),
    [({}, FLAT), ({"PYRCAL_COMPUTE__WORKING_POINT_MODES": "400"}, AT_WORK)],
)
def test_the_floor_is_that_of_the_model_in_use(environment, expected):
    shift, rotation, magnification = expected
    np.testing.assert_array_equal(
        floor_of(load_settings(None, environment)), [shift, shift, rotation, magnification]
    )


@pytest.mark.parametrize(
    ("name", "coarser"),
    [("flao-lbt", 1.0), ("aof-ut4", 1.0), (str(LENSLETS), 0.28 / 3 * 8.22 / 0.3)],
)
def test_the_floor_of_a_coarse_mirror_is_as_much_larger(name, coarser):
    """Rotation and magnification by the pitch over the diameter; a finer mirror has FLAO's."""
    settings = load_settings(None, {})
    shift, rotation, magnification = FLAT
    np.testing.assert_allclose(
        floor_of(settings, load_instrument(name)),
        [shift, shift, coarser * rotation, coarser * magnification],
    )
    given = load_settings(None, {"PYRCAL_TRACKING__FLOOR_ROTATION_DEG": "0.01"})
    assert floor_of(given, load_instrument(name))[2] == 0.01


def test_the_limit_of_a_stale_alpha_is_what_a_mode_across_tolerates():
    """The floor has no part in it: it is not age."""
    settings = load_settings(None, {})
    usual, coarse = policy_of(settings), policy_of(settings, load_instrument(LENSLETS))
    # 90 modes on 12 subapertures: the finest is no wider than 500 on 30 in subapertures, and
    # the rim moves sqrt(90 / 500) times as many widths of it for the same angle
    scale = np.array([1.0, 1.0, np.sqrt(500 / 90), np.sqrt(500 / 90)])
    np.testing.assert_allclose(coarse.stale_sigma, scale * usual.stale_sigma)
    fine = policy_of(settings, load_instrument("flao-lbt"))
    np.testing.assert_array_equal(fine.stale_sigma, usual.stale_sigma)


def test_a_floor_that_is_given_overrules_the_measured_one():
    settings = load_settings(None, {"PYRCAL_TRACKING__FLOOR_ROTATION_DEG": "0"})
    np.testing.assert_array_equal(floor_of(settings), [FLAT[0], FLAT[0], 0.0, FLAT[2]])


def test_places_of_images_that_are_not_stated_widen_only_what_is_shown():
    """Called unknown they are part of the floor, which the gate allows for."""
    settings, about = load_settings(None, {}), load_instrument("flao-lbt")
    left_out = policy_of(settings, about)
    unknown = policy_of(settings, replace(about, unknown=("wfs.image_offsets_px",)))
    assert left_out.image_floor[0] == pytest.approx(0.25 * 0.15)
    assert left_out.floor[0] == FLAT[0]
    assert not unknown.image_floor.any()
    np.testing.assert_allclose(unknown.floor, np.hypot(left_out.floor, left_out.image_floor))
    np.testing.assert_array_equal(left_out.image_sigma, left_out.image_floor)
    np.testing.assert_array_equal(unknown.image_sigma, left_out.image_floor)
    assert not policy_of(settings, load_instrument(LENSLETS)).image_sigma.any()


def test_a_coarse_basis_tolerates_more():
    """40 modes on 11 subapertures: each mode is sqrt(500/40) as wide a share of the pupil as one
    of 500, and 11/30 of that in subapertures."""
    settings = load_settings(None, {})
    usual, coarse = (
        policy_of(settings),
        policy_of(settings, load_instrument("tests/data/bench.toml")),
    )
    wider = np.sqrt(500 / 40)
    scale = np.array([wider * 11 / 30, wider * 11 / 30, wider, wider])
    np.testing.assert_allclose(coarse.useless_sigma, scale * usual.useless_sigma)
    np.testing.assert_allclose(coarse.tolerance, scale)
    np.testing.assert_array_equal(usual.tolerance, 1.0)
    np.testing.assert_allclose(coarse.update_threshold, scale * usual.update_threshold)
    given = load_settings(None, {"PYRCAL_CONTROL__UPDATE_SHIFT_SUBAP": "0.01"})
    threshold = policy_of(given, load_instrument("tests/data/bench.toml")).update_threshold
    np.testing.assert_allclose(threshold[:2], 0.01)
