"""The tracker does in recorded nights what it did when they were recorded."""

from pathlib import Path

import pytest

from pyrcal_studies.campaign.golden import INSTRUMENT, nights_in, read, replayed

FOLDER = Path(__file__).parents[1] / "data" / "golden"


@pytest.fixture(scope="module")
def instrument():
    (found,) = read(FOLDER / INSTRUMENT)
    return found


def test_there_are_nights_enough():
    assert len(nights_in(FOLDER)) >= 40


@pytest.mark.parametrize("path", nights_in(FOLDER), ids=lambda path: path.name.split(".")[0])
def test_a_night_told_again_has_the_effects_it_had(path, instrument):
    assert replayed(read(path), instrument) is None
