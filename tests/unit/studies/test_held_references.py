"""The table of nights whose RTC applies references as it should, or otherwise."""

import numpy as np
import pytest

from pyrcal_studies.campaign.held_references import KINDS, is_right, load_of, spoil_of, table


def row(kind, *, hidden=False, **changes):
    usual = {
        "n_changes": 5,
        "named_s": None if kind == KINDS[0] else 0.3,
        "n_worse": 0,
        "closed": True,
        "alarms": [],
    }
    return {"seed": 0, "kind": kind, "hidden": hidden} | usual | changes


@pytest.mark.parametrize("kind", KINDS)
def test_a_night_is_right_where_a_fault_that_is_shown_is_named_and_nothing_else(kind):
    assert is_right(row(kind))
    assert not is_right(row(kind, n_worse=1))
    assert is_right(row(kind, named_s=None)) is (kind == KINDS[0])
    assert is_right(row(kind, named_s=31.0, hidden=True)) is (kind != KINDS[0])


def test_the_table_has_a_line_for_each_kind_and_what_is_shown():
    rows = [row(kind, hidden=hidden) for kind in KINDS[1:] for hidden in (False, True)]
    lines = table([row(KINDS[0]), *rows]).splitlines()
    assert len(lines) == 2 + 1 + 2 * (len(KINDS) - 1)
    assert "1 of 1" in lines[3]
    assert "0.3, at most 0.3" in lines[3]


def test_shapes_are_steep_and_of_the_stated_size():
    shapes = [np.array(load_of(np.random.default_rng(seed)).values_m) for seed in range(20)]
    sizes_nm = [1e9 * np.linalg.norm(shape) for shape in shapes]
    assert 30.0 <= min(sizes_nm) < max(sizes_nm) <= 60.0
    assert np.abs(shapes[0][2]) > 3.0 * np.abs(shapes[0][21])


def test_an_rtc_spoils_what_it_is_sent_as_its_kind_says():
    old, new = np.float32([1.0, 2.0]), np.float32([3.0, -4.0])
    assert spoil_of(KINDS[0]) is None
    found = [spoil_of(kind)(old, new).tolist() for kind in KINDS[1:]]
    assert found == [[-3.0, 4.0], [6.0, -8.0], [1.0, 2.0]]
