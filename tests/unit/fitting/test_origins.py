"""Numbers found by a fit: which are findings, which may stand for model errors, which are not."""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.fit_table import table
from pyrcal.fitting.instrument_checks import FoundOptic
from pyrcal.fitting.models import Optic
from pyrcal.fitting.origins import (
    MODEL_GAIN_SIGMA,
    find_stroke,
    is_determined,
    list_origins,
    list_undetermined_keys,
)
from pyrcal.fitting.report import document
from service.model.slopes import Orientation, SlopeRecipe
from tests.support.made import a_fit, a_report
from tests.support.mistold import bench

TEN = FoundOptic(
    optic=Optic.SENSOR,
    key="modulation_lambda_over_d",
    change=0.75,
    sigma=0.014,
    found=10.6,
    reported=5.0,
)
UNKNOWN = replace(TEN, reported=None)


def file_values(share):
    """Return the fit with the file's values, of whose misfit the fitted ones leave a share."""
    return Alternative(share=1.0 / share, moved=np.zeros(4))


def test_a_number_that_explains_little_of_the_misfit_does_not_correct_the_file():
    """PAPYRUS: 80 % of the misfit is left, every disjoint set agrees, and the file is right."""
    assert not is_determined(TEN, file_values(0.8), 0.14)
    assert not is_determined(TEN, file_values(0.8), 0.01)


def test_a_number_that_explains_nearly_all_of_the_misfit_corrects_the_file():
    assert is_determined(TEN, file_values(0.03), 0.14)


@pytest.mark.parametrize(("structure", "found"), [(0.02, True), (0.14, False), (0.3, False)])
def test_a_number_that_the_file_lacks_is_a_finding_where_little_but_noise_is_left(structure, found):
    assert is_determined(UNKNOWN, None, structure) is found


def listed(optic, structure, share=None):
    slopes = SlopeRecipe(orientation=Orientation())
    there = None if share is None else file_values(share)
    return list_origins(bench(), slopes, slopes, (optic,), there, structure, np.ones(9))


def test_only_a_finding_is_to_be_written_into_the_file():
    (sure,), (open_,) = listed(UNKNOWN, 0.02), listed(UNKNOWN, 0.3)
    assert sure.correct
    assert not open_.correct
    assert "model" in open_.how
    assert "model" not in sure.how


def test_unknown_numbers_that_no_matrix_determines_are_listed():
    about = replace(bench(), unknown=("wfs.wavelength_m", "mirror.coupling"))
    loose = replace(UNKNOWN, optic=Optic.WIDTH, key="coupling", sigma=0.9)
    assert listed(loose, 0.02) == ()
    assert list_undetermined_keys(about, listed(loose, 0.02)) == (
        "wfs.wavelength_m",
        "mirror.coupling",
    )
    tight = replace(loose, sigma=0.01)
    assert list_undetermined_keys(about, listed(tight, 0.02)) == ("wfs.wavelength_m",)


def test_unknown_numbers_that_were_not_found_are_in_table_and_document():
    fit = a_fit(unknown_not_found=("wfs.wavelength_m",))
    (line,) = [row for row in table(a_report(fit)).splitlines() if row.startswith("unknown, not")]
    assert "wfs.wavelength_m" in line
    assert document(a_report(fit))["unknown_not_found"] == ["wfs.wavelength_m"]
    assert "unknown, not" not in table(a_report(a_fit()))


def stroke_of(gains, about=None, structure=0.0):
    about = replace(about or bench(), slopes=SlopeRecipe(orientation=Orientation()))
    return find_stroke(about, about.slopes, np.asarray(gains), (), structure)


def test_the_unit_of_the_commands_is_the_median_gain_with_its_sign():
    found = stroke_of(-4e-6 * np.array([0.99, 1.0, 1.01]))
    assert found.metres_per_unit == pytest.approx(-4e-6)
    scatter = np.std([0.99, 1.0, 1.01]) / np.sqrt(3)
    assert found.sigma == pytest.approx(4e-6 * np.hypot(MODEL_GAIN_SIGMA, scatter))
    assert "normalisation" in found.condition  # slopes of an RTC may have any scale


@pytest.mark.parametrize(
    ("gains", "structure", "reason"),
    [(np.ones(3), 0.2, "left over"), (np.array([0.2, 1.0, 5.0]), 0.0, "scatter")],
)
def test_the_unit_is_not_determined_where_the_gains_have_another_cause(gains, structure, reason):
    found = stroke_of(gains, structure=structure)
    assert found.metres_per_unit is None
    assert reason in found.condition


def test_an_unknown_wavelength_leaves_the_unit_open():
    about = replace(bench(), unknown=("wfs.wavelength_m",))
    assert stroke_of(np.ones(3), about).metres_per_unit is None


def test_the_sign_of_slopes_whose_axes_were_found_may_be_that_of_the_commands():
    about = replace(bench(), slopes=SlopeRecipe(orientation=None))
    turned = SlopeRecipe(orientation=Orientation(sign_x=-1, sign_y=-1))
    assert "the other sign" in find_stroke(about, turned, np.ones(3), (), 0.0).condition
