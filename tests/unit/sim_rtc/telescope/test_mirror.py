from dataclasses import replace

import numpy as np
import pytest

from service.errors import ConfigurationError
from service.model.surface import ThinPlate
from sim_rtc.telescope.mirror import (
    MirrorDrive,
    MirrorFaults,
    MirrorLimits,
    TensionedPlate,
    disobedient,
    misplace_actuators,
)


@pytest.fixture(scope="module")
def plate(small_instrument):
    mirror = small_instrument.mirror
    return TensionedPlate(mirror.positions_m / mirror.pitch_m, tension=0.7)


def test_a_plate_on_firm_springs_passes_through_every_actuator(plate):
    n = len(plate.positions)
    influence = plate.basis(plate.positions) @ plate.coefficients(np.eye(n))
    np.testing.assert_allclose(influence, np.eye(n), atol=1e-9)


def test_a_common_stroke_is_a_flat_piston(plate):
    n = len(plate.positions)
    points = np.random.default_rng(1).uniform(-4.0, 4.0, (50, 2))
    surface = plate.basis(points) @ plate.coefficients(np.ones((n, 1)))
    np.testing.assert_allclose(surface, 1.0, atol=1e-9)


def test_soft_springs_yield_to_a_single_actuator_but_not_to_piston(plate):
    n = len(plate.positions)
    soft = replace(plate, softness=0.05)
    influence = soft.basis(plate.positions) @ soft.coefficients(np.eye(n))
    assert np.all(np.diag(influence) < 1.0)
    np.testing.assert_allclose(influence.sum(axis=1), 1.0, atol=1e-9)


def test_little_tension_is_the_thin_plate_of_the_service_inside_the_mirror(plate):
    """The kernel tends to r² log r; what is left is the affine part the thin plate has besides."""
    n = len(plate.positions)
    central = int(np.argmin(np.hypot(*plate.positions.T)))
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (200, 2))

    def difference(tension):
        slack = replace(plate, tension=tension)
        found = slack.basis(points) @ slack.coefficients(np.eye(n))[:, central]
        thin = ThinPlate(plate.positions)
        return np.abs(found - thin.basis(points) @ thin.coefficients(np.eye(n))[:, central]).max()

    assert difference(0.01) < 1e-4
    assert difference(1.0) > 0.005
    assert difference(3.0) > 0.02


def test_the_kernel_is_continuous_where_its_series_takes_over():
    pair = TensionedPlate(np.zeros((1, 2)), tension=1.0)
    below, above = pair.basis(np.array([[0.999e-3, 0.0], [1.001e-3, 0.0]]))[:, 0]
    assert above / below == pytest.approx((1.001 / 0.999) ** 2, rel=1e-3)


def test_a_dead_actuator_is_where_its_neighbours_bend_the_plate(plate, small_basis):
    weights, stuck = disobedient(plate, small_basis.mode_to_actuator, MirrorFaults(dead=(20,)))
    assert np.all(weights[20] == 0.0)
    assert np.all(stuck == 0.0)
    healthy, _ = disobedient(plate, small_basis.mode_to_actuator, MirrorFaults())
    at = plate.basis(plate.positions)
    others = np.arange(len(plate.positions)) != 20
    np.testing.assert_allclose((at @ weights)[others], (at @ healthy)[others], atol=1e-8)
    # A tilt needs no actuator: the plate spans the gap.
    tilt, obeyed = (at @ weights)[:, 0], (at @ healthy)[:, 0]
    assert abs(tilt[20] - obeyed[20]) < 0.05 * np.ptp(obeyed)


def test_a_stuck_actuator_ignores_the_modes_and_keeps_its_place(plate, small_basis):
    faults = MirrorFaults(stuck=((20, 1e-6),))
    weights, stuck = disobedient(plate, small_basis.mode_to_actuator, faults)
    at = plate.basis(plate.positions)
    np.testing.assert_allclose((at @ weights)[20], 0.0, atol=1e-8)
    expected = np.where(np.arange(len(plate.positions)) == 20, 1e-6, 0.0)
    np.testing.assert_allclose(at @ stuck, expected, atol=1e-14)


@pytest.mark.parametrize(
    ("faults", "text"),
    [
        (MirrorFaults(dead=(500,)), "found actuator 500; the mirror has 0 to"),
        (MirrorFaults(dead=(3,), stuck=((3, 0.0),)), "expected every actuator once"),
    ],
)
def test_faults_the_mirror_cannot_have_are_refused(plate, small_basis, faults, text):
    with pytest.raises(ConfigurationError, match=text):
        disobedient(plate, small_basis.mode_to_actuator, faults)


def test_position_errors_contain_no_registration(small_instrument):
    mirror = small_instrument.mirror
    moved = misplace_actuators(mirror, 0.02, np.random.default_rng(2)).positions_m
    error = moved - mirror.positions_m
    x, y = mirror.positions_m.T
    assert np.abs(error.mean(axis=0)).max() < 1e-12
    assert abs(np.sum(x * error[:, 0] + y * error[:, 1])) < 1e-9
    assert abs(np.sum(x * error[:, 1] - y * error[:, 0])) < 1e-9
    # 77 actuators: 8 % on an RMS.
    assert error.std() == pytest.approx(0.02 * mirror.pitch_m, rel=0.25)


# --- the drive


RATE_HZ = 1000.0


def drive(instrument, basis, **options):
    return MirrorDrive(instrument.mirror, basis.mode_to_actuator, frame_rate_hz=RATE_HZ, **options)


def test_an_ideal_mirror_does_as_it_is_told(small_instrument, small_basis):
    command = np.random.default_rng(3).normal(0.0, 1e-8, 40).astype(np.float32)
    followed = command.copy()
    assert drive(small_instrument, small_basis).follow(followed, None) == 0
    np.testing.assert_array_equal(followed, command)


def test_the_mean_over_the_exposure_is_that_of_an_exponential(small_instrument, small_basis):
    rise_s = 0.7e-3
    slow = drive(small_instrument, small_basis, rise_s=rise_s)
    time_constant = rise_s * RATE_HZ / np.log(9.0)
    seen = []
    for _ in range(6):
        command = np.zeros(40, dtype=np.float32)
        command[3] = 1e-7
        slow.follow(command, None)
        seen.append(command[3] / 1e-7)
    t = np.arange(6)
    mean_left = time_constant * (1 - np.exp(-1 / time_constant)) * np.exp(-t / time_constant)
    np.testing.assert_allclose(seen, 1.0 - mean_left, rtol=1e-5)


def test_the_dither_part_lags_as_the_whole_does(small_instrument, small_basis):
    slow = drive(small_instrument, small_basis, rise_s=2e-3)
    rng = np.random.default_rng(4)
    for _ in range(5):
        dither = rng.normal(0.0, 1e-8, 40).astype(np.float32)
        whole = dither.copy()
        slow.follow(whole, dither)
        np.testing.assert_allclose(whole, dither, rtol=1e-5, atol=1e-14)
    # After its end it dies away with the rest.
    whole = np.zeros(40, dtype=np.float32)
    slow.follow(whole, None)
    assert np.abs(whole).max() > 0.0


def test_a_sharp_bend_is_flattened_and_counted(small_instrument, small_basis):
    limits = MirrorLimits(bend_m=0.2e-6)
    strokes = small_basis.mode_to_actuator
    limited = drive(small_instrument, small_basis, limits=limits)
    command = np.zeros(40, dtype=np.float32)
    command[39] = 2e-6
    asked = command.copy()
    assert limited.follow(command, None) > 0
    assert np.abs(strokes @ command).max() < np.abs(strokes @ asked).max()
    # A tilt of the same size bends only the edge, where a neighbour is missing.
    tilt = np.zeros(40, dtype=np.float32)
    tilt[0] = 0.2e-6
    assert drive(small_instrument, small_basis, limits=limits).follow(tilt, None) == 0


def test_no_actuator_is_asked_for_much_more_than_its_stroke(small_instrument, small_basis):
    limits = MirrorLimits(stroke_m=1e-6, bend_m=1.0)
    limited = drive(small_instrument, small_basis, limits=limits)
    command = np.zeros(40, dtype=np.float32)
    command[0] = 3e-6
    assert limited.follow(command, None) > 0
    # The modes cannot make the clipped shape exactly.
    assert np.abs(small_basis.mode_to_actuator @ command).max() < 1.5e-6
