from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pyrcal.fitting.matrix import FitOptions
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.pupil import Illumination, rtc_valid_subapertures
from tests.support.bench import ELSEWHERE, error, fit, instrument, matrix
from tests.support.numerics import small_basis, small_instrument

STRAIGHT = replace(ELSEWHERE, magnification=1.006)
"""So near to 1 that neither pitch nor diameter is doubted."""

EXPLAIN = FitOptions(explain=True)
RNG = np.random.default_rng(3)


def changed(**wfs):
    return replace(instrument(), wfs=replace(instrument().wfs, **wfs))


@pytest.mark.parametrize(("true", "assumed"), [tuple(Stop), tuple(Stop)[::-1]])
def test_a_wrong_stop_is_recognised_and_the_right_one_named(true, assumed):
    about = replace(instrument(), stop=assumed)
    found = fit(matrix(about=replace(instrument(), stop=true)), about, options=EXPLAIN)
    assert not found.accepted or np.all(np.abs(error(found)) < 3.0 * found.sigma)
    if assumed is Stop.TELESCOPE:  # its pupil may lie anywhere: it is found where α moves it
        places = found.image_offsets_px.mean(axis=0)
        np.testing.assert_allclose(places, found.alpha.vector[:2], atol=0.01)
    else:
        assert f'stop = "{true}"' in found.verdict + found.recommendation


def own_matrix(about, alpha=ELSEWHERE):
    """D on the grid of the fit itself, without noise."""
    model = InteractionModel(about, small_basis(), pupil_sampling=3, detector_nodes=3)
    return model.interaction_matrix(alpha).astype(np.float64)


def test_an_own_matrix_with_a_modulation_wide_for_its_subapertures_is_fitted_exactly():
    """Two points a subaperture alias from about 5 λ/D on: the derivatives take three."""
    about = changed(modulation_lambda_over_d=7.0)
    found = fit(own_matrix(about), about, options=EXPLAIN)
    assert found.accepted, found.verdict
    assert found.residual_fraction < 1e-4
    assert np.all(np.abs(error(found)) < 1e-5)
    (modulation,) = (one.found for one in found.optics if "modulation" in one.key)
    assert modulation == pytest.approx(7.0, rel=1e-4)


@pytest.mark.parametrize(("shift_subap", "accepted"), [(0.06, True), (0.15, False)])
def test_a_wrong_stop_refuses_only_if_it_moves_the_mirror_at_the_pupils_edge(shift_subap, accepted):
    alpha = replace(ELSEWHERE, shift_x_subap=shift_subap, shift_y_subap=0.0)
    found = fit(
        own_matrix(replace(instrument(), stop=Stop.TELESCOPE), alpha),
        replace(instrument(), stop=Stop.MIRROR),
        options=EXPLAIN,
    )
    (other,) = (one for one in found.alternatives if one.words == 'stop = "telescope"')
    assert other.preferred
    assert found.accepted is accepted, found.verdict
    assert 'stop = "telescope"' in found.recommendation
    assert "centre" not in found.recommendation, "with the mirror as stop nothing can be centred"
    assert not accepted or np.all(np.abs(error(found, alpha)) < found.sigma)


def test_a_modulation_is_found_beside_uneven_light():
    """A lamp to one side leaves a third of the signal, and a wrong modulation hides in that."""
    coordinates = np.linspace(-7.0, 7.0, 57)
    x, y = np.meshgrid(coordinates, coordinates)
    lamp = Illumination(
        coordinates=coordinates, intensity=1.0 + 0.6 * x / 7.0 + 0.3 * np.sin(1.9 * y)
    )
    bench = matrix(about=changed(modulation_lambda_over_d=6.0), illumination=lamp, noise=0.1)
    found = fit(bench)
    assert found.accepted
    assert any(r.startswith("with modulation_lambda_over_d = ") for r in found.remarks)
    corrected = fit(bench, changed(modulation_lambda_over_d=6.0))
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(corrected.alpha.vector - found.alpha.vector) < sigma)


@pytest.mark.parametrize(
    ("factor", "passes", "words"), [(2.0, False, "twice the model"), (0.5, False, "")]
)
def test_a_forgotten_double_pass_is_named_and_a_low_optical_gain_is_not(factor, passes, words):
    found = fit(factor * matrix(), double_pass=passes)
    assert found.accepted == (not words)
    assert words in found.verdict


def test_a_double_pass_that_was_none_is_named():
    found = fit(matrix(), double_pass=True)
    assert "set double_pass = false" in found.verdict


def test_twice_what_two_passes_give_is_per_metre_of_surface():
    found = fit(4.0 * matrix(), double_pass=True)
    assert not found.accepted
    assert "per metre of the mirror's surface" in found.verdict
    assert 'modes_kind = "surface"' in found.verdict


@pytest.mark.parametrize(
    ("factor", "passes", "words"),
    [
        (2.0, False, "double_pass = true if the light meets the mirror twice"),
        (4.0, True, "per metre of surface?"),
        (1.0, True, "double_pass = false if the light meets the mirror once"),
        (0.5, False, None),
    ],
)
def test_a_factor_of_two_among_scattered_gains_is_told(factor, passes, words):
    scattered = np.exp(0.2 * np.sin(np.arange(40) * 1.7))
    found = fit(factor * scattered * matrix(STRAIGHT), double_pass=passes)
    assert found.accepted
    assert [words in remark for remark in found.remarks] == ([True] if words else [])


def test_a_column_that_is_another_modes_is_named():
    """Measured twice: an exact copy of a column is left out before the fit, and named there."""
    twice = matrix()
    twice[:, 12] = 1.01 * twice[:, 20]
    assert "columns that are another mode's: 12 is mode 20's" in fit(twice).remarks


def test_a_matrix_that_is_right_needs_no_remarks():
    assert fit(matrix(STRAIGHT, noise=0.1)).remarks == ()


def test_optical_gains_of_a_sky_are_accepted():
    assert fit(matrix() * np.linspace(0.45, 0.75, 40)).accepted


def test_another_basis_is_refused():
    found = fit(matrix()[:, RNG.permutation(40)])
    assert not found.accepted


def test_signs_of_single_modes_are_refused():
    found = fit(matrix() * np.where(np.arange(40) % 3 == 0, -1.0, 1.0))
    assert not found.accepted
    assert "14 of 40 modes answer with the wrong sign" in found.verdict


def test_scattered_gains_are_refused_unless_the_stroke_is_unknown():
    scattered = matrix() * np.exp(0.8 * RNG.normal(size=40))
    assert "gains of the modes scatter" in fit(scattered).verdict
    mirror = replace(small_instrument().mirror, stroke_known=False)
    assert fit(scattered, replace(instrument(), mirror=mirror)).accepted


def test_as_much_noise_as_signal_determines_the_registration_as_far_as_sigma_says():
    found = fit(matrix(noise=1.0))
    assert found.accepted, found.verdict
    assert np.all(np.abs(error(found)) < 3.0 * found.sigma)


@pytest.mark.parametrize(("scatter", "accepted"), [(0.2, True), (0.7, False)])
def test_half_of_the_signal_left_over_without_noise_or_cause_is_refused(scatter, accepted):
    """Gains of single slopes: no instrument explains them, and no mode moves by them."""
    gains = 1.0 + scatter * np.random.default_rng(8).normal(size=(len(matrix()), 1))
    found = fit(gains * matrix(), options=EXPLAIN)
    assert found.accepted == accepted
    assert ("no cause was found" in found.verdict) != accepted
    assert ("no cause was found" in found.recommendation) != accepted


def test_columns_of_noise_alone_are_named_and_left_out():
    dead = matrix()
    dead[:, [3, 20, 30]] = 0.3 * dead.std() * RNG.normal(size=(len(dead), 3))
    found = fit(dead)
    assert found.accepted, found.verdict
    assert any("3 of 40 columns hold noise only: modes 3, 20, 30" in one for one in found.left_out)
    assert np.all(np.abs(error(found)) < 3.0 * found.sigma)


def test_columns_of_smooth_noise_are_named_and_left_out_but_not_those_of_another_basis():
    """Vibration and turbulence are smooth over the pupil; half of such columns had a wrong sign."""
    valid, rng = rtc_valid_subapertures(instrument()), np.random.default_rng(5)

    def with_noise(columns):
        maps = gaussian_filter(rng.normal(size=(len(columns), 2, *valid.shape)), (0, 0, 1.0, 1.0))
        noise = maps[:, :, valid].reshape(len(columns), -1).T
        spoilt = matrix()
        spoilt[:, columns] = 0.3 * spoilt.std() * noise / noise.std()
        return fit(spoilt)

    found = with_noise([5, 12, 18, 25, 30, 36])
    assert found.accepted, found.verdict
    assert any(
        "6 of 40 columns hold noise only: modes 5, 12, 18, 25, 30, 36" in one
        for one in found.left_out
    )
    assert np.all(np.abs(error(found)) < 3.0 * found.sigma)
    other = with_noise(list(range(26, 40)))
    assert not other.accepted
    assert not any("noise only" in one for one in other.left_out)


def test_sets_of_modes_that_were_measured_at_two_registrations_disagree():
    moved = matrix()
    later = matrix(Misregistration(shift_x_subap=0.45, rotation_rad=0.03, magnification=1.012))
    moved[:, ::2] = later[:, ::2]
    found = fit(moved)
    assert not found.accepted
    assert "sets of modes disagree" in found.verdict
    assert found.subset_scatter[0] > 0.02
