"""The RTC's own order, axes and signs of slopes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from service.errors import ModelError
from service.model.kinds import SignalKind, SlopeOrder
from service.model.slopes import (
    Orientation,
    SlopeRecipe,
    orient_mask,
    rtc_mask,
    signals_of_slopes,
    slopes_of,
    to_conventions,
    to_rtc,
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
    found = to_conventions(listed, SlopeRecipe(order=SlopeOrder.XY, orientation=orientation), MASK)
    expected = np.concatenate(gradients(positions(orient_mask(MASK, orientation)), plane))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def light(points, side_x, side_y, plane):
    """The light at ``points`` of the image at a side: it is brighter where the wavefront falls."""
    along_x, along_y = gradients(points, plane)
    x, y = points.T
    return 9.0 - side_x * along_x - side_y * along_y + side_x * side_y * (0.3 * x - 0.2 * y)


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=repr)
def test_images_seen_in_the_rtcs_axes_come_out_in_ours(orientation):
    """A flip mirrors the detector, where the images lie and what is in them; a sign only where."""
    plane = (0.7, -1.1, 0.31, 0.17)
    to_ours = np.eye(2)[::-1] if orientation.swap_xy else np.eye(2)
    to_ours = to_ours @ np.diag(
        [-1.0 if orientation.flip_x else 1.0, -1.0 if orientation.flip_y else 1.0]
    )
    listed = []
    for side_y, side_x in product((-1, 1), (-1, 1)):
        side = to_ours @ [side_x * orientation.sign_x, side_y * orientation.sign_y]
        listed.append(light(positions(MASK) @ to_ours.T, *side, plane))
    found = to_conventions(
        np.concatenate(listed), SlopeRecipe(order=SlopeOrder.IMAGES, orientation=orientation), MASK
    )
    ours = positions(orient_mask(MASK, orientation))
    expected = [light(ours, x, y, plane) for y, x in product((-1, 1), (-1, 1))]
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-12)
    slopes = slopes_of(found, SignalKind.INTENSITY)
    np.testing.assert_allclose(slopes, 4.0 * np.array(gradients(ours, plane)), atol=1e-12)


def test_the_orders_of_pixels_are_what_their_names_say():
    """Two subapertures above one: the pixels of a detector, numbered as they lie on it."""
    mask = np.array([[1, 1], [0, 1]], bool)
    detector = np.arange(16.0).reshape(4, 4)
    left, right = detector[:2], detector[2:]
    images = [part[mask] for half in (left, right) for part in (half[:, :2], half[:, 2:])]
    seen = np.tile(mask, (2, 2))
    for order, listed in (
        (SlopeOrder.IMAGES, np.concatenate(images)),
        (SlopeOrder.IMAGES_YX, np.concatenate([images[k] for k in (0, 2, 1, 3)])),
        (SlopeOrder.AROUND, np.concatenate([images[k] for k in (0, 1, 3, 2)])),
        (SlopeOrder.PIXELS, np.array(images).T.ravel()),
        (SlopeOrder.DETECTOR, detector[seen]),
    ):
        found = to_conventions(listed, SlopeRecipe(order=order, orientation=Orientation()), mask)
        np.testing.assert_array_equal(found, np.concatenate(images), str(order))


def test_slopes_of_the_smallest_signals_that_have_them_are_those():
    slopes = np.random.default_rng(2).normal(size=(2, N, 3))
    for kind in SignalKind:
        signals = signals_of_slopes(slopes, kind)
        assert signals.shape == (kind.n_planes * N, 3)
        np.testing.assert_allclose(slopes_of(signals, kind), slopes, rtol=1e-12)


@pytest.mark.parametrize("order", SlopeOrder)
def test_there_and_back_is_the_same_list_for_vectors_and_matrices(order):
    rng, n = np.random.default_rng(1), order.kind.n_planes * N
    both = rng.normal(size=n), rng.normal(size=(n, 3)).astype(np.float32)
    for orientation, values in product(ORIENTATIONS, both):
        there = to_conventions(values, SlopeRecipe(order=order, orientation=orientation), MASK)
        assert there.dtype == values.dtype
        back = to_rtc(values, SlopeRecipe(order=order, orientation=orientation), MASK)
        for found in (
            to_rtc(there, SlopeRecipe(order=order, orientation=orientation), MASK),
            to_conventions(back, SlopeRecipe(order=order, orientation=orientation), MASK),
        ):
            np.testing.assert_array_equal(found, values, err_msg=repr(orientation))


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=repr)
def test_a_mask_turned_and_turned_back_is_the_same_mask(orientation):
    np.testing.assert_array_equal(rtc_mask(orient_mask(MASK, orientation), orientation), MASK)


def test_the_orders_are_what_their_names_say():
    sx, sy = np.arange(N) + 0.0, np.arange(N) + 100.0
    same = Orientation()
    expected = np.concatenate([sx, sy])
    for order, listed in (
        (SlopeOrder.XY, expected),
        (SlopeOrder.YX, np.concatenate([sy, sx])),
        (SlopeOrder.INTERLEAVED, np.column_stack([sx, sy]).ravel()),
    ):
        np.testing.assert_array_equal(
            to_conventions(listed, SlopeRecipe(order=order, orientation=same), MASK), expected
        )


def test_by_hand_a_flip_of_x_reverses_a_row_and_negates_sx_only():
    row = np.ones((1, 3), bool)
    listed = np.array([1.0, 2, 3, 4, 5, 6])
    flipped = to_conventions(
        listed, SlopeRecipe(order=SlopeOrder.XY, orientation=Orientation(flip_x=True)), row
    )
    np.testing.assert_array_equal(flipped, [-3, -2, -1, 6, 5, 4])


def test_by_hand_a_swap_exchanges_the_components_and_transposes_the_grid():
    column = orient_mask(np.ones((1, 3), bool), Orientation(swap_xy=True))
    assert column.shape == (3, 1)
    listed = np.array([1.0, 2, 3, 4, 5, 6])
    swapped = to_conventions(
        listed,
        SlopeRecipe(order=SlopeOrder.XY, orientation=Orientation(swap_xy=True, sign_x=-1)),
        np.ones((1, 3), bool),
    )
    np.testing.assert_array_equal(swapped, [4, 5, 6, -1, -2, -3])


def test_an_unknown_orientation_is_taken_for_the_conventions_own():
    assert SlopeRecipe().orientation is None
    assert SlopeRecipe().assumed_orientation == Orientation()


def test_a_list_that_does_not_fit_the_mask_is_refused():
    with pytest.raises(ModelError, match=rf"found 5 of them; expected {2 * N}, 2 for each"):
        to_conventions(
            np.zeros(5), SlopeRecipe(order=SlopeOrder.XY, orientation=Orientation()), MASK
        )


def test_a_sign_other_than_one_is_refused():
    with pytest.raises(ModelError, match="found signs 1, 2; expected 1 or -1"):
        Orientation(sign_y=2)
