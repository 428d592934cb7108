from itertools import pairwise

import numpy as np
import pytest

from service.wire import RampRequest
from sim_rtc.computer.gains import GainRamp, by_group
from sim_rtc.options import parse_options

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
