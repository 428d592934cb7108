"""The page: every file that it names exists, every figure is there, and it says what was run."""

from __future__ import annotations

import re

import pytest

from pyrcal_studies.heritier2018 import figures
from pyrcal_studies.heritier2018.page import CAPTIONS
from pyrcal_studies.heritier2018.tables import listed, table
from pyrcal_studies.shared import save_picture
from tests.support.paper_page import PAGE


def main_rows() -> list[list[str]]:
    """Return the cells of the rows of figures, equations, tables and claims."""
    text = PAGE.read_text(encoding="utf-8")
    kinds = r"\| (Equation \d+|Table \d(, [\w ]+)?|\[Figure [^|]+|Section [\d.]+) \|"
    rows = [line for line in text.splitlines() if re.match(kinds, line)]
    return [[cell.strip() for cell in row.strip("| ").split(" | ")] for row in rows]


def test_every_equation_table_and_figure_has_a_row():
    first = {re.sub(r"\[(Figure \d+)\].*", r"\1", cells[0]) for cells in main_rows()}
    for kind, numbers in (("Equation", range(1, 11)), ("Figure", range(1, 15))):
        assert {f"{kind} {number}" for number in numbers} <= first
    assert {"Table 1", "Table 2, PSIM 400 Modes", "Table 2, LBT 400 Modes"} <= first


def test_every_row_of_an_equation_table_or_claim_names_a_file():
    rows = [cells for cells in main_rows() if not cells[0].startswith("[")]
    assert len(rows) >= 23
    for cells in rows:
        assert re.fullmatch(r"`[\w/.-]+\.\w+`", cells[2]), cells


def test_twelve_figures_are_on_the_page_and_small_enough():
    text = PAGE.read_text(encoding="utf-8")
    shown = re.findall(r"!\[Figure (\d+): [^\]]+\]\(([^)]+)\)", text)
    assert [int(number) for number, _ in shown] == list(range(3, 15))
    for _, path in shown:
        picture = (PAGE.parent / path).read_bytes()
        assert picture.startswith(b"\x89PNG")
        assert len(picture) < 100_000
    assert set(figures.DRAWN) == set(CAPTIONS) == set(range(3, 15))


def test_the_page_is_that_of_a_full_run():
    text = PAGE.read_text(encoding="utf-8")
    assert "rehearsal" not in text
    assert re.search(r"`make paper`.*\d{4}-\d\d-\d\d", text, re.DOTALL)
    assert " nan" not in text


def test_a_table_is_markdown():
    assert table(["a", "b"], [["1", "x|y"]]) == "| a | b |\n| --- | --- |\n| 1 | x/y |"
    assert listed([1.0, -2.25], "+.1f") == "+1.0 / -2.2"


@pytest.mark.parametrize("size", [1, 2000])
def test_a_picture_fits_its_limit(size, tmp_path):
    pytest.importorskip("PIL")
    figure = figures.canvas(6.0, 6.0)
    noise = figure.subplots()
    noise.imshow([[(7919 * k * j) % 251 for k in range(min(size, 60))] for j in range(60)])
    save_picture(figure, tmp_path / "noise.png")
    assert (tmp_path / "noise.png").stat().st_size < 100_000
