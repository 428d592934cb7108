"""Nights of the whole service as rows and a table."""

import json
import sys

import numpy as np
import pytest

from pyrcal_studies.campaign import system_nights
from pyrcal_studies.campaign.system_nights import Case, Plan, line_of, table
from sim_rtc.options import parse_options
from tests.support.small import INSTRUMENT, N_CONTROLLED


def row(case, **changes):
    found = {
        "jumps": [],
        "good_alpha_s": 5.0,
        "own_matrix_s": 10.0,
        "tracking_rms": [0.003, 0.004, 0.01, 0.0002],
        "wavefront_nm": 120.5,
        "dither_nm": 8.0,
        "windows": [20, 1],
        "published": [{}, {}],
        "refused": 0,
        "unstable": 0,
    }
    plan = Plan(case=case)
    given = {name: getattr(plan, name) for name in Plan.__slots__}
    return given | found | changes


@pytest.mark.parametrize("case", Case)
def test_every_case_is_a_command_line_the_simulator_takes(case):
    options = parse_options(Plan(case=case, seed=3).words)
    assert options.seed == 3
    assert len(options.jumps) == len(Plan(case=case, seed=3).jump_times_s)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_drifts_and_jumps_by_what_is_to_be_tracked(seed):
    options = parse_options(Plan(case=Case.BUSY, seed=seed).words)
    drift = options.drift
    assert np.hypot(drift.shift_x_subap, drift.shift_y_subap) == pytest.approx(0.05, abs=1e-4)
    assert abs(drift.rotation_deg) == pytest.approx(0.05)
    shift, turn, *_ = options.jumps
    assert np.hypot(shift.shift_x_subap, shift.shift_y_subap) == pytest.approx(0.1, abs=1e-4)
    assert abs(turn.rotation_deg) == pytest.approx(0.1)


def test_seeds_drift_in_different_directions():
    words = {Plan(case=Case.DRIFT, seed=seed).words[-1] for seed in range(5)}
    assert len(words) == 5


def test_a_line_tells_the_mean_the_worst_and_what_never_came():
    jumps = [
        {"at_s": 30.0, "flagged_s": 2.0, "corrected_s": 10.0},
        {"at_s": 60.0, "flagged_s": 4.0, "corrected_s": None},
    ]
    text = line_of("nights", [row(Case.JUMP, jumps=jumps), row(Case.JUMP, own_matrix_s=20.0)])
    cells = [cell.strip() for cell in text.split("|")]
    assert "15.0 (20.0)" in cells
    assert "3.0 (4.0)" in cells
    assert "10.0 (10.0, 1 never)" in cells
    assert "0.30 0.40 10.00 0.02" in cells


def test_the_cost_of_a_dither_is_the_plain_difference_with_its_twin():
    text = line_of("nights", [row(Case.BUDGET, twin_nm=120.2), row(Case.BUDGET, twin_nm=120.4)])
    assert "| 0.200 (0.300) |" in text


def test_nights_that_differ_in_more_than_the_seed_are_not_averaged():
    rows = [row(Case.DRIFT), row(Case.DRIFT, seed=1), row(Case.DRIFT, magnitude=7.0)]
    assert table(rows).count("**drift**") == 2


def test_a_night_is_played_once_and_its_row_survives_on_disk(tmp_path, monkeypatch, capsys):
    output = tmp_path / "rows.jsonl"
    arguments = ["nights", "--output", str(output), "--seeds", "0:1", "--seconds", "2"]
    arguments += ["--instrument", str(INSTRUMENT), "--n-controlled", str(N_CONTROLLED)]
    monkeypatch.setattr(sys, "argv", arguments)
    assert system_nights.main() == 0
    (first,) = [json.loads(text) for text in output.read_text().splitlines()]
    assert first["windows"] == [0, 0]
    assert first["published"] == []
    assert any(name == "dither.started" for _, _, name, _ in first["log"])
    assert system_nights.main() == 0
    assert len(output.read_text().splitlines()) == 1
    assert "**drift**" in capsys.readouterr().out
