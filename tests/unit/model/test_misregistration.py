"""The four numbers and their units."""

from __future__ import annotations

import numpy as np
import pytest

from service.errors import ModelError
from service.model.misregistration import PARAMETERS, Misregistration


def test_the_default_is_perfect_registration():
    np.testing.assert_array_equal(Misregistration().vector, [0.0, 0.0, 0.0, 1.0])


def test_boundaries_speak_degrees_and_the_numbers_inside_radians():
    alpha = Misregistration.from_boundary(
        {"shift_x_subap": 0.1, "shift_y_subap": -0.2, "rotation_deg": 65.08, "magnification": 1.01}
    )
    np.testing.assert_allclose(alpha.vector, [0.1, -0.2, 1.13586, 1.01], atol=1e-5)
    assert alpha.to_boundary()["rotation_deg"] == pytest.approx(65.08)
    assert tuple(alpha.to_boundary()) == PARAMETERS


@pytest.mark.parametrize(
    "vector", [[np.nan, 0, 0, 1], [0, np.inf, 0, 1], [0, 0, 0, 0], [0, 0, 0, -1]]
)
def test_numbers_no_registration_can_have_are_refused_and_shown(vector):
    with pytest.raises(ModelError, match=r"a magnification > 0: \(.* subap, .* deg, "):
        Misregistration.from_vector(np.array(vector, dtype=float))
