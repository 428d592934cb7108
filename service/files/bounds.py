"""Limits on the depth and the number of objects of an HDF5 file, checked before they are read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import h5py

from service.errors import MatrixError

MAX_DEPTH = 32
"""Groups within groups of an HDF5 file."""

MAX_OBJECTS = 10_000
"""Groups, datasets and links of an HDF5 file, and attributes of it."""


def datasets(file: h5py.File, path: Path) -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield the datasets of an HDF5 file with their names; no link leads anywhere else.

    Raises
    ------
    MatrixError
        If its groups are too many, or too deep.
    """
    seen = {h5py.h5o.get_info(file.id).addr}
    open_groups = [("", file["/"])]
    while open_groups:
        prefix, group = open_groups.pop()
        check_number(len(seen) + len(group), path)
        if prefix.count("/") > MAX_DEPTH:
            _refuse(str(path), f"more than {MAX_DEPTH} groups within each other", "no more")
        within = []
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                continue
            seen.add(address)
            if isinstance(item, h5py.Dataset):
                yield f"{prefix}{name}", item
            elif isinstance(item, h5py.Group):
                within.append((f"{prefix}{name}/", item))
        open_groups += reversed(within)


def check_number(n_objects: int, path: Path) -> None:
    """Refuse an HDF5 file of too many things.

    Raises
    ------
    MatrixError
        If it has so many.
    """
    if n_objects > MAX_OBJECTS:
        _refuse(str(path), f"more than {MAX_OBJECTS} groups, datasets or links", "no more")


def attributes(file: h5py.File, path: Path) -> dict[str, Any]:
    """Return the attributes of an HDF5 file.

    Raises
    ------
    MatrixError
        If they are too many.
    """
    if len(file.attrs) > MAX_OBJECTS:
        _refuse(str(path), f"{len(file.attrs)} attributes", f"at most {MAX_OBJECTS}")
    return dict(file.attrs)


def _refuse(where: str, found: str, expected: str) -> NoReturn:
    raise MatrixError(f"{where}: found {found}, expected {expected}")
