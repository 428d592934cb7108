"""The measured values that README and the index quote are those of the pages of results."""

import re
import tomllib

import pytest

from tests.support.repository import ROOT
from tests.support.shelf import anchors

RESULTS = ROOT / "docs" / "results"
ENTRIES = tomllib.loads((RESULTS / "measured.toml").read_text("utf-8"))
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w]|\.\d)")
"""A number by itself: no part of a name, a date or a longer number."""

QUOTING = {
    "README.md": re.compile(r"\]\(docs/results/([\w.]+\.md(?:#[\w-]+)?)\)"),
    "docs/results/README.md": re.compile(r"\[[^]]+\]\(([\w]+\.md)\)"),
}


def section_text(name):
    """The text of a section, without its subsections' siblings; of a page without an anchor."""
    page, _, anchor = name.partition("#")
    text = (RESULTS / page).read_text("utf-8")
    if not anchor:
        return text
    parts = re.split(r"^(?=## )", text, flags=re.M)
    (index,) = [k for k, title in enumerate(t for t in anchors(RESULTS / page)) if title == anchor]
    titles = re.findall(r"^#+ .*$", text, re.M)
    (part,) = [part for part in parts if titles[index] in part.splitlines()]
    return part


def numbers(text):
    return {n.rstrip(".") for n in NUMBER.findall(re.sub(r"\]\([^)]*\)|`[^`]*`", "", text))}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_quoted_value_is_printed_in_its_section(name):
    entry = ENTRIES[name]
    printed = numbers(section_text(entry["section"]))
    for value in entry["values"]:
        source = entry.get("from", {}).get(value, value)
        assert source in printed, (value, source)
        if source != value:
            digits = len(value.partition(".")[2])
            assert round(float(source) * entry["unit"], digits) == float(value)


def quotes():
    """Each line that quotes results: (file, line, section or page that it links)."""
    for file, link in QUOTING.items():
        for line in re.split(r"\n(?=[|-] |#)", (ROOT / file).read_text("utf-8")):
            for section in link.findall(line) if line.startswith(("| ", "- **")) else ():
                yield pytest.param(line, section, id=f"{file}-{section}")


@pytest.mark.parametrize(("line", "section"), list(quotes()))
def test_every_number_that_is_quoted_has_an_entry(line, section):
    known = {
        value
        for entry in ENTRIES.values()
        if entry["section"] == section or entry["section"].partition("#")[0] == section
        for value in entry["values"]
    }
    cells = line.split("|")
    quoted = "|".join(cells[2:-1]) if line.startswith("| ") else line
    if len(cells) == 5:  # the index: page, question, number
        quoted = cells[3]
    assert numbers(quoted) - known == set()


def test_a_quotation_states_what_its_entry_says_must_be_stated():
    lines = [(param.values[0], param.values[1]) for param in quotes()]
    for name, entry in ENTRIES.items():
        in_section = section_text(entry["section"])
        quoting = [line for line, section in lines if section == entry["section"]]
        for text in entry.get("stated", ()):
            assert text in in_section, (name, text)
            assert quoting, name
            assert all(text in line for line in quoting), (name, text)


def test_each_table_of_measured_values_is_quoted():
    linked = {param.values[1] for param in quotes()}
    for entry in ENTRIES.values():
        assert {entry["section"], entry["section"].partition("#")[0]} & linked


RESULT_LINK = re.compile(r"\]\((?:\.\./)*(?:docs/)?results/([\w.]+\.md(?:#[\w-]+)?)\)")


def quoting_sentences():
    """Each sentence, or row of an explanation's table, that links a section of the results."""
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        if page.parent == RESULTS:
            continue
        for number, line in enumerate(page.read_text("utf-8").splitlines(), 1):
            row = line.startswith("| ") and page.parent.name == "explanation"
            for sentence in [line] if row else re.split(r"(?<=[.;|]) ", line):
                if sections := RESULT_LINK.findall(sentence):
                    yield f"{page.relative_to(ROOT)}:{number}", sentence, sections


def is_printed(value, printed):
    """True if this number, or one that is rounded to it, is in the section."""
    digits = len(value.partition(".")[2])
    return any(f"{float(source):.{digits}f}" == value for source in printed)


def test_a_sentence_that_links_a_section_quotes_numbers_of_it():
    quotations = list(quoting_sentences())
    assert len(quotations) > 30
    wrong = []
    for place, sentence, sections in quotations:
        printed = set().union(*(numbers(section_text(name)) for name in sections))
        wrong += [(place, value) for value in numbers(sentence) if not is_printed(value, printed)]
    assert wrong == []
