"""What tests of several modules share of unit.test_shelf."""

from __future__ import annotations

import re


def anchors(page):
    """The anchors of a page's headings, as GitHub and Sphinx make them."""
    for title in re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.M):
        words = re.sub(r"[^\w\s-]", "", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).lower())
        yield re.sub(r"\s", "-", words).strip("-")
