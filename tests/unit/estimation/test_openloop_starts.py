"""Where to look for the mirror first, from light alone."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.openloop import far_starts
from service.model.instrument import SlopeRecipe
from service.model.kinds import Stop
from service.model.slopes import Orientation
from tests.unit.estimation.lamps import counts_of, small


def told(shift):
    """The flux as a status carries it."""
    return counts_of(small(), shift).astype("<f4").tobytes()


@pytest.mark.parametrize("shift", [(1.4, -0.9), (-0.3, 1.2)])
def test_light_tells_the_shift_where_the_mirror_is_the_stop(shift):
    first = far_starts(small(), told(shift))[0]
    assert (first.shift_x_subap, first.shift_y_subap) == pytest.approx(shift, abs=0.1)
    assert (first.rotation_rad, first.magnification) == (0.0, 1.0)


def test_the_nominal_registration_is_always_among_the_starts():
    instrument = replace(
        small(), mirror=replace(small().mirror, nominal_rotation_rad=np.deg2rad(65.08))
    )
    for flux in (None, told((1.0, 0.0))):
        assert instrument.start in far_starts(instrument, flux)


@pytest.mark.parametrize(
    "flux", [None, b"", np.zeros((4, 12, 12), "<f4").tobytes(), np.ones((4, 5, 5), "<f4").tobytes()]
)
def test_without_light_that_says_anything_the_nominal_registration_comes_first(flux):
    assert far_starts(small(), flux)[0] == small().start


def test_with_the_telescope_as_stop_the_images_say_nothing_of_the_mirror():
    instrument = small(Stop.TELESCOPE)
    assert far_starts(instrument, told((1.4, -0.9)))[0] == instrument.start


def test_light_in_axes_that_are_not_the_conventions_is_not_used():
    recipe = SlopeRecipe(orientation=Orientation(flip_x=True))
    instrument = replace(small(), slopes=recipe)
    assert far_starts(instrument, told((1.4, -0.9)))[0] == instrument.start
