"""A folder of products of one kind: each an immutable HDF5 file, complete or absent."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from service import __version__
from service.archive.records import NOT_UNDERSTOOD, from_json, to_json
from service.errors import ArchiveError, StorageError
from service.tracking.products import MeasurementRecord, NoisyRecord, ReconstructorRecord
from service.wire import checksum

Provenance = str | int | float | bool | NDArray[Any]
"""What an HDF5 attribute can hold."""

DAMAGE = (OSError, RuntimeError, *NOT_UNDERSTOOD)
"""What h5py raises, depending on where a file is damaged."""

Record = TypeVar("Record", bound=ReconstructorRecord | MeasurementRecord | NoisyRecord)


class Store(Generic[Record]):
    """A folder of products; the file of each holds its matrix, a checksum and its record.

    What a call has written is on the disk when it returns.

    Parameters
    ----------
    directory
        The folder.
    noun
        What one of them is called in messages.
    kind
        Of the record.
    dataset
        Name of the matrix in a file.
    description
        Its axes and unit.
    """

    def __init__(
        self, directory: Path, noun: str, kind: type[Record], dataset: str, description: str
    ) -> None:
        self.directory = directory
        self.noun = noun
        self._kind = kind
        self._dataset = dataset
        self._description = description

    def path_of(self, product_id: str) -> Path:
        """Return where the file of a product is, or would be."""
        return self.directory / f"{product_id}.h5"

    def ids(self) -> list[str]:
        """Return the ids of all files that are there."""
        return [path.stem for path in sorted(self.directory.glob("*.h5"))]

    def prepare(self) -> tuple[str, ...]:
        """Make the folder, remove what was half-written; return a line for what will not go.

        Raises
        ------
        OSError
            If the folder cannot be made.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        told = []
        for leftover in sorted(self.directory.glob("*.part")):
            try:
                leftover.unlink()
            except OSError as error:
                told.append(f"{leftover}: cannot be removed and is left alone: {error.strerror}")
        return tuple(told)

    def write(
        self, record: Record, matrix: NDArray[np.float32], fill: Callable[[h5py.File], None]
    ) -> None:
        """Write a product for good; ``fill`` adds what only this kind has.

        Raises
        ------
        ArchiveError
            If there is a file of this id.
        StorageError
            If the disk refuses.
        """
        path = self.path_of(record.id)
        if path.exists():
            raise self.taken(record.id)

        def whole(file: h5py.File) -> None:
            file[self._dataset] = np.asarray(matrix, "<f4")
            file[self._dataset].attrs["description"] = self._description
            fill(file)
            file.attrs["sha256"] = checksum(matrix)
            file.attrs["software_version"] = __version__
            file.attrs["record"] = to_json(record)

        write_whole(path, whole)

    def taken(self, product_id: str) -> ArchiveError:
        """Return the error of an id that names another product already."""
        return ArchiveError(f"{self.noun} {product_id}: already stored, ids are never reused")

    def record(self, product_id: str) -> Record:
        """Return the record in a file, as it was when the file was made.

        Raises
        ------
        ArchiveError
            If the file is missing, damaged or holds another product than its name says.
        """
        path = self.path_of(product_id)
        with _opened(path) as file:
            record = from_json(file.attrs["record"], self._kind)
        if record.id != product_id:
            text = f"found {self.noun} {record.id} in it, expected {product_id}"
            raise ArchiveError(f"{path}: {text}")
        return record

    def matrix(self, product_id: str, sha256: str | None = None) -> NDArray[np.float32]:
        """Return the matrix in a file, verified.

        Parameters
        ----------
        product_id
            Of the product.
        sha256
            Checksum it must have; None: that in the file.

        Raises
        ------
        ArchiveError
            If the file is missing or damaged, or the matrix has another checksum.
        """
        path = self.path_of(product_id)
        with _opened(path) as file:
            matrix = np.asarray(file[self._dataset][()], np.float32)
            expected = sha256 or file.attrs["sha256"]
        found = checksum(matrix)
        if found != expected:
            raise ArchiveError(f"{path}: damaged: found checksum {found}, expected {expected}")
        return matrix

    def unsound(self, product_ids: Iterable[str]) -> dict[str, str]:
        """Return, by id, what is wrong with files that are missing or cut; none of it is read."""
        wrong = {}
        for name in product_ids:
            try:
                with _opened(self.path_of(name)) as file:
                    len(file[self._dataset])
            except ArchiveError as error:
                wrong[name] = str(error)
        return wrong

    def check_numbers(
        self, product_id: str, name: str, values: NDArray[Any], shape: tuple[int, ...]
    ) -> None:
        """Look whether an array that is to be stored is finite and of this shape.

        Raises
        ------
        ArchiveError
            If it is not.
        """
        if values.shape != shape or not np.isfinite(values).all():
            raise ArchiveError(
                f"{self.noun} {product_id}: found {name} of shape {values.shape}, expected a "
                f"finite one of {shape}"
            )

    def check_sum(self, product_id: str, matrix: NDArray[np.float32], sha256: str) -> None:
        """Look whether a matrix that is to be stored is the one its record speaks of.

        Raises
        ------
        ArchiveError
            If it is not.
        """
        found = checksum(matrix)
        if found != sha256:
            raise ArchiveError(
                f"{self.noun} {product_id}: found a matrix of checksum {found}, "
                f"expected {sha256} of its record"
            )


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Write a file that is complete or absent, and read-only.

    It is written under another name, flushed to the disk, then given its own name.

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


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: missing, although it was stored") from error
    except DAMAGE as error:
        raise ArchiveError(f"{path}: damaged: {error}") from error


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
