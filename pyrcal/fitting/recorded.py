"""A measured interaction matrix in an HDF5, FITS, NumPy or MATLAB file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError
from service.files.container import DATASET, Container, StoredArray, check_number, opened
from service.files.whole import open_hdf5

Array = NDArray[np.float64]


def check_sealed(path: Path) -> None:
    """Raise if an HDF5 file refers to data outside itself; other formats cannot.

    Raises
    ------
    MatrixError
        If it contains a link to another file, a virtual dataset or external data, if it is damaged,
        or if it has too many members.
    """
    if not h5py.is_hdf5(path):
        return
    try:
        with open_hdf5(path) as file:
            # By address, because hard links may form a cycle without an end.
            seen = {h5py.h5o.get_info(file.id).addr}
            groups, n_links = [file["/"]], 0
            while groups:
                n_links += len(groups[-1])
                check_number(n_links, path)
                groups += _check_group(groups.pop(), path, seen)
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise MatrixError(f"{path}: damaged HDF5 file: {error}") from error


def _check_group(group: h5py.Group, path: Path, seen: set[int]) -> list[h5py.Group]:
    """Check the members of a group without following links; return groups not ``seen`` yet."""
    found = []
    for name in group:
        link = group.get(name, getlink=True)
        # Only hard links are opened, since opening an external one would read another file.
        item = group[name] if isinstance(link, h5py.HardLink) else link
        beyond = _find_outside_data(item)
        if beyond is not None:
            where = f"{path}:{group.name.rstrip('/')}/{name}"
            raise MatrixError(f"{where}: found {beyond}, expected all data in the file itself")
        if isinstance(item, h5py.Group):
            address = h5py.h5o.get_info(item.id).addr
            if address not in seen:
                seen.add(address)
                found.append(item)
    return found


def _find_outside_data(item: object) -> str | None:
    """Return the reference of an object or link to other files; None if there is none."""
    if isinstance(item, h5py.ExternalLink):
        return f"a link to another file, {item.filename}"
    if isinstance(item, h5py.Dataset) and item.is_virtual:
        files = sorted({source.file_name for source in item.virtual_sources()})
        return f"a virtual dataset of other files, {', '.join(files)}"
    if isinstance(item, h5py.Dataset) and item.external:
        return f"data outside, in {item.external[0][0]}"
    return None


FLUX_FRAME = "flux_frame"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """Arrays exactly as read from the file."""

    values: Array
    """``(n_slopes, n_modes)`` in the RTC's own order, or ``(n_modes, ny, nx)`` detector frames."""

    modes: NDArray[np.intp] | None
    """``(n_modes,)`` basis index of each column; None if the file does not give it."""

    noise: Array | None
    """``(n_modes,)`` 1 σ of an element of each column; None if the file does not give it."""

    double_pass: bool | None
    """True if the light was reflected by the mirror twice; None if the file does not give it."""

    flux_frame: Array | None
    """``(ny, nx)`` detector frame without commands; None if the file has none."""

    where: str
    """File and array, for messages."""

    sha256: str
    """SHA-256 of the whole file, 64 lower-case hex digits."""

    remark: str = ""
    """Notes on the values for the user; empty if there are none."""


def read_recorded(path: Path, dataset: str | None = None) -> Recorded:
    """Read a measured matrix from an HDF5, FITS, NumPy or MATLAB file.

    In the same HDF5 group, or as further FITS extensions, ``modes`` (``(n_modes,)``, basis
    indices), ``noise`` (``(n_modes,)``) and ``flux_frame`` are read if present. ``modes`` and
    ``double_pass`` may also be attributes of an HDF5 file, ``DBLPASS`` a keyword of a FITS file.

    Parameters
    ----------
    path
        The file.
    dataset
        Name of the array; None for ``interaction_matrix``, or the only one of a FITS or NumPy file.

    Raises
    ------
    MatrixError
        If the file or the array cannot be used; a missing array is reported with the names present.
    """
    with opened(path) as container:
        stored = _matrix(container, dataset)
        if len(stored.shape) not in {2, 3}:
            raise MatrixError(
                f"{stored.where}: found shape {stored.shape}, expected (n_slopes, n_modes), or "
                '(n_modes, ny, nx) where wfs.input = "frames"'
            )
        # Further arrays belong to the matrix next to them: a file may hold several matrices in
        # groups.
        group = (dataset or DATASET).strip("/").rpartition("/")[0]
        # A cube of frames has its modes along the first axis, a matrix of slopes along the second.
        n_modes = stored.shape[1 if len(stored.shape) == 2 else 0]

        def find_sibling(name: str) -> StoredArray | None:
            return container.find(f"{group}/{name}")

        return Recorded(
            values=stored.numbers(),
            modes=_modes(container, find_sibling("modes"), n_modes),
            noise=_noise(find_sibling("noise"), n_modes),
            double_pass=_double_pass(container),
            flux_frame=_numbers(find_sibling(FLUX_FRAME)),
            where=stored.where,
            sha256=file_sha256(path),
            remark=stored.remark,
        )


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hex.

    Raises
    ------
    MatrixError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise MatrixError(f"{path}: cannot be read: {error.strerror or error}") from error


def _matrix(container: Container, dataset: str | None) -> StoredArray:
    found = container.find(dataset or DATASET)
    # A FITS extension need not have a name, so the only one is taken.
    if found is None and dataset is None and container.is_fits and len(container.arrays) == 1:
        (found,) = container.arrays.values()
    if found is None:
        raise MatrixError(
            f"{container.path}: no dataset {dataset or DATASET}; it holds {container.listing()}; "
            "name one of them with --dataset"
        )
    return found


def _modes(
    container: Container, stored: StoredArray | None, n_modes: int
) -> NDArray[np.intp] | None:
    given: Any = container.facts.get("modes")
    where = f"{container.path}: modes"
    if stored is not None and len(stored.shape) == 1:  # a cube of this name is the modes' shapes
        given = stored.numbers()
    if given is None:
        return None
    values = np.asarray(given)
    if values.shape != (n_modes,):
        raise MatrixError(
            f"{where}: found shape {values.shape}, expected one for each of {n_modes}"
        )
    if values.dtype.kind not in "iuf" or not np.all((values >= 0) & (values == np.round(values))):
        raise MatrixError(f"{where}: found {values}, expected 0-based indices of the basis")
    indices = values.astype(np.intp)
    kinds, times = np.unique(indices, return_counts=True)
    if np.any(times > 1):
        # Two columns of one mode could have different gains, of which the fit has one.
        twice = kinds[times > 1][0]
        raise MatrixError(f"{where}: found mode {twice} more than once, expected each once")
    return indices


def _noise(stored: StoredArray | None, n_modes: int) -> Array | None:
    values = _numbers(stored)
    if stored is None or values is None:
        return None
    if values.shape != (n_modes,) or not np.all(values > 0.0):
        least = f", least value {np.min(values):g}" if values.size else ""
        raise MatrixError(
            f"{stored.where}: found shape {values.shape}{least}; "
            f"expected the positive 1 sigma of an element for each of {n_modes} columns"
        )
    return values


def _double_pass(container: Container) -> bool | None:
    given = container.facts.get("double_pass", container.facts.get("dblpass"))
    if given is None:
        return None
    flag = np.asarray(given)
    if flag.ndim == 0 and (flag.dtype.kind == "b" or (flag.dtype.kind in "iuf" and flag in (0, 1))):
        return bool(flag)
    raise MatrixError(f"{container.path}: double_pass: found {given!r}, expected true or false")


def _numbers(stored: StoredArray | None) -> Array | None:
    return None if stored is None else stored.numbers()
