"""Where along a star's light a mirror is seen: rays, drawn by hand."""

import numpy as np
import pytest

from pyrcal.fitting.guide_star import GuideStar, Similarity
from service.errors import ModelError

ARCSEC = np.pi / 180 / 3600


def test_at_the_pupil_every_star_sees_the_mirror_where_it_is():
    star = GuideStar(direction_rad=20 * ARCSEC * (1 + 1j), height_m=90e3)
    assert star.project_plane(0.0) == Similarity()


def test_a_natural_star_sees_a_mirror_shifted_and_as_large_as_it_is():
    """20 arcsec are 97 microradian: 0.873 m at 9 km, against the star's direction."""
    seen = GuideStar(direction_rad=20 * ARCSEC).project_plane(9000.0)
    assert seen.turn == 1.0
    assert seen.shift == pytest.approx(-0.87266, abs=1e-5)


def test_a_laser_star_magnifies_as_a_cone_narrows():
    """At a tenth of the star's height the beam is nine tenths as wide."""
    seen = GuideStar(direction_rad=1e-4j, height_m=90e3).project_plane(9000.0)
    assert seen.turn == pytest.approx(1 / 0.9)
    assert seen.shift == pytest.approx(-1j * 1e-4 * 9000.0 / 0.9)


@pytest.mark.parametrize("altitude_m", [-90.0, 600.0, 17500.0])
def test_it_is_where_straight_rays_meet_the_mirror(altitude_m):
    rng = np.random.default_rng(1)
    direction, height_m = complex(*rng.normal(size=2)) * 2e-4, 90e3
    pupil = rng.normal(size=(50, 2))
    star = np.array([direction.real * height_m, direction.imag * height_m, height_m])
    from_pupil = np.column_stack([pupil, np.zeros(50)])
    met = from_pupil + (star - from_pupil) * altitude_m / height_m
    seen = GuideStar(direction_rad=direction, height_m=height_m).project_plane(altitude_m)
    assert seen.points(met[:, :2]) == pytest.approx(pupil, abs=1e-12)


@pytest.mark.parametrize("altitude_m", [90e3, 95e3])
def test_a_mirror_above_the_star_is_refused(altitude_m):
    with pytest.raises(ModelError, match="expected the mirror below the star"):
        GuideStar(height_m=90e3).project_plane(altitude_m)
