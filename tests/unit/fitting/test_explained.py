"""Faults planted in a matrix, each named; and clean matrices of which nothing is said.

The matrices are those of the FFT pyramid of tests/physics with Gaussians written out: nothing of
the model is in them.
"""

import json
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from pyrcal.fitting import alternatives, comparison, instrument_checks, models, pupil_checks
from pyrcal.fitting.advice import Grounds, add_recommendation
from pyrcal.fitting.alternatives import CENTRED_KEY
from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.control_check import check_control
from pyrcal.fitting.fit_table import table
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.left_over import ResidualLocation
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.report import document, fill_fit, read_fit
from pyrcal.fitting.verdict import Reason, Refusal
from service.estimation.reference import Reference
from service.files.documents import json_text
from service.files.whole import write_whole
from service.model.kinds import SlopeOrder, Stop
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import lit_subapertures
from service.model.slopes import SlopeRecipe
from tests.support.bench import ELSEWHERE, PLAIN, fit, instrument, matrix
from tests.support.made import a_fit, a_report
from tests.support.mistold import MODES, TRUTH, N, bench, masked, sigmas_off, zonal

EXPLAIN = FitOptions(explain=True)
RNG = np.random.default_rng(7)


@cache
def modal() -> np.ndarray:
    return zonal() @ MODES


@cache
def modal_bench():
    return masked(bench(mode_to_actuator=MODES))


def explained(about, values, **options) -> Fit:
    return fit_matrix(about, Reference(matrix=values), FitOptions(explain=True, **options))


@cache
def clean() -> Fit:
    return explained(modal_bench(), modal())


def every(values: np.ndarray):
    """Return the number of each column, and that every row counts."""
    return np.arange(values.shape[1]), np.ones(len(values), dtype=bool)


def named(found: Fit, words: str):
    (one,) = [one for one in found.alternatives if words in one.words]
    return one


def said(found: Fit) -> list[str]:
    """All that is said of a fit beside its numbers, nothing of a clean one."""
    left = found.left_over.words
    wrong = [] if found.recommendation.startswith("use it: ") else [found.recommendation]
    return [*found.remarks, *([left] if left else []), *wrong]


# --- clean matrices


def test_of_a_clean_matrix_nothing_is_said_and_no_rival_preferred():
    assert said(clean()) == []
    assert not any(one.preferred for one in clean().alternatives)
    assert len(clean().alternatives) >= 15
    assert not any(one.correct for one in clean().origins)


def clean_fits(seed):
    rng = np.random.default_rng(seed)
    shift_x, shift_y, turn, size = rng.uniform([-1, -1, -3, 0.992], [1, 1, 3, 1.008])
    truth = Misregistration(
        shift_x_subap=shift_x,
        shift_y_subap=shift_y,
        rotation_rad=np.deg2rad(turn),
        magnification=size,
    )
    for strokes in (None, MODES):
        values = zonal(truth) if strokes is None else zonal(truth) @ strokes
        for noise in (0.0, 0.1):
            noisy = values + noise * values.std() * rng.normal(size=values.shape)
            yield explained(masked(bench(mode_to_actuator=strokes)), noisy)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_of_twelve_clean_matrices_nothing_is_said():
    found = [fit for seed in range(300, 303) for fit in clean_fits(seed)]
    assert len(found) == 12
    assert [said(one) for one in found if said(one)] == []


# --- what a rival would change


def test_the_move_told_of_the_right_stop_leads_to_the_truth():
    found = explained(replace(modal_bench(), stop=Stop.MIRROR), modal())
    right = named(found, 'stop = "telescope"')
    assert right.preferred
    before = found.alpha.vector - TRUTH.vector
    after = before + right.moved
    assert np.hypot(*before[:2]) > 0.007
    assert np.hypot(*after[:2]) < 0.25 * np.hypot(*before[:2])
    assert found.recommendation.startswith('do not use it: with stop = "telescope" the misfit is')


def test_the_move_told_of_an_image_that_is_not_stretched_is_the_fits():
    stretched = matrix(ELSEWHERE.with_anamorphosis(np.array([0.003, -0.002])), noise=0.05)
    found = fit(stretched, options=EXPLAIN)
    without = fit(stretched, options=FitOptions(anamorphosis=False))
    moved = without.alpha.vector - found.alpha.vector
    told = named(found, "no anamorphosis")
    assert told.share > 1.05
    assert np.all(np.abs(told.moved - moved) < 0.25 * found.sigma)


@pytest.mark.long  # that of the anamorphosis above is with every run
def test_the_move_told_of_half_the_modes_is_that_of_a_fit_of_them():
    noisy = matrix(noise=0.15)
    found = fit(noisy, options=EXPLAIN)
    alone = fit(noisy, options=FitOptions(modes=np.arange(20, 40)))
    moved = alone.alpha.vector - found.alpha.vector
    told = named(found, "the upper half of the modes")
    assert np.all(np.abs(told.moved - moved) < 0.5 * alone.sigma)


def test_another_modulation_is_worse_and_would_move_it_by_sigmas():
    told = named(clean(), "modulation_lambda_over_d = 3.3")
    assert told.share > 2.0
    assert not told.undecided
    assert np.max(np.abs(told.moved[:2])) > 1e-3  # subapertures


def test_a_pupil_off_the_middle_is_found_as_the_mean_place_of_its_images():
    """A stop at the mirror, which would move the pupil by the shift, is not preferred for it."""
    off = (0.5, -0.05)
    found = explained(modal_bench(), zonal(TRUTH, off) @ MODES)
    assert found.accepted
    assert np.all(sigmas_off(found) < 3.0)
    np.testing.assert_allclose(found.image_offsets_px.mean(axis=0), off, atol=0.025)
    assert not any(one.preferred for one in found.alternatives)


def test_gains_of_each_axis_are_named():
    half = len(modal()) // 2
    found = explained(modal_bench(), np.concatenate([1.05 * modal()[:half], modal()[half:]]))
    told = named(found, "than Sy")
    assert told.preferred
    share = float(told.words.split()[1].strip("%")) / 100.0
    assert share == pytest.approx(0.05, abs=0.006)
    assert "stronger" in told.words
    assert np.all(sigmas_off(found) < 3.0)


def test_one_mode_is_explained_too():
    found = fit(matrix()[:, :1], options=EXPLAIN)
    assert "too few modes (1) to check each other" in found.recommendation
    assert not any(one.preferred for one in found.alternatives)


# --- what was found rather than told


def test_what_was_found_rather_than_told_is_listed_with_how():
    about = replace(
        modal_bench(),
        wfs=replace(modal_bench().wfs, modulation_lambda_over_d=5.0, wavelength_m=500e-9),
        unknown=("wfs.wavelength_m",),
        slopes=SlopeRecipe(order=SlopeOrder.YX),
    )
    found = explained(about, modal())
    origins = {one.key: one for one in found.origins}
    assert float(origins["modulation_lambda_over_d"].found) == pytest.approx(3.0, abs=0.03)
    assert origins["modulation_lambda_over_d"].reported == "5"
    assert origins["modulation_lambda_over_d"].correct
    assert float(origins["wavelength_m"].found) == pytest.approx(750e-9, rel=0.02)
    assert origins["order"].found == '"xy"'
    assert origins["orientation"].reported == '"auto"'
    assert not origins["coupling"].correct
    assert found.recommendation.startswith(
        'use it, and correct the instrument file (order = "xy", modulation_lambda_over_d = '
    )


# --- gains


def sizes():
    """Peak to valley and RMS of the modes over the pupil."""
    radius, angle = np.sqrt(RNG.random(4000)) * N / 2, RNG.random(4000) * 2.0 * np.pi
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    shapes = modal_bench_basis().render(points)
    return np.ptp(shapes, axis=0), shapes.std(axis=0)


@cache
def modal_bench_basis():
    return modal_basis(modal_bench())


@pytest.mark.parametrize(
    ("divided", "words"),
    [
        (lambda: sizes()[0], "one over the modes' peak to valley"),
        (lambda: sizes()[1], "one over the modes' RMS"),
        pytest.param(
            lambda: np.abs(MODES).max(axis=0),
            "one over the largest stroke of their actuators",
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda: np.linalg.norm(modal(), axis=0) / 3e7,
            "one over the size of their slopes",
            marks=pytest.mark.long,
        ),
    ],
)
def test_the_size_that_modes_were_scaled_by_is_named(divided, words):
    found = explained(modal_bench(), modal() / divided())
    (remark,) = [remark for remark in found.remarks if "gains go as" in remark]
    assert words in remark
    assert np.all(sigmas_off(found) < 3.0)


def test_optical_gains_of_a_sky_are_named():
    found = explained(modal_bench(), modal() * np.linspace(0.45, 0.75, 60))
    assert found.accepted
    assert any("optical gain of a pyramid" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1e-3, "per millimetre: multiply it by 1000"), (4.0, "both passes and per metre of surface")],
)
def test_a_unit_of_all_gains_is_named(factor, words):
    found = explained(modal_bench(), factor * modal())
    assert not found.accepted or factor == 4.0
    assert any(words in remark for remark in found.remarks), found.remarks


def test_commands_of_the_other_sign_are_named():
    here = FitOptions(explain=True, start=ELSEWHERE, orientation=PLAIN)
    found = fit(-matrix(), options=here)
    assert found.recommendation.startswith(
        "do not use it: every mode answers with the wrong sign: commands or slopes"
    )


# --- columns


def test_columns_in_each_others_place_are_named_with_their_sign():
    mixed = modal().copy()
    mixed[:, [7, 30]] = -mixed[:, [30, 7]]
    mixed[:, 12] *= -1.0
    found = explained(modal_bench(), mixed)
    assert not found.accepted
    assert found.recommendation == (
        "do not use it: columns of the wrong sign: 12; "
        "columns that have changed places: 7 and 30 with other signs"
    )


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ([59, *range(59)], "column 1 is mode 0's"),
        pytest.param([*range(1, 60), 0], "the first column is missing", marks=pytest.mark.long),
        pytest.param(range(59, -1, -1), "in reverse", marks=pytest.mark.long),
    ],
)
def test_columns_that_all_stand_elsewhere_are_named(columns, words):
    found = explained(modal_bench(), modal()[:, list(columns)])
    assert not found.accepted
    assert found.recommendation.startswith("do not use it: ")
    assert words in found.recommendation


# --- what is left over


def test_a_subaperture_that_answers_unlike_the_model_is_named():
    place = 40
    row, column = np.argwhere(lit_subapertures(bench()))[place]
    spoilt = modal().copy()
    rows = [place, place + len(spoilt) // 2]
    spoilt[rows] = RNG.normal(size=(2, 60)) * spoilt.std()
    found = explained(modal_bench(), spoilt)
    assert [one[:2] for one in found.left_over.subapertures] == [(row, column)]
    assert f"row {row} column {column}" in found.left_over.words
    assert np.all(sigmas_off(found) < 3.0)


def test_a_mode_that_was_measured_badly_is_named():
    spoilt = modal().copy()
    spoilt[:, 9] += 0.5 * spoilt[:, 9].std() * RNG.normal(size=len(spoilt))
    found = explained(modal_bench(), spoilt)
    assert [mode for mode, _ in found.left_over.modes] == [9]


# --- what to do


def test_modes_that_fit_badly_are_the_cause_where_sets_of_modes_disagree():
    bad = ResidualLocation(border=None, subapertures=(), modes=((67, 0.71),))
    divided = a_fit(accepted=False, verdict="refused: sets of modes disagree", left_over=bad)
    grounds = Grounds(refusal=Refusal.DIVIDED, reason=Reason(), structure=0.05, n_sets=8)
    assert add_recommendation(divided, grounds).recommendation == (
        "do not use it: modes that fit worse than the others: 67 (71%) left over; measure these "
        "again, or leave them out (--modes)"
    )


@pytest.mark.parametrize(
    ("entry", "values"),
    [
        ('stop = "mirror"', {"instrument.stop": "mirror"}),
        (
            "spiders_m = 0.2, spiders_deg = [0, 90]",
            {"instrument.spiders_m": 0.2, "instrument.spiders_deg": [0, 90]},
        ),
        ("no spider", {"instrument.spiders_m": None, "instrument.spiders_deg": None}),
        ("the pupil map turned by 2 deg", {"instrument.pupil": "turned by 2 deg"}),
        ("pupil_diameter_subap = 11.8", {"wfs.pupil_diameter_subap": 11.8}),
        ('influence = "thin-plate"', {"mirror.influence": "thin-plate"}),
        ('normalisation = "local"', {"slopes.normalisation": "local"}),
        (CENTRED_KEY, {}),
    ],
)
def test_a_recommended_correction_is_also_given_as_keys_with_their_values(entry, values):
    better = Alternative(words=entry, key=entry, share=0.2, moved=np.zeros(4), preferred=True)
    found = a_fit(accepted=False, verdict="refused: another", alternatives=(better,))
    grounds = Grounds(refusal=Refusal.ANOTHER_INSTRUMENT, reason=Reason(), structure=0.1, n_sets=8)
    assert add_recommendation(found, grounds).corrections == values


def test_a_sigma_next_to_what_is_enough_is_said_to_its_third_place():
    known = a_fit(covariance=np.diag([0.0304**2, 1e-6, 1e-12, 1e-12]))
    grounds = Grounds(refusal=None, reason=Reason(), structure=0.0, n_sets=8)
    words = add_recommendation(known, grounds).recommendation
    assert "known to 0.030 subapertures (1 sigma), 0.03 is enough" in words


@pytest.mark.parametrize(("sigma_subap", "action"), [(0.09, "use it"), (0.11, "measure more")])
def test_a_stable_reconstructor_recommends_no_sigma_beyond_a_tenth(sigma_subap, action):
    stable = check_control(MODES, MODES, np.ones(MODES.shape[1]), *every(MODES))
    assert stable.holds
    known = a_fit(covariance=np.diag([sigma_subap**2, 1e-6, 1e-12, 1e-12]), reconstructor=stable)
    grounds = Grounds(refusal=None, reason=Reason(), structure=0.0, n_sets=8)
    assert add_recommendation(known, grounds).recommendation.startswith(f"{action}: ")


def test_too_few_modes_and_too_much_noise_are_reasons_to_measure_more():
    few = fit(matrix(noise=0.05)[:, :5], options=EXPLAIN)
    assert few.recommendation.startswith("measure more: ")
    noisy = fit(matrix(noise=3.0), options=EXPLAIN)
    assert noisy.recommendation.startswith("measure more: ")
    assert "average more" in noisy.recommendation
    assert np.all(np.abs(noisy.alpha.vector - ELSEWHERE.vector) < 3.0 * noisy.sigma)


def test_of_pure_noise_nothing_is_called_found():
    noise = np.random.default_rng(2).normal(size=modal().shape) * modal().std()
    about = replace(modal_bench(), unknown=("wfs.modulation_lambda_over_d",))
    found = explained(about, noise)
    assert not found.accepted
    assert "there is too much noise" in found.verdict
    assert found.optics == found.origins == found.remarks == ()
    assert not any(one.preferred for one in found.alternatives)


def test_a_fit_that_nobody_asked_to_explain_is_advised_all_the_same():
    found = fit(matrix(noise=0.05), instrument())
    assert found.recommendation.startswith("use it")


# --- written


def test_a_fit_is_written_whichever_alternative_is_preferred(monkeypatch, tmp_path):
    """Each passes its tests by limits that all pass, so its own numbers come to its flags."""
    for module in (alternatives, comparison, instrument_checks, models, pupil_checks):
        for name in ("PREFERRED_SHARE", "FAR_PREFERRED_SHARE"):
            monkeypatch.setattr(module, name, np.inf, raising=False)
        monkeypatch.setattr(module, "MIN_EXPLAINED", -1.0, raising=False)
    monkeypatch.setattr(comparison, "SIGNIFICANT", -np.inf)
    for name in ("NOTABLE_OFFSET_SUBAP", "NOTABLE_OFFSET_SHARE", "NOTABLE_GAIN_RATIO"):
        monkeypatch.setattr(alternatives, name, -1.0)
    monkeypatch.setattr(pupil_checks, "MIN_PUPIL_EXPLAINED", -1.0)
    about = modal_bench()
    # where the images are unknown, the fit itself places the pupil
    about = replace(about, wfs=replace(about.wfs, image_offsets_subap=((0.0, 0.0),) * 4))
    found = explained(about, modal())
    preferred = [one.words for one in found.alternatives if one.preferred]
    for words in ("off the sensor's middle", "than Sy", "stop =", "normalisation =", "influence ="):
        assert any(words in one for one in preferred), preferred
    for one in found.alternatives:
        asked = replace(one, preferred=True, undecided=np.False_, share=np.float64(0.3))
        report = a_report(replace(found, alternatives=(one, asked)))
        assert json.loads(json_text(document(report)))["alternatives"][1]["preferred"] is True
        write_whole(tmp_path / "fit.h5", partial(fill_fit, report=report))
        assert read_fit(tmp_path / "fit.h5").accepted is found.accepted
        (tmp_path / "fit.h5").unlink()
        table(report)
