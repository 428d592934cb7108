"""A study writes its own section of a page and nothing else."""

import re

import pytest

from pyrcal_studies.result_figures import read_table, write_figures
from pyrcal_studies.shared import RESULTS, write_section


def test_a_section_is_replaced_and_the_rest_stays(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- begin: x -->\nold\n<!-- end: x -->\nb\n", encoding="utf-8")
    write_section(page, "x", "new\\1\n")
    write_section(page, "x", "new\\1\n")
    assert page.read_text("utf-8") == "a\n<!-- begin: x -->\nnew\\1\n<!-- end: x -->\nb\n"


@pytest.mark.parametrize(
    "text", ["", "<!-- begin: x -->\n", "<!-- begin: x -->\n<!-- end: x -->" * 2]
)
def test_a_page_has_the_section_once(tmp_path, text):
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match="expected one"):
        write_section(page, "x", "new")
    assert page.read_text("utf-8") == text


def test_the_pages_have_the_sections_of_the_benchmarks():
    marks = re.compile(r"<!-- begin: ([a-z_-]+) -->\n.*?<!-- end: \1 -->", re.S)
    found = {page.name: marks.findall(page.read_text("utf-8")) for page in RESULTS.glob("*.md")}
    assert found["speed.md"] == ["bench"]
    assert found["link.md"] == ["soak", "load"]


def test_figures_are_drawn_from_the_tables_of_the_pages(tmp_path):
    write_figures(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"faults.png", "elt.png", "shack_hartmann.png", "references.png"}
    assert all((RESULTS / name).is_file() for name in names)
    with pytest.raises(ValueError, match="no table"):
        read_table("speed.md", "No such section")
