"""As little dither as keeps the registration as well known as it must be."""

from __future__ import annotations

import itertools
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from service.control.dither import (
    CLEARANCE_HZ,
    COARSE_BAND,
    FINE_BAND,
    LINE_BAND_RATIO,
    MAX_LINES,
    MIN_LINES,
    PRECISION_RATIO_RANGE,
    PRECISION_TABLE,
    TABLE_MAGNITUDES,
    DitherRequirement,
    choose_burst_s,
    choose_window_s,
    compute_information,
    compute_precision_ratio,
    compute_schedule,
    look_up_precision,
    place_lines,
    select_informative_modes,
    spread_lines,
    spread_modes,
    update_mean_ratio,
)
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.records.operations import Schedule

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


# --- which modes are dithered


RNG = np.random.default_rng(3)
WANTED = np.array([0.003, 0.003, 1e-4, 3e-4])


@pytest.fixture(scope="module")
def linearisation():
    return Linearisation(
        alpha=Misregistration(),
        matrix=RNG.normal(size=(60, 12)).astype(np.float32),
        derivatives=RNG.normal(size=(4, 60, 12)).astype(np.float32),
    )


def worst(found, modes):
    covariance = np.linalg.inv(found[list(modes)].sum(axis=0))
    return (np.diag(covariance) / WANTED**2).max()


def test_information_is_that_of_a_fit_with_the_modes_gain_free(linearisation):
    found = compute_information(linearisation)
    for mode in (0, 7):
        regressors = np.column_stack(
            [*linearisation.derivatives[:, :, mode], linearisation.matrix[:, mode]]
        ).astype(float)
        covariance = np.linalg.inv(regressors.T @ regressors)
        np.testing.assert_allclose(np.linalg.inv(found[mode]), covariance[:4, :4], rtol=1e-5)


def test_no_exchange_of_one_mode_improves_the_chosen_set(linearisation):
    found = compute_information(linearisation)
    chosen = select_informative_modes(found, range(12), 4, WANTED)
    assert len(set(chosen)) == 4
    for place, other in itertools.product(range(4), set(range(12)) - set(chosen)):
        exchanged = [*chosen[:place], other, *chosen[place + 1 :]]
        assert worst(found, exchanged) >= worst(found, chosen) * (1 - 1e-5)


def test_only_candidates_are_chosen(linearisation):
    assert set(
        select_informative_modes(compute_information(linearisation), range(5, 30), 3, WANTED)
    ) <= set(range(5, 12))


def test_fewer_candidates_than_wanted_are_all_taken(linearisation):
    assert select_informative_modes(
        compute_information(linearisation), range(9, 40), 4, WANTED
    ) == (9, 10, 11)


def test_what_is_wanted_decides_which_modes_tell_most(linearisation):
    found = compute_information(linearisation)
    only_rotation = select_informative_modes(found, range(12), 1, np.array([1e3, 1e3, 1e-4, 1e3]))
    variances = [np.linalg.inv(found[mode])[2, 2] for mode in range(12)]
    assert only_rotation == (int(np.argmin(variances)),)


# --- the precision that a dither reaches


@pytest.mark.parametrize("row", range(3))
def test_the_table_is_met_at_its_own_magnitudes(row):
    np.testing.assert_allclose(look_up_precision(TABLE_MAGNITUDES[row]), PRECISION_TABLE[row])


def test_between_two_magnitudes_it_is_their_geometric_mean():
    np.testing.assert_allclose(
        look_up_precision(8.5), np.sqrt(PRECISION_TABLE[0] * PRECISION_TABLE[1])
    )


def test_the_brightest_are_no_better_than_the_table_and_fainter_ones_worse():
    np.testing.assert_allclose(look_up_precision(3.0), PRECISION_TABLE[0])
    np.testing.assert_allclose(
        look_up_precision(15.0), PRECISION_TABLE[2] ** 2 / PRECISION_TABLE[1]
    )


def test_an_unknown_star_is_taken_for_a_faint_one():
    np.testing.assert_allclose(look_up_precision(None), PRECISION_TABLE[2])


def test_a_window_of_the_tables_own_precision_has_the_ratio_one():
    """σ = κ / (A sqrt(T)): 4 nm for 25 s is 20 times the precision of 1 nm for 1 s."""
    sigma = look_up_precision(10.0) / (4e-9 * 5.0)
    ratio = compute_precision_ratio(np.diag(sigma**2), 4e-9, 25.0, 10.0)
    np.testing.assert_allclose(ratio, 1.0)
    ratio = compute_precision_ratio(np.diag(4.0 * sigma**2), 4e-9, 25.0, 10.0)
    np.testing.assert_allclose(ratio, 2.0)


def test_a_window_beyond_belief_counts_as_the_edge_of_belief():
    ratio = compute_precision_ratio(np.diag([1e6, 1e-30, 1.0, 1.0]), 1e-9, 1.0, 10.0)
    assert (ratio[0], ratio[1]) == (PRECISION_RATIO_RANGE[1], PRECISION_RATIO_RANGE[0])


def test_the_first_window_is_believed_and_a_change_after_a_dozen():
    mean = None
    for number in range(20):
        mean = update_mean_ratio(mean, number, np.full(4, 0.5))
    np.testing.assert_allclose(mean, 0.5)
    for number in range(20, 36):
        mean = update_mean_ratio(mean, number, np.full(4, 2.0))
    # (7/8)^16 = 12 % of the mean square is still the old one
    np.testing.assert_allclose(mean, np.sqrt(0.118 * 0.25 + 0.882 * 4.0), rtol=1e-2)


# --- the dithers of an acquisition


@pytest.mark.parametrize("n_modes", [16, 30, 60, 224, 594])
def test_the_modes_that_confirm_are_others_than_those_that_lead(n_modes):
    lead, confirm = (spread_modes(reach, n_modes, 8) for reach in (COARSE_BAND, FINE_BAND))
    assert not set(lead) & set(confirm)
    assert max(lead) < min(confirm)
    assert max(confirm) < n_modes
    assert len(lead) >= MIN_LINES
    assert len(confirm) >= MIN_LINES


def test_in_a_long_basis_the_bands_are_those_that_were_studied():
    assert spread_modes(COARSE_BAND, 594, 8) == (0, 4, 8, 12, 16, 20, 24, 28)
    assert spread_modes(FINE_BAND, 594, 8) == (36, 45, 54, 63, 72, 81, 90, 99)


@pytest.mark.parametrize("rate_hz", [300.0, 500.0, 990.0, 1000.0, 2000.0])
def test_every_line_has_whole_periods_and_room_for_its_noise(rate_hz):
    lines = spread_lines(rate_hz, 2.0, 8)
    assert MIN_LINES <= len(lines) <= MAX_LINES
    assert all((2.0 * line) % 1.0 == 0.0 for line in lines)
    assert min(b - a for a, b in combinations(sorted(lines), 2)) >= CLEARANCE_HZ
    assert LINE_BAND_RATIO[0] * rate_hz <= min(lines)
    assert max(lines) <= LINE_BAND_RATIO[1] * rate_hz


def test_no_line_is_made_by_three_others():
    lines = spread_lines(1000.0, 2.0, 8)
    for a, b in combinations(lines, 2):
        for c in set(lines) - {a, b}:
            rest = set(lines) - {a, b, c}
            assert all(abs(a + b - c - line) >= 2.0 for line in rest)


def test_a_slow_camera_has_fewer_lines_and_a_very_slow_one_none():
    assert len(spread_lines(500.0, 2.0, 8)) < len(spread_lines(1000.0, 2.0, 8))
    assert spread_lines(150.0, 2.0, 8) == ()


def test_an_rtc_that_plays_few_modes_gets_few():
    assert len(spread_lines(1000.0, 2.0, 4)) == 4
    assert spread_lines(1000.0, 2.0, 2) == ()


def test_finer_modes_are_the_more_precise_ones():
    assert np.all(FINE_BAND.floor < COARSE_BAND.floor)
