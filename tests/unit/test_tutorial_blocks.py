"""The comparison of a tutorial's outputs can fail, and allows for other machines."""

import pytest

from tests.support.tutorial_blocks import ENDING, agrees, missing_lines, steps

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


@pytest.mark.parametrize(
    ("line", "agreed"),
    [
        ("mode auto; up 1 min 8 s", True),
        ("mode auto; up 12 s, late", True),
        ("mode hold; up 12 s", False),
        ("  x  +0.4931  +0.31", True),
        ("  x  +0.6000  +0.31", False),
        ("a is made: cm-7, 500 modes: stable", True),
        ("a is made: cm-7, 500 modes: refused", False),
    ],
)
def test_three_dots_within_a_line_stand_for_any_text(line, agreed):
    printed = ["mode auto; up ...", "x +0.4930 ...", "... is made: ..., 500 modes: stable"]
    assert any(agrees(one, line) for one in printed) == agreed


def test_what_a_program_prints_at_its_end_is_not_the_output_of_the_block_before(tmp_path):
    page = tmp_path / "page.md"
    ending = "<!-- printed by demo at its end -->\n```text\nGOOD\n```\n"
    page.write_text(f"```sh\npyrcal audit\n```\n{ending}", encoding="utf-8")
    assert list(steps(page)) == [("sh", "pyrcal audit\n", None)]
    assert ENDING.findall(page.read_text("utf-8")) == [("demo", "GOOD\n")]
