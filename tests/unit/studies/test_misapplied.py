"""RTCs that apply another matrix than they say, against the whole service in simulated time."""

import pytest

from pyrcal_studies.campaign import misapplied
from pyrcal_studies.campaign.misapplied import Draw, is_right, play, table


@pytest.mark.parametrize(("kind", "n_sent"), [("never swapped", 1), ("sign turned", 2)])
def test_it_is_named_and_the_loop_is_safe(kind, n_sent, monkeypatch):
    monkeypatch.setattr(misapplied, "NIGHT_S", 18.0)
    row = play(Draw(seed=0, kind=kind, plant="linear"))
    assert is_right(row)
    assert row["n_sent"] == n_sent
    assert row["named_s"] < 1.0
    assert row["closed"] is (kind == "never swapped")
    assert table([row]).count("\n") == 3


def test_a_row_is_right_only_with_few_matrices_a_name_and_a_safe_loop():
    row = {"kind": "sign turned", "n_sent": 2, "named_s": 0.1, "wrong_s": 1.9, "n_worse": 1}
    assert is_right(row)
    for change in ({"n_sent": 3}, {"named_s": None}, {"wrong_s": 2.1}):
        assert not is_right(row | change)
    healthy = {"kind": "as it should", "n_sent": 7, "named_s": None, "n_worse": 0}
    assert is_right(healthy)
    assert not is_right(healthy | {"n_worse": 1})
