"""The matrix as an RTC lists it."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from service.model.interaction import InteractionModel, RtcInteractionModel
from service.model.kinds import SlopeOrder
from service.model.slopes import Orientation, SlopeRecipe, to_conventions
from tests.numerics import SOMEWHERE, small_basis, small_instrument

ORIENTATION = Orientation(swap_xy=True, flip_x=True, sign_y=-1)


def models():
    """Of an RTC with habits of its own, and a mask without any symmetry."""
    mask = np.hypot(np.arange(12)[:, None] - 5.2, np.arange(12) - 6.1) < 5.4
    mask[4, 7] = False
    instrument = small_instrument()
    instrument = replace(
        instrument,
        wfs=replace(instrument.wfs, valid_subapertures=mask),
        slopes=SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=ORIENTATION),
    )
    return (
        mask,
        InteractionModel(instrument, small_basis()),
        RtcInteractionModel(instrument, small_basis()),
    )


def test_matrix_and_derivatives_are_the_models_as_the_rtc_lists_its_slopes():
    mask, ours, theirs = models()

    def back(matrix):
        return to_conventions(
            matrix, SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=ORIENTATION), mask
        )

    found, expected = theirs.linearise(SOMEWHERE), ours.linearise(SOMEWHERE)
    np.testing.assert_array_equal(back(found.matrix), expected.matrix)
    for there, here in zip(found.derivatives, expected.derivatives, strict=True):
        np.testing.assert_array_equal(back(there), here)
    assert not np.array_equal(found.matrix, expected.matrix)


def test_an_rtc_with_the_conventions_own_habits_gets_the_models_matrix():
    plain = InteractionModel(small_instrument(), small_basis())
    theirs = RtcInteractionModel(small_instrument(), small_basis())
    np.testing.assert_array_equal(
        theirs.interaction_matrix(SOMEWHERE), plain.interaction_matrix(SOMEWHERE)
    )


def test_slopes_near_unknown_surface_are_listed_alike():
    mask, ours, theirs = models()
    unknown = ours.pupil.points[:, 0] > 4.0

    class Partly(type(small_basis())):
        def known(self, points):
            return ~unknown

    basis = Partly(**{one.name: getattr(small_basis(), one.name) for one in fields(small_basis())})
    ours.basis = theirs.basis = basis
    rows = theirs.unknown_rows(SOMEWHERE).astype(float)
    back = (
        to_conventions(
            rows, SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=ORIENTATION), mask
        )
        != 0
    )
    np.testing.assert_array_equal(back, ours.unknown_rows(SOMEWHERE))
    assert 0 < back.sum() < len(back)
