"""Reference slopes that hold a shape, shapes as modes of the mirror, and how large they may be."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from service.control.references import (
    MAX_SLOPE,
    compute_references,
    holding_gain,
    limit_shape,
    shape_in_modes,
)
from service.errors import ModelError
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.zernikes import compute_zernikes
from service.records.products import Frame
from tests.support.numerics import (
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    small_basis,
    small_instrument,
    small_matrix,
    small_model,
)

QUARTER = Misregistration(rotation_rad=np.pi / 2)


@pytest.mark.parametrize(("gain", "held"), [(0.72, 1.01), (0.525, 1.06), (0.36, 1.17)])
def test_references_with_the_gain_of_pokes_hold_more_than_the_shape(gain, held):
    # to the digits of the measurement
    assert gain / holding_gain(np.array([gain]))[0] == pytest.approx(held, abs=0.006)


def test_a_sensor_without_loss_holds_what_it_shows():
    assert holding_gain(np.array([1.0, 1.9])).tolist() == [1.0, 1.9]


@pytest.mark.parametrize("gain", [0.0, -0.4, np.nan, np.inf])
def test_a_gain_that_is_not_positive_is_refused(gain):
    with pytest.raises(ModelError, match="positive"):
        holding_gain(np.array([0.5, gain]))


def test_references_are_the_slopes_of_the_shape_times_the_holding_gain():
    matrix = np.array([[1e6, 2e6], [0.0, 4e6], [3e6, 0.0]], np.float32)
    gain = np.array([1.0, 0.36])
    # 0.36 / 1.17 = 0.307: 100 nm of the second mode shows as 30.7 nm
    expected = [0.1 + 2 * 0.0307, 4 * 0.0307, 0.3]
    assert compute_references(matrix, gain, np.array([1e-7, 1e-7])) == pytest.approx(
        np.array(expected), abs=2e-3
    )


def test_references_of_other_modes_than_the_matrix_are_refused():
    with pytest.raises(ModelError, match="found 3 gains and 2 coefficients for a matrix of 2"):
        compute_references(np.ones((4, 2)), np.ones(3), np.ones(2))
    with pytest.raises(ModelError, match="finite"):
        compute_references(np.ones((4, 2)), np.ones(2), np.array([1.0, np.nan]))


def disc(n: int = 400) -> np.ndarray:
    axis = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) <= 1.0]


def test_zernikes_are_orthonormal_over_the_disc():
    points = disc()
    shapes = np.array([compute_zernikes(row, points) for row in np.eye(36)])
    # the border of a disc of 400 points across is good to a few per mille
    assert shapes @ shapes.T / len(points) == pytest.approx(np.eye(36), abs=0.01)


@pytest.mark.parametrize(
    ("noll", "shape"),
    [
        (2, lambda x, _: 2 * x),
        (3, lambda _, y: 2 * y),
        (4, lambda x, y: np.sqrt(3) * (2 * (x**2 + y**2) - 1)),
        (5, lambda x, y: np.sqrt(6) * 2 * x * y),
        (6, lambda x, y: np.sqrt(6) * (x**2 - y**2)),
        (8, lambda x, y: np.sqrt(8) * (3 * (x**2 + y**2) - 2) * x),
        (11, lambda x, y: np.sqrt(5) * (6 * (x**2 + y**2) ** 2 - 6 * (x**2 + y**2) + 1)),
    ],
)
def test_zernikes_have_the_numbers_of_noll(noll, shape):
    points = disc(30)
    expected = shape(*points.T)
    assert compute_zernikes(np.eye(noll)[noll - 1], points) == pytest.approx(expected, abs=1e-12)


def test_a_shape_of_the_mirror_stays_as_it_is():
    given = np.arange(5) * 1e-9
    found = shape_in_modes(small_model(), SOMEWHERE, given, Frame.MIRROR, n_modes=N_CONTROLLED)
    assert found.coefficients_m.tolist() == [*given, *np.zeros(N_MODES - 5)]
    assert found.unexplained == 0.0


@pytest.mark.parametrize("alpha", [Misregistration(), SOMEWHERE, QUARTER])
def test_a_shape_of_the_instrument_does_not_turn_with_the_mirror(alpha):
    model, astigmatism = small_model(), np.array([0, 0, 0, 0, 0, 60e-9])
    found = shape_in_modes(model, alpha, astigmatism, Frame.INSTRUMENT, n_modes=N_CONTROLLED)
    points, weights = model.pupil.points, model.pupil.weights
    expected = compute_zernikes(astigmatism, points / 6.0)
    made = model.render_modes(alpha) @ found.coefficients_m
    left = made - expected - weights @ (made - expected)
    size = np.sqrt(weights @ (expected - weights @ expected) ** 2)
    assert np.sqrt(weights @ left**2) / size == pytest.approx(found.unexplained, rel=1e-3)
    assert found.unexplained < 0.05
    assert not found.coefficients_m[N_CONTROLLED:].any()


def test_a_quarter_turn_of_the_mirror_reverses_the_coefficients_of_astigmatism():
    at_0, turned = (
        shape_in_modes(
            small_model(),
            alpha,
            np.array([0, 0, 0, 0, 0, 60e-9]),
            Frame.INSTRUMENT,
            n_modes=N_CONTROLLED,
        ).coefficients_m
        for alpha in (Misregistration(), QUARTER)
    )
    # the actuators of the inner rings do not repeat after a quarter of a turn
    assert turned @ at_0 / (at_0 @ at_0) == pytest.approx(-1.0, abs=0.05)


def test_a_map_is_the_same_shape_as_its_zernikes():
    axis = (np.arange(120) + 0.5) / 60.0 - 1.0
    x, y = np.meshgrid(axis, axis)
    coma = np.array([0, 0, 0, 0, 0, 0, 0, 40e-9])
    drawn = compute_zernikes(coma, np.column_stack([x.ravel(), y.ravel()])).reshape(120, 120)
    by_map, by_number = (
        shape_in_modes(
            small_model(), SOMEWHERE, given, Frame.INSTRUMENT, n_modes=N_CONTROLLED
        ).coefficients_m
        for given in (drawn, coma)
    )
    # a bilinear interpolation between 120 pixels
    assert by_map == pytest.approx(by_number, abs=0.1e-9)


def test_a_shape_that_no_mode_makes_is_unexplained():
    ripple = np.zeros(120)
    ripple[105:] = 10e-9
    found = shape_in_modes(small_model(), SOMEWHERE, ripple, Frame.INSTRUMENT, n_modes=N_CONTROLLED)
    assert found.unexplained > 0.8


@pytest.mark.parametrize(
    ("given", "frame", "message"),
    [
        (np.ones(N_CONTROLLED + 1), Frame.MIRROR, "30 modes that the loop controls"),
        (np.ones((3, 3)), Frame.MIRROR, "30 modes that the loop controls"),
        (np.ones((3, 4)), Frame.INSTRUMENT, "square"),
        (np.full((3, 3), np.nan), Frame.INSTRUMENT, "finite"),
        (np.array([0.0, np.nan]), Frame.MIRROR, "finite"),
    ],
)
def test_what_is_no_shape_is_refused(given, frame, message):
    with pytest.raises(ModelError, match=message):
        shape_in_modes(small_model(), SOMEWHERE, given, frame, n_modes=N_CONTROLLED)


@cache
def astigmatism_limit(rms_m: float, seeing_arcsec: float):
    return limit_shape(
        small_instrument(),
        small_basis(),
        np.eye(N_MODES)[2] * rms_m,
        optical_gain=np.ones(N_MODES),
        n_controlled=N_CONTROLLED,
        worst_seeing_arcsec=seeing_arcsec,
    )


def test_the_largest_shape_does_not_depend_on_the_size_that_is_given():
    one, other = astigmatism_limit(1e-8, 0.6), astigmatism_limit(1e-6, 0.6)
    assert one.largest_m == pytest.approx(other.largest_m, rel=1e-6)
    assert one.accepted
    assert not other.accepted
    assert f"at most {one.largest_m * 1e9:.0f} nm" in other.reason


def test_a_worse_seeing_permits_less():
    limits = [astigmatism_limit(1e-8, seeing).largest_m for seeing in (0.6, 0.9, 1.2)]
    assert limits == sorted(limits, reverse=True)


def test_in_good_seeing_the_largest_reference_slope_is_the_limit():
    peak = np.abs(small_matrix(Misregistration())[:, 2]).max()
    assert astigmatism_limit(1e-8, 0.01).largest_m == pytest.approx(MAX_SLOPE / peak, rel=0.01)


def test_a_flat_shape_is_always_accepted():
    assert astigmatism_limit(0.0, 1.2).accepted


def test_a_seeing_that_is_not_positive_is_refused():
    with pytest.raises(ModelError, match="seeing"):
        astigmatism_limit(1e-8, 0.0)


def test_a_sensor_that_does_not_lose_its_response_has_no_limit():
    instrument = load_instrument("canary")
    basis = modal_basis(instrument)
    found = limit_shape(
        instrument,
        basis,
        np.eye(basis.n_modes)[2] * 1e-7,
        optical_gain=np.ones(basis.n_modes),
        n_controlled=20,
        worst_seeing_arcsec=2.0,
    )
    assert found.accepted
    assert found.largest_m == np.inf
