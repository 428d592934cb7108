"""The shelf: every link and every file that a page names is there; decisions are few and short."""

import re

import pytest

from tests.support.repository import ROOT
from tests.support.shelf import anchors

DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
FOLDERS = (
    "service|pyrcal|check_rtc|sim_rtc|cacao_bridge|pyrcal_studies|benchmarks|tests|examples|deploy"
    "|docs"
)
NAMED = re.compile(rf"`((?:{FOLDERS})/[\w./-]*\w\.(?:py|toml|md|yml|json|js))`")
DECISIONS = sorted((DOCS / "decisions").glob("0*.md"))
MOST_DECISIONS, MOST_WORDS = 30, 600
TOPS = (ROOT / "service", ROOT / "pyrcal", ROOT)
DEPENDENCIES = "0001-dependencies.md"
"""One line for each: as long as it must be."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_is_there(page):
    text = page.read_text("utf-8")
    missing = [name for name in NAMED.findall(text) if not (ROOT / name).exists()]
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if re.match(r"[a-z]+:", link):
            continue
        if not target.exists() or (
            anchor and target.suffix == ".md" and anchor not in anchors(target)
        ):
            missing.append(link)
    assert missing == []


def test_the_architecture_names_files_of_the_service():
    """With the folder it is that file; a bare name follows one of the same folder."""
    text = (DOCS / "developer" / "architecture.md").read_text("utf-8")
    folder, missing = "", []
    for name in re.findall(r"`([\w/]+\.(?:py|toml))`", text):
        folder = f"{name.rpartition('/')[0]}/" if "/" in name else folder
        places = [top / (name if "/" in name else folder + name) for top in TOPS]
        if not any(place.exists() for place in [*places, TOPS[0] / name]):
            missing.append(name)
    assert missing == []


def test_decisions_are_those_in_force():
    """Each says what it supersedes, fits a page, and is in the list."""
    assert len(DECISIONS) <= MOST_DECISIONS
    listed = (DOCS / "decisions" / "README.md").read_text("utf-8")
    numbers = [path.name[:4] for path in DECISIONS]
    assert len(set(numbers)) == len(numbers), "a number is used twice"
    for path in DECISIONS:
        text = path.read_text("utf-8")
        assert re.search(r"^Status: .+ Supersedes: .+", text, re.M), path.name
        assert path.name == DEPENDENCIES or len(text.split()) <= MOST_WORDS, path.name
        assert f"]({path.name})" in listed, path.name
