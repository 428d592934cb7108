"""Sets of a linear problem: their steps, their scatter and what enters σ."""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.disjoint_sets import (
    Normals,
    SetComparison,
    jackknife_sigma,
    pupil_partitions,
)
from pyrcal.fitting.solver import dispersion
from service.estimation.solver import Projection

N_ROWS, N_MODES, N_REGIONS = 120, 32, 12
EVERY = np.arange(N_MODES)


def problem(seed, wrong=0.0):
    """Four unknowns, noise of 1, and a second half of modes that sees the first one displaced."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(4, N_ROWS, N_MODES))
    residual = rng.normal(size=(N_ROWS, N_MODES))
    residual += wrong * np.where(EVERY < N_MODES // 2, -1.0, 1.0) * jacobian[0]
    seen = Projection(
        gains=np.ones(N_MODES), residual=residual, jacobian=jacobian, weights=np.ones(N_MODES)
    )
    # at the solution the scores of all modes are zero
    at_rest = residual - np.tensordot(seen.best_step, jacobian, axes=1)
    return Projection(
        gains=np.ones(N_MODES), residual=at_rest, jacobian=jacobian, weights=np.ones(N_MODES)
    )


def comparison(seen, places=None):
    n_rows = seen.residual.shape[0]
    regions = np.arange(n_rows) % N_REGIONS
    nothing = np.zeros((4, 4)), np.zeros(4)
    parts = Normals.of_rows(seen, regions)
    places = np.random.default_rng(0).normal(size=(n_rows, 2)) if places is None else places
    noise = seen.chi / seen.residual.size
    return parts, SetComparison(
        seen=seen,
        regions=regions,
        held=nothing[0],
        pull=nothing[1],
        noise=noise,
        distortion=parts.fit_distortion(places, *nothing, seen.chi, noise),
    )


def compared(seen, partitions):
    return list(comparison(seen)[1].of_modes(partitions, Normals.of_modes(seen)))


def test_the_jackknife_of_pure_noise_is_its_formal_sigma():
    formal = 1.0 / np.sqrt(N_ROWS * N_MODES)
    found = [jackknife_sigma(compared(problem(seed), {"combs": EVERY % 8})) for seed in range(20)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(formal, rel=0.2)


def test_the_steps_of_two_halves_average_to_none():
    (one,) = compared(problem(3), {"halves": EVERY % 2})
    np.testing.assert_allclose(one.steps.mean(axis=0), 0.0, atol=0.2 * one.sigma.max())


def test_sets_that_disagree_count_by_themselves_and_not_by_the_mean_over_all():
    seen = problem(4, wrong=0.5)
    found = compared(seen, {"odd": EVERY % 2, "low": 2 * EVERY // N_MODES})
    assert found[1].tension[0] > 3.0
    assert np.all(found[0].tension < 4.0)
    assert jackknife_sigma(found)[0] == pytest.approx(0.5, rel=0.2)
    assert np.all(jackknife_sigma(found)[1:] < 0.05)


def test_halves_of_the_pupil_are_compared_and_do_not_enter_sigma():
    seen = problem(5, wrong=0.5)
    (one,) = compared(seen, {"left and right half": 2 * EVERY // N_MODES})
    assert not one.even
    assert np.all(jackknife_sigma([one]) == 0.0)


def test_both_sides_of_an_arm_turn_the_mirror_in_opposite_directions_and_not_in_sigma():
    """Sigma of the rotation stays that of the noise, although alternate sectors are 2 apart."""
    rng = np.random.default_rng(9)
    valid = np.hypot(*(np.indices((18, 18)) - 8.5)) < 9.0
    y, x = np.argwhere(valid).T - 8.5
    angle, away = np.tile(np.arctan2(y, x), 2), np.tile(np.hypot(x, y), 2)
    # Arms at 30, 150 and 270 deg are along edges of sectors.
    off_arm = (angle - np.pi / 6.0 + np.pi / 3.0) % (2.0 * np.pi / 3.0) - np.pi / 3.0
    wrong = np.where(np.abs(off_arm) < np.pi / 6.0, np.sign(off_arm), 0.0)
    jacobian = (
        rng.normal(size=(4, len(angle), N_MODES)) * np.array([1.0, 1.0, 0.0, 1.0])[:, None, None]
    )
    jacobian[2] = away[:, None] * rng.normal(size=(len(angle), N_MODES))
    residual = rng.normal(size=(len(angle), N_MODES)) + wrong[:, None] * jacobian[2]
    one = np.ones(N_MODES)
    seen = Projection(gains=one, residual=residual, jacobian=jacobian, weights=one)
    residual = residual - np.tensordot(seen.best_step, jacobian, axes=1)
    parts, sets = comparison(replace(seen, residual=residual))
    labels = pupil_partitions(valid, 2, np.ones(len(angle), dtype=bool))
    found = list(sets.of_rows(labels, parts))
    sectors = next(one for one in found if one.words == "alternate sectors")
    assert np.ptp(sectors.steps[:, 2]) > 1.0
    assert jackknife_sigma(found)[2] < 0.1


def test_partitions_of_a_pupil_list_every_slope_that_counts():
    valid = np.hypot(*(np.indices((10, 10)) - 4.5)) < 5.0
    rows = np.ones(2 * int(valid.sum()), dtype=bool)
    rows[:3] = False
    for labels in pupil_partitions(valid, 2, rows).values():
        assert len(labels) == rows.sum()
        assert len(np.unique(labels)) > 1


def test_the_sigma_of_a_set_holds_errors_that_all_modes_share_in_a_region():
    """Slopes of a region err together in every mode: noise alone would be 3 times smaller."""
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        seen = problem(seed)
        shared = rng.normal(size=N_REGIONS)[np.arange(N_ROWS) % N_REGIONS]
        wrong = seen.residual + 0.5 * shared[:, None] * seen.jacobian[0]
        wrong -= np.tensordot(replace(seen, residual=wrong).best_step, seen.jacobian, axes=1)
        parts, sets = comparison(replace(seen, residual=wrong))
        halves = (np.arange(N_ROWS) % N_REGIONS) % 2
        (one,) = sets.of_rows({"halves": halves}, parts)
        ratios.append(one.ratios[0, 0])
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_a_distortion_is_found_and_explains_the_difference_of_inner_and_outer_sets():
    rng = np.random.default_rng(7)
    radius, angle = np.sqrt(rng.random(N_ROWS)), 2.0 * np.pi * rng.random(N_ROWS)
    x, y = places = radius * np.array([np.cos(angle), np.sin(angle)])
    along_x, along_y = rng.normal(size=(2, N_ROWS, N_MODES))
    # shift, rotation and magnification are what a displacement of every point is made of
    turned = x[:, None] * along_y - y[:, None] * along_x
    larger = x[:, None] * along_x + y[:, None] * along_y
    jacobian = np.array([along_x, along_y, turned, larger])
    field = 0.6 * (x**2 + y**2) * places
    residual = 0.1 * rng.normal(size=(N_ROWS, N_MODES))
    residual += field[0][:, None] * along_x + field[1][:, None] * along_y
    one = np.ones(N_MODES)
    seen = Projection(gains=one, residual=residual, jacobian=jacobian, weights=one)
    residual = residual - np.tensordot(seen.best_step, jacobian, axes=1)
    seen = replace(seen, residual=residual)
    parts, sets = comparison(seen, places.T)
    # only the noise is left
    assert sets.distortion.share == pytest.approx(0.1**2 / np.mean(residual**2), rel=0.05)
    outer = (radius > np.median(radius)).astype(int)
    (rings,) = sets.of_rows({"rings": outer}, parts)
    assert rings.straight_tension[3] > 3.0
    assert rings.tension[3] < 1.5
    # and sigma holds it: the magnification of a distorted mirror is a matter of where one looks
    assert jackknife_sigma([rings])[3] > 0.3 * np.ptp(rings.steps[:, 3])


def test_a_mirror_that_is_not_distorted_moves_no_set():
    _, sets = comparison(problem(8))
    assert sets.distortion.rms_subap < 0.1
    assert sets.distortion.share > 0.98


@pytest.mark.parametrize("n_alike", [1, 10])
def test_slopes_that_err_alike_count_as_one(n_alike):
    """Of noise every slope counts; where ten have one derivative and one error, ten count as one.

    The scatter is that of the sum of squares of 4 unknowns in 120 or 12 regions.
    """
    rng = np.random.default_rng(6)
    regions = np.arange(N_ROWS) // n_alike
    n_regions = int(regions[-1]) + 1
    jacobian = rng.normal(size=(4, n_regions, N_MODES))[:, regions]
    residual = rng.normal(size=(n_regions, N_MODES))[regions]
    seen = Projection(
        gains=np.ones(N_MODES), residual=residual, jacobian=jacobian, weights=np.ones(N_MODES)
    )
    assert dispersion(seen, regions) == pytest.approx(n_alike, rel=0.35)
