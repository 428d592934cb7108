"""What the mirror holds of a change of references, by the mean of the commands."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.estimation.estimator import Change, LoopContext
from service.estimation.held_shape import BLOCK_S, BLOCKS_BEFORE, CLOSING_S, MeanCommands
from service.tracking.references import MIN_LOG_ODDS
from tests.support.streams import block

RATE_HZ = 100.0
N_MODES = 12
SHAPE_M = np.array([0.0, 0.0, 40e-9, 30e-9, 20e-9])
NONE = np.zeros(5)


def commands(n_frames, seed, rms_m, memory_s=0.3):
    """Turbulence whose modes remember themselves for some time."""
    noise = np.random.default_rng(seed).standard_normal((n_frames, N_MODES))
    keep = np.exp(-1.0 / (memory_s * RATE_HZ))
    total = np.empty_like(noise)
    total[0] = noise[0]
    for k in range(1, n_frames):
        total[k] = keep * total[k - 1] + np.sqrt(1.0 - keep**2) * noise[k]
    return rms_m * total


def fed(factor, *, seconds=25.0, rms_m=40e-9, seed=1, before_m=NONE):
    """Feed telemetry in which a shape follows another one and is applied times a factor."""
    n_frames = round(seconds * RATE_HZ)
    both = commands(2 * n_frames, seed, rms_m)
    both[:, -1] = 0.0  # a mode that is not controlled
    both[:n_frames, : len(SHAPE_M)] += before_m
    both[n_frames:, : len(SHAPE_M)] += factor * SHAPE_M
    estimator, due = MeanCommands(), 0
    names = ["ref-1"] * n_frames + ["ref-2~"] * 50 + ["ref-2"] * n_frames
    rows = np.concatenate([both[:n_frames], both[:50] + 1e-6, both[n_frames:]])
    for first in range(0, len(rows), 50):
        part = SimpleNamespace(commands_m=rows[first : first + 50], reference_name=names[first])
        before = estimator
        frames = SimpleNamespace(block=part, rtc=SimpleNamespace(frame_rate_hz=RATE_HZ))
        estimator = estimator.update(frames)
        due += estimator.is_due(before)
    return estimator, due


@pytest.mark.parametrize("names", [("ref-1",), ("ref-1", "ref-2")])
def test_commands_do_not_count_until_a_closed_loop_has_settled(names):
    """A slipped segment that came back looked like references with the sign turned."""
    rtc = SimpleNamespace(frame_rate_hz=RATE_HZ)
    loop = LoopContext(description=None, rtc=rtc)
    estimator, n_frames = fed(1.0, seconds=2.0)[0].restart(loop, Change.OPEN), 0
    while not estimator.blocks:
        name = names[n_frames > 200 and -1]
        part = SimpleNamespace(commands_m=np.zeros((10, N_MODES)), reference_name=name)
        estimator = estimator.update(SimpleNamespace(block=part, rtc=rtc))
        n_frames += 10
    assert n_frames == (CLOSING_S + BLOCK_S) * RATE_HZ
    assert not estimator.before


WAYS = {1.0: "", -1.0: "with the sign turned", 0.0: "not at all", 2.0: "twice as large"}


def found_in(estimator, shape_m=SHAPE_M, before_m=NONE, expected=1.0):
    return estimator.measure({"ref-1": before_m, "ref-2": shape_m}, expected)


@pytest.mark.parametrize("factor", WAYS)
def test_the_ratio_is_the_factor_within_its_sigma(factor):
    estimator, due = fed(factor, seconds=28.0, rms_m=20e-9)
    assert (estimator.name, {name for name, _ in estimator.before}) == ("ref-2", {"ref-1"})
    found = found_in(estimator)
    assert found.ratio == pytest.approx(factor, abs=4.0 * found.sigma)
    assert found.sigma < 0.15
    assert due == 11
    assert (found.log_odds > MIN_LOG_ODDS) is (factor != 1.0)
    if factor != 1.0:
        assert found.other == WAYS[factor]


@pytest.mark.parametrize("factor", WAYS)
def test_a_shape_that_replaces_another_one_is_measured_as_a_whole(factor):
    before_m = np.array([0.0, 0.0, -40e-9, 30e-9, 25e-9])
    estimator, _ = fed(factor, before_m=before_m, rms_m=20e-9)
    found = found_in(estimator, before_m=before_m)
    assert found.ratio == pytest.approx(factor, abs=4.0 * found.sigma)


def test_former_references_are_told_from_none():
    before_m = np.array([0.0, 0.0, 40e-9, 30e-9, -25e-9])
    estimator, _ = fed(0.0, before_m=before_m, rms_m=20e-9)
    blocks = tuple(block + np.pad(before_m, (0, N_MODES - 5)) for block in estimator.blocks)
    found = found_in(replace(estimator, blocks=blocks), before_m=before_m)
    assert (found.other, found.log_odds > MIN_LOG_ODDS) == ("as the former ones", True)


def test_a_gain_that_has_fallen_by_half_is_no_double_shape():
    estimator, _ = fed(2.0, rms_m=20e-9)
    assert found_in(estimator).log_odds > MIN_LOG_ODDS
    assert found_in(estimator, expected=2.0).log_odds < 0.0


def test_a_change_of_seeing_makes_the_gain_uncertain():
    estimator, _ = fed(2.0, rms_m=20e-9)
    mean = np.mean(estimator.blocks, axis=0)
    # The variance of the turbulence becomes 3.2 times that before: twice the seeing.
    worse = tuple(mean + 1.8 * (block - mean) for block in estimator.blocks)
    assert found_in(replace(estimator, blocks=worse)).log_odds < MIN_LOG_ODDS


def test_blocks_with_unknown_references_do_not_count():
    estimator, _ = fed(1.0)
    assert estimator.measure({"ref-2": SHAPE_M}) is None


def test_sigma_is_the_scatter_of_the_ratio_and_what_is_as_sent_is_not_named():
    found = [found_in(fed(1.0, seed=seed)[0]) for seed in range(40)]
    errors = np.array([one.ratio - 1.0 for one in found])
    sigmas = np.array([one.sigma for one in found])
    # 40 values have a scatter of 11 %; sigma is itself measured from some ten blocks that count.
    assert 0.6 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.6
    assert abs(errors.mean()) < 3.0 * errors.std() / np.sqrt(len(errors))
    assert max(one.log_odds for one in found) < MIN_LOG_ODDS


def test_a_small_change_in_strong_turbulence_has_a_large_sigma():
    estimator, _ = fed(1.0, rms_m=400e-9)
    assert found_in(estimator).sigma > 0.8
    assert found_in(estimator, NONE, SHAPE_M) is None


def test_nothing_is_found_before_enough_telemetry_on_both_sides():
    estimator, due = fed(1.0, seconds=2.0)
    assert due == 0
    assert found_in(estimator) is None


def test_blocks_are_bounded():
    estimator, _ = fed(1.0, seconds=70.0)
    assert len(estimator.blocks) == len(estimator.before) == BLOCKS_BEFORE


def test_a_block_of_frames_is_taken_as_the_link_gives_it():
    one = block(0, 100, cm_id="initial")
    frames = SimpleNamespace(block=one, rtc=SimpleNamespace(frame_rate_hz=100.0))
    estimator = MeanCommands().update(frames)
    np.testing.assert_allclose(
        estimator.blocks[0], one.commands_m.mean(axis=0)[:300], rtol=1e-3, atol=1e-12
    )
