"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; the first column is text, the others are what they are."""
    lines = [_row(head), _row(["---"] * len(head))]
    return "\n".join([*lines, *(_row(row) for row in rows)])


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def listed(values: Iterable[float], spec: str = ".1f", between: str = " / ") -> str:
    """Return numbers one after the other."""
    return between.join(f"{value:{spec}}" for value in values)


def with_scatter(found: NDArray[np.float64], spec: str = ".1f") -> list[str]:
    """Return the mean over telescopes of each column and, of several, its scatter."""
    if len(found) == 1:
        return [f"{value:{spec}}" for value in found[0]]
    scatter = found.std(axis=0, ddof=1)
    return [f"{m:{spec}} ± {s:{spec}}" for m, s in zip(found.mean(axis=0), scatter, strict=True)]


def met(*, reached: bool) -> str:
    """Return whether a target was reached."""
    return "reached" if reached else "**not reached**"
