"""Registration from dithered telemetry of a closed loop, against the truth of a linear plant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from service.estimation import lockin
from service.estimation.lockin import (
    MAX_LAG_FRAMES,
    LockIn,
    LockInEstimate,
    LockInPlan,
    Spectra,
    compute_total_commands,
    fit_window,
)
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from tests.numerics import (
    DT_NS,
    FRAME_RATE_HZ,
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    T0_NS,
    Sky,
    closed_loop,
    sines,
    small_linearisation,
    small_loop,
    small_model,
)

N_WINDOWS, FIRST = 48, 12


def the_response(dither, matrix, loop, frequency_hz, gain):
    """Return the total command that one line leads to."""
    found = compute_total_commands(
        dither[None], loop.reconstructor @ matrix, loop, (frequency_hz,), np.array([gain])
    )
    return found[0]


def plan(*frequencies_hz: float, amplitude_m: float = 10e-9) -> LockInPlan:
    """Two of the modes that the loop does not control, one-second windows."""
    return LockInPlan(
        modes=(33, 37),
        frequencies_hz=frequencies_hz,
        amplitude_m=(amplitude_m, amplitude_m),
        frame_rate_hz=FRAME_RATE_HZ,
        n_frames=1000,
        first_seq=0,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A star and the loop and dither it is observed with."""

    sky: Sky
    gain: float
    plan: LockInPlan

    @property
    def loop(self) -> lockin.ClosedLoop:
        return small_loop(gain=self.gain)


BRIGHT = Case(sky=Sky(noise=2e-3), gain=0.3, plan=plan(230.0, 270.0))
FAINT = Case(sky=Sky(noise=0.05, turbulence=0.3), gain=0.5, plan=plan(60.0, 90.0))
"""Strong turbulence and noise at frequencies where the loop answers both: the hard case."""


@cache
def bright_windows() -> list[Spectra]:
    return windows(BRIGHT, N_WINDOWS)


@cache
def faint_windows() -> list[Spectra]:
    return windows(FAINT, N_WINDOWS)


def windows(case: Case, number: int) -> list[Spectra]:
    dither = sines(case.plan, number * case.plan.n_frames)
    return demodulated(case, closed_loop(case.loop, case.sky, dither))


def demodulated(case: Case, block) -> list[Spectra]:
    _, ended = LockIn(plan=case.plan).accumulate(block)
    assert all(isinstance(window, Spectra) for window in ended)
    return ended


def settled(case: Case, spectra: list[Spectra]) -> list[LockInEstimate]:
    """Estimates about a linearisation where the first of them are, found from α = 0 in rounds."""
    linearisation = small_linearisation()
    for _ in range(2):
        first = [fit_window(window, linearisation, case.loop) for window in spectra[:FIRST]]
        mean = np.mean([estimate.alpha.vector for estimate in first], axis=0)
        linearisation = small_model().linearise(Misregistration.from_vector(mean))
    return [fit_window(window, linearisation, case.loop) for window in spectra]


@cache
def bright_estimates() -> list[LockInEstimate]:
    return settled(BRIGHT, bright_windows())


@cache
def faint_estimates() -> list[LockInEstimate]:
    return settled(FAINT, faint_windows())


def errors(case: Case, estimates: list[LockInEstimate]) -> np.ndarray:
    return np.array([e.alpha.vector for e in estimates]) - case.sky.alpha.vector


def in_sigma_of_the_mean(error: np.ndarray) -> np.ndarray:
    return error.mean(axis=0) / (error.std(axis=0, ddof=1) / np.sqrt(len(error)))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((BRIGHT, bright_estimates), id="bright", marks=pytest.mark.long),
        pytest.param((FAINT, faint_estimates), id="faint"),
    ],
)
def found(request):
    """A case and the estimates of its 48 windows."""
    case, estimates = request.param
    return case, estimates()


def test_the_mean_of_many_windows_is_the_truth(found):
    """Each parameter within 3 σ of the mean of 48 windows."""
    error = errors(*found)
    assert np.abs(in_sigma_of_the_mean(error)).max() < 3.0


def test_the_predicted_covariance_is_the_scatter_that_is_seen(found):
    """chi2/4 has a standard deviation of 0.10 over 48 windows; 0.94 was measured elsewhere."""
    _, estimates = found
    chi2 = [
        d @ np.linalg.solve(e.covariance, d) for d, e in zip(errors(*found), estimates, strict=True)
    ]
    assert 0.6 < np.mean(chi2) / 4 < 1.6


def test_the_sigma_of_the_gains_is_the_scatter_that_is_seen(found):
    """48 windows tell a standard deviation to 10 %."""
    case, estimates = found
    seen = np.std([np.abs(e.optical_gain) for e in estimates], axis=0, ddof=1)
    said = np.sqrt(np.mean([e.gain_sigma**2 for e in estimates], axis=0))
    np.testing.assert_allclose(seen / said, 1.0, atol=0.3)
    assert estimates[0].modes == case.plan.modes


def test_the_command_as_its_own_instrument_is_biased(monkeypatch):
    """What the instrument is for: the command carries turbulence and noise of its own."""
    right = errors(FAINT, faint_estimates())
    monkeypatch.setattr(
        lockin, "_instrument", lambda spectra, *_: spectra.commands[:, 0].astype(complex)
    )
    wrong = errors(FAINT, settled(FAINT, faint_windows()))
    assert np.abs(in_sigma_of_the_mean(wrong)).max() > 5.0
    assert np.abs(wrong.mean(axis=0))[0] > 3 * np.abs(right.mean(axis=0))[0]


def test_the_optical_gain_and_the_alignment_of_the_columns_are_measured():
    """1 %: 48 windows at a signal to noise of a few hundred."""
    estimates = bright_estimates()
    gains = np.mean([e.optical_gain for e in estimates], axis=0)
    np.testing.assert_allclose(np.abs(gains), BRIGHT.sky.optical_gain, rtol=0.01)
    assert np.abs(np.mean([e.lag_frames for e in estimates], axis=0)).max() < 0.01


def test_an_exact_model_leaves_nothing_but_noise():
    misfit = np.mean([e.misfit for e in bright_estimates()])
    assert misfit == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("lag", [1, -1])
def test_columns_that_are_a_frame_apart_are_noticed_with_the_sign_of_the_lag(lag):
    """Positive: the slopes lag behind the commands. 0.05: the loop's own reply moves too."""
    dither = sines(BRIGHT.plan, 3002)
    block = closed_loop(BRIGHT.loop, BRIGHT.sky, dither)
    late = replace(block, slopes=np.roll(block.slopes, lag, axis=0))
    for estimate in settled(BRIGHT, demodulated(BRIGHT, late)):
        np.testing.assert_allclose(estimate.lag_frames, lag, atol=0.05)
        assert np.abs(estimate.lag_frames).min() > MAX_LAG_FRAMES


def test_a_wrong_model_shows_in_the_misfit():
    """The residual of a sensor that is not the model's: 40 % more gain on every other slope."""
    block = closed_loop(BRIGHT.loop, BRIGHT.sky, sines(BRIGHT.plan, 3000))
    uneven = np.where(np.arange(block.slopes.shape[1]) % 2, 1.4, 1.0).astype(np.float32)
    other = demodulated(BRIGHT, replace(block, slopes=block.slopes * uneven))
    assert min(e.misfit for e in settled(BRIGHT, other)) > 5.0


def test_modes_that_stand_still_change_nothing():
    """Of an ELT most do; they are left out of the sums."""
    spectra, about = bright_windows()[0], small_linearisation()
    n_slopes, n_modes = about.matrix.shape
    wide = [(0, 0), (0, 9 * n_modes)]
    other = np.random.default_rng(1).normal(size=(5, n_slopes, 9 * n_modes)).astype(np.float32)
    other *= np.abs(about.matrix).max()
    many = replace(
        about,
        matrix=np.hstack([about.matrix, other[0]]),
        derivatives=np.concatenate([about.derivatives, other[1:]], axis=2),
    )
    still = replace(
        spectra,
        commands=np.pad(spectra.commands, [(0, 0), *wide]),
        dither=np.pad(spectra.dither, wide),
    )
    few, found = (
        fit_window(window, lin, BRIGHT.loop) for window, lin in ((spectra, about), (still, many))
    )
    np.testing.assert_allclose(found.alpha.vector, few.alpha.vector, atol=1e-6)
    np.testing.assert_allclose(found.covariance, few.covariance, rtol=1e-3)
    assert (found.weak, found.dither_m) == (few.weak, pytest.approx(few.dither_m))


def test_an_estimate_says_which_window_it_is_of():
    spectra = bright_windows()[0]
    estimate = fit_window(spectra, small_linearisation(), BRIGHT.loop)
    assert (estimate.session, estimate.cm_id) == ("night-1", "cm-1")
    assert estimate.t_ns_utc == spectra.t_end_ns_utc > T0_NS + 998 * DT_NS


def test_an_estimate_says_how_much_dither_it_is_of():
    found = fit_window(bright_windows()[0], small_linearisation(), BRIGHT.loop)
    total_m = np.sqrt(np.sum(np.square(BRIGHT.plan.amplitude_m)))
    assert found.dither_m == pytest.approx(total_m, rel=1e-3)
    assert found.window_s == 1.0


def test_the_step_leads_from_the_linearisation_to_the_estimate():
    estimate = fit_window(bright_windows()[0], small_linearisation(), BRIGHT.loop)
    np.testing.assert_allclose(
        estimate.step, estimate.alpha.vector - Misregistration().vector, atol=1e-12
    )
    assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0)
    np.testing.assert_array_equal(estimate.covariance, estimate.covariance.T)


def test_twice_the_dither_halves_the_uncertainty():
    """σ = κ / (A sqrt T). 20 %: the scatter of six windows' own noise estimate."""
    double = replace(BRIGHT, plan=replace(BRIGHT.plan, amplitude_m=(20e-9, 20e-9)))
    once = settled(BRIGHT, windows(BRIGHT, 6))
    twice = settled(double, windows(double, 6))
    sigma = [
        np.sqrt(np.mean([np.diag(e.covariance) for e in found], axis=0)) for found in (once, twice)
    ]
    np.testing.assert_allclose(sigma[0] / sigma[1], 2.0, rtol=0.2)


# --- without noise


def quiet(linearisation: Linearisation, alpha: Misregistration, gain: complex) -> Spectra:
    """One window of a noise-free sensor that is exactly the linearised model."""
    matrix = linearisation.matrix_at(alpha)
    loop = small_loop()
    dither = np.zeros((2, N_MODES), complex)
    dither[[0, 1], [33, 37]] = -1.8e-6j
    commands = np.zeros((2, 37, N_MODES), complex)
    commands[:, 0] = [
        the_response(u, matrix, loop, f, gain)
        for u, f in zip(dither, BRIGHT.plan.frequencies_hz, strict=True)
    ]
    rng = np.random.default_rng(9)
    slopes = gain * commands @ matrix.T.astype(complex)
    slopes[:, 1:] += 1e-9 * rng.normal(size=slopes[:, 1:].shape)
    return Spectra(
        plan=BRIGHT.plan,
        session="night-1",
        cm_id="cm-1",
        first_seq=0,
        t_end_ns_utc=T0_NS,
        n_missing=0,
        slopes=slopes.astype(np.complex64),
        commands=commands.astype(np.complex64),
        dither=dither.astype(np.complex64),
    )


@pytest.mark.parametrize("gain", [1.0, 0.45, 0.6 * np.exp(0.1j)])
def test_a_noise_free_linear_sensor_is_read_exactly(gain):
    """1e-5 subapertures, radians and magnification: single precision of the spectra."""
    estimate = fit_window(
        quiet(small_linearisation(), SOMEWHERE, gain), small_linearisation(), small_loop()
    )
    np.testing.assert_allclose(estimate.alpha.vector, SOMEWHERE.vector, atol=1e-5)
    np.testing.assert_allclose(estimate.optical_gain, gain, atol=1e-4)


def test_slopes_that_are_known_to_be_noisy_count_less():
    """Half of them four times as noisy as the others: counted alike they cost twice the σ."""
    even = small_linearisation()
    rng, spectra = np.random.default_rng(3), quiet(even, SOMEWHERE, 1.0)
    shape = np.where(rng.random(even.matrix.shape[0]) < 0.5, 4.0, 1.0)
    noise = rng.normal(size=(2, *spectra.slopes.shape)) * shape
    size = 0.01 * np.abs(spectra.slopes[:, 0]).mean()
    noisy = replace(
        spectra, slopes=(spectra.slopes + size * (noise[0] + 1j * noise[1])).astype(np.complex64)
    )
    known = replace(even, noise_shape=shape / np.sqrt(np.mean(shape**2)))
    alike, weighted = (fit_window(noisy, about, small_loop()) for about in (even, known))
    sigma = np.sqrt([np.diag(alike.covariance), np.diag(weighted.covariance)])
    expected = np.sqrt(np.mean(shape**2) * np.mean(shape**-2.0))
    assert expected > 2.0
    np.testing.assert_allclose(sigma[0] / sigma[1], expected, rtol=0.25)
    error = np.abs(weighted.alpha.vector - SOMEWHERE.vector)
    assert np.all(error < 3 * sigma[1])


# --- the closed loop's answer to the dither


def response(mode: int, optical_gain: float, **loop) -> np.ndarray:
    dither = np.zeros(N_MODES)
    dither[mode] = 1.0
    matrix = small_linearisation().matrix
    return the_response(dither, matrix, small_loop(**loop), 230.0, optical_gain)


def test_a_dither_of_an_uncontrolled_mode_passes_unchanged_and_moves_the_controlled_ones():
    """Modes are not orthogonal to the sensor: the reconstructor takes some of it for its own."""
    found = response(35, 0.7)
    assert found[35] == pytest.approx(1.0)
    np.testing.assert_array_equal(found[N_CONTROLLED:][np.arange(10) != 5], 0.0)
    assert np.abs(found[:N_CONTROLLED]).max() > 1e-3


def test_a_dither_of_a_controlled_mode_is_rejected_by_the_textbook_function():
    """R D is the identity on controlled modes: 1 / (1 + g γ e^{-iwd} / (1 - leak e^{-iw}))."""
    z = np.exp(-2j * np.pi * 0.23)
    expected = 1.0 / (1.0 + 0.3 * 0.7 * z**2 / (1.0 - 0.999 * z))
    found = response(4, 0.7)
    assert found[4] == pytest.approx(expected, rel=1e-4)
    assert np.abs(np.delete(found, 4)).max() < 1e-4


def test_an_open_loop_leaves_the_dither_alone():
    found = response(35, 0.7, gain=0.0)
    np.testing.assert_array_equal(found, np.eye(N_MODES)[35])


def test_the_simulated_loop_answers_as_the_formula_says():
    """The transfer function against frames of the recursion itself, no turbulence, no noise.

    1e-3: what single precision and the first windows' transient leave.
    """
    case = replace(BRIGHT, sky=replace(BRIGHT.sky, noise=0.0, turbulence=0.0))
    spectra = windows(case, 2)[1]
    matrix = small_model().interaction_matrix(case.sky.alpha)
    for line, frequency in enumerate(case.plan.frequencies_hz):
        expected = the_response(
            spectra.dither[line], matrix, case.loop, frequency, case.sky.optical_gain
        )
        np.testing.assert_allclose(
            spectra.commands[line, 0], expected, atol=1e-3 * np.abs(expected).max()
        )


def test_a_mode_in_the_place_of_another_is_told_and_no_other_is():
    """On the linear plant a free mode is the file's, or another in its place."""
    here = small_model().linearise(SOMEWHERE)
    place = np.arange(N_MODES)
    place[[33, 39]] = [39, 33]
    other = replace(here, matrix=here.matrix[:, place], derivatives=here.derivatives[:, :, place])
    for spectra in bright_windows()[:6]:
        assert fit_window(spectra, here, BRIGHT.loop).answers_as == (33, 37)
        assert fit_window(spectra, other, BRIGHT.loop).answers_as == (39, 37)


def test_noise_puts_no_mode_in_the_place_of_another():
    assert {estimate.answers_as for estimate in faint_estimates()} == {(33, 37)}


def test_a_line_far_weaker_than_the_strongest_is_told():
    spectra, here = bright_windows()[0], small_model().linearise(SOMEWHERE)
    estimate = fit_window(spectra, here, BRIGHT.loop)
    assert estimate.weak == ()
    assert estimate.strong.all()
    dither = spectra.dither.copy()
    dither[1] *= 0.2
    weaker = fit_window(replace(spectra, dither=dither), here, BRIGHT.loop)
    assert weaker.weak == (37,)
    np.testing.assert_array_equal(weaker.strong, [True, False])
