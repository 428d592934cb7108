"""What the mirror holds of a change of references, by the mean of the commands."""

from types import SimpleNamespace

import numpy as np
import pytest

from service.estimation.held_shape import BLOCKS_AFTER, MeanCommands
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


@pytest.mark.parametrize("factor", [1.0, -1.0, 0.0, 2.0])
def test_the_ratio_is_the_factor_within_its_sigma(factor):
    estimator, due = fed(factor)
    assert (estimator.name, estimator.before[0]) == ("ref-2", "ref-1")
    found = estimator.measure(SHAPE_M, NONE)
    assert found.ratio == pytest.approx(factor, abs=4.0 * found.sigma)
    assert found.sigma < 0.3
    assert due == 9


@pytest.mark.parametrize("factor", [1.0, -1.0, 2.0])
def test_a_shape_that_replaces_another_one_is_measured_as_a_whole(factor):
    before_m = np.array([0.0, 0.0, -40e-9, 30e-9, 25e-9])
    estimator, _ = fed(factor, before_m=before_m)
    found = estimator.measure(SHAPE_M, before_m)
    assert found.ratio == pytest.approx(factor, abs=4.0 * found.sigma)


def test_sigma_is_the_scatter_of_the_ratio():
    found = [fed(1.0, seed=seed)[0].measure(SHAPE_M, NONE) for seed in range(40)]
    errors = np.array([one.ratio - 1.0 for one in found])
    sigmas = np.array([one.sigma for one in found])
    # 40 values have a scatter of 11 %; sigma is itself measured from some ten blocks that count.
    assert 0.6 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.6
    assert abs(errors.mean()) < 3.0 * errors.std() / np.sqrt(len(errors))


def test_a_small_change_in_strong_turbulence_has_a_large_sigma():
    estimator, _ = fed(1.0, rms_m=400e-9)
    assert estimator.measure(SHAPE_M, NONE).sigma > 0.8
    assert estimator.measure(NONE, SHAPE_M) is None


def test_nothing_is_found_before_enough_telemetry_on_both_sides():
    estimator, due = fed(1.0, seconds=2.0)
    assert due == 0
    assert estimator.measure(SHAPE_M, NONE) is None


def test_blocks_are_bounded():
    estimator, _ = fed(1.0, seconds=60.0)
    assert len(estimator.blocks) == BLOCKS_AFTER


def test_a_block_of_frames_is_taken_as_the_link_gives_it():
    one = block(0, 100, cm_id="initial")
    frames = SimpleNamespace(block=one, rtc=SimpleNamespace(frame_rate_hz=100.0))
    estimator = MeanCommands().update(frames)
    np.testing.assert_allclose(
        estimator.blocks[0], one.commands_m.mean(axis=0)[:300], rtol=1e-3, atol=1e-12
    )
