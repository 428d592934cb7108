"""Print answers to standard output, everything else to standard error."""

from __future__ import annotations

import getpass
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from service.errors import say, shown


def login() -> str:
    """Return the login name; empty if there is none."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container may run under a number that has no name
        return ""


def show_progress(step: str) -> None:
    """Show progress at a terminal, but not in a log."""
    if sys.stderr.isatty():
        say(f"... {step}")


def print_document(document: dict[str, Any], indent: int | None = 2) -> None:
    """Print a document of REST."""
    print(json.dumps(document, indent=indent).replace("\x7f", "\\u007f"), flush=True)


def print_lines(lines: Iterable[str]) -> None:
    """Print lines that may quote untrusted text."""
    sys.stdout.writelines(f"{shown(line)}\n" for line in lines)
    sys.stdout.flush()


def table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield rows as lines with columns of equal width, except the last."""
    clean = [[shown(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*clean, strict=True)]
    for row in clean:
        cells = [cell.ljust(width) for cell, width in zip(row[:-1], widths, strict=False)]
        yield "  ".join([*cells, row[-1]])


def clock(utc: str | None) -> str:
    """Return a time from REST for people: to the second, Z for UTC."""
    return "?" if utc is None else f"{utc[:10]} {utc[11:19]}Z"


def span(seconds: float) -> str:
    """Return a duration in seconds as text for people."""
    for unit_s, unit, smaller_s, smaller in (
        (86_400.0, "d", 3600.0, "h"),
        (3600.0, "h", 60.0, "min"),
        (60.0, "min", 1.0, "s"),
    ):
        if seconds >= unit_s:
            return f"{seconds // unit_s:.0f} {unit} {seconds % unit_s // smaller_s:.0f} {smaller}"
    return f"{seconds:.2g} s" if seconds < 10.0 else f"{seconds:.0f} s"
