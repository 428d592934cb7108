"""From an interaction matrix to a reconstructor."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pyrcal.fitting.report import KnownFit, Provenance
from service.control import reconstructor
from service.control.gains import CalibrationGains
from service.control.gate import judge
from service.control.loop import ControlLoop
from service.control.reconstructor import (
    MAX_CONDITION,
    Prior,
    Recipe,
    invert,
    invert_with_prior,
    reconstruct,
)
from service.errors import ModelError
from service.model.misregistration import Misregistration
from tests.support.numerics import (
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    small_basis,
    small_linearisation,
)


def with_singular_values(values: list[float], n_slopes: int = 20) -> np.ndarray:
    rng = np.random.default_rng(6)
    left, _ = np.linalg.qr(rng.normal(size=(n_slopes, len(values))))
    right, _ = np.linalg.qr(rng.normal(size=(len(values), len(values))))
    return left * values @ right.T


@pytest.mark.parametrize("n_modes", [1, 10, N_MODES])
def test_the_reconstructor_undoes_the_controlled_modes(n_modes):
    """1e-5: rounded to single precision."""
    matrix = small_linearisation().matrix
    found = invert(matrix, n_modes)
    assert found.matrix.shape == (n_modes, len(matrix))
    np.testing.assert_allclose(found.matrix @ matrix[:, :n_modes], np.eye(n_modes), atol=1e-5)
    assert found.n_truncated == 0


def test_the_reconstructor_is_the_pseudo_inverse():
    matrix = small_linearisation().matrix.astype(float)
    found = invert(matrix, N_MODES).matrix
    expected = np.linalg.pinv(matrix)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_noise_outside_the_response_of_the_modes_is_ignored():
    matrix = with_singular_values([3.0, 2.0, 1.0])
    slopes = np.random.default_rng(2).normal(size=20)
    outside = slopes - matrix @ np.linalg.lstsq(matrix, slopes, rcond=None)[0]
    np.testing.assert_allclose(invert(matrix, 3).matrix @ outside, 0.0, atol=1e-6)


def test_the_condition_number_is_that_of_the_controlled_columns_before_truncation():
    matrix = with_singular_values([500.0, 100.0, 20.0, 1.0])
    found = invert(matrix, 4)
    assert found.condition_number == pytest.approx(500.0)
    assert found.n_truncated == 1
    assert invert(matrix, 1).condition_number == pytest.approx(1.0)


def test_truncation_drops_what_would_amplify_noise_and_keeps_the_rest():
    """The rest still obeys R D R = R, and is no larger than max_condition allows."""
    matrix = with_singular_values([1.0, 0.5, 0.9 / MAX_CONDITION, 1e-9])
    found = invert(matrix, 4)
    assert found.n_truncated == 2
    assert np.linalg.matrix_rank(found.matrix, tol=1e-3) == 2
    np.testing.assert_allclose(found.matrix @ matrix @ found.matrix, found.matrix, atol=1e-5)
    assert np.linalg.norm(found.matrix, 2) == pytest.approx(2.0, rel=1e-5)


def test_the_limit_of_the_condition_can_be_chosen():
    matrix = with_singular_values([1.0, 0.5, 0.01])
    assert [invert(matrix, 3, max_condition=c).n_truncated for c in (1000.0, 10.0, 1.5)] == [
        0,
        1,
        2,
    ]


def test_many_modes_are_truncated_by_their_eigenvectors_as_fewer_are(monkeypatch):
    """1e-6 of the largest element at a condition of 5000: squares of it lose half of 16 digits."""
    matrix = with_singular_values(list(np.geomspace(1.0, 2e-4, 12)))
    by_svd = invert(matrix, 12)
    monkeypatch.setattr(reconstructor, "_N_MODES_FOR_EIGENVECTORS", 1)
    monkeypatch.setattr(reconstructor, "_SLOPES_PER_BLOCK", 7)
    found = invert(matrix, 12)
    assert found.n_truncated == by_svd.n_truncated == 6
    assert found.condition_number == pytest.approx(by_svd.condition_number, rel=1e-6)
    np.testing.assert_allclose(found.matrix, by_svd.matrix, atol=1e-6 * np.abs(by_svd.matrix).max())


def test_a_mode_that_nobody_sees_leaves_a_condition_that_cannot_be_told(monkeypatch):
    matrix = with_singular_values([3.0, 2.0, 0.0])
    monkeypatch.setattr(reconstructor, "_N_MODES_FOR_EIGENVECTORS", 1)
    found = invert(matrix, 3)
    assert found.n_truncated == 1
    assert found.condition_number > 1e7
    assert np.all(np.isfinite(found.matrix))


def test_what_travels_is_single_precision_row_after_row():
    matrix = invert(small_linearisation().matrix, 10).matrix
    assert matrix.dtype == np.float32
    assert matrix.flags.c_contiguous


@pytest.mark.parametrize(
    ("shape", "n_modes", "text"),
    [
        ((20, 5), 6, r"found 6 modes to control; expected 1 to 5 \(5 modes, 20 slopes\)"),
        ((4, 5), 5, r"expected 1 to 4 \(5 modes, 4 slopes\)"),
        ((20, 5), 0, "found 0 modes to control"),
        ((20, 5), -1, "found -1 modes to control"),
    ],
)
def test_a_number_of_modes_that_cannot_be_controlled_is_refused(shape, n_modes, text):
    with pytest.raises(ModelError, match=text):
        invert(np.ones(shape), n_modes)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_matrix_that_is_not_finite_is_refused(bad):
    matrix = with_singular_values([3.0, 2.0, 1.0])
    matrix[7, 1] = bad
    with pytest.raises(ModelError, match="NaN or Inf"):
        invert(matrix, 3)


def test_a_bad_number_in_a_mode_that_is_not_controlled_does_no_harm():
    matrix = with_singular_values([3.0, 2.0, 1.0])
    matrix[7, 2] = np.nan
    assert np.all(np.isfinite(invert(matrix, 2).matrix))


def test_the_interaction_matrix_is_left_alone():
    matrix = with_singular_values([3.0, 2.0, 1.0])
    before = matrix.copy()
    invert(matrix, 3)
    np.testing.assert_array_equal(matrix, before)


# --- MAP reconstructors


MATRIX = small_linearisation().matrix
N_SLOPES = len(MATRIX)


def prior(noise: float = 0.05, n_modes: int = N_MODES) -> Prior:
    return Prior(
        variance_m2=small_basis().variance_m2[:n_modes], slope_noise=np.full(N_SLOPES, noise)
    )


def left_of(modes: np.ndarray, reconstructor: np.ndarray, noise: float) -> float:
    """RMS error of the first modes, metres, of a wavefront of these modes seen through noise."""
    rng = np.random.default_rng(8)
    slopes = modes @ MATRIX.T + noise * rng.normal(size=(len(modes), N_SLOPES))
    error = slopes @ reconstructor.T - modes[:, : len(reconstructor)]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def turbulence(n: int = 400) -> np.ndarray:
    rng = np.random.default_rng(9)
    return rng.normal(size=(n, N_MODES)) * np.sqrt(small_basis().variance_m2)


def test_without_noise_and_with_all_modes_it_is_the_least_squares_inverse():
    found = invert_with_prior(MATRIX, N_MODES, prior(noise=1e-6)).matrix
    expected = invert(MATRIX, N_MODES).matrix
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_two_slopes_of_one_mode_weigh_by_their_noise():
    """By hand: weights 1/σ², then scaled until the mode comes back whole."""
    matrix = np.array([[2.0], [2.0]])
    known = Prior(variance_m2=np.array([5.0]), slope_noise=np.array([1.0, 2.0]))
    np.testing.assert_allclose(invert_with_prior(matrix, 1, known).matrix, [[0.4, 0.1]], rtol=1e-6)


def test_a_mode_beyond_the_controlled_ones_no_longer_aliases():
    """Least squares on 30 modes takes what mode 35 shows for something else; MAP knows better."""
    slopes = MATRIX[:, 35]
    aliased = np.linalg.norm(invert(MATRIX, N_CONTROLLED).matrix @ slopes)
    left = np.linalg.norm(invert_with_prior(MATRIX, N_CONTROLLED, prior(0.01)).matrix @ slopes)
    assert left < 0.02 * aliased


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_turbulence_seen_through_noise_is_estimated_better_than_by_least_squares(noise):
    modes = turbulence()
    by_map = left_of(modes, invert_with_prior(MATRIX, N_CONTROLLED, prior(noise)).matrix, noise)
    by_svd = left_of(modes, invert(MATRIX, N_CONTROLLED).matrix, noise)
    assert by_map < by_svd


@pytest.mark.parametrize("n_modes", [1, N_CONTROLLED, N_MODES])
@pytest.mark.parametrize("noise", [0.01, 1.0])
def test_every_mode_comes_back_whole_so_that_a_loop_gain_keeps_its_meaning(n_modes, noise):
    """1e-5: rounded to single precision."""
    found = invert_with_prior(MATRIX, n_modes, prior(noise)).matrix
    np.testing.assert_allclose(np.diag(found @ MATRIX[:, :n_modes]), 1.0, atol=1e-5)


def test_a_prior_of_the_controlled_modes_alone_is_enough():
    found = invert_with_prior(MATRIX, N_CONTROLLED, prior(n_modes=N_CONTROLLED)).matrix
    alone = invert_with_prior(MATRIX[:, :N_CONTROLLED], N_CONTROLLED, prior()).matrix
    np.testing.assert_allclose(found, alone)


def test_the_condition_number_is_that_of_the_controlled_columns():
    found = invert_with_prior(MATRIX, N_CONTROLLED, prior())
    assert found.condition_number == pytest.approx(
        invert(MATRIX, N_CONTROLLED).condition_number, rel=1e-6
    )
    assert found.n_truncated == 0


@pytest.mark.parametrize(("degrees", "accepted"), [(0.0, True), (15.0, False)])
def test_the_gate_judges_it_like_any_other(degrees, accepted):
    found = invert_with_prior(MATRIX, N_CONTROLLED, prior()).matrix
    sigma = np.array([0.01, 0.01, np.deg2rad(0.01), 0.0005])
    loop = ControlLoop(
        frame_rate_hz=1000.0, gains=np.full(N_CONTROLLED, 0.5), leak=1.0, delay_frames=2.0
    )
    at = Misregistration(rotation_rad=np.deg2rad(degrees))
    verdict = judge(found, small_linearisation(), at, np.diag(sigma**2), loop, bound=0.95)
    assert verdict.accepted is accepted


@pytest.mark.parametrize(
    ("n_modes", "known", "text"),
    [
        (10, prior(n_modes=5), "prior of 5 modes"),
        (
            3,
            Prior(variance_m2=np.ones(N_MODES), slope_noise=np.ones(7)),
            f"40 modes and 7 slopes; expected at least 3 and {N_SLOPES}",
        ),
    ],
)
def test_a_prior_of_something_else_is_refused(n_modes, known, text):
    with pytest.raises(ModelError, match=text):
        invert_with_prior(MATRIX, n_modes, known)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_a_prior_that_is_not_positive_is_refused_and_the_first_place_named(bad):
    variance = np.ones(N_MODES)
    variance[[4, 9]] = bad
    with pytest.raises(ModelError, match=r"variance_m2: .* 2 values .* first at 4"):
        Prior(variance_m2=variance, slope_noise=np.ones(N_SLOPES))


# --- recipes


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
