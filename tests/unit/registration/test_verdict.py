from dataclasses import replace

import numpy as np
import pytest

from service.model.instrument import Stop
from service.model.misregistration import Misregistration
from tests.numerics import small_instrument
from tests.unit.registration.bench import fit, instrument, matrix

RNG = np.random.default_rng(3)


def changed(**wfs):
    return replace(instrument(), wfs=replace(instrument().wfs, **wfs))


@pytest.mark.parametrize(("true", "assumed"), [tuple(Stop), tuple(Stop)[::-1]])
def test_a_wrong_stop_is_recognised_and_the_right_one_named(true, assumed):
    found = fit(matrix(about=replace(instrument(), stop=true)), replace(instrument(), stop=assumed))
    assert not found.accepted
    assert f'stop = "{true}"' in found.verdict


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_modulation_is_recognised(factor):
    found = fit(matrix(about=changed(modulation_lambda_over_d=3.0 * factor)))
    assert not found.accepted
    assert f"modulation_lambda_over_d = {3.0 * factor:g}" in found.verdict


def test_a_modulation_off_by_a_tenth_is_lived_with():
    assert fit(matrix(about=changed(modulation_lambda_over_d=3.3))).accepted


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


def test_noise_alone_is_refused():
    found = fit(RNG.normal(size=matrix().shape) * 1e6)
    assert not found.accepted


def test_as_much_noise_as_signal_is_refused_with_the_share_left_over():
    found = fit(matrix(noise=1.0))
    assert "of the signal unexplained" in found.verdict


def test_sets_of_modes_that_were_measured_at_two_registrations_disagree():
    moved = matrix()
    later = matrix(Misregistration(shift_x_subap=0.45, rotation_rad=0.03, magnification=1.012))
    moved[:, ::2] = later[:, ::2]
    found = fit(moved)
    assert not found.accepted
    assert "sets of modes disagree" in found.verdict
    assert found.subset_scatter[0] > 0.02


def test_noise_that_hides_the_registration_leaves_it_undetermined_or_unexplained():
    found = fit(matrix(noise=3.0)[:, :6])
    assert not found.accepted
