from itertools import count

import numpy as np
import pytest

from service.wire import Loop, LoopRequest, MeasureRequest, Pattern, RampRequest
from sim_rtc.computer.feed import OpenLoopBlock
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import LoopSettings
from tests.unit.sim_rtc.computer.test_real_time_computer import (
    IDENTITY,
    N_MODES,
    N_SLOPES,
    OPTICS,
    RESPONSE,
    dither_request,
    reconstructor,
)

START = (0.4,) * N_MODES
GAINS = (0.1, 0.3, 0.6, 1.2)


def computer_of(slopes):
    """A computer whose open-loop slopes ``(n_frames, N_SLOPES)`` come from a function of time."""

    def blocks():
        for first in count(0, 30):
            yield OpenLoopBlock(
                first_frame=first,
                optics=OPTICS,
                slopes=slopes(first + np.arange(30)).astype(np.float32),
                phases_m=np.zeros((3, 5), np.float32),
            )

    return RealTimeComputer(
        blocks(),
        identity=IDENTITY,
        settings=LoopSettings(
            frame_rate_hz=1000.0,
            delay_frames=2,
            gains=START,
            leak=1.0,
            n_controlled_next=3,
        ),
        reconstructor=reconstructor("first", 3),
        optics=OPTICS,
        stroke_m=1e-5,
    )


@pytest.fixture
def noisy():
    """Nothing to correct: whatever the loop does, it does to the noise."""
    rng = np.random.default_rng(8)
    return computer_of(lambda frame: rng.normal(0.0, 1e-8, (len(frame), N_SLOPES)))


@pytest.fixture
def swaying():
    """A slow wave in mode 0, noise in mode 2: the one wants a high gain, the other a low one."""
    rng = np.random.default_rng(9)

    def slopes(frame):
        modes = np.zeros((len(frame), N_MODES))
        modes[:, 0] = 1e-7 * np.sin(2 * np.pi * frame / 100)
        modes[:, 2] = rng.normal(0.0, 1e-8, len(frame))
        return modes @ RESPONSE.T

    return computer_of(slopes)


def ramp(name="r", groups=((0, 1), (2, 2)), gains=GAINS, frames_per_gain=400):
    return RampRequest(id=name, groups=groups, gains=gains, frames_per_gain=frames_per_gain)


def run(computer, n_batches):
    return [computer.next_batch() for _ in range(n_batches)]


def test_a_ramp_on_command_picks_the_gain_of_least_residual_for_each_group(swaying):
    run(swaying, 20)
    assert swaying.execute(ramp()).accepted
    assert swaying.status().gains[:3] == (0.1, 0.1, 0.4), "the first gain is in force at once"
    run(swaying, 330)
    # a wave of 10 Hz at 1 kHz: the higher the better, up to the resonance of two frames of delay
    assert swaying.status().gains == (0.6, 0.6, 0.1, 0.0)
    assert swaying.execute(ramp("again")).accepted, "it is over"


def test_each_gain_is_in_force_for_the_frames_asked_for(noisy):
    reply = noisy.execute(ramp(groups=((0, 2),), gains=(0.1, 0.9, 0.5)))
    seen = [(noisy.status().gains[0], noisy.next_batch().seq0) for _ in range(121)]
    first = {}
    for gain, seq in seen:
        first.setdefault(gain, seq)
    assert reply.start_seq == 0
    assert (first[0.1], first[0.9], first[0.5]) == (0, 400, 800)
    assert seen[-1] == (0.1, 1200), "chosen after the last"


def test_while_one_runs_another_is_refused_and_so_is_what_would_spoil_it(noisy):
    noisy.execute(ramp())
    run(noisy, 5)
    measure = MeasureRequest(
        id="m", pattern=Pattern.PUSH_PULL_MODAL, modes=(0,), amplitude_m=(1e-9,), n_average=1
    )
    for command in (ramp("other"), LoopRequest(id="g", gains=START), measure):
        reply = noisy.execute(command)
        assert not reply.accepted
        assert reply.reason == "busy: gain ramp r is under way; open the loop to end it"
    run(noisy, 330)
    assert noisy.execute(LoopRequest(id="g2", gains=START)).accepted


def test_opening_the_loop_ends_it_with_what_is_chosen_and_what_was_there(swaying):
    swaying.execute(ramp())
    run(swaying, 170)
    assert swaying.status().gains[:3] == (0.6, 0.6, 0.1), "the second group is being tried"
    assert swaying.execute(LoopRequest(id="o", loop=Loop.OPEN)).accepted
    run(swaying, 50)
    swaying.execute(LoopRequest(id="c", loop=Loop.CLOSED))
    run(swaying, 200)
    assert swaying.status().gains == (0.6, 0.6, 0.4, 0.0)


def test_a_new_session_ends_it(noisy):
    noisy.execute(ramp())
    run(noisy, 5)
    noisy.restart()
    run(noisy, 50)
    assert noisy.status().gains == (0.4, 0.4, 0.4, 0.0)
    assert noisy.execute(ramp("other")).accepted


def test_fewer_modes_in_the_loop_end_it(noisy):
    noisy.execute(ramp())
    run(noisy, 5)
    noisy.stage(reconstructor("two", 2))
    run(noisy, 5)
    assert noisy.status().gains == (0.4, 0.4, 0.0, 0.0)


@pytest.mark.parametrize("disturb", ["matrix", "dither"])
def test_a_group_begins_again_when_the_loop_is_another(noisy, disturb):
    noisy.execute(ramp())
    run(noisy, 100)
    assert noisy.status().gains[0] == 0.6, "the third gain"
    if disturb == "matrix":
        noisy.stage(reconstructor("second", 3))
    else:
        assert noisy.execute(dither_request("d")).accepted, "a dither may go on meanwhile"
    run(noisy, 3)
    assert noisy.status().gains[0] == 0.1


def test_a_ramp_waits_for_a_measurement_to_end(noisy):
    request = MeasureRequest(
        id="m", pattern=Pattern.PUSH_PULL_MODAL, modes=(0, 1), amplitude_m=(1e-9,) * 2, n_average=5
    )
    assert noisy.execute(request).accepted
    assert noisy.execute(ramp()).reason.startswith("busy: matrix m is being measured until frame")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"groups": ((0, 3),)}, "range: mode 3 in groups, expected 0 to 2"),
        ({"gains": (0.5, 2.5)}, "range: gain 2.5, expected at most 2"),
    ],
)
def test_a_ramp_the_loop_cannot_do_is_refused_and_changes_nothing(noisy, changes, reason):
    before = noisy.settings
    reply = noisy.execute(ramp(**changes))
    assert not reply.accepted
    assert reply.reason == reason
    assert noisy.settings == before


def test_an_open_loop_has_no_gains_to_try(noisy):
    noisy.execute(LoopRequest(id="o", loop=Loop.OPEN))
    reply = noisy.execute(ramp())
    assert reply.reason == "unsupported: a gain ramp while the loop is open; close it first"
