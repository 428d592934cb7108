"""Displacements of pupil images that no pyramid has leave the registration uncertain."""

import numpy as np
import pytest

import pyrcal.fitting.alternatives as alternatives
from tests.unit.estimation.bench import ELSEWHERE, fit, matrix


def in_place(found):
    return [one for one in found.alternatives if "in their places" in one.words]


def test_images_that_are_displaced_as_pyramids_have_them_are_no_alternative():
    assert in_place(fit(matrix(ELSEWHERE))) == []


def test_images_displaced_beyond_belief_are_tried_in_their_places(monkeypatch):
    monkeypatch.setattr(alternatives, "PLAUSIBLE_DISPLACEMENT_PX", 0.0)
    exact = matrix(ELSEWHERE)
    noise = 0.2 * exact.std(axis=0) * np.random.default_rng(3).normal(size=exact.shape)
    (one,) = in_place(fit(exact + noise))
    assert one.counts
    assert one.undecided
    # the true images are in their places: nothing is lost and hardly anything moves
    assert one.share == pytest.approx(1.0, abs=0.05)
    assert np.all(np.abs(one.moved) < 0.01)
