"""Karhunen-Loeve modes of functions that end, tile by tile, against the same functions whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.instrument.mirrors import grid
from service.model import karhunen_loeve
from service.model.kinds import Influence
from service.model.modes import analytic_basis
from service.model.pupil import instrument_pupil
from tests.support.numerics import small_instrument

N_MODES = 300


def dense_grid():
    """24 subapertures, 489 actuators, some of them behind the obscuration."""
    plain = small_instrument(
        grid(25, 8.0 / 24, 8.4),
        influence=Influence.GAUSSIAN,
        n_modes=N_MODES,
        obscuration_ratio=0.3,
    )
    return replace(
        plain,
        wfs=replace(plain.wfs, n_subapertures=24, pupil_separation_subap=30.0),
        mirror=replace(plain.mirror, pitch_m=8.0 / 24),
    )


@pytest.fixture
def by_tiles(monkeypatch):
    monkeypatch.setattr(karhunen_loeve, "WHOLE_BYTES", 0.0)


def test_statistics_by_tiles_are_those_of_the_functions_whole(monkeypatch):
    """A millionth of a function is left out at most, and that of the last mode is not lost."""
    instrument = dense_grid()
    surface = analytic_basis(instrument).surface
    whole = karhunen_loeve.surface_statistics(instrument, surface)
    monkeypatch.setattr(karhunen_loeve, "WHOLE_BYTES", 0.0)
    found = karhunen_loeve.surface_statistics(instrument, surface)
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(other).max())


def test_modes_by_tiles_are_orthonormal_over_the_pupil(by_tiles):
    """1e-5: what is left out of the functions, seen on the pupil with the functions whole."""
    instrument = dense_grid()
    pupil = instrument_pupil(instrument, 4)
    basis = analytic_basis(instrument)
    shapes = basis.render(pupil.points)
    shapes -= pupil.weights @ shapes
    gram = shapes.T @ (shapes * pupil.weights[:, None])
    np.testing.assert_allclose(gram, np.eye(N_MODES), atol=1e-5)


def test_modes_by_tiles_are_the_modes_of_the_functions_whole(monkeypatch):
    """Their variances, and the space that they span, but for what is left out."""
    instrument = dense_grid()
    whole = analytic_basis(instrument)
    monkeypatch.setattr(karhunen_loeve, "WHOLE_BYTES", 0.0)
    found = analytic_basis(instrument)
    np.testing.assert_allclose(found.variance_m2, whole.variance_m2, rtol=1e-4)
    points = instrument_pupil(instrument, 2).points
    one, other = found.render(points)[:, :50], whole.render(points)[:, :50]
    assert np.linalg.norm(one - other) < 1e-3 * np.linalg.norm(other)
