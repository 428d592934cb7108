"""Marked sections of the pages of results, each written by one study.

A section is what a page has between ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``. The text
around it (target, conditions, limits) is written by hand.
"""

from __future__ import annotations

import re
from pathlib import Path

RESULTS = Path(__file__).parents[1] / "docs" / "results"


def write_section(page: Path, name: str, text: str) -> None:
    """Replace the marked section ``name`` of a page; ValueError unless the page has it once."""
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    old = page.read_text(encoding="utf-8")
    parts = re.split(f"({re.escape(begin)}\n.*?{re.escape(end)})", old, flags=re.DOTALL)
    if len(parts) != 3:
        raise ValueError(f"{page}: found {len(parts) // 2} sections {name!r}; expected one")
    page.write_text(f"{parts[0]}{begin}\n{text.strip()}\n{end}{parts[2]}", encoding="utf-8")
