"""The whole service finds a small telescope's mirror from nothing, in simulated time."""

from pathlib import Path

import pytest

from pyrcal_studies.campaign.acquisition import Start, play, wrong

SMALL = Path(__file__).parents[2] / "system" / "small.toml"


@pytest.mark.long
def test_a_loop_that_diverges_a_subaperture_off_ends_tracking_where_the_mirror_is():
    start = Start(instrument=str(SMALL), n_controlled=60, seed=0, within_s=40.0)
    assert (abs(start.alpha - [0.0, 0.0, 0.0, 1.0]) > [0.4, 1.0, 4.0, 0.04]).all()
    row = play(start)
    assert row["stage"] == "tracking", row["log"]
    assert not wrong(row)
    assert row["closed"]
    assert row["time_s"] < 30.0
    assert all(radius < 0.95 for radius in row["radii"])
