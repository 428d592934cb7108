"""Matrices of a bench with Gaussian influence functions, fitted with one thing told wrong.

They are made by the FFT pyramid of tests/physics and by Gaussians written out here: nothing of the
model is in them.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.models import Optic
from pyrcal_studies.drawn_fits import Condition, Draw, instrument_of
from pyrcal_studies.drawn_fits import fitted as drawn_fit
from pyrcal_studies.drawn_fits import measured as drawn_matrices
from service.errors import ModelError
from service.estimation.reference import Reference
from service.model.instrument import Instrument, PupilMap
from service.model.pupil import instrument_pupil, lit_subapertures
from service.model.slopes import SlopeRecipe
from tests.support.mistold import (
    ACTUATORS_M,
    ARM_M,
    ARMS_DEG,
    COUPLING,
    DIAMETER_M,
    MODES,
    OBSCURATION,
    PITCH_M,
    TRUTH,
    N,
    bench,
    masked,
    sigmas_off,
    zonal,
)


def modulated(radius: float) -> Instrument:
    return replace(bench(), wfs=replace(bench().wfs, modulation_lambda_over_d=radius))


def fitted(about: Instrument, matrix: np.ndarray | None = None, **options):
    return fit_matrix(
        about, Reference(matrix=zonal() if matrix is None else matrix), FitOptions(**options)
    )


@pytest.mark.parametrize(
    ("told", "modal"), [(0.2, False), (0.35, False), (0.35, True), (0.5, True)]
)
def test_whatever_coupling_is_told_the_registration_is_right_and_the_coupling_found(told, modal):
    about = bench(coupling=told, mode_to_actuator=MODES if modal else None)
    found = fitted(about, zonal() @ MODES if modal else zonal())
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)
    assert np.all(found.sigma < [2e-3, 2e-3, np.deg2rad(0.01), 1e-3])
    width = {one.optic: one for one in found.optics}[Optic.WIDTH]
    assert width.found == pytest.approx(COUPLING, abs=0.01)
    named = any(f"coupling = {width.found:.3g}" in remark for remark in found.remarks)
    assert named == (told != COUPLING)
    assert not any("modulation" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("told", "corrections"),
    [
        ("order of slopes", {"slopes.order": "xy", "slopes.orientation": {"sign": 1}}),
        # Single columns named of a fit that has found nothing would be those of chance.
        ("pairs of modes exchanged", {}),
    ],
)
def test_a_wrong_order_is_refused_and_of_slopes_corrected(told, corrections):
    draw = Draw(code="fft", condition=Condition(told=told), seed=700)
    ((_, found),) = drawn_matrices([draw])
    refused = drawn_fit(draw, found)
    assert not refused.accepted
    assert refused.corrections == corrections
    assert "column" not in refused.recommendation


@pytest.mark.parametrize("told", [1.5, 6.0])
def test_whatever_modulation_is_told_the_registration_is_right_and_the_modulation_named(told):
    found = fitted(modulated(told))
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)
    assert any("modulation_lambda_over_d = 3" in remark for remark in found.remarks)
    assert not any("coupling" in remark for remark in found.remarks)


@pytest.mark.parametrize(("true", "told"), [(3.0, 0.0), (0.0, 3.0)])
def test_no_modulation_and_one_are_never_taken_for_each_other(true, told):
    """They leave half of the signal and move the magnification by a tenth."""
    matrix = zonal(modulation=true) @ MODES
    wrong = replace(modulated(told), mirror=bench(mode_to_actuator=MODES).mirror)
    found = fitted(wrong, matrix, explain=True)
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)
    assert found.corrections == {"wfs.modulation_lambda_over_d": pytest.approx(true, abs=0.15)}
    again = fitted(replace(wrong, wfs=modulated(true).wfs), matrix)
    assert again.accepted
    assert np.all(sigmas_off(again) < 3.0)


@pytest.mark.parametrize("also", [(), ("wfs.wavelength_m",)])
def test_an_unknown_modulation_of_an_unmodulated_pyramid_is_found_to_be_zero(also):
    """A search of logarithms from 3 λ/D ended at 6.5 λ/D, with gains that scatter by 40 %."""
    draw = Draw(code="fft", condition=Condition(modulation_lambda_over_d=0.0), seed=0)
    ((_, measured),) = drawn_matrices([draw])
    about = instrument_of(draw, measured)
    wfs = replace(about.wfs, modulation_lambda_over_d=3.0)
    about = replace(about, wfs=wfs, unknown=("wfs.modulation_lambda_over_d", *also))
    found = fitted(about, measured.matrix, explain=True)
    assert found.accepted
    assert np.all(np.abs(found.alpha.vector - draw.alpha.vector) < 3.0 * found.sigma)
    expected = {"wfs.modulation_lambda_over_d": pytest.approx(0.0, abs=0.15)}
    if also:
        expected["wfs.wavelength_m"] = pytest.approx(measured.wavelength_m, rel=0.01)
    assert found.corrections == expected


def test_four_modes_and_nine_say_the_same_of_a_modulation():
    """A rule that asks how sure the registration is would say another thing of few modes."""
    x, y = ACTUATORS_M.T
    lowest = np.stack([x, y, x * y, x**2 - y**2, x**2 + y**2, x**3, y**3, x**2 * y, x * y**2])
    for n_modes in (4, 9):
        strokes = lowest[:n_modes].T
        about = modulated(4.5)
        about = replace(about, mirror=replace(about.mirror, mode_to_actuator=strokes))
        found = fitted(about, zonal() @ strokes)
        assert found.accepted, found.verdict
        assert np.all(sigmas_off(found) < 3.0)


def with_arms(**changes) -> Instrument:
    about = replace(bench(), spiders_m=ARM_M, spiders_deg=ARMS_DEG)
    wfs = replace(about.wfs, valid_subapertures=lit_subapertures(bench()))
    return replace(about, wfs=wfs, **changes)


@pytest.mark.parametrize("turn", [-8.0, 0.0, 2.0])
def test_arms_of_the_file_are_questioned(turn):
    """Arms turned by 2 deg turn a registration by 0.03 deg."""
    about = with_arms(spiders_deg=tuple(angle + turn for angle in ARMS_DEG))
    found = fitted(about, zonal(arms_deg=ARMS_DEG))
    assert np.all(sigmas_off(found) < 3.0)
    assert found.accepted == (turn == 0.0)
    tried = {one.words: one for one in found.alternatives if one.preferred}
    named = [words for words in tried if words.startswith("spiders_deg")]
    assert len(named) == (turn != 0.0)
    for words in named:
        angles = re.findall(r"[\d.]+", words)
        assert np.array(angles, float) == pytest.approx(ARMS_DEG, abs=0.5)
        assert words in found.recommendation


def test_arms_turned_by_one_degree_move_the_rotation_by_what_is_reported():
    """On the coarse grid of other alternatives it was half of that, and the error 3.2 σ."""
    turned = tuple(angle + 1.0 for angle in ARMS_DEG)
    found = fitted(with_arms(spiders_deg=turned), zonal(arms_deg=ARMS_DEG))
    (one,) = (one for one in found.alternatives if one.words.startswith("spiders_deg"))
    assert one.preferred
    assert one.share < 0.5
    off = TRUTH.vector[2] - found.alpha.vector[2]
    assert one.moved[2] == pytest.approx(off, rel=0.5)
    assert np.all(sigmas_off(found) < 3.0)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_width_of_the_arms_of_the_file_is_questioned(ratio):
    found = fitted(with_arms(spiders_m=ratio * ARM_M), zonal(arms_deg=ARMS_DEG))
    assert np.all(sigmas_off(found) < 3.0)
    (width,) = (one for one in found.alternatives if one.key.startswith("spiders_m"))
    assert width.preferred
    assert float(width.words.split()[-1]) == pytest.approx(ARM_M, rel=0.1)


def test_a_file_of_arms_that_do_not_exist_is_questioned():
    found = fitted(with_arms())
    assert np.all(sigmas_off(found) < 3.0)
    assert "no spider" in {one.words for one in found.alternatives if one.preferred}


@pytest.mark.parametrize(
    ("quarters", "turn_deg", "named_deg"),
    [(0, 0.0, None), (2, 0.0, 180), (0, 5.0, -5), (3, 0.0, 270)],
)
def test_a_pupil_map_turned_the_wrong_way_is_named(quarters, turn_deg, named_deg):
    arms = with_arms(spiders_deg=tuple(angle + turn_deg for angle in ARMS_DEG))
    lit = np.rot90(instrument_pupil(arms, 8).amplitude, quarters)
    pupil = PupilMap(lit=lit, pitch_m=DIAMETER_M / N / 8)
    about = with_arms(spiders_m=None, spiders_deg=(), obscuration_ratio=0.0, pupil=pupil)
    found = fitted(about, zonal(arms_deg=ARMS_DEG))
    assert np.all(sigmas_off(found) < 3.0)
    words = [one.words for one in found.alternatives if one.preferred and "map" in one.words]
    assert len(words) == (named_deg is not None)
    assert [float(one.split()[-2]) for one in words] == pytest.approx(
        [named_deg] * len(words), abs=0.15
    )
    assert all(one in found.recommendation for one in words)


def test_a_wavelength_told_wrong_is_named_and_moves_nothing():
    found = fitted(replace(bench(), wfs=replace(bench().wfs, wavelength_m=900e-9)))
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)
    assert any("a wavelength of 7.5" in remark for remark in found.remarks)


def test_a_pitch_told_wrong_is_a_magnification_and_is_told_to_be_one_or_the_other():
    about = bench(positions_m=ACTUATORS_M * 1.05, pitch_m=PITCH_M * 1.05)
    found = fitted(about)
    as_drawn = found.alpha.vector * [1.0, 1.0, 1.0, 1.05]
    assert np.all(np.abs(as_drawn - TRUTH.vector) < 3.0 * found.sigma)
    assert any("pitch_m" in remark for remark in found.remarks)


def test_mirrored_actuators_are_noted_with_any_orientation_and_refused_with_one_that_is_told():
    about = bench(positions_m=ACTUATORS_M * [-1.0, 1.0])
    told = fitted(about)
    assert not told.accepted
    assert "mirrored" in told.verdict
    found = fitted(replace(about, slopes=SlopeRecipe()))
    assert any("mirrored or exchanged" in remark for remark in found.remarks)


def test_exchanged_coordinates_are_noted():
    found = fitted(replace(bench(positions_m=ACTUATORS_M[:, ::-1]), slopes=SlopeRecipe()))
    assert any("mirrored or exchanged" in remark for remark in found.remarks)


def test_what_is_unknown_is_found_and_told():
    keys = ("wfs.wavelength_m", "wfs.modulation_lambda_over_d", "mirror.coupling")
    about = replace(modulated(5.0), unknown=keys)
    found = fitted(replace(about, wfs=replace(about.wfs, wavelength_m=500e-9)))
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)
    for words in (
        "modulation_lambda_over_d = 3 was found",
        "coupling = 0.35",
        "wavelength_m = 7.5",
    ):
        assert any(words in remark for remark in found.remarks), words
    assert not any("the instrument file says" in remark for remark in found.remarks)


def test_actuators_in_millimetres_are_an_error_that_says_what_was_expected():
    with pytest.raises(
        ModelError, match=r"bench: found \d+ of 13.* modes that move nothing.* metres"
    ):
        fitted(bench(positions_m=ACTUATORS_M * 1e3))


def noisy(share: float) -> np.ndarray:
    """Every element with as much noise, whatever the actuator's own size."""
    scatter = np.random.default_rng(8).normal(size=zonal().shape)
    return zonal() + share * zonal().std() * scatter


@pytest.mark.parametrize(("told", "noise"), [(0.25, 0.0), (0.3, 0.15)])
def test_an_obscuration_told_wrong_is_in_sigma_and_the_right_one_advised(told, noise):
    about = masked(replace(bench(), obscuration_ratio=told))
    found = fitted(about, noisy(noise), explain=True)
    assert not found.accepted or np.all(sigmas_off(found) < 3.0)
    said = found.recommendation + found.verdict
    named = re.search(r"obscuration_ratio = (0\.\d+)", said)
    assert named is not None, said
    assert float(named[1]) == pytest.approx(OBSCURATION, abs=0.04)


@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_noise_that_nobody_has_told_of_is_no_cause_to_refuse(noise):
    found = fitted(bench(), noisy(noise))
    assert found.residual_fraction > noise
    assert found.accepted, found.verdict
    assert np.all(sigmas_off(found) < 3.0)


def test_a_shade_that_nothing_explains_moves_the_registration_by_less_than_sigma_allows():
    """An arm across the pupil that is not smooth: 10 % of the signal are left over."""
    rows, columns = np.nonzero(lit_subapertures(bench()))
    shaded = np.where(np.abs(rows - columns) < 2, 0.6, 1.0)
    shaded *= np.where((rows + columns) % 5 == 0, 1.3, 1.0)
    found = fitted(bench(), zonal() * np.tile(shaded, 2)[:, None])
    assert found.residual_fraction > 0.1
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)


def test_a_diameter_told_wrong_is_a_magnification_and_is_told_to_be_one_or_the_other():
    found = fitted(replace(bench(), diameter_m=DIAMETER_M * 0.98))
    as_told = TRUTH.vector * [1.0, 1.0, 1.0, 0.98]
    assert np.all(np.abs(found.alpha.vector - as_told) < 3.0 * found.sigma)
    assert any("diameter_m" in remark for remark in found.remarks)


def test_a_pupil_told_two_percent_small_is_a_magnification_and_the_right_one_advised():
    wfs = replace(bench().wfs, pupil_diameter_subap=N * 0.98)
    found = fitted(masked(replace(bench(), wfs=wfs)), explain=True)
    as_told = TRUTH.vector * [1.0, 1.0, 1.0, 1.0 / 0.98]
    off = np.abs(found.alpha.vector - as_told) / found.sigma
    assert not found.accepted or np.all(off < 3.0)
    said = found.recommendation + found.verdict
    assert re.search(r"pupil_diameter_subap = 12(\.1)?\b", said), said
