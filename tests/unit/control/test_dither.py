"""As little dither as keeps the registration as well known as it must be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.control.dither import (
    DitherRequirement,
    Schedule,
    choose_burst_s,
    choose_window_s,
    compute_schedule,
    place_lines,
)

KAPPA = np.array([0.02, 0.02, np.deg2rad(0.08), 0.004]) * 1e-9
"""Magnitude 10 of the design study: 2 % of a subaperture in 1 s at 1 nm."""

SLOW = np.array([0.05, 0.05, np.deg2rad(0.05), 0.0005]) / np.sqrt(3600.0)


def demand(
    sigma_subap: float = 0.005, budget_m: float = 10e-9, drift: np.ndarray = SLOW
) -> DitherRequirement:
    return DitherRequirement(
        sigma=np.array([sigma_subap, sigma_subap, np.deg2rad(0.05), 0.002]),
        drift_rate=drift,
        budget_m=budget_m,
        window_s=5.0,
    )


def worst_of_a_simulated_filter(
    found: Schedule, asked: DitherRequirement, kappa: np.ndarray
) -> np.ndarray:
    """σ before each window once a Kalman filter on this schedule has settled, ``(4,)``."""
    noise = kappa**2 / (found.total_m**2 * asked.window_s)
    before = np.full(4, 1.0)
    for _ in range(20_000):
        after = before * noise / (before + noise)
        before = after + asked.drift_rate**2 * found.interval_s
    return np.sqrt(before)


@pytest.mark.parametrize("sigma_subap", [0.003, 0.005, 0.02])
def test_a_schedule_holds_what_was_asked_for(sigma_subap):
    asked = demand(sigma_subap)
    found = compute_schedule(KAPPA, asked)
    assert found.sufficient
    assert found.total_m <= asked.budget_m
    assert found.interval_s >= asked.window_s
    settled = worst_of_a_simulated_filter(found, asked, KAPPA)
    np.testing.assert_allclose(found.sigma, settled, rtol=1e-3)
    assert np.all(settled <= asked.sigma * 1.001)


def test_a_dither_that_need_not_be_exact_is_weak_and_seldom():
    strict, loose = compute_schedule(KAPPA, demand(0.003)), compute_schedule(KAPPA, demand(0.02))
    assert loose.total_m < strict.total_m
    assert loose.interval_s > 2 * strict.interval_s
    strictly, loosely = (one.total_m / np.sqrt(one.interval_s) for one in (strict, loose))
    assert loosely < strictly / 3


def test_the_budget_is_never_exceeded_even_when_it_does_not_suffice():
    asked = demand(0.003, budget_m=0.3e-9, drift=40 * SLOW)
    found = compute_schedule(KAPPA, asked)
    assert not found.sufficient
    assert found.total_m <= asked.budget_m
    assert found.interval_s == asked.window_s
    assert found.sigma[0] > asked.sigma[0]


def test_where_the_flexure_is_too_fast_nothing_is_spent_on_a_tenth_of_sigma():
    asked = demand(0.003, budget_m=50e-9, drift=40 * SLOW)
    found = compute_schedule(KAPPA, asked)
    least = np.sqrt(asked.drift_rate**2 * asked.window_s)
    assert not found.sufficient
    assert found.total_m < asked.budget_m / 4
    assert least[0] < found.sigma[0] <= 1.11 * least[0]


def test_a_burst_is_twice_as_precise_as_asked_so_that_it_may_stand_alone():
    asked = demand(0.01)
    found = compute_schedule(KAPPA, asked)
    noise = KAPPA / (found.total_m * np.sqrt(asked.window_s))
    assert np.max(noise / asked.sigma) == pytest.approx(0.5)


@pytest.mark.parametrize(("budget_nm", "length_s"), [(10.0, 2.0), (2.0, 5.0), (0.5, 60.0)])
def test_a_small_budget_needs_long_bursts(budget_nm, length_s):
    """2 % of a subaperture in 1 s at 1 nm: 0.5 % takes (4 / budget)² seconds."""
    asked = demand(0.005, budget_m=budget_nm * 1e-9, drift=1e-3 * SLOW)
    assert choose_burst_s(KAPPA, asked, (2.0, 5.0, 10.0, 20.0, 60.0)) == length_s


def test_no_burst_is_so_long_that_alpha_walks_away_inside_it():
    asked = demand(0.005, budget_m=0.5e-9, drift=20 * SLOW)
    assert choose_burst_s(KAPPA, asked, (2.0, 5.0, 10.0, 20.0, 60.0)) == 20.0


def test_without_pause_each_window_tells_what_one_alone_must():
    asked = replace(demand(drift=60.0 * SLOW), longest_s=0.0)
    weak = compute_schedule(KAPPA, asked)
    told = replace(asked, window_sigma=np.array([np.inf, np.inf, np.deg2rad(0.004), np.inf]))
    found = compute_schedule(KAPPA, told)
    assert found.total_m > weak.total_m
    assert KAPPA[2] / (found.total_m * np.sqrt(5.0)) == pytest.approx(np.deg2rad(0.004))
    assert compute_schedule(KAPPA, replace(told, budget_m=weak.total_m)).total_m == weak.total_m


def test_a_fast_flexure_is_followed_without_pause_by_no_more_than_it_needs():
    asked = demand(0.02, budget_m=50e-9, drift=4 * SLOW)
    found = compute_schedule(KAPPA, asked)
    assert found.sufficient
    assert found.total_m < asked.budget_m


@pytest.mark.parametrize(("budget_nm", "length_s"), [(10.0, 1.0), (2.0, 5.0), (0.5, 20.0)])
def test_a_window_is_as_short_as_the_dither_stands_out_of_the_noise(budget_nm, length_s):
    """2 % of a subaperture in 1 s at 1 nm: 0.5 % takes (4 / budget)² seconds."""
    asked = demand(budget_m=budget_nm * 1e-9)
    usable = np.array([0.005, 0.005, 1.0, 1.0])
    assert choose_window_s(KAPPA, asked, usable, (1.0, 5.0, 20.0)) == length_s


def lines(avoid: tuple[float, ...]) -> tuple[float, ...] | None:
    return place_lines(
        (211.0, 239.0, 283.0, 331.0),
        avoid,
        clearance_hz=8.0,
        step_hz=0.5,
        range_hz=(200.0, 350.0),
    )


def test_lines_stay_where_no_vibration_is():
    assert lines(()) == (211.0, 239.0, 283.0, 331.0)
    assert lines((50.0, 120.0)) == (211.0, 239.0, 283.0, 331.0)


def test_a_line_moves_away_from_a_vibration_by_the_clearance_and_no_further():
    moved = lines((240.0,))
    assert moved is not None
    assert moved[1] in (232.0, 248.0)
    assert (moved[0], *moved[2:]) == (211.0, 283.0, 331.0)


def test_lines_on_the_products_of_others_are_moved():
    """260 = 220 + 240 - 200: the pyramid's cubic term puts power there."""
    moved = place_lines(
        (200.0, 220.0, 240.0, 260.0),
        (),
        clearance_hz=8.0,
        step_hz=0.5,
        range_hz=(190.0, 350.0),
    )
    assert moved is not None
    assert moved != (200.0, 220.0, 240.0, 260.0)
    for i, a in enumerate(moved):
        for b in moved[i:]:
            for c in set(moved) - {a, b}:
                others = set(moved) - {a, b, c}
                assert all(abs(a + b - c - d) >= 2.0 for d in others)


def test_a_spectrum_full_of_vibrations_leaves_no_room():
    assert lines(tuple(np.arange(195.0, 360.0, 10.0))) is None
