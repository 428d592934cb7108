from itertools import count, pairwise

import numpy as np
import pytest

from service.wire import Loop, LoopRequest, MeasureRequest, Pattern, RampRequest
from sim_rtc.computer.feed import OpenLoopBlock
from sim_rtc.computer.gains import GainRamp, by_group
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import LoopSettings
from sim_rtc.options import parse_options
from tests.support.real_time_computer import (
    IDENTITY,
    N_MODES,
    N_SLOPES,
    OPTICS,
    RESPONSE,
    dither_request,
    reconstructor,
)

START = (0.4,) * 300
GROUPS = (slice(0, 2), slice(2, 100), slice(100, 300))
RUNGS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
BEST = (0.7, 0.4, 0.2)
"""Of the three groups, in the loop that is played here."""


def residual_with(gains, rng, scale=1.0):
    """Ten frames of a loop whose residual is least at BEST."""
    distance = sum(
        (gains[group.start] / best - 1) ** 2 for group, best in zip(GROUPS, BEST, strict=True)
    )
    return (scale * (1 + distance) * rng.standard_normal((10, 50))).astype(np.float32)


def run(ramp, rng, n_batches=2000):
    tried = [ramp.gains]
    for _ in range(n_batches):
        if ramp.done:
            break
        if ramp.take(residual_with(ramp.gains, rng)):
            tried.append(ramp.gains)
    return tried


def asked(gains, groups=((2, 99), (0, 1)), frames_per_gain=320):
    request = RampRequest(id="r", groups=groups, gains=gains, frames_per_gain=frames_per_gain)
    return GainRamp(START, request, frame_rate_hz=1000.0)


def ramp_of():
    return asked(RUNGS, groups=tuple((group.start, group.stop - 1) for group in GROUPS))


def test_each_group_gets_the_gain_of_least_residual():
    ramp = ramp_of()
    run(ramp, np.random.default_rng(1))
    assert ramp.done
    chosen = ramp.gains_by_group
    # rungs are 0.1 apart, and the minimum is flat
    np.testing.assert_allclose(chosen, BEST, atol=0.101)
    for group in GROUPS:
        assert len(set(ramp.gains[group])) == 1


def test_only_one_group_moves_at_a_time():
    for before, after in pairwise(run(ramp_of(), np.random.default_rng(2))):
        moved = {k for k, group in enumerate(GROUPS) if before[group] != after[group]}
        assert len(moved) <= 2, "the group that ends and the one that begins"


def test_the_gain_rises_no_further_once_the_residual_has_clearly_grown():
    ramp = ramp_of()
    run(ramp, np.random.default_rng(3))
    last = [step for step in ramp.steps if step.group == 2]
    assert len(last) < len(RUNGS)
    best = min(step.residual_m for step in last)
    assert last[-1].residual_m > 1.5 * best
    assert all(step.residual_m <= 1.5 * best for step in last[1:-1])


def test_frames_right_after_a_change_are_not_judged():
    ramp, rng = ramp_of(), np.random.default_rng(4)
    for _ in range(2):
        ramp.take(residual_with(ramp.gains, rng, scale=1e6))
    for _ in range(30):
        ramp.take(residual_with(ramp.gains, rng))
    assert ramp.steps[0].residual_m < 100


def test_a_frame_of_nan_is_not_judged():
    ramp, rng = ramp_of(), np.random.default_rng(5)
    while not ramp.steps:
        residual = residual_with(ramp.gains, rng)
        residual[3, 7] = np.nan
        ramp.take(residual)
    assert np.isfinite(ramp.steps[0].residual_m)


def test_a_group_begins_again_when_the_loop_has_changed():
    ramp, rng = ramp_of(), np.random.default_rng(7)
    while len(ramp.steps) < 3:
        ramp.take(residual_with(ramp.gains, rng))
    ramp.again()
    assert ramp.steps == ()
    assert ramp.gains[0] == pytest.approx(RUNGS[0])


def test_groups_and_gains_are_those_asked_for_in_their_order():
    ramp, rng = asked((0.2, 0.7, 0.4)), np.random.default_rng(10)
    tried = run(ramp, rng)
    assert [(s.group, s.gain) for s in ramp.steps] == [
        (group, gain) for group in (0, 1) for gain in (0.2, 0.7, 0.4)
    ]
    # BEST of the modes to 100 and of tip and tilt, in the order of the groups
    assert ramp.gains_by_group == (0.4, 0.7)
    assert {gains[100:] for gains in tried} == {START[100:]}, "the others keep theirs"


@pytest.mark.parametrize(("frames_per_gain", "settling"), [(1000, 200), (100, 50)])
def test_what_settles_is_part_of_the_frames_of_a_gain_and_at_most_half_of_them(
    frames_per_gain, settling
):
    ramp = asked((0.5,), groups=((0, 1),), frames_per_gain=frames_per_gain)
    ramp.take(np.full((settling, 2), 1e6, np.float32))
    ramp.take(np.ones((frames_per_gain - settling, 2), np.float32))
    assert ramp.done
    assert ramp.steps[0].residual_m == 1.0


def test_after_a_clearly_worse_gain_only_lower_ones_are_tried():
    ramp = asked((0.4, 1.8, 2.0, 0.3), groups=((2, 99),))
    run(ramp, np.random.default_rng(11))
    assert [step.gain for step in ramp.steps] == [0.4, 1.8, 0.3]


def test_a_ramp_that_ends_early_leaves_what_it_has_chosen_and_what_was_there():
    ramp, rng = asked((0.2, 0.7, 0.4)), np.random.default_rng(12)
    while len(ramp.steps) < 4:
        ramp.take(residual_with(ramp.gains, rng))
    assert ramp.settled == START[:2] + (0.4,) * 98 + START[100:]


def test_gains_are_given_by_group():
    assert by_group((0.5, 0.4, 0.3), 150) == (0.5,) * 2 + (0.4,) * 98 + (0.3,) * 50
    assert by_group((0.5, 0.4, 0.3), 60) == (0.5,) * 2 + (0.4,) * 58
    assert parse_options(["--gains", "0.5,0.4,0.3"]).group_gains == (0.5, 0.4, 0.3)
    assert parse_options([]).group_gains is None


@pytest.mark.parametrize("text", ["0.5", "0.5,0.4", "0.5,0.4,2.1", "0.5,0.4,-0.1", "a,b,c"])
def test_gains_that_cannot_be_are_refused(text, capsys):
    with pytest.raises(SystemExit) as ended:
        parse_options([f"--gains={text}"])
    assert ended.value.code == 2
    assert "expected TIP_TILT,TO_100,REST, each 0 to 2" in capsys.readouterr().err


LOOP_START = (0.4,) * N_MODES
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
            gains=LOOP_START,
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


def run_loop(computer, n_batches):
    return [computer.next_batch() for _ in range(n_batches)]


def test_a_ramp_on_command_picks_the_gain_of_least_residual_for_each_group(swaying):
    run_loop(swaying, 20)
    assert swaying.execute(ramp()).accepted
    assert swaying.status().gains[:3] == (0.1, 0.1, 0.4), "the first gain is in force at once"
    run_loop(swaying, 330)
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
    run_loop(noisy, 5)
    measure = MeasureRequest(
        id="m", pattern=Pattern.PUSH_PULL_MODAL, modes=(0,), amplitude_m=(1e-9,), n_average=1
    )
    for command in (ramp("other"), LoopRequest(id="g", gains=LOOP_START), measure):
        reply = noisy.execute(command)
        assert not reply.accepted
        assert reply.reason == "busy: gain ramp r is under way; open the loop to end it"
    run_loop(noisy, 330)
    assert noisy.execute(LoopRequest(id="g2", gains=LOOP_START)).accepted


def test_opening_the_loop_ends_it_with_what_is_chosen_and_what_was_there(swaying):
    swaying.execute(ramp())
    run_loop(swaying, 170)
    assert swaying.status().gains[:3] == (0.6, 0.6, 0.1), "the second group is being tried"
    assert swaying.execute(LoopRequest(id="o", loop=Loop.OPEN)).accepted
    run_loop(swaying, 50)
    swaying.execute(LoopRequest(id="c", loop=Loop.CLOSED))
    run_loop(swaying, 200)
    assert swaying.status().gains == (0.6, 0.6, 0.4, 0.0)


def test_a_new_session_ends_it(noisy):
    noisy.execute(ramp())
    run_loop(noisy, 5)
    noisy.restart()
    run_loop(noisy, 50)
    assert noisy.status().gains == (0.4, 0.4, 0.4, 0.0)
    assert noisy.execute(ramp("other")).accepted


def test_fewer_modes_in_the_loop_end_it(noisy):
    noisy.execute(ramp())
    run_loop(noisy, 5)
    noisy.stage(reconstructor("two", 2))
    run_loop(noisy, 5)
    assert noisy.status().gains == (0.4, 0.4, 0.0, 0.0)


@pytest.mark.parametrize("disturb", ["matrix", "dither"])
def test_a_group_begins_again_when_the_loop_is_another(noisy, disturb):
    noisy.execute(ramp())
    run_loop(noisy, 100)
    assert noisy.status().gains[0] == 0.6, "the third gain"
    if disturb == "matrix":
        noisy.stage(reconstructor("second", 3))
    else:
        assert noisy.execute(dither_request("d")).accepted, "a dither may go on meanwhile"
    run_loop(noisy, 3)
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
