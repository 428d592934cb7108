import numpy as np

from service.files.table import table
from tests.unit.files.made import SCAN, a_fit, a_report


def line(text, name):
    (found,) = [line for line in text.splitlines() if line.startswith(name)]
    return found


def test_the_verdict_comes_first():
    fit = a_fit(accepted=False, verdict="refused: sets of modes disagree; check the stop")
    assert table(a_report(fit)).splitlines()[0] == fit.verdict


def test_the_four_parameters_are_there_with_unit_and_uncertainty():
    text = table(a_report())
    assert line(text, "shift x").split() == [
        "shift",
        "x",
        "-0.9200",
        "0.0100",
        "0.0010",
        "subapertures",
    ]
    assert line(text, "rotation").split() == ["rotation", "65.0800", "0.0100", "0.0040", "deg"]
    assert line(text, "magnification").split()[1:] == ["0.98000", "0.00100", "0.00010", "ratio"]


def test_what_was_left_out_is_named():
    assert "mode 17" in line(table(a_report(a_fit(left_out=("dead: mode 17",)))), "left out")


def test_modes_are_told_as_ranges():
    assert "3 (0 to 1, 4)" in line(table(a_report()), "modes used")


def test_a_gain_far_from_the_others_is_named():
    fit = a_fit(gains=np.array([1.0, 1.02, 0.5]))
    assert "mode 4" in line(table(a_report(fit)), "gains")
    assert "off" not in line(table(a_report()), "gains")


def test_the_papers_table_has_a_line_for_every_step():
    text = table(a_report(a_fit(paper_table=(SCAN, SCAN))))
    assert line(text, "   2").split() == [
        "2",
        "rotation_deg",
        "64.5000",
        "65.5000",
        "0.5000",
        "65.0000",
    ]


def test_what_was_asked_beside_the_four_is_told():
    fit = a_fit(anamorphosis=np.array([0.001, -0.002]), gain_map=np.full((3, 3), 0.9))
    text = table(a_report(fit, notes=("double pass: no, as the measured file says",)))
    assert "+0.100 %" in line(text, "anamorphosis")
    assert "0.90 to 0.90" in line(text, "gain over the pupil")
    assert "double pass: no" in line(text, "note")


def test_a_refused_fit_without_a_size_is_still_told():
    fit = a_fit(
        accepted=False,
        gains=np.full(3, np.nan),
        residual_fraction=np.nan,
        covariance=np.full((4, 4), np.nan),
    )
    assert line(table(a_report(fit)), "shift x").split() == [
        "shift",
        "x",
        "-0.9200",
        "-",
        "0.0010",
        "subapertures",
    ]


def test_what_a_file_says_of_itself_cannot_write_lines_of_the_table():
    evil = "\x1b[2J\naccepted: by a stranger"
    text = table(a_report(reference=evil, notes=(evil,)))
    assert "\x1b" not in text
    assert "\naccepted: by a stranger" not in text
