"""Bound what a file claims before a library reads it: depths, numbers of things, shapes.

Libraries trust a header: one of a negative axis has astropy read the same block for ever.
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NoReturn, cast

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


# --- FITS: the keywords that say how long each part is


BLOCK, CARD = 2880, 80
"""Bytes of a FITS file's blocks and of a line of its headers."""

MAX_HDUS = 1000
MAX_AXES = 8
MAX_HEADER_BLOCKS = 1000
"""36,000 lines of a header."""

MAX_DATA_BYTES = 8 << 30
"""Of all parts of one file, unpacked."""

_SIZES = re.compile(rb"(BITPIX|Z?NAXIS\d{0,3}|[PG]COUNT) *= *([^ /]*)")
_WHOLE = re.compile(rb"[+-]?\d{1,18}")
_BITS = (8, 16, 32, 64, -32, -64)


def check_fits(path: Path) -> None:
    """Refuse a FITS file, gzipped or not, whose headers claim what cannot be.

    Raises
    ------
    MatrixError
        If it does: a negative axis, a hundred of them, a part beyond all files.
    """
    n_bytes = 0
    try:
        with _unpacked(path) as file:
            for number in range(MAX_HDUS + 1):
                where = f"{path}[{number}]"
                sizes = _sizes_of(file, where)
                if sizes is None:
                    return
                part_bytes = _data_bytes(sizes, where)
                n_bytes += part_bytes
                if n_bytes > MAX_DATA_BYTES:
                    _refuse(where, f"{n_bytes / 1e9:.3g} GB of data", "at most 8 GB")
                file.seek(-(-part_bytes // BLOCK) * BLOCK, 1)
    except (OSError, EOFError, zlib.error) as error:
        raise MatrixError(f"{path}: damaged FITS file: {error}") from error
    _refuse(str(path), f"more than {MAX_HDUS} parts", "no more")


def _unpacked(path: Path) -> IO[bytes]:
    with path.open("rb") as file:
        is_packed = file.read(2) == b"\x1f\x8b"
    return cast("IO[bytes]", gzip.open(path)) if is_packed else path.open("rb")


def _sizes_of(file: IO[bytes], where: str) -> dict[str, int] | None:
    """Return the numbers of the next header that tell a size; None: there is no further header."""
    sizes: dict[str, int] = {}
    for n_block in range(MAX_HEADER_BLOCKS):
        block = file.read(BLOCK)
        if n_block == 0 and block[:8] not in {b"SIMPLE  ", b"XTENSION"}:
            return None  # blocks of another kind may follow the last part
        for start in range(0, len(block), CARD):
            card = block[start : start + CARD]
            if card[:8].rstrip() == b"END":
                return sizes
            _note_size(sizes, card, where)
        if len(block) < BLOCK:
            break
    return _refuse(where, "a header that does not end", "END")


def _note_size(sizes: dict[str, int], card: bytes, where: str) -> None:
    match = _SIZES.match(card)
    if match is None:
        return
    keyword, value = match[1].decode(), match[2]
    if keyword in sizes:
        _refuse(where, f"{keyword} twice", "it once")
    if _WHOLE.fullmatch(value) is None:
        _refuse(where, f"{keyword} = {value.decode(errors='replace')}", "a whole number")
    sizes[keyword] = int(value)
    if sizes[keyword] < 0 and keyword != "BITPIX":
        _refuse(where, f"{keyword} = {sizes[keyword]}", "no negative number")
    if keyword in {"NAXIS", "ZNAXIS"} and sizes[keyword] > MAX_AXES:
        _refuse(where, f"{keyword} = {sizes[keyword]}", f"at most {MAX_AXES} axes")


def _data_bytes(sizes: dict[str, int], where: str) -> int:
    """Return how many bytes of data follow a header."""
    if sizes.get("BITPIX") not in _BITS:
        _refuse(where, f"BITPIX = {sizes.get('BITPIX')}", "one of 8, 16, 32, 64, -32, -64")
    try:
        axes = [sizes[f"NAXIS{k + 1}"] for k in range(sizes["NAXIS"])]
    except KeyError as error:
        _refuse(where, f"no {error.args[0]}", "it")
    if not axes:
        return 0
    n_values = sizes.get("PCOUNT", 0) + math.prod(axes if axes[0] else axes[1:])
    return abs(sizes["BITPIX"]) // 8 * sizes.get("GCOUNT", 1) * n_values


def _refuse(where: str, found: str, expected: str) -> NoReturn:
    raise MatrixError(f"{where}: found {found}, expected {expected}")
