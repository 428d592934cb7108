"""The reconstructor that knows how strong modes and noise are."""

from __future__ import annotations

import numpy as np
import pytest

from service.control.gate import judge
from service.control.loop import ControlLoop
from service.control.reconstructor import Prior, invert, invert_with_prior
from service.errors import ModelError
from service.model.misregistration import Misregistration
from tests.numerics import N_CONTROLLED, N_MODES, small_basis, small_linearisation

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
