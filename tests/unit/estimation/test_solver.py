"""Columns against a model: gains, residual, and the step that is best to first order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.solver import Columns


@pytest.fixture
def projected():
    """150 slopes, of which every fifth does not count, of seven columns; three unknowns."""
    rng = np.random.default_rng(2)
    model = rng.standard_normal((150, 7))
    derivatives = rng.standard_normal((3, 150, 7))
    columns = Columns(
        matrix=model * np.arange(1.0, 8.0) + 0.1 * rng.standard_normal(model.shape),
        weights=rng.uniform(0.5, 2.0, 7),
        rows=np.arange(150) % 5 > 0,
    )
    return columns.project(model, derivatives)


def test_only_slopes_that_count_are_projected(projected):
    assert projected.residual.shape == (120, 7)
    assert projected.jacobian.shape == (3, 120, 7)


def test_the_normal_matrix_is_the_sum_of_those_of_the_modes(projected):
    np.testing.assert_allclose(projected.normal, projected.normals.sum(axis=0), rtol=1e-12)


def test_the_best_step_is_that_of_least_squares(projected):
    root = np.sqrt(projected.weights)
    design = (projected.jacobian * root).reshape(3, -1).T
    expected, *_ = np.linalg.lstsq(design, (projected.residual * root).ravel())
    np.testing.assert_allclose(projected.best_step, expected, rtol=1e-6)
    left = projected.residual - np.tensordot(expected, projected.jacobian, axes=1)
    np.testing.assert_allclose(projected.chi_at_best, np.sum(left**2, axis=0) @ projected.weights)


def test_other_weights_are_not_answered_with_what_was_found_for_these(projected):
    first = projected.normal, projected.scores, projected.best_step
    twice = replace(projected, weights=2.0 * projected.weights)
    np.testing.assert_allclose(twice.normal, 2.0 * first[0])
    np.testing.assert_allclose(twice.scores, 2.0 * first[1])
    np.testing.assert_allclose(twice.best_step, first[2])


def test_a_column_to_which_the_model_does_not_respond_explains_nothing():
    columns = Columns(matrix=np.eye(4, 2), weights=np.ones(2), rows=np.ones(4, dtype=bool))
    model = np.eye(4, 2) * [1.0, 0.0]
    assert columns.misfit(model) == 0.5
    assert columns.project(model, np.zeros((1, 4, 2))).gains.tolist() == [1.0, 0.0]
