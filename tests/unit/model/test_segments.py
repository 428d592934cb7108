"""Mirrors of several segments: functions that end at a gap, modes without differential pistons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.instrument.mirrors import hexagonal
from service.model import karhunen_loeve
from service.model.instrument import Mirror, instrument_sha256
from service.model.kinds import Influence, InfluenceShape
from service.model.modes import analytic_basis
from service.model.pupil import instrument_pupil
from service.model.surface import Gaussian, segment_of
from tests.support.numerics import small_instrument

GAPS = (30.0, 90.0, 150.0, 210.0, 270.0, 330.0)
PITCH_M = 0.6


def petals(*, segments_deg=GAPS):
    """Six petals of 8.8 m over a pupil of 8; no actuator on a gap."""
    points = hexagonal(PITCH_M, 8.8)
    middle = np.rad2deg(np.arctan2(points[:, 1], points[:, 0])) % 60.0
    positions = points[(np.abs(middle - 30.0) > 1e-6) & (np.linalg.norm(points, axis=1) > 1.0)]
    plain = small_instrument(
        positions, influence=Influence.GAUSSIAN, n_modes=120, obscuration_ratio=0.3
    )
    mirror = Mirror(
        positions_m=positions,
        pitch_m=PITCH_M,
        shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=0.3),
        segments_deg=segments_deg,
    )
    return replace(plain, mirror=mirror)


def pistons(instrument):
    """Each petal one metre high, without the mean of all, at the points of a pupil."""
    pupil = instrument_pupil(instrument, 4)
    there = segment_of(pupil.points, GAPS)
    shapes = (there[:, None] == np.arange(6)).astype(float)
    return pupil, shapes - pupil.weights @ shapes


def test_a_function_ends_at_the_gap_with_its_rates():
    """Two actuators 1 m apart, a gap between them: 0.35 of neither reaches the other."""
    ends = Gaussian(np.array([[2.0, 0.5], [2.0, -0.5]]), 1.0, 0.35, (0.0, 180.0))
    np.testing.assert_array_equal(ends.basis(ends.positions), np.eye(2))
    one = np.array([[2.0, 0.1], [2.0, -0.1]])
    height = 0.35 ** (0.4**2)
    np.testing.assert_allclose(ends.basis(one), height * np.eye(2))
    up = ends.slope(one, np.array([[0.0, 1.0], [0.0, 1.0]]))
    assert up[0, 0] > 0.0 > up[1, 1]
    assert up[0, 1] == up[1, 0] == 0.0
    np.testing.assert_array_equal(ends.wider(one) == 0.0, ~np.eye(2, dtype=bool))


def test_steps_are_what_a_petal_is_higher_than_the_one_before():
    """A gap at 0 deg, 1 to 2 from the centre: a function on it is half there, as its mean says."""
    ends = Gaussian(np.array([[1.5, 0.2], [1.5, -0.2]]), 1.0, 0.35, (0.0, 180.0))
    radius = np.arange(1.0, 2.0, 0.25)
    mean = np.mean(0.35 ** ((radius - 1.5) ** 2 + 0.04))
    np.testing.assert_allclose(ends.steps(1.0, 2.0)[0], [mean, -mean], rtol=1e-4)


def test_points_are_on_the_segment_that_begins_at_the_gap_before_them():
    angle = np.deg2rad([0.0, 29.0, 31.0, 90.0, 359.0])
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    np.testing.assert_array_equal(segment_of(points, GAPS), [0, 0, 1, 2, 0])


@pytest.mark.parametrize("whole_bytes", [0.0, 1e12], ids=["by tiles", "whole"])
def test_modes_hold_no_differential_piston_and_still_make_tilts(monkeypatch, whole_bytes):
    """What is left of a tilt is what all actuators leave, to a tenth: a tilt has no step."""
    monkeypatch.setattr(karhunen_loeve, "WHOLE_BYTES", whole_bytes)
    instrument = petals()
    basis = analytic_basis(instrument)
    radius = instrument.wfs.pupil_diameter / 2
    steps = basis.surface.steps(0.3 * radius, radius) @ basis.mode_to_actuator
    assert np.abs(steps).max() < 1e-9 * np.abs(basis.mode_to_actuator).max()
    pupil, _ = pistons(instrument)
    tilt = pupil.points[:, 0] - pupil.weights @ pupil.points[:, 0]
    assert left(basis, pupil, tilt) < 1.1 * left(zonal(basis), pupil, tilt)


def zonal(basis):
    return replace(basis, coefficients=np.eye(len(basis.mode_to_actuator)))


def left(basis, pupil, shape):
    """Of a shape, what the modes cannot make of it."""
    root = np.sqrt(pupil.weights)
    modes = basis.render(pupil.points)
    modes = (modes - pupil.weights @ modes) * root[:, None]
    rest = shape * root - modes @ np.linalg.lstsq(modes, shape * root, rcond=None)[0]
    return np.linalg.norm(rest) / np.linalg.norm(shape * root)


def test_a_petals_piston_cannot_be_made_of_the_modes():
    """The actuators make it to 9 %; of modes with steps 26 % would be left, of these 41 %."""
    instrument = petals()
    basis = analytic_basis(instrument)
    pupil, shapes = pistons(instrument)
    alternating = shapes @ np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    assert left(zonal(basis), pupil, alternating) < 0.1
    assert left(basis, pupil, alternating) > 0.4


def test_a_mirror_of_one_piece_keeps_the_digest_that_it_has_always_had():
    assert instrument_sha256(petals()) != instrument_sha256(petals(segments_deg=()))
    plain = small_instrument(petals().mirror.positions_m)
    assert "segments" not in repr(plain.mirror.shape)
