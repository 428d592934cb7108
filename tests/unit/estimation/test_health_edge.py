"""The outer ring of the mirror, watched for a slip that the slopes do not show."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy

from service.estimation.description import Actuators, EdgeWatch, edge_watch
from service.estimation.health import SLIPPED_RATIO, SUSPECT_RATIO, EdgeHealth, observe_edge
from service.instrument.mirrors import rings
from service.model.kinds import KarhunenLoeve
from service.model.modes import ModalBasis, karhunen_loeve_basis
from tests.support.numerics import block_of, small_instrument

N_MODES = 100
SECONDS = 4


@cache
def basis() -> ModalBasis:
    """Enough modes for some to be left out: those of 105 actuators."""
    return karhunen_loeve_basis(small_instrument(n_modes=N_MODES, turbulence=KarhunenLoeve()))


def actuators() -> Actuators:
    return Actuators(positions=rings(1, 5, 0.8), strokes=basis().mode_to_actuator)


@cache
def watch(diameter_m: float = 8.22) -> EdgeWatch:
    found = edge_watch(actuators(), basis().variance_m2, np.arange(N_MODES), diameter_m)
    assert found is not None
    return found


def turbulence(seed: int, memory_s: float = 0.05, strength: float = 1.0) -> np.ndarray:
    """Commands of a healthy loop, 100 a second, ``(n, n_modes)``."""
    rng = np.random.default_rng(seed)
    memory = np.exp(-0.01 / memory_s)
    fresh = np.sqrt(1 - memory**2) * rng.normal(size=(100 * SECONDS, N_MODES))
    wave = scipy.signal.lfilter([1.0], [1.0, -memory], fresh, axis=0)
    return strength * wave * np.sqrt(basis().variance_m2)


def outer_actuator_by(step_m: float) -> np.ndarray:
    """The modal command that moves one outermost actuator and, in least squares, no other."""
    strokes = np.zeros(len(basis().mode_to_actuator))
    strokes[-1] = step_m
    return np.linalg.lstsq(basis().mode_to_actuator, strokes, rcond=None)[0]


def seen(commands: np.ndarray, diameter_m: float = 8.22) -> list[EdgeHealth]:
    health, found = EdgeHealth(), []
    for k, command in enumerate(commands):
        rows = np.repeat(command[None], 10, axis=0)
        health = observe_edge(health, block_of(rows[:, :1], rows, None, 10 * k), watch(diameter_m))
        found.append(health)
    return found


@pytest.mark.parametrize("strength", [0.3, 1.0, 3.0])
def test_turbulence_of_any_strength_is_no_slip(strength):
    for seed in range(5):
        found = seen(turbulence(seed, strength=strength))
        assert not any(health.slipped for health in found)
        assert max(health.ratio for health in found[100:]) < 2.5


def test_turbulence_that_the_wind_takes_longer_to_carry_across_is_no_slip():
    """As modes of 39 m see it: the watch remembers for longer there."""
    commands = np.concatenate([turbulence(seed, memory_s=0.05 * 39.0 / 8.22) for seed in range(8)])
    assert max(health.ratio for health in seen(commands, 39.0)[400:]) < 1.7


@pytest.mark.parametrize("memory_s", [0.24, 1.0, 4.0])
def test_turbulence_that_outlasts_the_memory_of_the_watch_is_no_slip(memory_s):
    """A slow wind: inner actuators stay as far out as outer ones (3.5 without a look at them)."""
    for seed in range(6):
        found = seen(turbulence(seed, memory_s=memory_s))
        assert max(health.ratio for health in found[100:]) < 2.1
        assert not any(health.slipped for health in found[100:])


def test_a_slip_of_five_wavelengths_is_seen_in_a_slow_wind_too():
    commands = turbulence(1, memory_s=1.0)
    commands[100:300] += outer_actuator_by(3.75e-6)
    found = seen(commands)
    assert not any(health.slipped for health in found[:100])
    assert all(health.slipped for health in found[200:300])


def test_an_outer_actuator_that_stays_five_wavelengths_away_has_slipped_and_may_come_back():
    """12 σ of what turbulence asks of it; half of them are in the low modes, which are left out."""
    commands = turbulence(1)
    commands[100:250] += outer_actuator_by(3.75e-6)
    found = seen(commands)
    assert not any(health.slipped for health in found[:100])
    assert all(health.slipped for health in found[140:250])
    assert not found[-1].slipped


def test_tip_and_tilt_however_large_are_no_slip():
    commands = turbulence(2)
    commands[:, :2] += 2e-5
    assert not any(health.slipped for health in seen(commands))


def test_a_loop_of_few_modes_is_not_watched():
    assert edge_watch(actuators(), basis().variance_m2, np.arange(60)) is None
    assert edge_watch(actuators(), basis().variance_m2, np.arange(0, N_MODES, 3)) is None


def test_modes_without_gain_move_nothing_and_are_asked_for_nothing():
    """What stands in them was left there when their gain was set to 0."""
    in_loop = np.setdiff1d(np.arange(N_MODES), np.arange(40, 50))
    found = edge_watch(actuators(), basis().variance_m2, in_loop)
    assert found is not None
    assert found.modes.tolist() == [*range(30, 40), *range(50, N_MODES)]
    ratio = found.outer / watch().outer[:, np.isin(watch().modes, found.modes)]
    # each actuator is expected to move less by what those modes would have moved it
    assert np.all(ratio > 1.0)
    np.testing.assert_allclose(ratio, np.repeat(ratio[:, :1], ratio.shape[1], axis=1), rtol=1e-4)


def test_modes_of_which_no_turbulence_is_known_are_not_watched():
    assert edge_watch(actuators(), np.zeros(N_MODES), np.arange(N_MODES)) is None


def test_one_that_stays_a_little_too_far_out_is_a_slip_after_half_a_second():
    """3 σ on average: the ring had slipped at 1.1 micrometres and stood there for three seconds."""
    commands = turbulence(3)
    commands[100:300] += outer_actuator_by(2e-6)
    found = seen(commands)
    ratios = [health.ratio for health in found[150:300]]
    assert min(ratios) > SUSPECT_RATIO
    assert max(ratios) < SLIPPED_RATIO
    first = next(k for k, health in enumerate(found) if health.slipped)
    assert 150 <= first <= 190
    assert all(health.slipped for health in found[first:300])
    assert not found[-1].slipped
