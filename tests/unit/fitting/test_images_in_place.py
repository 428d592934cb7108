"""Displacements of pupil images that no pyramid has leave the registration uncertain."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pyrcal.fitting.alternatives as alternatives
from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.instrument_checks import fit_file_values
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.methods import settle_at
from pyrcal.fitting.models import FitModels
from pyrcal.fitting.solver import image_patterns, nuisances_of
from pyrcal_studies.benches import coarse_bench, fit_bench, some_columns
from pyrcal_studies.drawn_fits import Condition, Draw, instrument_of
from pyrcal_studies.drawn_fits import measured as drawn_matrices
from pyrcal_studies.image_offsets import as_told
from service.estimation.reference import Reference, target_of
from tests.support.bench import ELSEWHERE, fit, instrument, matrix
from tests.support.numerics import small_basis


def in_place(found):
    return [one for one in found.alternatives if "in their places" in one.words]


def test_images_that_are_displaced_as_pyramids_have_them_are_no_alternative():
    assert in_place(fit(matrix(ELSEWHERE))) == []


@pytest.mark.parametrize(
    ("share", "sigma", "is_open"),
    [(0.9, 0.1, True), (2.0, 0.5, True), (2.0, 0.3, False), (9.0, 4.0, True), (94.0, 32.0, False)],
)
def test_an_alternative_that_leaves_many_times_as_much_is_excluded(share, sigma, is_open):
    """The last one is a matrix of HCIPy with Gaussian influence functions."""
    one = Alternative(share=share, share_sigma=sigma, moved=np.zeros(4))
    assert one.is_open is is_open


def test_images_displaced_beyond_belief_are_tried_in_their_places(monkeypatch):
    monkeypatch.setattr(alternatives, "PLAUSIBLE_DISPLACEMENT_PX", 0.0)
    exact = matrix(ELSEWHERE)
    noise = 0.2 * exact.std(axis=0) * np.random.default_rng(3).normal(size=exact.shape)
    (one,) = in_place(fit(exact + noise))
    assert one.counts
    assert one.undecided
    # the true images are in their places: nothing is lost and hardly anything moves
    assert one.share == pytest.approx(1.0, abs=0.05)
    assert np.all(np.abs(one.moved) < 0.01)


@pytest.mark.parametrize("stated", [0.0, 1.0])
def test_places_of_pupil_images_in_the_file_are_questioned(stated):
    """Places stated as zeros of images 0.1 pixel off the grid move a shift by 0.02 subaperture."""
    draw = Draw(code="fft", condition=Condition(images_px=0.1, images="told"), seed=0)
    ((_, measured),) = drawn_matrices([draw])
    about = as_told(instrument_of(draw, measured), stated * draw.offsets)
    found = fit_matrix(about, Reference(matrix=measured.matrix), FitOptions(explain=True))
    assert np.all(np.abs(found.alpha.vector - draw.alpha.vector) < 3.0 * found.sigma)
    named = [one for one in found.alternatives if one.words == 'image_offsets_px = "unknown"']
    assert [one.preferred for one in named] == [stated == 0.0]
    if stated:
        assert found.accepted
        assert np.all(found.sigma[:2] < 2e-3)
    else:
        assert named[0].words in found.recommendation


@pytest.mark.parametrize("modulation", [0.0, 3.0])
def test_a_pupil_off_the_middle_is_found_although_the_mask_lacks_columns(modulation):
    """A pyramid of another code, one subaperture off; without its place 9 to 24 % is left over."""
    draw = Draw(code="fft", condition=Condition(modulation_lambda_over_d=modulation), seed=3)
    ((_, measured),) = drawn_matrices([draw])
    kept = measured.valid & (np.arange(12) < (10 if modulation == 0.0 else 11))
    planes = measured.matrix.reshape(2, int(measured.valid.sum()), -1)[:, kept[measured.valid]]
    about = instrument_of(draw, measured)
    grid = {"n_subapertures": 14, "valid_subapertures": np.pad(kept, ((2, 0), (0, 2)))}
    about = replace(about, wfs=replace(about.wfs, **grid, pupil_diameter_subap=12.0))
    found = fit_matrix(about, Reference(matrix=planes.reshape(-1, planes.shape[2])), FitOptions())
    error = found.alpha.vector - draw.alpha.vector - np.array([-1.0, 1.0, 0.0, 0.0])
    assert found.accepted
    assert np.all(np.abs(error) < 3.0 * found.sigma)
    assert np.all(np.abs(error[:2]) < 0.002)
    assert found.residual_fraction < 0.02


def test_file_values_are_fitted_with_the_images_where_the_fit_displaced_them():
    """The file's values are the true ones, so that fitted ones explain no more."""
    models = FitModels(instrument=instrument(), basis=small_basis())
    patterns = image_patterns(instrument().stop)
    displaced = 0.4 * patterns[0] - 0.4 * patterns[4]
    there = models.with_displaced_images(displaced)
    exact = there.fine.interaction_matrix(ELSEWHERE)
    noise = 0.01 * exact.std(axis=0) * np.random.default_rng(3).normal(size=exact.shape)
    target = target_of(Reference(matrix=exact + noise), instrument())
    nuisances = nuisances_of(
        target.valid,
        instrument().slopes.kind,
        optics=models.optics,
        images=patterns,
        image_sigma=0.2,
    )
    settled = settle_at(there, target, ELSEWHERE, replace(nuisances, displaced=displaced))
    found = fit_file_values(models, settled, ())
    assert found.share == pytest.approx(1.0, abs=0.05)
    assert np.all(np.abs(found.moved) < 1e-3)


BENCHES = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data"))


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.skipif(not (BENCHES / "ao188").is_dir(), reason="no measured matrices here")
def test_images_of_a_real_bench_stay_where_their_light_is_with_a_wrong_obscuration():
    """A third of the signal is left over: images once moved by 2 pixels, and α by 12.9 sigma."""
    pytest.importorskip("astropy")
    bench = coarse_bench("ao188")
    stated = "obscuration_ratio = 0.30"
    assert stated in bench.instrument
    wrong = replace(bench, instrument=bench.instrument.replace(stated, "obscuration_ratio = 0.40"))
    columns = some_columns("ao188")
    right, other = (fit_bench(one, BENCHES, columns) for one in (bench, wrong))
    assert right.accepted
    assert np.abs(other.image_offsets_px).max() < 0.3  # what real pyramids have at most
    assert np.all(np.abs(other.alpha.vector - right.alpha.vector) < 3.0 * other.sigma)
