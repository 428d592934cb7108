"""A pupil under measured light."""

from __future__ import annotations

import numpy as np
import pytest

from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.pupil import Illumination, annular_pupil
from tests.numerics import small_basis, small_instrument, small_model


def ramp(slope: float = 0.02, reach: int = 10) -> Illumination:
    """Light that rises along +x."""
    u = np.arange(-reach, reach + 1.0)
    return Illumination(coordinates=u, intensity=np.tile(1.0 + slope * u, (len(u), 1)))


def test_the_amplitude_is_the_root_of_the_intensity():
    pupil = annular_pupil(n_subapertures=12, diameter_subap=12.0, obscuration_ratio=0.1, sampling=3)
    lit = pupil.lit_by(ramp())
    ratio = (lit.amplitude[pupil.lit] / pupil.amplitude[pupil.lit]) ** 2
    np.testing.assert_allclose(ratio, 1.0 + 0.02 * pupil.points[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(lit.lit, pupil.lit)


def test_rows_are_y_and_beyond_the_map_the_edge_goes_on():
    light = ramp(reach=2)
    found = light.at(np.array([-5.0, 0.5, 5.0]))
    np.testing.assert_allclose(found, np.tile([0.96, 1.01, 1.04], (3, 1)))


def test_even_light_of_any_strength_changes_no_slope():
    u = np.array([-10.0, 10.0])
    dim = Illumination(coordinates=u, intensity=np.full((2, 2), 0.3))
    lit = InteractionModel(small_instrument(), small_basis(), illumination=dim)
    np.testing.assert_allclose(
        lit.interaction_matrix(Misregistration()),
        small_model().interaction_matrix(Misregistration()),
        rtol=1e-3,
        atol=1e-3 * np.abs(small_model().interaction_matrix(Misregistration())).max(),
    )


def test_slopes_are_larger_where_there_is_more_light():
    lit = InteractionModel(small_instrument(), small_basis(), illumination=ramp(0.05))
    even = small_model().interaction_matrix(Misregistration())[:, 0]
    uneven = lit.interaction_matrix(Misregistration())[:, 0]
    n = len(even) // 2
    x = np.nonzero(lit.valid)[1]
    left, right = x < 4, x > 7
    gain = uneven[:n] / even[:n]
    assert np.median(gain[right]) > 1.1 > 0.9 > np.median(gain[left])


@pytest.mark.parametrize(
    ("intensity", "text"),
    [
        (np.ones((2, 3)), r"found \(2, 3\); expected \(3, 3\)"),
        (np.full((3, 3), np.nan), "negative or not finite"),
        (np.full((3, 3), -1.0), "negative or not finite"),
        (np.zeros((3, 3)), "no light at all"),
    ],
)
def test_light_that_cannot_be_is_refused(intensity, text):
    with pytest.raises(ModelError, match=text):
        Illumination(coordinates=np.arange(3.0), intensity=intensity)
