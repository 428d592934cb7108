"""One reconstructor in one HDF5 file: complete or absent, never changed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from service import __version__
from service.archive.records import record_from_json, record_to_json
from service.errors import ArchiveError, StorageError
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.reactions.gain_tables import table_of
from service.state import ReconstructorRecord
from service.wire import checksum

Provenance = str | int | float | bool | NDArray[Any]
"""What an HDF5 attribute can hold."""

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)
"""What h5py raises, depending on where a file is damaged."""


def write_product(
    path: Path,
    record: ReconstructorRecord,
    matrix: NDArray[np.float32],
    covariance: NDArray[np.float64] | None,
    provenance: Mapping[str, Provenance],
) -> None:
    """Write the file under another name, flush it to the disk, then give it its own name.

    Raises
    ------
    StorageError
        If the disk refuses.
    """

    def fill(file: h5py.File) -> None:
        _fill(file, record, np.asarray(matrix, "<f4"), covariance)
        file.create_group("provenance").attrs.update(provenance)

    write_whole(path, fill)


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Write a file that is complete or absent, and read-only.

    Raises
    ------
    StorageError
        If the disk refuses.
    """
    part = path.with_name(path.name + ".part")
    try:
        with h5py.File(part, "w") as file:
            fill(file)
        part.chmod(0o444)
        _flush(part)
        part.rename(path)
        _flush(path.parent)
    except (OSError, RuntimeError) as error:
        part.unlink(missing_ok=True)
        raise StorageError(f"{path}: cannot be written: {error}") from error


def swept(directory: Path) -> tuple[str, ...]:
    """Make a directory and remove what was half-written; return a line for what will not go.

    Raises
    ------
    OSError
        If the directory cannot be made.
    """
    directory.mkdir(parents=True, exist_ok=True)
    told = []
    for leftover in sorted(directory.glob("*.part")):
        try:
            leftover.unlink()
        except OSError as error:
            told.append(f"{leftover}: cannot be removed and is left alone: {error.strerror}")
    return tuple(told)


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a product to read it.

    Raises
    ------
    ArchiveError
        If the file is missing or damaged.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: missing, although it was stored") from error
    except DAMAGE as error:
        raise ArchiveError(f"{path}: damaged: {error}") from error


def check_whole(path: Path, dataset: str) -> None:
    """Look whether a product is there and not cut, without reading its numbers.

    Raises
    ------
    ArchiveError
        If it is missing or damaged.
    """
    with opened(path) as file:
        len(file[dataset])


def read_matrix(path: Path) -> NDArray[np.float32]:
    """Return the reconstructor of a file, ``(n_modes, n_slopes)``.

    Raises
    ------
    ArchiveError
        If the file is missing or damaged.
    """
    with opened(path) as file:
        return _matrix(file)


def write_fate(path: Path, record: ReconstructorRecord) -> None:
    """Write beside a product what has become of it, for the day when the index is lost.

    Raises
    ------
    StorageError
        If the disk refuses.
    """
    part = path.with_suffix(".json.part")
    try:
        part.write_text(record_to_json(record), encoding="utf-8")
        part.replace(path.with_suffix(".json"))
    except OSError as error:
        raise StorageError(f"{part}: cannot be written: {error}") from error


def read_fate(path: Path) -> ReconstructorRecord | None:
    """Return what has become of a product; None: nothing is known of it."""
    try:
        record = record_from_json(path.with_suffix(".json").read_text(encoding="utf-8"))
    except DAMAGE:
        return None
    return record if record.id == path.stem else None


def read_product(path: Path) -> tuple[ReconstructorRecord, NDArray[np.float32]]:
    """Return the record as it was when the file was made, and the verified reconstructor.

    Raises
    ------
    ArchiveError
        If the file is damaged or holds another product than its name says.
    """
    with opened(path) as file:
        record = record_from_json(file.attrs["record"])
        matrix = _matrix(file)
        sha256 = file.attrs["sha256"]
    if record.id != path.stem:
        raise ArchiveError(f"{path}: found reconstructor {record.id} in it, expected {path.stem}")
    if checksum(matrix) != sha256:
        raise ArchiveError(f"{path}: damaged: found checksum {checksum(matrix)}, expected {sha256}")
    return record, matrix


def _matrix(file: h5py.File) -> NDArray[np.float32]:
    return np.asarray(file["reconstructor"][()], np.float32)


def _fill(
    file: h5py.File,
    record: ReconstructorRecord,
    matrix: NDArray[np.float32],
    covariance: NDArray[np.float64] | None,
) -> None:
    file["reconstructor"] = matrix
    file["reconstructor"].attrs["description"] = "(n_modes, n_slopes), metres OPD per slope"
    file.attrs.update(_attributes(record))
    file.attrs["sha256"] = checksum(matrix)
    file.attrs["software_version"] = __version__
    file.attrs["record"] = record_to_json(record)
    if record.optical_gains:
        _add_gains(file, record)
    if covariance is not None:
        file["covariance"] = covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
        file["covariance"].attrs["parameters"] = PARAMETERS


def _add_gains(file: h5py.File, record: ReconstructorRecord) -> None:
    """Put the table of loop gains beside the matrix, which knows nothing of it."""
    table = table_of(record.optical_gains, record.n_modes)
    group = file.create_group("gains")
    group.attrs["description"] = "optical gain of every mode; not part of the reconstructor"
    group.attrs["measured_modes"] = [gain.mode for gain in record.optical_gains]
    group.attrs["measured_gain"] = [gain.gain for gain in record.optical_gains]
    group.attrs["measured_sigma"] = [gain.sigma for gain in record.optical_gains]
    group["optical_gain"] = table.optical_gain
    group["relative_sigma"] = table.relative_sigma
    group["factor"] = table.factors
    group["factor"].attrs["description"] = "multiplies one loop gain for all modes"


def _attributes(record: ReconstructorRecord) -> dict[str, Provenance]:
    """Return what a person wants to see in the file, each with its unit in its name."""
    values: dict[str, Provenance] = {
        "id": record.id,
        "n_modes": record.n_modes,
        "created_ns_utc": record.created_ns_utc,
        "parent": record.parent or "",
    }
    if record.alpha is not None:
        values |= record.alpha.to_boundary()
    if record.sigma is not None:
        sigma = record.sigma * BOUNDARY_SCALE
        values |= {f"sigma_{p}": float(s) for p, s in zip(PARAMETERS, sigma, strict=True)}
    if record.condition_number is not None:
        values["condition_number"] = record.condition_number
    if record.gate is not None:
        values["worst_pole_radius"] = record.gate.worst_pole_radius
    return values


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
