import numpy as np
import pytest

from pyrcal.fitting.arguments import parse_arms
from service.files import parse_alpha, parse_modes


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:4", [0, 1, 2, 3]),
        ("0:7:3", [0, 3, 6]),
        ("3, 5,9", [3, 5, 9]),
        ("0:2,10:12", [0, 1, 10, 11]),
    ],
)
def test_modes_are_ranges_and_numbers(text, expected):
    assert parse_modes(text).tolist() == expected


@pytest.mark.parametrize(
    "text", ["", "a", "-1:3", "4:4", "0:4:0", "1,1", "0:3,2", "0:1e5", "0:9999999"]
)
def test_other_modes_are_refused_with_what_was_found(text):
    with pytest.raises(ValueError, match="found") as error:
        parse_modes(text)
    assert repr(text) in str(error.value)


def test_a_start_is_in_subapertures_degrees_and_ratio():
    alpha = parse_alpha("-0.9, 0.35,65,0.98")
    assert alpha.vector == pytest.approx([-0.9, 0.35, np.deg2rad(65.0), 0.98])


@pytest.mark.parametrize("text", ["", "1,2,3", "0,0,0,0", "0,0,nan,1", "0,0,0,-1", "0;0;0;1"])
def test_another_start_is_refused(text):
    with pytest.raises(ValueError, match="expected X,Y,ROT,MAG"):
        parse_alpha(text)


def test_arms_are_a_width_and_angles():
    arms = parse_arms("0.9:90,-150,330")
    assert arms.width_subap == 0.9
    assert np.rad2deg(arms.angles_rad) == pytest.approx([90.0, -150.0, 330.0])


@pytest.mark.parametrize("text", ["", "0.9", "0.9:", "0:90", "90,210", "inf:90", "1:nan", "1:a"])
def test_other_arms_are_refused(text):
    with pytest.raises(ValueError, match="expected WIDTH:DEG"):
        parse_arms(text)
