"""The paper's own words and values, compared with its source where that is at hand."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from pyrcal.fitting.methods import TABLE_1 as SCANNED
from pyrcal_studies.heritier2018 import paper, plan, results
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

ROOT = Path(__file__).parents[4]
PAGE = ROOT / "docs" / "results" / "heritier2018.md"
NAME = "heritier2018.tex"


def source() -> str:
    """Return the paper as plain text."""
    given = os.environ.get("PYRCAL_PAPER")
    path = Path(given) if given else ROOT.parent / "shared" / "paper" / NAME
    if not path.is_file():
        pytest.skip(f"the paper's source is not at hand: PYRCAL_PAPER or ../shared/paper/{NAME}")
    return paper.plain(path.read_text(encoding="utf-8"))


def tight(text: str) -> str:
    """Return a text without spaces and rules of tables."""
    return re.sub(r"\s|hline", "", text)


def test_tex_is_read_as_people_read_it():
    tex = r"a rotation of $1^\circ$ to 25 \% of $\lambda/D$ (see Fig. \ref{fig:x} and \cite{y})"
    assert paper.plain(tex) == "a rotation of 1° to 25% of λ/D (see Fig. [x] and)"


def test_every_quotation_is_the_papers():
    text = source()
    quotes = [*paper.QUOTES.values(), paper.START, paper.FOUND]
    assert [quote.text for quote in quotes if quote.text not in text] == []


def test_both_tables_are_the_papers():
    text = tight(source())
    lines = [*paper.table_1_lines(), *paper.table_2_lines()]
    assert [line for line in lines if tight(line) not in text] == []


def test_every_quotation_on_the_page_is_the_papers():
    text = source()
    quoted = re.findall(r"“([^”]+)”", PAGE.read_text(encoding="utf-8"))
    assert len(quoted) >= 20
    assert [one for one in quoted if one not in text] == []


def test_the_values_of_a_quotation_are_in_its_words():
    for quote in [*paper.QUOTES.values()]:
        for value in quote.values:
            if quote is not paper.QUOTES["modulation"]:
                assert f"{value:g}" in quote.text, quote


def test_the_scans_are_those_of_table_1():
    ours = [
        (results.SYMBOLS[name], step * float(results.SHOWN[PARAMETERS.index(name)]))
        for name, step in SCANNED
    ]
    assert ours == [(step.symbol, pytest.approx(step.step)) for step in paper.TABLE_1]


def test_start_and_truth_are_equations_9_and_10():
    for alpha, quote in ((plan.ROUGH, paper.START), (plan.TRUTH, paper.FOUND)):
        shown = alpha.vector * BOUNDARY_SCALE * results.SHOWN
        assert shown == pytest.approx(quote.values)
    assert tuple(variant.value for variant in plan.Variant) == tuple(paper.TABLE_2)
