"""Find columns, rows, modes and functions that cannot be used, and name them by number.

A broken actuator or a pixel that failed leaves NaN, zeros or a copy of its neighbour. One of them
must not make the rest unusable, nor be left out silently.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import list_first

NOT_FINITE, ZERO = "NaN", "zero"
"""Reasons of entries that hold no numbers, and nothing but zeros."""

Defect = str | int
"""Reason why an entry cannot be used; a number is that of the earlier entry that it repeats."""

_LISTED = 12
"""Numbers that a message lists."""


def find_defects(values: NDArray[Any]) -> dict[int, Defect]:
    """Return the entries along the first axis that cannot be used, with the reason.

    An entry is unusable if it holds a NaN that not all others have at the same place (outside a
    pupil all may be unknown), if it is zero, or if it equals an earlier one.
    """
    array = np.asarray(values)
    flat = array.reshape(len(array), array[0].size if len(array) else 0)
    unknown = ~np.isfinite(flat)
    n_unknown = unknown.sum(axis=1)
    # The entry with the fewest: what it lacks, as outside a pupil, all others may lack.
    usual = unknown[int(np.argmin(n_unknown))] if len(flat) else np.zeros(0, bool)
    found: dict[int, Defect] = {}
    seen: dict[bytes, int] = {}
    for number, entry in enumerate(flat):
        if n_unknown[number] == flat.shape[1] or np.any(unknown[number] & ~usual):
            found[number] = NOT_FINITE
            continue
        if not (np.nan_to_num(entry) if n_unknown[number] else entry).any():
            found[number] = ZERO
            continue
        # a digest, for the entries of a large table would double the memory
        first = seen.setdefault(hashlib.blake2b(entry.tobytes()).digest(), number)
        if first != number:
            found[number] = first
    return found


def explain_defects(
    defects: Mapping[int, Defect], what: str, numbers: NDArray[Any] | None = None
) -> list[str]:
    """Return one note for each kind of defect: ``columns 3, 7 are zero: left out``.

    ``numbers`` are those by which a person knows the entries; None if they count from 0.
    """

    def known(entry: int) -> int:
        return entry if numbers is None else int(numbers[entry])

    listed: dict[str, list[str]] = {"not finite": [], "zero": [], "copies": []}
    for entry, reason in sorted(defects.items()):
        if isinstance(reason, int):
            listed["copies"].append(f"{known(entry)} (of {known(reason)})")
        else:
            listed["not finite" if reason == NOT_FINITE else "zero"].append(str(known(entry)))
    notes = []
    for kind, entries in listed.items():
        text = list_first(entries, _LISTED)
        if len(entries) == 1:
            notes.append(f"{what} {text} is {'a copy' if kind == 'copies' else kind}: left out")
        elif entries:
            notes.append(f"{what}s {text} are {kind}: left out")
    return notes


def list_ranges(numbers: NDArray[np.integer], n_listed: int = _LISTED) -> str:
    """Return numbers as ranges, ends included: ``0 to 5, 9, ...`` where there are more."""
    numbers = np.sort(numbers)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    words = [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs[:n_listed]]
    return ", ".join(words) + (", ..." if len(runs) > n_listed else "")
