"""Places of a pyramid's pupil images: derivatives, axes of the RTC, uncertainty when unknown."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pyrcal.fitting.solver import image_patterns, is_blurring
from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.kinds import Normalisation, SlopeOrder, Stop
from service.model.misregistration import Misregistration
from service.model.sensors.pyramid.description import FrameWindows, image_offsets, orient_offsets
from service.model.sensors.pyramid.model import EDGE_SHIFT, EDGE_TURN, LOCATED_SIGMA_PX
from service.model.sensors.registry import KINDS, kind_of
from service.model.slopes import Orientation
from tests.support.numerics import small_basis, small_instrument

AT = Misregistration(shift_x_subap=0.3, rotation_rad=0.01)


def model(instrument, offsets=None):
    if offsets is not None:
        places = tuple(map(tuple, offsets.tolist()))
        wfs = replace(instrument.wfs, image_offsets_subap=places)
        instrument = replace(instrument, wfs=wfs)
    return InteractionModel(
        instrument, small_basis(), pupil_sampling=2, detector_nodes=5, dtype=np.float64
    )


@pytest.mark.parametrize("normalisation", list(Normalisation))
@pytest.mark.parametrize("order", [SlopeOrder.XY, SlopeOrder.IMAGES])
def test_rates_of_single_images_are_differences_of_displaced_models(order, normalisation):
    about = small_instrument()
    about = replace(about, slopes=replace(about.slopes, order=order, normalisation=normalisation))
    rates = model(about).image_derivatives(AT)
    offsets = np.random.default_rng(0).normal(size=(4, 2))
    offsets -= offsets.mean(axis=0)
    step = 1e-3
    there, back = (
        model(about, side * step * offsets).interaction_matrix(AT) for side in (1.0, -1.0)
    )
    expected = (there - back) / (2.0 * step)
    found = np.tensordot(offsets.T.ravel(), rates, axes=1)
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_all_images_together_move_as_the_shift_does():
    about = replace(small_instrument(), stop=Stop.MIRROR)
    one = model(about)
    rates, shifts = one.image_derivatives(AT), one.derivatives(AT)[:2]
    assert np.allclose(rates[:4].sum(axis=0), shifts[0], atol=1e-9 * np.abs(shifts).max())
    assert np.allclose(rates[4:].sum(axis=0), shifts[1], atol=1e-9 * np.abs(shifts).max())


def test_images_at_their_places_change_nothing():
    about = small_instrument()
    told, own = (model(about, at).interaction_matrix(AT) for at in (np.zeros((4, 2)), None))
    assert np.abs(told - own).max() < 1e-12 * np.abs(own).max()


@pytest.mark.parametrize("axes", list(product([False, True], [False, True], [False, True])))
@pytest.mark.parametrize("sign", [1, -1])
def test_axes_of_the_rtc_are_turned_there_and_back(axes, sign):
    swap, flip_x, flip_y = axes
    orientation = Orientation(swap_xy=swap, flip_x=flip_x, flip_y=flip_y, sign_x=sign, sign_y=-sign)
    offsets = np.random.default_rng(1).normal(size=(2, 2, 2))
    there = orient_offsets(offsets, orientation)
    assert np.allclose(orient_offsets(there, orientation, back=True), offsets)


def test_a_flip_moves_an_image_to_the_other_side_and_turns_its_displacement():
    offsets = np.zeros((2, 2, 2))
    offsets[0, 1] = [0.1, 0.2]  # the image at +x -y
    turned = orient_offsets(offsets, Orientation(flip_x=True))
    assert turned[0, 0] == pytest.approx([-0.1, 0.2])
    assert not turned[0, 1].any()


def test_with_the_mirror_as_stop_the_mean_is_the_shift_itself():
    about = small_instrument()
    for stop, mean in ((Stop.MIRROR, 0.0), (Stop.TELESCOPE, 0.2)):
        there = replace(about, stop=stop)
        wfs = kind_of(there).displace_images(there, np.full(8, 0.2))
        told = replace(there, wfs=wfs)
        assert np.allclose(image_offsets(told), 0.0)
        shift = InteractionModel(told, small_basis(), pupil_sampling=1, detector_nodes=1)
        assert shift._image_shift(Misregistration()) == pytest.approx((mean, mean))


def test_patterns_are_orthonormal_and_blurs_are_told_from_quadrupoles():
    for stop, n in ((Stop.MIRROR, 6), (Stop.TELESCOPE, 8)):
        patterns = image_patterns(stop)
        assert np.allclose(patterns @ patterns.T, np.eye(n))
        assert sum(map(is_blurring, patterns)) == 4


def test_unknown_places_widen_the_floor_and_known_ones_do_not():
    about = small_instrument()
    kind = kind_of(about)
    called_unknown, unstated = kind.image_floors(about)
    assert not called_unknown.any()
    unknown = kind.image_floors(replace(about, unknown=("wfs.image_offsets_px",)))
    assert unknown[0][0] == pytest.approx(0.25 * 0.15)
    np.testing.assert_array_equal(unstated, unknown[0])
    assert not unknown[1].any()
    told = replace(about, wfs=kind.displace_images(about, np.zeros(8)))
    assert not np.any(kind.image_floors(told))
    assert kind.image_sigma_subap(told) is None


def test_turned_edges_widen_shift_and_rotation_by_the_square_of_the_displacement():
    about = small_instrument()
    kind, separation = kind_of(about), about.wfs.image_separation_subap
    sheared = np.array([[0.1, 0.2], [0.1, -0.2], [-0.1, -0.2], [-0.1, 0.2]])
    found = kind.turned_edge_sigma(about, sheared + np.array([0.3, 0.4]))
    shift = EDGE_SHIFT * 0.025 / separation
    turn = EDGE_TURN * shift / (about.wfs.pupil_diameter / 2.0)
    np.testing.assert_allclose(found, [shift, shift, turn, 0.0])
    framed = replace(about, frames=FrameWindows(pixels_per_subaperture=2))
    located = kind.turned_edge_sigma(framed, sheared)
    shift = EDGE_SHIFT * 0.025 / separation
    assert located[:2] == pytest.approx(np.hypot(shift, LOCATED_SIGMA_PX / 2))
    np.testing.assert_allclose(located[2:], [turn, 0.0])
    stated = replace(about, wfs=kind.displace_images(about, sheared.T.ravel()))
    np.testing.assert_allclose(kind.turned_edge_sigma(stated, np.zeros((4, 2))), found)
    np.testing.assert_allclose(kind.turned_edge_sigma(stated, sheared), 4.0 * found)


def test_a_sensor_of_one_image_has_none_to_be_moved():
    lenslets = KINDS["shack-hartmann"].model
    with pytest.raises(ModelError):
        lenslets.displace_images(small_instrument(), np.zeros(8))
    edges = lenslets.turned_edge_sigma(small_instrument(), np.ones((4, 2)))
    assert not edges.any()
