"""Laws of the model at any registration."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from service.model.kinds import SlopeOrder, Stop
from service.model.misregistration import Misregistration, rotation
from service.model.slopes import (
    Orientation,
    SlopeRecipe,
    orient_mask,
    rtc_mask,
    to_conventions,
    to_rtc,
)
from tests.support.numerics import small_linearisation, small_model

registrations = st.builds(
    Misregistration,
    shift_x_subap=st.floats(-1.0, 1.0),
    shift_y_subap=st.floats(-1.0, 1.0),
    rotation_rad=st.floats(-np.pi, np.pi),
    magnification=st.floats(0.9, 1.1),
)


@given(registrations)
def test_boundary_units_and_back_is_the_same_registration(alpha):
    again = Misregistration.from_boundary(alpha.to_boundary())
    np.testing.assert_allclose(again.vector, alpha.vector, rtol=1e-14, atol=1e-300)


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_rotations_add_up_and_keep_lengths(first, second):
    both = rotation(first) @ rotation(second)
    np.testing.assert_allclose(both, rotation(first + second), atol=1e-13)
    np.testing.assert_allclose(both @ both.T, np.eye(2), atol=1e-13)


@settings(max_examples=15, deadline=None)
@given(registrations, st.sampled_from(Stop))
def test_the_matrix_is_finite_and_full_rank_at_any_registration(alpha, stop):
    matrix = small_model(stop).interaction_matrix(alpha)
    assert np.all(np.isfinite(matrix))
    assert np.linalg.cond(matrix[:, :20]) < 100


@settings(max_examples=15, deadline=None)
@given(registrations)
def test_a_whole_turn_is_no_turn(alpha):
    """1e-5: single precision."""
    around = Misregistration.from_vector(alpha.vector + np.array([0, 0, 2 * np.pi, 0]))
    matrix = small_model().interaction_matrix(alpha)
    difference = small_model().interaction_matrix(around) - matrix
    assert np.linalg.norm(difference) < 1e-5 * np.linalg.norm(matrix)


@settings(deadline=None)
@given(registrations)
def test_a_linearisation_moves_linearly(alpha):
    """Half-way between two registrations lies the mean of their matrices."""
    start = small_linearisation()
    middle = Misregistration.from_vector((alpha.vector + start.alpha.vector) / 2)
    expected = (start.matrix_at(alpha) + start.matrix) / 2
    scale = np.abs(expected).max()
    np.testing.assert_allclose(start.matrix_at(middle), expected, atol=1e-5 * scale)


signs = st.sampled_from((1, -1))
orientations = st.builds(
    Orientation,
    swap_xy=st.booleans(),
    flip_x=st.booleans(),
    flip_y=st.booleans(),
    sign_x=signs,
    sign_y=signs,
)
masks = arrays.arrays(bool, st.tuples(st.integers(1, 6), st.integers(1, 6)))


@given(masks, orientations, st.sampled_from(SlopeOrder))
def test_an_rtcs_list_of_slopes_is_a_permutation_with_signs(mask, orientation, order):
    """Every slope is there once, its sign is 1 or -1, and the way back undoes the way there."""
    listed = np.arange(1.0, order.kind.n_planes * mask.sum() + 1)
    there = to_conventions(listed, SlopeRecipe(order=order, orientation=orientation), mask)
    np.testing.assert_array_equal(np.sort(np.abs(there)), listed)
    np.testing.assert_array_equal(
        to_rtc(there, SlopeRecipe(order=order, orientation=orientation), mask), listed
    )
    turned = orient_mask(mask, orientation)
    assert turned.sum() == mask.sum()
    np.testing.assert_array_equal(rtc_mask(turned, orientation), mask)
