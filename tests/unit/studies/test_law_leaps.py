"""Pointing laws that leap, against the whole service in simulated time."""

import numpy as np
import pytest

from pyrcal_studies.campaign import law_leaps
from pyrcal_studies.campaign.law_leaps import KINDS, Draw, play, story_of, table


@pytest.mark.parametrize("kind", KINDS)
def test_the_law_leaps_as_drawn(kind):
    """From one report to the next, and by nothing else at that time."""
    story = story_of(Draw(seed=5, kind=kind))
    before, after = (
        story.law.at(dict.fromkeys(story.law.names, 0.0) | story.reports(since_s))
        for since_s in (-8.2, 0.0)
    )
    step = after.vector - before.vector
    assert step[0] == pytest.approx(story.step[0], abs=0.03)
    assert np.rad2deg(step[2]) == pytest.approx(story.step[2], abs=0.1)


def test_no_matrix_is_made_for_a_derotator_that_wraps(monkeypatch):
    monkeypatch.setattr(law_leaps, "NIGHT_S", 24.0)
    row = play(Draw(seed=0, kind="wraps"))
    assert row["named_s"] <= 1.0
    assert row["named_s"] < row["confirmed_s"] <= 6.0
    assert (row["right_after_s"], row["n_made_wrong"], row["n_used_wrong"]) == (0.0, 0, 0)
    assert table([row]).count("\n") == 3
