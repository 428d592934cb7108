from concurrent.futures import Executor, Future
from itertools import islice

import numpy as np
import pytest

from service.model.kinds import KarhunenLoeve
from service.model.misregistration import Misregistration
from sim_rtc.computer.feed import BATCH_FRAMES, Ahead, OpenLoopFeed, OpenModes, message_frames
from sim_rtc.telescope.atmosphere import Layer, build_layers
from sim_rtc.telescope.detector import Detector
from sim_rtc.telescope.imperfections import SETS, Imperfections
from sim_rtc.telescope.linear import LinearPlant
from sim_rtc.telescope.mirror import MirrorFaults
from sim_rtc.telescope.registration import Drift, Flexure, Jump, MovingOptics, Schedule
from sim_rtc.telescope.scene import PlayedTurbulence
from sim_rtc.telescope.sky import SeeingSchedule, Shape, Sky, Turbulence, VibrationLine, Vibrations

STILL = Schedule(start=Misregistration())
STEADY = SeeingSchedule(start_arcsec=1.0)


class Immediate(Executor):
    """Does the work when it is submitted: what the background would have had time for."""

    def submit(self, function, /, *args, **kwargs):
        future = Future()
        future.set_result(function(*args, **kwargs))
        return future


class Never(Executor):
    """Work that is never finished in time."""

    def submit(self, function, /, *args, **kwargs):
        return Future()


@pytest.fixture(scope="module")
def plant(small_instrument, small_basis):
    return LinearPlant(small_instrument, small_basis, rng=np.random.default_rng(1))


def make_feed(
    plant,
    instrument,
    schedule,
    executor=None,
    winds=((20.0, 10.0), (7.0, 100.0)),
    seeing=STEADY,
    lines=(),
    played=None,
    batch_frames=BATCH_FRAMES,
):
    optics = MovingOptics(plant, schedule, executor or Immediate())
    detector = Detector(
        instrument,
        images=optics.start().images,
        valid=plant.valid,
        magnitude=-30.0,
        frame_rate_hz=500.0,
    )
    layers = build_layers(
        tuple(Layer(fraction=1.0, speed_m_s=v, direction_deg=angle) for v, angle in winds),
        points_m=plant.points_m,
        pitch_m=plant.pitch_m,
        turbulence=KarhunenLoeve(),
        rng=np.random.default_rng(2),
    )
    return OpenLoopFeed(
        sky=Sky(
            turbulence=Turbulence(layers, seeing),
            vibrations=Vibrations(
                lines,
                points=plant.points_m,
                weights=plant.weights,
                frame_rate_hz=500.0,
                rng=np.random.default_rng(4),
            ),
            played=played,
        ),
        optics=optics,
        sensor_opd_m=plant.sensor_opd_m,
        detector=detector,
        frame_rate_hz=500.0,
        jump_times_s=tuple(jump.time_s for jump in schedule.jumps),
        rng=np.random.default_rng(3),
        batch_frames=batch_frames,
    )


def test_slopes_are_those_of_the_phase_beside_them(plant, small_instrument):
    schedule = Schedule(start=Misregistration(), jumps=(Jump(time_s=0.35, shift_x_subap=0.2),))
    blocks = list(islice(make_feed(plant, small_instrument, schedule).blocks(), 3))
    for block in blocks:
        expected = block.phases_m @ block.optics.slopes_per_phase.T
        # float32 products over 1200 points.
        np.testing.assert_allclose(block.slopes[::10], expected, atol=1e-4 * expected.std())


def test_a_jump_falls_on_its_batch_and_changes_the_optics(plant, small_instrument):
    schedule = Schedule(start=Misregistration(), jumps=(Jump(time_s=0.35, shift_x_subap=0.2),))
    blocks = list(islice(make_feed(plant, small_instrument, schedule).blocks(), 2))
    # 0.35 s at 500 Hz is frame 175, within the batch from 170 on.
    assert [b.first_frame for b in blocks] == [0, 180]
    assert [b.optics.alpha.shift_x_subap for b in blocks] == pytest.approx([0.0, 0.2])


def test_turbulence_is_continuous_across_blocks(plant, small_instrument):
    blocks = islice(
        make_feed(plant, small_instrument, Schedule(start=Misregistration())).blocks(), 3
    )
    slopes = np.concatenate([block.slopes for block in blocks])
    steps = np.linalg.norm(np.diff(slopes, axis=0), axis=1)
    assert steps[[499, 999]].max() < 2 * np.median(steps)


def test_wind_faster_than_a_step_per_frame_is_no_trouble(plant, small_instrument):
    feed = make_feed(
        plant, small_instrument, Schedule(start=Misregistration()), winds=((500.0, 0.0),)
    )
    blocks = list(islice(feed.blocks(), 2))
    expected = blocks[1].phases_m @ blocks[1].optics.slopes_per_phase.T
    np.testing.assert_allclose(blocks[1].slopes[::10], expected, atol=1e-4 * expected.std())


def test_optics_that_are_late_leave_the_old_ones_in_place(plant):
    schedule = Schedule(start=Misregistration(), jumps=(Jump(time_s=1.0, shift_x_subap=0.2),))
    optics = MovingOptics(plant, schedule, Never())
    first = optics.start()
    assert optics.at(5.0) is first


def test_a_drift_moves_in_steps_through_exact_optics(plant):
    schedule = Schedule(start=Misregistration(), drift=Drift(shift_x_subap=0.3))
    optics = MovingOptics(plant, schedule, Immediate())
    optics.start()
    times = np.arange(0.0, 45.0, 0.5)
    truth = np.array([optics.at(t).alpha.shift_x_subap for t in times])
    # Steps of 2 s at 0.005 subapertures per second, half of it either way.
    assert np.abs(truth - 0.005 * times).max() <= 0.005 + 1e-12
    assert optics.at(44.9) is optics.at(44.9)


def test_blocks_are_computed_ahead_and_errors_reach_the_loop():
    def failing():
        yield 1
        raise ValueError("screen torn")

    with Ahead(failing()) as ahead:
        blocks = iter(ahead)
        assert next(blocks) == 1
        with pytest.raises(ValueError, match="screen torn"):
            next(blocks)


def test_vibrations_reach_slopes_and_phases_alike(plant, small_instrument):
    lines = (
        VibrationLine(shape=Shape.TIP, frequency_hz=20.0, rms_m=3e-6),
        VibrationLine(shape=Shape.FOCUS, frequency_hz=60.0, rms_m=1e-6, damping=0.0),
    )
    (quiet,), (shaken,) = (
        islice(make_feed(plant, small_instrument, STILL, lines=chosen).blocks(), 1)
        for chosen in ((), lines)
    )
    phases = shaken.phases_m - quiet.phases_m
    assert phases.std() > 1e-6
    expected = phases @ shaken.optics.slopes_per_phase.T
    np.testing.assert_allclose(
        (shaken.slopes - quiet.slopes)[::10], expected, atol=1e-3 * expected.std()
    )


def test_the_seeing_scales_the_turbulence_as_it_changes(plant, small_instrument):
    changing = SeeingSchedule(start_arcsec=1.0, later=((0.6, 2.0),))
    steady_blocks, changing_blocks = (
        list(islice(make_feed(plant, small_instrument, STILL, seeing=seeing).blocks(), 2))
        for seeing in (STEADY, changing)
    )
    assert changing_blocks[0].first_frame == 0
    for steady, changed in zip(steady_blocks, changing_blocks, strict=True):
        time_s = (changed.first_frame + np.arange(0, 500, 10)) / 500.0
        ratio = np.linalg.norm(changed.phases_m, axis=1) / np.linalg.norm(steady.phases_m, axis=1)
        np.testing.assert_allclose(ratio, changing.strength(time_s), rtol=1e-5)


def test_a_static_wavefront_of_the_sensor_is_in_the_slopes_alone(small_instrument, small_basis):
    flawed = LinearPlant(
        small_instrument,
        small_basis,
        rng=np.random.default_rng(1),
        imperfections=Imperfections(ncpa_nm=50.0),
    )
    (block,) = islice(make_feed(flawed, small_instrument, STILL).blocks(), 1)
    offset = block.slopes[::10] - block.phases_m @ block.optics.slopes_per_phase.T
    expected = block.optics.slopes_per_phase @ flawed.sensor_opd_m
    np.testing.assert_allclose(offset.mean(axis=0), expected, atol=0.01 * np.abs(expected).max())


def test_by_day_the_turbulence_is_on_the_mirror_and_not_in_the_air(
    plant, small_instrument, small_basis
):
    modes = small_basis.render(plant.points_m / small_instrument.subaperture_m)
    played = PlayedTurbulence(modes.astype(np.float32), plant.weights, passes=2)
    (night,), (day,) = (
        islice(make_feed(plant, small_instrument, STILL, played=chosen).blocks(), 1)
        for chosen in (None, played)
    )
    assert not day.phases_m.any()
    # What two passes over 40 modes make of it is nearly all of the turbulence.
    seen_twice = 2 * day.played_m[::10] @ modes.T.astype(np.float32)
    left = night.phases_m - seen_twice
    left -= left @ plant.weights[:, None].astype(np.float32)
    assert left.std() < 0.2 * night.phases_m.std()


def test_a_flexure_is_followed_through_exact_optics(plant):
    schedule = Schedule(start=Misregistration(), flexure=Flexure(shift_x_subap=0.1, period_s=60.0))
    optics = MovingOptics(plant, schedule, Immediate())
    optics.start()
    times = np.arange(0.0, 60.0, 0.25)
    truth = np.array([optics.at(t).alpha.shift_x_subap for t in times])
    # Twelve straight pieces (3.4 %) of ten steps, half a step of 3 degrees (2.6 %) either way.
    assert np.abs(truth - 0.1 * np.sin(2 * np.pi * times / 60.0)).max() < 0.1 * (0.034 + 0.027)


def test_a_stuck_actuator_is_in_slopes_and_phases(small_instrument, small_basis):
    def block(faults):
        plant = LinearPlant(
            small_instrument,
            small_basis,
            rng=np.random.default_rng(1),
            imperfections=SETS["ideal"],
            faults=faults,
        )
        return next(make_feed(plant, small_instrument, STILL).blocks())

    stuck, free = block(MirrorFaults(stuck=((30, 1e-7),))), block(None)
    added = stuck.optics.stuck_opd_m
    np.testing.assert_allclose(stuck.phases_m - free.phases_m, np.tile(added, (50, 1)), atol=1e-11)
    expected = stuck.optics.slopes_per_phase @ added
    assert np.abs(expected).max() > 0.01
    # the same sky and noise, and no optical gain that goes by the modes
    np.testing.assert_allclose(stuck.slopes - free.slopes, np.tile(expected, (500, 1)), atol=1e-5)


def test_the_length_of_a_batch_changes_no_frame(plant, small_instrument):
    short, long = (
        list(islice(make_feed(plant, small_instrument, STILL, batch_frames=n).blocks(), 2))
        for n in (10, 50)
    )
    for a, b in zip(short, long, strict=True):
        np.testing.assert_array_equal(a.slopes, b.slopes)
        np.testing.assert_allclose(a.phases_m[::5], b.phases_m, atol=1e-12)
        np.testing.assert_array_equal(b.phase_at(100), b.phases_m[2])


@pytest.mark.parametrize(
    ("rate_hz", "n_frames"), [(3000.0, 50), (1000.0, 50), (400.0, 20), (90.0, 10)]
)
def test_a_message_is_of_fifty_milliseconds_within_what_the_wire_takes(rate_hz, n_frames):
    assert message_frames(rate_hz) == n_frames


def test_open_modes_are_those_of_the_reconstructor_in_use():
    rng = np.random.default_rng(7)
    slopes = rng.standard_normal((600, 8), dtype=np.float32)
    first, second = (rng.standard_normal((3, 8), dtype=np.float32) for _ in range(2))
    modes = OpenModes()
    # the matrix is swapped within what has been computed ahead
    for row, matrix in ((0, first), (50, first), (100, second), (350, second), (550, first)):
        np.testing.assert_allclose(
            modes.rows(slopes, row, 50, matrix), slopes[row : row + 50] @ matrix.T, atol=1e-5
        )
