"""The comparison of a tutorial's outputs can fail, and allows for other machines."""

import pytest

from tests.unit.tutorial_blocks import missing_lines

PRINTED = "shift x             -0.0978      0.0029  subapertures\n...\nverdict: accepted\n"


@pytest.mark.parametrize(
    ("output", "missing"),
    [
        ("shift x   -0.0980  0.0030  subapertures\nother\nverdict: accepted", 0),
        ("verdict: accepted\nshift x   -0.0980  0.0030  subapertures", 1),
        ("shift x   -0.1100  0.0030  subapertures\nverdict: accepted", 1),
        ("shift x   -0.0980  0.0030  deg\nverdict: refused", 2),
    ],
)
def test_lines_are_found_in_their_order_with_their_numbers(output, missing):
    assert len(missing_lines(PRINTED, output)) == missing
