"""Is the loop holding?"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.control.loop import pole_radius
from service.estimation.description import ActuatorWatch
from service.estimation.estimator import Change, LoopContext
from service.estimation.health import (
    CALM_RATIO,
    DIVERGING_RATIO,
    LOST_RATIO,
    LOST_S,
    MIN_UPPER_MODES,
    LoopHealth,
    PlayedCommands,
    observe,
)
from service.model.misregistration import Misregistration
from tests.support.numerics import (
    N_CONTROLLED,
    N_MODES,
    Sky,
    block_of,
    closed_loop,
    part,
    small_basis,
    small_loop,
    small_model,
)

VARIANCE = small_basis().variance_m2
IN_LOOP = np.arange(N_CONTROLLED)
UPPER = slice(N_CONTROLLED // 2, N_CONTROLLED)


def times_expectation(factor: float, n_frames: int = 100):
    """A block whose upper half has ``factor`` times the RMS turbulence asks of it."""
    rng = np.random.default_rng(12)
    commands = factor * np.sqrt(VARIANCE) * rng.normal(size=(n_frames, N_MODES))
    return block_of(np.zeros((n_frames, 2)), commands, None)


def after(health: LoopHealth, factor: float, n_blocks: int = 60) -> LoopHealth:
    """Six seconds of it: twelve memories."""
    for _ in range(n_blocks):
        health = observe(health, times_expectation(factor), VARIANCE, IN_LOOP)
    return health


def test_the_ratio_of_a_loop_that_follows_turbulence_is_one():
    """5 %: 1500 random numbers to the block."""
    assert after(LoopHealth(), 1.0).ratio == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("factor", [0.0, 1.0, 3.0])
def test_a_loop_that_holds_is_left_in_peace(factor):
    assert not after(LoopHealth(), factor).diverging


def test_a_loop_ten_times_beyond_its_expectation_is_diverging():
    assert after(LoopHealth(), 1.1 * DIVERGING_RATIO).diverging
    assert not after(LoopHealth(), 0.9 * DIVERGING_RATIO).diverging


def test_a_loop_that_was_diverging_must_fall_to_half_the_limit_to_count_as_calm():
    between = (CALM_RATIO + DIVERGING_RATIO) / 2
    diverging = after(LoopHealth(), 20.0)
    assert after(diverging, between).diverging
    assert not after(LoopHealth(), between).diverging
    assert not after(after(diverging, between), 0.8 * CALM_RATIO).diverging


def test_a_loop_a_hundred_times_beyond_is_lost_within_a_fifth_of_a_second():
    """Two blocks of 0.1 s; at 0.7 of the limit it diverges and is not lost, however long."""
    growing = after(LoopHealth(), 20.0, n_blocks=1)
    seen = after(growing, 2.0 * LOST_RATIO, n_blocks=2)
    assert seen.diverging
    assert seen.lost
    assert seen.beyond_s >= LOST_S
    assert not after(growing, 0.7 * LOST_RATIO).lost


def test_a_single_wrong_frame_loses_no_loop_and_a_calm_one_is_lost_no_more():
    wrong = observe(LoopHealth(), times_expectation(5000.0, n_frames=1), VARIANCE, IN_LOOP)
    assert wrong.diverging
    assert not wrong.lost
    lost = after(after(LoopHealth(), 20.0, n_blocks=1), 2.0 * LOST_RATIO)
    assert lost.lost
    assert not after(lost, 1.0).lost


def test_only_the_upper_half_of_the_controlled_modes_is_watched():
    """Low modes carry the turbulence, uncontrolled ones the dither."""
    commands = np.full((100, N_MODES), 1.0)
    commands[:, UPPER] = 0.0
    block = block_of(np.zeros((100, 2)), commands, None)
    assert observe(LoopHealth(), block, VARIANCE, IN_LOOP).ratio == 0.0


def test_a_burst_of_one_frame_is_forgotten_within_three_seconds():
    burst = times_expectation(100.0, n_frames=1)
    health = after(observe(LoopHealth(), burst, VARIANCE, IN_LOOP), 1.0, n_blocks=30)
    assert health.ratio == pytest.approx(1.0, rel=0.1)


def test_a_loop_that_was_a_thousand_times_beyond_and_holds_again_is_calm_within_a_second():
    """The service waits so long before it opens a loop that it has given its old matrix back."""
    lost = after(LoopHealth(), 1000.0)
    assert lost.diverging
    assert not after(lost, 1.0, n_blocks=9).diverging


def test_the_split_into_blocks_hardly_matters():
    block = times_expectation(4.0, 400)
    whole = observe(LoopHealth(), block, VARIANCE, IN_LOOP)
    health = LoopHealth()
    for start in range(0, 400, 10):
        health = observe(health, part(block, start, start + 10), VARIANCE, IN_LOOP)
    assert health.ratio == pytest.approx(whole.ratio, rel=0.05)


def after_parts(health: LoopHealth, *parts: tuple[float, int], in_loop=IN_LOOP) -> LoopHealth:
    """Parts of 0.1 s: so many at each factor, whatever the expectation is."""
    for factor, n_blocks in parts:
        for _ in range(n_blocks):
            health = observe(health, times_expectation(factor), VARIANCE, in_loop)
    return health


def test_commands_that_grow_beyond_those_of_the_seconds_before_are_a_lost_loop_below_the_limit():
    """A pyramid that saturates bounds them: 2.5 in RMS counts, in each of three parts."""
    quiet = after_parts(LoopHealth(), (0.8, 40))
    assert not after_parts(quiet, (2.4, 2)).diverging
    assert after_parts(quiet, (2.4, 3)).diverging
    assert not after_parts(quiet, (1.8, 30)).diverging
    lost = after_parts(quiet, (2.4, 3))
    assert lost.ratio < DIVERGING_RATIO
    assert lost.power.ratio == pytest.approx(3.0, rel=0.1)


def test_commands_that_ran_away_and_came_back_end_the_alarm_and_begin_a_new_history():
    lost = after_parts(LoopHealth(), (0.8, 40), (2.4, 60))
    assert lost.diverging
    assert after_parts(lost, (0.8, 2)).diverging
    calm = after_parts(lost, (0.8, 3))
    assert not calm.diverging
    assert calm.power.parts_m2 == ()


def test_few_modes_and_a_short_history_show_no_commands_that_run_away():
    few = IN_LOOP[: 2 * MIN_UPPER_MODES - 1]
    assert not after_parts(LoopHealth(), (0.8, 40), (2.4, 10), in_loop=few[:-1]).diverging
    assert after_parts(LoopHealth(), (0.8, 40), (2.4, 10), in_loop=few).diverging
    assert not after_parts(LoopHealth(), (0.8, 4), (2.4, 20)).diverging


def test_another_gain_or_reference_drops_the_history_and_another_matrix_keeps_it():
    quiet, loop = after_parts(LoopHealth(), (0.8, 40)), LoopContext(description=None)
    assert not after_parts(quiet.restart(loop, Change.LOOP), (2.4, 5)).diverging
    assert not after_parts(quiet.restart(loop, Change.REFERENCES), (2.4, 5)).diverging
    assert after_parts(quiet.restart(loop, Change.MATRIX), (2.4, 5)).diverging
    lost = after_parts(quiet, (2.4, 5))
    assert lost.restart(loop, Change.LOOP).diverging
    assert not lost.restart(loop, Change.OPEN).diverging


def test_a_dither_is_none_of_the_commands_that_run_away():
    quiet = after_parts(LoopHealth(), (0.8, 40))
    plain = times_expectation(0.8)
    dither = np.zeros_like(plain.commands_m)
    dither[:, UPPER] = 5.0 * np.sqrt(VARIANCE[UPPER])
    moved = replace(plain, commands_m=plain.commands_m + dither, dither_m=dither)
    for _ in range(5):
        quiet = observe(quiet, moved, VARIANCE, IN_LOOP)
    assert not quiet.diverging


def observed(**loop) -> list[bool]:
    """What the health says, block by block, of two simulated seconds."""
    sky = Sky(turbulence=1.0, alpha=loop.pop("truth"))
    block = closed_loop(small_loop(**loop), sky, np.zeros((2000, N_MODES)))
    health, seen = LoopHealth(), []
    for start in range(0, 2000, 50):
        health = observe(health, part(block, start, start + 50), VARIANCE, IN_LOOP)
        seen.append(health.diverging)
    return seen


def test_a_simulated_loop_that_diverges_is_recognised_and_one_that_holds_is_not():
    """Turned by 7 degrees the small loop's poles leave the unit circle; 0.7 is its optical gain."""
    turned = Misregistration(rotation_rad=np.deg2rad(7.0))
    matrix = small_model().interaction_matrix(turned)[:, :N_CONTROLLED]
    product = small_loop().reconstructor @ matrix
    radius = pole_radius(np.linalg.eigvals(0.7 * 0.7 * product), leak=0.999).max()
    assert 1.0 < radius < 1.02
    assert observed(truth=turned, gain=0.7)[-1]
    assert not any(observed(truth=Misregistration(), gain=0.7))


def test_modes_without_gain_are_not_in_the_loop_and_hide_no_divergence():
    """Of the last two thirds none moves: the upper half is that of the first third."""
    few = IN_LOOP[: N_CONTROLLED // 3]
    commands = 1.2 * DIVERGING_RATIO * np.sqrt(VARIANCE) * np.ones((3000, N_MODES))
    commands[:, len(few) :] = 0.0
    block = block_of(np.zeros((3000, 2)), commands, None)
    assert observe(LoopHealth(), block, VARIANCE, few).diverging
    assert not observe(LoopHealth(), block, VARIANCE, IN_LOOP).diverging


def test_a_loop_that_is_opened_is_well():
    assert observe(after(LoopHealth(), 20.0), times_expectation(20.0), VARIANCE, IN_LOOP[:0]) == (
        LoopHealth()
    )


def test_an_rtc_that_controls_no_mode_is_not_diverging():
    assert not observe(LoopHealth(), times_expectation(1.0), VARIANCE, IN_LOOP[:0]).diverging


@pytest.mark.parametrize(
    ("unit", "name"), [(1e9, "nanometres"), (1e8, "nanometres"), (1e6, "micrometres")]
)
def test_commands_that_no_mirror_plays_are_in_another_unit_and_no_divergence(unit, name):
    health = after(LoopHealth(), unit)
    assert health.absurd
    assert not health.diverging
    assert name in health.conditions[0]


def test_a_loop_in_another_unit_that_has_just_closed_begins_at_zero():
    health = observe(LoopHealth(), times_expectation(0.0, n_frames=3), VARIANCE, IN_LOOP)
    assert after(health, 1e9).absurd


def test_a_loop_that_runs_away_beyond_all_measure_is_diverging_and_not_in_another_unit():
    health = LoopHealth()
    for factor in 3.0 ** np.arange(20):
        health = observe(health, times_expectation(factor), VARIANCE, IN_LOOP)
    assert health.diverging
    assert not health.absurd


def test_a_unit_that_changes_at_once_is_no_divergence_either():
    assert after(after(LoopHealth(), 1.0), 1e9).absurd


def test_commands_that_are_metres_again_are_sane_at_once():
    health = after(after(LoopHealth(), 1e9), 1.0, n_blocks=1)
    assert not health.absurd
    assert not health.diverging


def test_a_matrix_of_fewer_modes_than_the_status_says_is_waited_for():
    """A swap from 60 to 52 modes: frames name the new matrix before the status does."""
    rng = np.random.default_rng(1)
    block = SimpleNamespace(
        cm_id="cm-2",
        dt_ns=2_000_000,
        n_frames=200,
        slopes=rng.normal(size=(200, 24)).astype(np.float32),
        commands_m=rng.normal(size=(200, 60)).astype(np.float32),
    )
    watch = ActuatorWatch(modes=np.arange(10, 60), shapes=np.ones((8, 50), np.float32))
    terms = SimpleNamespace(reconstructor=np.ones((52, 24), np.float32))
    before = PlayedCommands()
    frames = SimpleNamespace(block=block, loop=SimpleNamespace(actuators=watch), terms=terms)
    assert before.update(frames) is before
    frames.terms.reconstructor = np.ones((60, 24), np.float32)
    assert before.update(frames).turbulence.shape[1] == 8
