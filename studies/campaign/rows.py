"""The rows of a campaign: a file that a run which was ended goes on with, and a table of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

Row = dict[str, Any]


class RowFile:
    """Rows in a file, one JSON object a line; it is made if it is not there."""

    def __init__(self, path: Path) -> None:
        path.touch()  # a folder that is not there is said before anything is played
        self._path = path
        self.rows: list[Row] = [json.loads(line) for line in path.read_text().splitlines()]
        """All there are, those of earlier runs first."""

    def add(self, *rows: Row) -> None:
        """Keep more rows; they are in the file when this returns."""
        self.rows += rows
        with self._path.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


def tell(text: str, path: Path | None, program: str) -> None:
    """Print a table; with a ``path`` also write it there, below the command that made it."""
    sys.stdout.write(text)
    if path is not None:
        path.write_text(f"Made by `{' '.join([program, *sys.argv[1:]])}`.\n\n{text}")


def range_of(text: str) -> range:
    """Return the range that ``FIRST:END`` names; END is not in it."""
    first, end = text.split(":")
    return range(int(first), int(end))
