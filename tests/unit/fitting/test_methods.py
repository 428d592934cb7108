"""The scans of the paper's Table 1, and its criterion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions
from pyrcal.fitting.methods import (
    FITTED_HALF_WIDTH,
    SAME_MINIMUM,
    TABLE_1,
    ScanStep,
    Settled,
    chi_n,
    reuse_image_derivatives,
    scan,
)
from pyrcal.fitting.models import FitModels
from pyrcal.fitting.solver import image_patterns, nuisances_of, refine
from service.errors import ModelError
from service.estimation.reference import Reference, Target, target_of
from service.model.kinds import Method
from service.model.misregistration import PARAMETERS, Misregistration
from tests.support.bench import ELSEWHERE, GRID, PLAIN, fit, instrument, matrix
from tests.support.numerics import small_basis

ALL_MODES = np.arange(small_basis().n_modes)


def models() -> FitModels:
    return FitModels(instrument=instrument(), basis=small_basis())


def target(values: np.ndarray) -> Target:
    return target_of(Reference(matrix=values), instrument())


@pytest.fixture(scope="module")
def scanned() -> tuple[Misregistration, tuple[ScanStep, ...], list[str]]:
    told: list[str] = []
    start = Misregistration(rotation_rad=np.deg2rad(0.4))
    alpha, table = scan(models(), target(matrix()), start, progress=told.append)
    return alpha, table, told


def test_a_model_matrix_is_found_by_the_ten_steps_from_where_the_paper_began(scanned):
    """No shift, no magnification, the rotation 0.9 deg off: like 64.5 deg for 65.08."""
    alpha, table, _ = scanned
    assert [(one.parameter, one.step) for one in table] == list(TABLE_1)
    # the bench's matrix is of a finer grid than the fit's: GRID is what that moves a fit by
    assert np.all(np.abs(alpha.vector - ELSEWHERE.vector) < 2.0 * GRID)


def test_a_third_estimation_changes_nothing(scanned):
    alpha, *_ = scanned
    again, _ = scan(models(), target(matrix()), alpha, TABLE_1[6:])
    assert np.all(np.abs(again.vector - alpha.vector) < GRID)


def test_every_scan_is_announced_with_its_value(scanned):
    _, table, told = scanned
    assert len(told) == len(TABLE_1)
    for line, step in zip(told, table, strict=True):
        assert line.endswith(f"{step.minimum:.4f}")


def test_a_scan_goes_on_until_its_lowest_sample_has_neighbours(scanned):
    _, table, _ = scanned
    for step in table:
        lowest = int(np.argmin(step.chi))
        assert 0 < lowest < len(step.samples) - 1
        np.testing.assert_allclose(np.diff(step.samples), step.step)
        near = np.abs(step.samples - step.samples[lowest]) < (FITTED_HALF_WIDTH + 0.5) * step.step
        places = (step.samples[near] - step.minimum) / step.step
        fitted = np.polyfit(places, step.chi[near], 2)
        np.testing.assert_allclose(step.coefficients, fitted, rtol=1e-6, atol=1e-9 * fitted[0])
        assert abs(step.coefficients[1]) < 1e-6 * step.coefficients[0], "the minimum is at 0"


def test_the_first_scans_cover_the_rough_estimate_that_the_paper_assumes(scanned):
    """±2 deg and ±1 subaperture (section 4)."""
    _, table, _ = scanned
    for step, reach in zip(table[:3], (2.0, 1.0, 1.0), strict=True):
        assert np.ptp(step.samples) >= 2.0 * reach - 1e-9


def test_the_criterion_is_the_squared_norm_of_each_modes_rmse():
    """Equations 7 and 8, by hand; a gain of 2 in a column is an error, not a free gain."""
    synthetic = matrix().astype(np.float32)
    measured = synthetic.astype(np.float64).copy()
    measured[:, 3] *= 2.0
    expected = np.mean(synthetic[:, 3].astype(np.float64) ** 2)
    assert chi_n(target(measured), synthetic) == pytest.approx(expected, rel=1e-5)


def test_a_matrix_of_unknown_strokes_is_refused():
    """Without a free gain its unit would decide the registration."""
    mirror = replace(instrument().mirror, stroke_known=False)
    about = replace(instrument(), mirror=mirror)
    options = FitOptions(method=Method.PAPER, start=ELSEWHERE, orientation=PLAIN)
    with pytest.raises(ModelError, match="strokes are unknown"):
        fit(matrix(), about, options)


def test_every_parameter_of_table_1_is_one_of_the_registration():
    assert {parameter for parameter, _ in TABLE_1} == set(PARAMETERS)
    assert len(ALL_MODES) == target(matrix()).n_modes


@pytest.mark.parametrize(("away", "reused"), [(0.5, True), (1.5, False)])
def test_derivatives_by_image_displacements_hold_near_where_they_were_computed(away, reused):
    """A fit that moved far has them from its start, so that they do not hold at its result."""
    seen, kind = target(matrix(ELSEWHERE)), instrument().slopes.kind
    patterns = image_patterns(instrument().stop)
    nuisances = nuisances_of(seen.valid, kind, images=patterns, image_sigma=0.2)
    begin = ELSEWHERE.with_vector(ELSEWHERE.vector + away * SAME_MINIMUM * [1.0, 0.0, 0.0, 0.0])
    solution = refine(models(), seen, begin, nuisances)
    assert np.all(np.abs(solution.vector - ELSEWHERE.vector) < SAME_MINIMUM / 10.0)
    settled = Settled(solution=solution, target=seen, models=models(), nuisances=nuisances)
    found = reuse_image_derivatives(settled, solution.alpha, nuisances)
    assert (found is not None) == reused
    if found is not None:
        np.testing.assert_array_equal(found, solution.near[-len(patterns) :])
