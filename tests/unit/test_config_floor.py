import numpy as np
import pytest

from service.config import load_settings
from service.config.floor import AT_WORK, FLAT, floor_of


@pytest.mark.parametrize(
    ("environment", "expected"),
    [({}, FLAT), ({"PYRCAL_COMPUTE__WORKING_POINT_MODES": "400"}, AT_WORK)],
)
def test_the_floor_is_that_of_the_model_in_use(environment, expected):
    shift, rotation, magnification = expected
    np.testing.assert_array_equal(
        floor_of(load_settings(None, environment)), [shift, shift, rotation, magnification]
    )


def test_a_floor_that_is_given_overrules_the_measured_one():
    settings = load_settings(None, {"PYRCAL_TRACKING__FLOOR_ROTATION_DEG": "0"})
    np.testing.assert_array_equal(floor_of(settings), [FLAT[0], FLAT[0], 0.0, FLAT[2]])
