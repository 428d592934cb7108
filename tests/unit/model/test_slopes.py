"""The RTC's own order, axes and signs of slopes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from service.errors import ModelError
from service.model.kinds import SlopeOrder
from service.model.slopes import (
    Orientation,
    SlopeRecipe,
    rtc_mask,
    to_conventions,
    to_rtc,
    turned_mask,
)

SIGNS = (1, -1)
ORIENTATIONS = [
    Orientation(swap_xy=swap, flip_x=flip_x, flip_y=flip_y, sign_x=sign_x, sign_y=sign_y)
    for swap, flip_x, flip_y, sign_x, sign_y in product(
        (False, True), (False, True), (False, True), SIGNS, SIGNS
    )
]
MASK = np.array([[0, 1, 1, 0], [1, 1, 1, 1], [1, 0, 1, 1], [0, 0, 1, 0]], bool)
"""Like none of its own turns."""

N = int(MASK.sum())


def gradients(points, plane):
    """Sx and Sy at ``points`` of the wavefront ``a x + b y + c x y + d x² / 2``."""
    a, b, c, d = plane
    x, y = points.T
    return a + c * y + d * x, b + c * x


def positions(mask):
    y, x = np.nonzero(mask)
    centre = (np.array(mask.shape[::-1]) - 1) / 2
    return np.column_stack([x, y]) - centre


def seen_by_the_rtc(plane, orientation, mask):
    """What an RTC with these axes measures of a wavefront, worked out from the geometry alone.

    Its column axis is our x unless swapped, and runs backwards if flipped.
    """
    to_ours = np.eye(2)[::-1] if orientation.swap_xy else np.eye(2)
    to_ours = to_ours @ np.diag([-1.0 if orientation.flip_x else 1.0, 1.0])
    to_ours = to_ours @ np.diag([1.0, -1.0 if orientation.flip_y else 1.0])
    ours = positions(mask) @ to_ours.T
    along = np.array(gradients(ours, plane)).T @ to_ours
    return along[:, 0] * orientation.sign_x, along[:, 1] * orientation.sign_y


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=repr)
def test_a_wavefront_seen_in_the_rtcs_axes_comes_out_in_ours(orientation):
    plane = (0.7, -1.1, 0.31, 0.17)
    listed = np.concatenate(seen_by_the_rtc(plane, orientation, MASK))
    found = to_conventions(listed, SlopeOrder.XY, orientation, MASK)
    expected = np.concatenate(gradients(positions(turned_mask(MASK, orientation)), plane))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("order", SlopeOrder)
@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=repr)
def test_there_and_back_is_the_same_list_for_vectors_and_matrices(order, orientation):
    rng = np.random.default_rng(1)
    for values in (rng.normal(size=2 * N), rng.normal(size=(2 * N, 3)).astype(np.float32)):
        there = to_conventions(values, order, orientation, MASK)
        assert there.dtype == values.dtype
        np.testing.assert_array_equal(to_rtc(there, order, orientation, MASK), values)
        back = to_rtc(values, order, orientation, MASK)
        np.testing.assert_array_equal(to_conventions(back, order, orientation, MASK), values)


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=repr)
def test_a_mask_turned_and_turned_back_is_the_same_mask(orientation):
    np.testing.assert_array_equal(rtc_mask(turned_mask(MASK, orientation), orientation), MASK)


def test_the_orders_are_what_their_names_say():
    sx, sy = np.arange(N) + 0.0, np.arange(N) + 100.0
    same = Orientation()
    expected = np.concatenate([sx, sy])
    for order, listed in (
        (SlopeOrder.XY, expected),
        (SlopeOrder.YX, np.concatenate([sy, sx])),
        (SlopeOrder.INTERLEAVED, np.column_stack([sx, sy]).ravel()),
    ):
        np.testing.assert_array_equal(to_conventions(listed, order, same, MASK), expected)


def test_by_hand_a_flip_of_x_reverses_a_row_and_negates_sx_only():
    row = np.ones((1, 3), bool)
    listed = np.array([1.0, 2, 3, 4, 5, 6])
    flipped = to_conventions(listed, SlopeOrder.XY, Orientation(flip_x=True), row)
    np.testing.assert_array_equal(flipped, [-3, -2, -1, 6, 5, 4])


def test_by_hand_a_swap_exchanges_the_components_and_transposes_the_grid():
    column = turned_mask(np.ones((1, 3), bool), Orientation(swap_xy=True))
    assert column.shape == (3, 1)
    listed = np.array([1.0, 2, 3, 4, 5, 6])
    swapped = to_conventions(
        listed, SlopeOrder.XY, Orientation(swap_xy=True, sign_x=-1), np.ones((1, 3), bool)
    )
    np.testing.assert_array_equal(swapped, [4, 5, 6, -1, -2, -3])


def test_an_unknown_orientation_is_taken_for_the_conventions_own():
    assert SlopeRecipe().orientation is None
    assert SlopeRecipe().assumed_orientation == Orientation()


def test_a_list_that_does_not_fit_the_mask_is_refused():
    with pytest.raises(ModelError, match=rf"found 5 of them; expected {2 * N}, two for each"):
        to_conventions(np.zeros(5), SlopeOrder.XY, Orientation(), MASK)


def test_a_sign_other_than_one_is_refused():
    with pytest.raises(ModelError, match="found signs 1, 2; expected 1 or -1"):
        Orientation(sign_y=2)
