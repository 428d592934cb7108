"""The optical gain of every dithered mode."""

import numpy as np
import pytest

from service.control.gains import GAIN_RATE
from service.records import events as ev
from service.records.state import Mode
from service.tracking.filtering import (
    MODES_KEPT,
    PRIOR_FLUCTUATION,
    PRIOR_SCATTER,
    update_gains,
)
from tests.support.situations import SECOND, START_NS, Story, estimate


def windows(gains, mode=501, every_s=2.0, sigma=0.001):
    table = ()
    for k, gain in enumerate(gains):
        t_ns = START_NS + round(k * every_s * SECOND)
        table = update_gains(table, (mode,), np.array([gain]), np.array([sigma]), t_ns)
    return table[0]


def test_a_first_window_is_worth_its_own_noise_and_what_the_gain_fluctuates():
    found = windows([0.6], sigma=0.05)
    assert (found.mode, found.gain) == (501, 0.6)
    assert found.sigma == pytest.approx(np.hypot(0.05, PRIOR_FLUCTUATION * 0.6))
    assert windows([0.6]).sigma == pytest.approx(PRIOR_FLUCTUATION * 0.6, rel=0.01)
    (unknown,) = update_gains((), (501,), np.array([0.6]), None, START_NS)
    assert unknown.sigma == PRIOR_SCATTER * 0.6


def test_windows_that_scatter_tell_how_precise_one_is_and_their_mean_is_better():
    rng = np.random.default_rng(4)
    found = [windows(0.6 + 0.02 * rng.normal(size=100)) for _ in range(20)]
    assert np.mean([gain.scatter for gain in found]) == pytest.approx(0.02, rel=0.15)
    errors = np.array([gain.gain - 0.6 for gain in found])
    sigma = np.mean([gain.sigma for gain in found])
    assert sigma < 0.02
    assert np.sqrt(np.mean(errors**2)) < 1.3 * sigma


def test_a_gain_that_changes_is_followed():
    """From 0.6 to 0.5 within five minutes, to two of its own σ."""
    found = windows([0.6 - 0.1 * k / 150 for k in range(150)])
    assert abs(found.gain - 0.5) < 2.0 * found.sigma
    assert found.sigma < 0.02


def test_one_mad_window_does_not_move_it_far():
    found = windows([*[0.6] * 50, 3.0, *[0.6] * 5])
    assert found.gain == pytest.approx(0.6, abs=0.2)


FAINT = (409, 427, 445, 463, 11)
NOISE = np.array([0.02, 0.02, 0.02, 0.02, 0.08])
"""Of a window at magnitude 11; none of these modes alone shows a change by a fifth."""


def watch(truths, rng, table=()):
    """Return the table after each window of the faint star."""
    tables = []
    for k, true in enumerate(truths):
        seen = true + NOISE * rng.normal(size=5)
        t_ns = START_NS + round((k + 1) * 5.0 * SECOND)
        table = update_gains(table, FAINT, seen, NOISE, t_ns)
        tables.append(table)
    return tables


def test_after_a_change_of_the_seeing_sigma_says_so_and_the_second_window_decides():
    """Fifty nights whose gains fall by a third between two windows."""
    ratios = []
    for seed in range(50):
        older = update_gains((), (3, 5), np.array([0.7, 0.7]), None, START_NS)
        tables = watch([0.7] * 10 + [0.47] * 4, np.random.default_rng(seed), older)
        assert len(tables[9]) == 7
        # Those that are dithered no more are of the seeing before.
        assert {gain.mode for gain in tables[10]} == set(FAINT)
        errors = np.array([[(g.gain - 0.47) / g.sigma for g in table] for table in tables[10:]])
        ratios.append(np.sqrt(np.mean(errors**2, axis=1)))
        assert np.abs([gain.gain / 0.7 - 1.0 for gain in tables[10]]).max() < 0.2
        assert np.abs([g.gain - 0.47 for g in tables[11] if g.mode != 11]).max() < 0.08
    typical = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert np.all((typical > 0.5) & (typical < 2.0))


def test_seeing_that_stays_is_no_change():
    known = watch([0.7] * 500, np.random.default_rng(1))
    assert max(gain.sigma for table in known[10:] for gain in table if gain.mode != 11) < 0.03


def test_after_a_pause_the_next_window_counts_more():
    steady = update_gains((), (7,), np.array([0.6]), None, START_NS)
    for k in range(1, 30):
        t_ns = START_NS + k * 2 * SECOND
        steady = update_gains(steady, (7,), np.array([0.6]), np.array([0.02]), t_ns)
    (known,) = steady
    later = known.t_ns_utc + 600 * SECOND
    (found,) = update_gains(steady, (7,), np.array([0.5]), np.array([0.02]), later)
    walked = (GAIN_RATE * 0.6) ** 2 * 600.0
    assert walked > 10 * known.scatter**2
    assert found.gain == pytest.approx(0.5, abs=0.01)


def test_modes_that_are_dithered_no_more_are_kept_and_the_oldest_forgotten():
    table = ()
    for mode in range(MODES_KEPT + 10):
        table = update_gains(table, (mode,), np.array([0.5]), None, START_NS + mode)
    assert [gain.mode for gain in table] == list(range(10, MODES_KEPT + 10))


def test_every_window_brings_those_of_its_lines():
    story = Story(Mode.HOLD).meet()
    modes, gains = (501, 519, 537, 555), np.array([0.5, 0.55, 0.6, 0.65]) * np.exp(0.01j)
    story.see(modes=modes, optical_gain=gains, gain_sigma=np.full(4, 0.01))
    found = story.state.alpha.registration.optical_gains
    assert [gain.mode for gain in found] == list(modes)
    np.testing.assert_allclose([gain.gain for gain in found], np.abs(gains))


def test_a_window_that_does_not_know_its_modes_brings_none():
    story = Story(Mode.HOLD).meet()
    story.tell(ev.WindowFitted(estimate=estimate()))
    assert story.state.alpha.registration.optical_gains == ()
