"""Writes the page of the packaged instruments: each key, its value, and where it comes from."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from pyrcal_studies.reference import page

FOLDER = Path(__file__).parents[1] / "service" / "instrument" / "packaged"

_KEY = re.compile(r"(?P<key>[a-z0-9_]+) *= *(?P<value>\"[^\"]*\"|[^#]*?) *(?:# *(?P<source>.*))?")

_TABLE = re.compile(r"\[+(?P<name>[a-z._]+)\]+ *(?:# *(?P<source>.*))?")

ASSUMED = "assumed"

NO_SOURCE = {"name": "the name of this file"}


def packaged() -> str:
    """Return docs/reference/instruments.md: every packaged instrument, key by key."""
    intro = (
        "Each is a file in `service/instrument/packaged`, used by its name: `pyrcal demo --instrument "
        "papyrus`, `pyrcal instrument show papyrus papyrus.png`. A value is public, and then its "
        f"source is named, or it is {ASSUMED}: chosen by the authors of pyrcal because no public "
        "source was found. Check assumed values before you use a file on the real telescope."
    )
    parts = [part for path in sorted(FOLDER.glob("*.toml")) for part in _instrument(path)]
    return page("Packaged instruments", intro, *parts)


def _instrument(path: Path) -> Iterator[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    n_head = next(k for k, line in enumerate(lines) if line.startswith("["))
    head = [line.removeprefix("#").strip() for line in lines[:n_head]]
    yield f"## {path.stem}"
    sources = dict(_sources(head))
    about = [line for line in head if line and not _is_source(line)]
    last = next((k for k, line in enumerate(about) if line.startswith("Sources")), len(about))
    yield " ".join(about[:last])
    if sources:
        yield "\n".join(f"- [{name}] {text}" for name, text in sources.items())
    rows = ["| table | key | value | source |", "| --- | --- | --- | --- |", *_rows(lines[n_head:])]
    yield "\n".join(rows)


def _is_source(line: str) -> bool:
    return re.match(r"\[[A-Z]\] |ours:", line) is not None


def _sources(head: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the letter and the text of each source; a text may go on in the next lines."""
    letter, words = "", list[str]()
    begun = False
    for line in [*head, ""]:
        begun |= line.startswith("Sources")
        match = re.match(r"\[([A-Z])\] (.*)", line)
        if not begun or (letter and not match and line and not line.startswith("ours:")):
            words += [line] if letter else []
            continue
        if letter:
            yield letter, " ".join(words)
            letter, words = "", []
        if match:
            letter, words = match[1], [match[2]]


def _rows(lines: list[str]) -> Iterator[str]:
    table, default = "", ""
    for line in lines:
        if (match := _TABLE.fullmatch(line)) is not None:
            table, default = match["name"], match["source"] or ""
        elif (match := _KEY.fullmatch(line)) is not None:
            source = match["source"] or NO_SOURCE.get(match["key"], default)
            yield f"| {table} | `{match['key']}` | `{match['value']}` | {_worded(source)} |"


def _worded(source: str) -> str:
    """Return a source as the table has it: what has none is assumed."""
    text = re.sub(r"\bours\b", ASSUMED, source).replace("|", "\\|")
    return text or ASSUMED
