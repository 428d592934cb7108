"""What tests of several modules share of unit.test_docs."""

from __future__ import annotations

import re
import shlex
from itertools import groupby

from tests.support.repository import ROOT

DOCS = ROOT / "docs"


RECORDS = {"decisions", "results", "rtc"}
"""Folders of docs that nobody works through with their hands at the keys."""


PAGES = [
    ROOT / "README.md",
    *sorted(page for page in DOCS.rglob("*.md") if page.parent.name not in RECORDS),
]


NOT_RUN = re.compile(r"<!-- not run: (.+) -->\n\Z")
"""On the line before a block that no test can run, with the reason."""


def blocks_of(page, kind):
    """Every fenced block of a kind on a page, and why it is not run; None: it is."""
    whole = page.read_text("utf-8")
    for found in re.finditer(rf"^```{kind}\n(.*?)^```", whole, re.M | re.S):
        mark = NOT_RUN.search(whole[: found.start()])
        yield found[1], mark and mark[1]


def commands(text):
    """The commands of a block, as words."""
    text = re.sub(r"(?<!\S)#.*", "", text.replace("\\\n", " "))
    lexer = shlex.shlex(text, posix=True, punctuation_chars=";|&<>\n")
    lexer.whitespace, lexer.whitespace_split = " \t", True
    for ends, words in groupby(lexer, lambda word: not set(word) - set(";|&\n")):
        if not ends:
            words = list(words)
            yield words[: words.index(">")] if ">" in words else words
