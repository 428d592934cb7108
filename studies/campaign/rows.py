"""The rows of a campaign: a file that a run which was ended goes on with, and a table of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Row = dict[str, Any]

UNITS = np.array([100.0, 100.0, 1000.0, 100.0])
"""An α is printed in % of a subaperture, thousandths of a degree, %."""


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


def heading(*columns: str) -> str:
    """Return the head of a Markdown table."""
    return line(*columns) + "|---" * len(columns) + "|\n"


def line(*cells: object) -> str:
    """Return a line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |\n"


def four(values: NDArray[np.float64]) -> str:
    """Return the four numbers of an α as one cell."""
    return " ".join(f"{value:.2f}" for value in values)


def tell(text: str, path: Path | None, program: str) -> None:
    """Print a table; with a ``path`` also write it there, below the command that made it."""
    sys.stdout.write(text)
    if path is not None:
        path.write_text(f"Made by `{' '.join([program, *sys.argv[1:]])}`.\n\n{text}")


def range_of(text: str) -> range:
    """Return the range that ``FIRST:END`` names; END is not in it."""
    first, end = text.split(":")
    return range(int(first), int(end))
