"""Writes the page of the packaged instruments: each key, its value, and its source."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from pyrcal_studies.contract_tables import table as table_of
from pyrcal_studies.reference import page

FOLDER = Path(__file__).parents[1] / "service" / "instrument" / "packaged"

_KEY = re.compile(r"(?P<key>[a-z0-9_]+) *= *(?P<value>\"[^\"]*\"|[^#]*?) *(?:# *(?P<source>.*))?")

_TABLE = re.compile(r"\[+(?P<name>[a-z._]+)\]+ *(?:# *(?P<source>.*))?")

ASSUMED = "assumed"


class Value(NamedTuple):
    """One key of an instrument file with its value and source."""

    table: str
    key: str
    value: str
    labels: str
    """Labels of the sources, such as ``[S] [D]``; empty if the value is assumed."""

    note: str


def packaged() -> str:
    """Return docs/reference/instruments.md: the values of every packaged instrument by source."""
    paths = sorted(FOLDER.glob("*.toml"))
    heads, values = {}, {}
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        n_head = next(k for k, line in enumerate(lines) if line.startswith("["))
        heads[path.stem] = [line.removeprefix("#").strip() for line in lines[:n_head]]
        values[path.stem] = list(_values(lines[n_head:]))
    everywhere = [
        one
        for one in values[paths[0].stem]
        if all(
            any((each.table, each.key, each.value) == one[:3] for each in found)
            for found in values.values()
        )
    ]
    common = {one[:3] for one in everywhere}
    intro = (
        "Each is a file in `service/instrument/packaged`, used by its name, which is `name` in "
        "`[instrument]`: `pyrcal demo --instrument papyrus`. A value is public, with its source, "
        f"or {ASSUMED}: chosen by the authors of pyrcal because no public source was found. Check "
        "assumed values before you use a file on the real telescope. An `r0_m` of 0.126 is a "
        "seeing of 0.8 arcseconds at 500 nm. Equal in all, and assumed where no source is named: "
        f"{', '.join(f'`{one.key}` {one.value} in `[{one.table}]`' for one in everywhere)}."
    )
    parts = [
        part
        for name, head in heads.items()
        for part in _instrument(name, head, [one for one in values[name] if _own(one, common)])
    ]
    return page("Packaged instruments", intro, *parts)


def _own(one: Value, common: set[tuple[str, str, str]]) -> bool:
    """Return whether the section of an instrument lists a value."""
    return one.key != "name" and (one[:3] not in common or bool(one.labels))


def _instrument(name: str, head: list[str], values: list[Value]) -> Iterator[str]:
    yield f"## {name}"
    about = [line for line in head if line and not _is_source(line)]
    last = next((k for k, line in enumerate(about) if line.startswith("Sources")), len(about))
    yield " ".join(about[:last])
    yield "\n".join(f"- [{label}] {text}" for label, text in _sources(head))
    tables = dict.fromkeys(one.table for one in values)
    rows = (
        (
            f"`{table}`",
            _cell(one for one in values if one.table == table and one.labels),
            _cell(one for one in values if one.table == table and not one.labels),
        )
        for table in tables
    )
    yield table_of(("table", "public", ASSUMED), list(rows))


def _cell(values: Iterable[Value]) -> str:
    """Return keys and values, each with its sources and note."""
    return ", ".join(
        " ".join(
            filter(None, (f"`{one.key}`", one.value, one.labels, one.note and f"({one.note})"))
        )
        for one in values
    )


def _is_source(line: str) -> bool:
    return re.match(r"\[[A-Z]\] |assumed:", line) is not None


def _sources(head: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the letter and the text of each source; a text may go on in the next lines."""
    letter, words = "", list[str]()
    begun = False
    for line in [*head, ""]:
        begun |= line.startswith("Sources")
        match = re.match(r"\[([A-Z])\] (.*)", line)
        if not begun or (letter and not match and line and not line.startswith("assumed:")):
            words += [line] if letter else []
            continue
        if letter:
            yield letter, " ".join(words)
            letter, words = "", []
        if match:
            letter, words = match[1], [match[2]]


def _values(lines: list[str]) -> Iterator[Value]:
    table, default = "", ""
    n_modes = 0
    for line in lines:
        if (match := _TABLE.fullmatch(line)) is not None:
            table, default = match["name"], match["source"] or ""
            if table == "wfs.mode":  # one of several tables of this name
                n_modes += 1
                table += f" {n_modes}"
        elif (match := _KEY.fullmatch(line)) is not None:
            source = (match["source"] or default).replace("|", "\\|")
            default = ASSUMED if default.startswith(ASSUMED) else default  # its note is given once
            rest = re.sub(r"^(\[[A-Z]\] ?)+", "", source)
            labels = source.removesuffix(rest).strip()
            note = rest.removeprefix(ASSUMED).strip(":; ")
            yield Value(table, match["key"], match["value"], labels, note)
