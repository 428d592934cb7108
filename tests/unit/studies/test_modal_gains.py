"""The table of nights whose seeing changes."""

import pytest

from pyrcal_studies.campaign.modal_gains import GainNight, table_of_change


def night(errors):
    """A row with windows of 1 s, whose seeing changes after 4 s; σ is 0.1."""
    history = [
        {"time_s": k + 1.0, "error": [error, -error], "sigma": [0.1, 0.1]}
        for k, error in enumerate(errors)
    ]
    about = {"magnitude": 6.0, "seeing_arcsec": 0.5, "then_arcsec": 1.0, "window_s": 1.0}
    plan = GainNight(n_windows=len(errors), **about)
    return {name: getattr(plan, name) for name in GainNight.__dataclass_fields__} | {
        "history": history
    }


def test_windows_are_counted_from_the_change_and_errors_are_rms():
    rows = [night([0.01, 0.02, 0.9, 0.9, 0.9, 0.2, 0.05, sign * 0.03]) for sign in (1, -1)]
    lines = [line.split("|")[2:6] for line in table_of_change(rows).splitlines()[2:]]
    found = {number.strip(): [float(part) for part in parts] for number, *parts in lines}
    assert list(found) == ["last before", "1", "2", "3"]
    assert found["last before"][:2] == [1.0, 10.0]
    assert found["1"] == pytest.approx([20.0, 10.0, 2.0])
    assert found["3"] == pytest.approx([3.0, 10.0, 0.3])


def test_a_night_whose_seeing_changes_says_so_to_the_simulator():
    night_of_two = GainNight(seeing_arcsec=0.5, then_arcsec=1.0, n_windows=8, window_s=1.0)
    assert {"--seeing-at=4.0:0.5", "--seeing-at=6.0:1"} <= set(night_of_two.words)
    assert not any("seeing-at" in word for word in GainNight().words)
