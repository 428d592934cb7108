"""What the figures show, read back from matplotlib's own objects; and that the sheet is written."""

import sys

import numpy as np
import pytest

from pyrcal.fitting import figures
from pyrcal.fitting.figures import check_plots, write_sheet
from service.errors import ConfigurationError
from service.model.misregistration import Misregistration
from tests.support.made import ALPHA, GAINS, SCAN, SYNTHETIC, a_fit
from tests.support.numerics import small_instrument


@pytest.fixture
def axes():
    figure = pytest.importorskip("matplotlib.figure").Figure()
    return figure.subplots()


def test_singular_values_are_told_with_both_condition_numbers(axes):
    figures.singular_values(axes, a_fit())
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    condition = np.linalg.cond(SYNTHETIC * GAINS)
    assert labels == [
        f"synthetic, condition {condition:.2f}",
        f"measured, condition {condition:.2f}",
    ]


def test_gains_stand_at_their_modes(axes):
    figures.gains(axes, a_fit())
    points = axes.get_lines()[0]
    assert points.get_xdata().tolist() == [0, 1, 4]
    assert points.get_ydata().tolist() == GAINS.tolist()


def test_a_point_of_the_mirror_lands_turned_scaled_and_then_shifted():
    alpha = Misregistration(
        shift_x_subap=1.0, shift_y_subap=2.0, rotation_rad=np.pi / 2, magnification=2.0
    )
    np.testing.assert_allclose(figures.map_to_sensor(np.array([[3.0, 0.0]]), alpha), [[1.0, 8.0]])


def test_every_actuator_is_in_the_registration_picture(axes):
    instrument = small_instrument()
    figures.registration(axes, a_fit(), instrument)
    drawn = axes.get_lines()[0].get_xydata()
    expected = figures.map_to_sensor(
        instrument.mirror.positions_m / instrument.subaperture_m, ALPHA
    )
    np.testing.assert_allclose(drawn, expected)
    low, high = axes.get_xlim()
    assert low < drawn.min()
    assert high > drawn.max()


@pytest.mark.parametrize(("n_scans", "n_places"), [(5, 5), (6, 10)])
def test_the_scans_take_as_many_rows_of_five_as_they_need(n_scans, n_places):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    figures.scans(figure.subfigures(), (SCAN,) * n_scans)
    assert len(figure.subfigs[0].axes) == n_places


def test_the_sheet_is_written(tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "fit.png"
    write_sheet(a_fit(paper_table=(SCAN,) * 6), "a fit", small_instrument(), path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_refused_fit_with_holes_is_drawn_too(tmp_path):
    pytest.importorskip("matplotlib")
    fit = a_fit(
        accepted=False,
        verdict="refused: " + "sets of modes disagree, " * 20,
        residual_map=np.full((2, 3, 3), np.nan),
        residual_fraction=np.nan,
    )
    write_sheet(fit, "a fit", small_instrument(), tmp_path / "fit.png")
    assert (tmp_path / "fit.png").exists()


def test_a_kind_of_file_nobody_knows_is_refused(tmp_path):
    pytest.importorskip("matplotlib")
    with pytest.raises(ConfigurationError, match="--plot: cannot write"):
        write_sheet(a_fit(), "a fit", small_instrument(), tmp_path / "fit.doc")


def test_without_matplotlib_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigurationError, match="extra 'plots'"):
        check_plots()
