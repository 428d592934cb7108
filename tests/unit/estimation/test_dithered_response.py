"""The model's residual in the response of dithered modes, with its noise."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.dithered_response import DitheredResponse
from service.estimation.lockin import LockInPlan, Spectra
from service.model.misregistration import Misregistration
from service.records.estimates import LockInEstimate

N_SLOPES, N_MODES = 200, 60
MODES = tuple(range(30, 60))
FRAME_RATE_HZ = 1000.0
RNG = np.random.default_rng(8)
MODEL = RNG.standard_normal((N_SLOPES, N_MODES)).astype(np.float32)
PATTERN = np.outer(RNG.standard_normal(N_SLOPES), RNG.standard_normal(len(MODES)))
ERROR = (
    0.4
    * np.linalg.norm(MODEL)
    / np.sqrt(N_MODES / len(MODES))
    * (PATTERN / np.linalg.norm(PATTERN))
)
"""An error of 40 % of the response of 30 modes; as one pattern, as a smooth error nearly is."""


NO_ERROR = np.zeros_like(ERROR)


def a_window(
    error, *, noise, gain=0.6, seed=1, session="s1", modes=MODES, plant=MODEL, replies=(0, 1)
):
    """A window of modes that respond with ``gain`` times the model and the error.

    ``noise`` is the norm of each part of the noise over that of a mode's response.
    """
    rng = np.random.default_rng(seed)
    shape = (len(modes), N_SLOPES)
    commands = np.zeros((len(modes), 2, N_MODES), np.complex64)
    phases = np.exp(2j * np.pi * rng.uniform(size=len(modes)))
    commands[np.arange(len(modes)), 0, list(modes)] = 1e-6 * phases
    # the loop answers each line with two of its own modes
    commands[:, 0, list(replies)] = 5e-7 * rng.standard_normal((len(modes), 2))
    response = plant.astype(float)
    response[:, list(modes)] += error[:, : len(modes)]
    clean = gain * commands[:, 0] @ response.T
    parts = rng.standard_normal((2, *shape))
    size = noise * gain * 1e-6 * np.sqrt(np.mean(MODEL**2))
    slopes = clean + size * (parts[0] + 1j * parts[1])
    plan = LockInPlan(
        modes=modes,
        frequencies_hz=tuple(100.0 + 8.0 * np.arange(len(modes))),
        amplitude_m=(1e-8,) * len(modes),
        frame_rate_hz=FRAME_RATE_HZ,
        n_frames=1000,
        first_seq=0,
    )
    spectra = Spectra(
        plan=plan,
        slopes=np.stack([slopes, slopes], axis=1).astype(np.complex64),
        commands=commands,
        dither=commands[:, 0],
        session=session,
        cm_id=None,
        first_seq=0,
        t_end_ns_utc=0,
        n_missing=0,
    )
    estimate = LockInEstimate(
        alpha=Misregistration(),
        covariance=np.eye(4) * 1e-6,
        optical_gain=np.full(len(modes), gain, complex),
        gain_sigma=np.full(len(modes), 0.02),
        lag_frames=np.zeros(len(modes)),
        misfit=1.0,
        step=np.zeros(4),
        t_ns_utc=0,
        cm_id=None,
        session=session,
        modes=modes,
    )
    return spectra, estimate


def measured(error, noise, n_windows=1):
    """The residual after some windows."""
    found = DitheredResponse()
    for seed in range(n_windows):
        found.add(*a_window(error, noise=noise, seed=seed), MODEL)
    return found.left_over()


def relative_error(found):
    return np.linalg.norm(found.slopes - ERROR) / np.linalg.norm(ERROR)


def test_without_noise_the_residual_is_the_error():
    found = measured(ERROR, 1e-4)
    assert found.columns.tolist() == list(MODES)
    assert relative_error(found) < 1e-3


def test_an_error_hidden_in_the_noise_of_every_single_mode_is_found_in_all_together():
    """The noise is twice the error. Along the error's pattern are 200 + 30 of its 200 x 30 numbers.

    A pattern of noise that passes adds 1 of 30.
    """
    expected = 2.0 * np.sqrt((N_SLOPES + len(MODES)) / (N_SLOPES * len(MODES)))
    assert relative_error(measured(ERROR, 0.8)) < np.hypot(
        expected, 2.0 * np.sqrt(2.0 / len(MODES))
    )


@pytest.mark.parametrize(("n_modes", "noise"), [(4, 0.1), (30, 0.1), (30, 1.0)])
def test_of_a_right_model_one_or_two_patterns_of_noise_pass(n_modes, noise):
    ranks = []
    for seed in range(20):
        found = DitheredResponse()
        found.add(*a_window(NO_ERROR, noise=noise, seed=seed, modes=MODES[:n_modes]), MODEL)
        left = found.left_over()
        ranks.append(0 if left is None else np.linalg.matrix_rank(left.slopes, tol=1e-5))
    assert np.mean(ranks) <= 2.0
    assert max(ranks) <= 3


def test_windows_of_one_mode_are_averaged():
    """The noise falls with the root of their number."""
    eight, one = (relative_error(measured(ERROR, 0.5, n)) for n in (8, 1))
    assert eight < 0.6 * one


def test_the_residual_follows_a_response_that_has_changed():
    found = DitheredResponse()
    for k in range(80):
        found.add(*a_window(ERROR if k < 20 else -ERROR, noise=0.1, seed=k), MODEL)
    left = found.left_over()
    assert relative_error(replace(left, slopes=-left.slopes)) < 0.1


def test_within_its_noise_the_residual_is_the_mean_of_the_windows_and_one_noise_more_or_less():
    found = DitheredResponse()
    found.add(*a_window(NO_ERROR, noise=0.5), MODEL)
    mean, more, less = (one.slopes for one in found.with_noise())
    unit = np.linalg.norm(MODEL[:, list(MODES)])
    assert np.linalg.norm(mean) / unit == pytest.approx(0.5, rel=0.05)
    assert np.linalg.norm(more - mean) / unit == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(more + less, 2.0 * mean, atol=1e-5)
    assert [one.columns.tolist() for one in found.with_noise(MODES[:28])] == [[58, 59]] * 3
    assert found.with_noise(MODES) == ()


def test_the_replies_of_modes_with_a_residual_are_no_residual_of_the_dithered_ones():
    """The loop answers with modes 0 and 1, whose residual an earlier window has measured."""
    error = 0.4 * np.random.default_rng(3).standard_normal((N_SLOPES, 2))
    plant = MODEL.copy()
    plant[:, :2] += error
    found = DitheredResponse()
    found.add(*a_window(NO_ERROR, noise=1e-4, modes=(0, 1), plant=plant, replies=(5, 6)), MODEL)
    np.testing.assert_allclose(found.left_over().slopes, error, atol=0.01)
    found.add(*a_window(NO_ERROR, noise=1e-4, plant=plant), MODEL)
    left, *_ = found.with_noise((0, 1))
    assert np.linalg.norm(left.slopes) < 1e-3 * np.linalg.norm(MODEL)


def test_the_modes_of_the_rtcs_own_matrix_keep_its_residual():
    found = DitheredResponse()
    found.add(*a_window(ERROR, noise=0.1), MODEL)
    assert found.left_over(MODES[:10]).columns.tolist() == list(MODES[10:])
    assert found.left_over(MODES) is None


def test_a_mode_without_a_clear_response_has_no_residual():
    spectra, estimate = a_window(ERROR, noise=0.1)
    gains = estimate.optical_gain.copy()
    gains[3], gains[5] = 0.07, -0.6
    found = DitheredResponse()
    found.add(spectra, replace(estimate, optical_gain=gains), MODEL)
    assert found.left_over().columns.tolist() == [m for m in MODES if m not in {33, 35}]
    unknown = DitheredResponse()
    unknown.add(spectra, replace(estimate, gain_sigma=None), MODEL)
    assert unknown.left_over() is None


def test_another_session_of_the_rtc_begins_with_nothing():
    found = DitheredResponse()
    found.add(*a_window(ERROR, noise=0.1), MODEL)
    found.add(*a_window(ERROR, noise=0.1, session="s2", modes=MODES[:4]), MODEL)
    assert found.left_over().columns.tolist() == list(MODES[:4])
