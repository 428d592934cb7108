from itertools import count, pairwise

import numpy as np
import pytest

from service.wire import Loop, LoopRequest
from sim_rtc.computer import LoopSettings, RealTimeComputer
from sim_rtc.dither import DitherLimits
from sim_rtc.feed import OpenLoopBlock
from sim_rtc.gains import FACTORS, GainRamp, Tuner, by_group, groups_of
from sim_rtc.options import parse_options
from tests.unit.sim_rtc.test_computer import IDENTITY, N_MODES, N_SLOPES, OPTICS, reconstructor

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


def ramp_of(gains=START):
    return GainRamp(gains, n_controlled=300, settling_frames=20, judged_frames=300)


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


def tuned(computer, step_s=0.05, n_batches=3000):
    tuner = Tuner(computer, step_s=step_s)
    for _ in range(n_batches):
        tuner.look(computer.next_batch())
        if tuner.done:
            break
    return tuner


def test_in_a_real_loop_the_result_is_in_the_status(noisy_computer):
    before = noisy_computer.snapshot().gains
    assert tuned(noisy_computer).done
    gains = noisy_computer.snapshot().gains
    assert gains[0] == gains[1]
    assert gains[:3] != before[:3]
    assert gains[3] == 0.0, "not controlled"


def test_noise_alone_wants_the_lowest_gain(noisy_computer):
    """Nothing to correct: whatever the loop does, it does to the noise."""
    tuned(noisy_computer, step_s=0.5)
    assert noisy_computer.snapshot().gains[0] == pytest.approx(FACTORS[0] * 0.4)


def test_an_open_loop_is_not_tuned(noisy_computer):
    noisy_computer.execute(LoopRequest(id="open", loop=Loop.OPEN))
    settings = noisy_computer.snapshot().settings
    assert not tuned(noisy_computer, n_batches=300).done
    assert noisy_computer.snapshot().settings == settings


@pytest.fixture
def noisy_computer():
    def noise():
        rng = np.random.default_rng(8)
        for first in count(0, 30):
            yield OpenLoopBlock(
                first_frame=first,
                optics=OPTICS,
                slopes=rng.normal(0.0, 1e-8, (30, N_SLOPES)).astype(np.float32),
                phases_m=np.zeros((3, 5), np.float32),
            )

    return RealTimeComputer(
        noise(),
        identity=IDENTITY,
        settings=LoopSettings(
            frame_rate_hz=1000.0,
            delay_frames=2,
            gains=(0.4,) * N_MODES,
            leak=1.0,
            n_controlled_next=3,
        ),
        reconstructor=reconstructor("first", 3),
        optics=OPTICS,
        stroke_m=1e-5,
        limits=DitherLimits(),
    )


@pytest.mark.parametrize(
    ("words", "step_s"), [([], None), (["--gain-ramp"], 1.0), (["--gain-ramp", "0.5"], 0.5)]
)
def test_the_ramp_runs_on_request_only(words, step_s):
    assert parse_options(words).gain_ramp_s == step_s


def test_modes_outside_the_loop_get_the_last_groups_gain():
    ramp = GainRamp((0.4,) * 300, n_controlled=60, settling_frames=0, judged_frames=10)
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
