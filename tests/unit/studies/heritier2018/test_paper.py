"""The paper's own words and values, compared with its source where that is at hand."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from pyrcal.fitting.methods import TABLE_1 as SCANNED
from pyrcal_studies.heritier2018 import paper, plan, results
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from tests.support.paper_page import PAGE, ROOT

NAME = "heritier2018.tex"


def tex() -> str:
    """Return the paper's source."""
    given = os.environ.get("PYRCAL_PAPER")
    path = Path(given) if given else ROOT.parent / "shared" / "paper" / NAME
    if not path.is_file():
        pytest.skip(f"the paper's source is not at hand: PYRCAL_PAPER or ../shared/paper/{NAME}")
    return path.read_text(encoding="utf-8")


def source() -> str:
    """Return the paper as plain text."""
    return paper.plain(tex())


def numbered(text: str) -> dict[str, set[str]]:
    """Return the numbers that LaTeX gives to sections, equations, tables and figures."""
    sections, chapter, part = set(), 0, 0
    for level in re.findall(r"\\(section|subsection)\{", text):
        chapter, part = (chapter + 1, 0) if level == "section" else (chapter, part + 1)
        sections.add(f"{chapter}.{part}" if part else f"{chapter}")
    found = {"section": sections}
    for kind in ("equation", "table", "figure"):
        count = len(re.findall(rf"\\begin\{{{kind}\*?\}}", text))
        found[kind] = {str(number) for number in range(1, count + 1)}
    return found


def citations() -> list[tuple[str, str, str]]:
    """Return file, kind and number of each place of the paper that code and documents cite."""
    found = []
    for folder in ("service", "pyrcal", "sim_rtc", "pyrcal_studies", "docs"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix not in {".py", ".md", ".toml"}:
                continue
            text = re.sub(r"\s+", " ", path.read_text(encoding="utf-8"))
            # what follows the name up to the end of the sentence or the parenthesis
            for cited in re.findall(r"Heritier et al\. 2018[^.;]?((?:[^.;)]|\.\d)*)", text):
                places = re.findall(r"(section|equation|table|figure)s? ([\d.]*\d)", cited.lower())
                found += [(str(path.relative_to(ROOT)), *place) for place in places]
    return found


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
            assert f"{value:g}" in quote.text, quote


def test_the_scans_are_those_of_table_1():
    ours = [
        (results.SYMBOLS[name], step * float(results.SHOWN[PARAMETERS.index(name)]))
        for name, step in SCANNED
    ]
    assert ours == [(step.symbol, pytest.approx(step.step)) for step in paper.TABLE_1]


def test_the_paper_has_the_places_that_are_cited():
    numbers = numbered(tex())
    assert [len(numbers[kind]) for kind in ("equation", "table", "figure")] == [10, 2, 14]
    cited = citations()
    assert len(cited) >= 15
    assert [one for one in cited if one[2] not in numbers[one[1]]] == []


def test_start_and_truth_are_equations_9_and_10():
    for alpha, quote in ((plan.ROUGH, paper.START), (plan.TRUTH, paper.FOUND)):
        shown = alpha.vector * BOUNDARY_SCALE * results.SHOWN
        assert shown == pytest.approx(quote.values)
    assert tuple(variant.value for variant in plan.Variant) == tuple(paper.TABLE_2)
