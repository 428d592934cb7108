from concurrent.futures import Executor, Future
from itertools import islice

import numpy as np
import pytest

from service.model.instrument import KarhunenLoeve
from service.model.misregistration import Misregistration
from sim_rtc.atmosphere import Layer, frozen_layers
from sim_rtc.detector import Detector
from sim_rtc.feed import Ahead, OpenLoopFeed
from sim_rtc.motion import MovingOptics
from sim_rtc.plant import LinearPlant
from sim_rtc.schedule import Drift, Jump, Schedule


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


def make_feed(plant, instrument, schedule, executor=None, winds=((20.0, 10.0), (7.0, 100.0))):
    optics = MovingOptics(plant, schedule, executor or Immediate())
    detector = Detector(
        instrument,
        images=optics.start().images,
        valid=plant.valid,
        magnitude=-30.0,
        frame_rate_hz=500.0,
    )
    layers = frozen_layers(
        tuple(Layer(fraction=1.0, speed_m_s=v, direction_deg=angle) for v, angle in winds),
        points_m=plant.points_m,
        pitch_m=plant.pitch_m,
        turbulence=KarhunenLoeve(),
        rng=np.random.default_rng(2),
    )
    return OpenLoopFeed(
        layers=layers,
        optics=optics,
        detector=detector,
        frame_rate_hz=500.0,
        jump_times_s=tuple(jump.time_s for jump in schedule.jumps),
        rng=np.random.default_rng(3),
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
    # Steps of 2 s at 0.005 subapertures per second.
    assert np.abs(truth - 0.005 * times).max() <= 0.01 + 1e-12
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
