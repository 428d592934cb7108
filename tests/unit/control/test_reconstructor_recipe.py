"""Recipe and provenance."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pyrcal.fitting.report import KnownFit, Provenance
from service.control.gains import CalibrationGains
from service.control.reconstructor import (
    Prior,
    Recipe,
    invert,
    invert_with_prior,
    reconstruct,
)
from tests.numerics import N_CONTROLLED, N_MODES, SOMEWHERE, small_basis, small_linearisation

MATRIX = small_linearisation().matrix
PRIOR = Prior(variance_m2=small_basis().variance_m2, slope_noise=np.full(len(MATRIX), 0.05))
BY_MAP = Recipe(n_modes=N_CONTROLLED, prior=PRIOR)


def test_a_recipe_is_carried_out_by_its_method():
    by_svd = reconstruct(MATRIX, Recipe(n_modes=N_CONTROLLED))
    np.testing.assert_array_equal(by_svd.matrix, invert(MATRIX, N_CONTROLLED).matrix)
    expected = invert_with_prior(MATRIX, N_CONTROLLED, PRIOR).matrix
    np.testing.assert_array_equal(reconstruct(MATRIX, BY_MAP).matrix, expected)


def test_the_limit_of_the_condition_is_obeyed():
    truncated = reconstruct(MATRIX, Recipe(n_modes=N_MODES, max_condition=1.5))
    assert truncated.n_truncated > 0


def test_the_provenance_of_a_tuned_synthetic_matrix_says_what_it_was_made_of():
    gains = CalibrationGains.of_modes(np.ones(20), np.arange(20), N_MODES)
    found = Provenance(
        recipe=BY_MAP,
        inversion=reconstruct(gains.tuned(MATRIX), BY_MAP),
        fit=KnownFit(
            alpha=SOMEWHERE,
            covariance=np.diag([0.01, 0.02, np.deg2rad(0.1), 0.001]) ** 2,
            reference_sha256="ab12",
            double_pass=True,
        ),
        gains=gains,
        measured_illumination=True,
    ).attributes()
    assert found["method"] == "map"
    assert found["n_gains_measured"] == 20
    assert found["n_gains_extended"] == N_CONTROLLED - 20
    assert found["rotation_deg"] == pytest.approx(0.4)
    assert found["sigma_rotation_deg"] == pytest.approx(0.1)
    assert found["prior_slope_noise"] == pytest.approx(0.05)
    assert found["reference_passes"] == 2
    assert found["single_pass"] is True
    assert found["measured_illumination"] is True
    assert json.loads(json.dumps(found)) == found


def test_the_provenance_of_a_registration_by_hand_claims_nothing_else():
    recipe = Recipe(n_modes=10)
    found = Provenance(
        recipe=recipe,
        inversion=reconstruct(MATRIX, recipe),
        fit=KnownFit(alpha=SOMEWHERE),
        gains=None,
        measured_illumination=False,
    ).attributes()
    assert found["max_condition"] == 100.0
    claims = {"sigma_rotation_deg", "prior_n_modes", "n_gains_measured", "reference_passes"}
    assert not claims & set(found)
