"""The study of RTCs that are not what they are told to be."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.campaign.mistold import CASES, MistoldDome, play, table

SMALL = str(Path(__file__).parents[2] / "system" / "small.toml")
BY_NAME = {case.name: case for case in CASES}


def night(name, seconds):
    given = argparse.Namespace(
        instrument=SMALL, plant="linear", n_controlled=45, magnitude=8.0, seconds=seconds
    )
    return play(BY_NAME[name], given)


@pytest.mark.parametrize("name", ["both signs", "leak 0.97"])
def test_an_rtc_that_is_not_as_told_is_named_and_gets_no_matrix(name):
    row = night(name, 3.0)
    assert row["named_s"] is not None
    assert row["named_s"] <= 2.0
    assert row["sent"] == 0
    assert not row["opened"]


def test_what_it_shows_of_its_matrix_makes_its_commands_of_its_slopes():
    words = [f"--instrument={SMALL}", "--n-controlled=45", "--seed=1"]
    plain, other = (
        MistoldDome(words, BY_NAME[name]) for name in ("as told", "interleaved with sign")
    )
    slopes = np.random.default_rng(1).standard_normal((3, plain.dialect.index.size))
    heard = slopes[:, other.dialect.index] * other.dialect.sign
    np.testing.assert_allclose(
        heard @ other.applied()[1].T, slopes @ plain.applied()[1].T, rtol=1e-3, atol=1e-12
    )
    assert not np.allclose(heard, slopes)


def test_a_case_that_was_not_named_shows_in_the_table():
    row = {"instrument": "small", "plant": "linear", "case": "leak 0.9", "named_s": None}
    row |= {"by": None, "sent": 1, "opened": True, "worst_nm": 35000.0}
    assert "| leak 0.9 | - | - | 1 | yes | 35000 nm |" in table([row])
