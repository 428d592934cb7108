"""The study of false flags and of how soon a jump is told."""

import sys

import numpy as np
import pytest

from pyrcal_studies import jump_flags
from pyrcal_studies.jump_flags import Night


def test_a_window_in_which_it_jumps_is_between_both_places():
    jump = np.array([0.1, 0.0, 0.0, 0.0])
    night = Night(
        sigma=np.zeros(4), n_windows=9, drift=np.array([0.0, 0.0, 0.06, 0.0]), jump=jump, at_s=9.5
    )
    assert night.mean(8.0)[0] == 0.0
    assert night.mean(10.0)[0] == pytest.approx(0.025)
    assert night.mean(12.0) == pytest.approx([0.1, 0.0, 0.011, 0.0])


def test_jumps_far_above_the_noise_are_all_told_in_time_and_noise_is_none(monkeypatch, capsys):
    words = "jump_flags --sigma-mdeg 5 --hours 0.05 --jumps 4"
    monkeypatch.setattr(sys, "argv", words.split())
    assert jump_flags.main() == 0
    rows = capsys.readouterr().out.splitlines()
    assert [row.split("|")[4:6] for row in rows[1:3]] == [[" 0.00 ", " 0.00 "]] * 2
    assert [row.split("|")[3].strip() for row in rows[4:]] == ["100% of 4"] * 2
