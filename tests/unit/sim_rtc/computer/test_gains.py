from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from service.wire import RampRequest
from sim_rtc.computer.gains import FACTORS, GainRamp, Plan, by_group, groups_of
from sim_rtc.options import parse_options

START = (0.4,) * 300
BEST = (0.7, 0.4, 0.2)
"""Of the three groups, in the loop that is played here."""


def residual_with(gains, rng, scale=1.0):
    """Ten frames of a loop whose residual is least at BEST."""
    distance = sum(
        (gains[group.start] / best - 1) ** 2
        for group, best in zip(groups_of(300), BEST, strict=True)
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


def plan_of(gains=START, n_controlled=300):
    plan = Plan.at_start(gains, n_controlled=n_controlled, frame_rate_hz=1000.0, step_s=0.3)
    return replace(plan, settling_frames=20)


def ramp_of(gains=START):
    return GainRamp(gains, plan_of(gains))


@pytest.mark.parametrize(
    ("n_modes", "edges"),
    [
        (594, [(0, 2), (2, 100), (100, 594)]),
        (100, [(0, 2), (2, 100)]),
        (60, [(0, 2), (2, 60)]),
        (2, [(0, 2)]),
    ],
)
def test_the_groups_are_tip_and_tilt_to_100_and_the_rest(n_modes, edges):
    assert [(group.start, group.stop) for group in groups_of(n_modes)] == edges


def test_each_group_gets_the_gain_of_least_residual():
    ramp = ramp_of()
    run(ramp, np.random.default_rng(1))
    assert ramp.done
    chosen = ramp.gains_by_group
    # rungs are 0.1 apart, and the minimum is flat
    np.testing.assert_allclose(chosen, BEST, atol=0.101)
    for group in groups_of(300):
        assert len(set(ramp.gains[group])) == 1


def test_only_one_group_moves_at_a_time():
    for before, after in pairwise(run(ramp_of(), np.random.default_rng(2))):
        moved = {k for k, group in enumerate(groups_of(300)) if before[group] != after[group]}
        assert len(moved) <= 2, "the group that ends and the one that begins"


def test_the_gain_rises_no_further_once_the_residual_has_clearly_grown():
    ramp = ramp_of()
    run(ramp, np.random.default_rng(3))
    last = [step for step in ramp.steps if step.group == 2]
    assert len(last) < len(FACTORS)
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


def test_a_gain_never_exceeds_what_the_loop_takes():
    assert max(max(gains) for gains in run(ramp_of((1.5,) * 300), np.random.default_rng(6))) <= 2.0


def test_a_group_begins_again_when_the_loop_has_changed():
    ramp, rng = ramp_of(), np.random.default_rng(7)
    while len(ramp.steps) < 3:
        ramp.take(residual_with(ramp.gains, rng))
    ramp.again()
    assert ramp.steps == ()
    assert ramp.gains[0] == pytest.approx(FACTORS[0] * 0.4)


def asked(gains, groups=((2, 99), (0, 1)), frames_per_gain=320):
    request = RampRequest(id="r", groups=groups, gains=gains, frames_per_gain=frames_per_gain)
    return GainRamp(START, Plan.asked(request, frame_rate_hz=1000.0))


def test_groups_and_gains_are_those_asked_for_in_their_order():
    ramp, rng = asked((0.2, 0.7, 0.4)), np.random.default_rng(10)
    tried = run(ramp, rng)
    assert [(s.group, s.gain) for s in ramp.steps] == [
        (group, gain) for group in (0, 1) for gain in (0.2, 0.7, 0.4)
    ]
    # BEST of the modes to 100 and of tip and tilt, in the order of the groups
    assert ramp.gains_by_group == (0.4, 0.7)
    assert {gains[100:] for gains in tried} == {START[100:]}, "the others keep theirs"


def test_what_settles_is_part_of_the_frames_of_a_gain_and_at_most_half_of_them():
    long, short = (
        Plan.asked(
            RampRequest(id="r", groups=((0, 1),), gains=(0.5,), frames_per_gain=n),
            frame_rate_hz=1000.0,
        )
        for n in (1000, 100)
    )
    assert (long.settling_frames, long.judged_frames) == (200, 800)
    assert (short.settling_frames, short.judged_frames) == (50, 50)


def test_after_a_clearly_worse_gain_only_lower_ones_are_tried():
    ramp = asked((0.4, 1.8, 2.0, 0.3), groups=((2, 99),))
    run(ramp, np.random.default_rng(11))
    assert [step.gain for step in ramp.steps] == [0.4, 1.8, 0.3]


def test_a_ramp_that_ends_early_leaves_what_it_has_chosen_and_what_was_there():
    ramp, rng = asked((0.2, 0.7, 0.4)), np.random.default_rng(12)
    while len(ramp.steps) < 4:
        ramp.take(residual_with(ramp.gains, rng))
    assert ramp.settled == START[:2] + (0.4,) * 98 + START[100:]


@pytest.mark.parametrize(
    ("words", "step_s"), [([], None), (["--gain-ramp"], 1.0), (["--gain-ramp", "0.5"], 0.5)]
)
def test_the_ramp_runs_on_request_only(words, step_s):
    assert parse_options(words).gain_ramp_s == step_s


def test_modes_outside_the_loop_get_the_last_groups_gain():
    ramp = GainRamp(START, plan_of(n_controlled=60))
    rng = np.random.default_rng(9)
    while not ramp.done:
        ramp.take(rng.standard_normal((10, 50)).astype(np.float32))
    assert len(ramp.gains_by_group) == 2
    assert set(ramp.gains[2:]) == {ramp.gains_by_group[1]}


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
