"""The folders of products: files, and rows of the index."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Generic, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.archive.index import Index, Product, begun_ns_utc
from service.archive.serialisation import NOT_UNDERSTOOD, from_json, to_json
from service.errors import ArchiveError, StorageError, UnknownIdError
from service.files.whole import open_hdf5, write_whole
from service.version import software_version
from service.wire import checksum, validate_id

Provenance = str | int | float | bool | NDArray[Any]
"""Types that an HDF5 attribute can hold."""

DAMAGE = (OSError, RuntimeError, *NOT_UNDERSTOOD)
"""Errors raised by h5py, depending on where a file is damaged."""

Record = TypeVar("Record", bound=Product)


FOLDER_MODE = 0o700
"""Permissions of a new folder: the orders of a night and the persons who gave them are private."""


class Folder:
    """Folder with an HDF5 file for each product, and a JSON file with its record."""

    noun: str
    """Name of such a product in messages."""

    counted = True
    """True if they count in ``keep_gb``."""

    lost_with_it = "it cannot be fitted or compared any more; what is known of it is in the index"
    """Consequence of a damaged file, for messages."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def path_of(self, product_id: str) -> Path:
        """Return where the file of one is, or would be."""
        return self.directory / f"{product_id}.h5"

    def prepare(self) -> tuple[str, ...]:
        """Make the folder, remove what was half-written; return a line for what will not go.

        Raises
        ------
        OSError
            If the folder cannot be made.
        """
        self.directory.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        lines = []
        for leftover in sorted(self.directory.glob("*.part")):
            try:
                leftover.unlink()
            except OSError as error:
                lines.append(f"{leftover}: cannot be removed and is left alone: {error.strerror}")
        return tuple(lines)

    def remove(self, product_id: str) -> None:
        """Remove one.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        try:
            # what became of it goes last: without that a file taken in again would be as when made
            for path in (self.path_of(product_id), self.path_of(product_id).with_suffix(".json")):
                path.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(f"{path}: cannot be removed: {error}") from error

    def kept(self, _records: Iterable[Any]) -> dict[str, str]:
        """Return, by id, why some of them are kept for ever whatever their age."""
        return {}


class Store(Folder, Generic[Record]):
    """Products of one kind: their files, and their table in the index.

    The file of each holds its matrix, a checksum and its record. What a call has written is on the
    disk when it returns. Belongs to an :class:`~service.archive.Archive`, which opens it.
    """

    kind: type[Record]
    """Type of their records."""

    described: str
    """Axes and unit of the matrix."""

    dataset = "interaction_matrix"
    """Name of the matrix in a file."""

    def __init__(self, directory: Path, index: Index) -> None:
        super().__init__(directory)
        self._index = index
        self._table = self.noun.replace(" ", "_")
        self._unsound: dict[str, str] = {}
        self._stand_ins: dict[str, Record] = {}

    def stored(self) -> frozenset[str]:
        """Return the ids of the products whose numbers are stored."""
        return frozenset(self._index.checksums(self._table))

    @override
    def remove(self, product_id: str) -> None:
        """Remove the numbers of one; what is known of it stays in the index.

        The index forgets them first: one that is killed in between takes the file in again.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        self._index.forget_numbers(self._table, product_id)
        super().remove(product_id)

    def adopt(self, *, anew: bool) -> list[str]:
        """Index complete files that the index lacks; the argument is True for a new index.

        Returns
        -------
        A line for each missing or damaged file, and for each unreadable record.
        """
        known, lines = self._index.checksums(self._table), []
        for path in sorted(self.directory.glob("*.h5")):
            # Written before its row in the index: a service killed in between left it without one.
            if path.stem not in known:
                try:
                    record, matrix = self._record(path.stem), self._matrix(path.stem)
                except ArchiveError as error:
                    lines.append(str(error))
                else:
                    became = self._became(record, anew=anew)
                    self._index.add(self._table, became, checksum(matrix))
        _, wrong = self._index.records(self._table, self.kind)
        # Only opened here: the checksums of all matrices would take minutes, and each is verified
        # when it is read.
        self._unsound = self._find_damage(sorted(known.keys() - wrong.keys()))
        self._stand_ins.clear()
        for name in wrong:
            # A product that is damaged as well is reported by its file.
            with contextlib.suppress(ArchiveError):
                self._stand_ins[name] = self._became(self._record(name), anew=False)
        return [*lines, *self._unsound.values(), *wrong.values()]

    def records(self) -> tuple[Record, ...]:
        """Return the records of all products, oldest first.

        A record that cannot be read is replaced by the one inside its product.
        """
        understood, wrong = self._index.records(self._table, self.kind)
        known = [*understood, *(r for name, r in self._stand_ins.items() if name in wrong)]
        return tuple(sorted(known, key=begun_ns_utc))

    def matrix(self, product_id: str) -> NDArray[np.float32]:
        """Return a matrix, its checksum verified.

        Raises
        ------
        UnknownIdError
            If none of this id was ever stored here.
        ArchiveError
            If its file is missing, damaged, or holds other numbers than were stored.
        """
        sha256 = self._index.checksums(self._table).get(product_id)
        if sha256 is None:
            raise UnknownIdError(f"{self.noun} {product_id}: no such matrix in the archive")
        return self._matrix(product_id, sha256)

    def file(self, product_id: str) -> Path:
        """Return where the HDF5 file is, as it was written, once its matrix is verified.

        Raises
        ------
        UnknownIdError, ArchiveError
            As :meth:`matrix`.
        """
        self.matrix(product_id)
        return self.path_of(product_id)

    def _became(self, record: Record, *, anew: bool) -> Record:
        """Return what has become of a product, as far as is known without the index."""
        return record

    def _write(
        self,
        record: Record,
        matrix: NDArray[np.float32],
        shape: tuple[int, ...],
        sha256: str | None,
        fill: Callable[[h5py.File], None],
    ) -> None:
        """Write a product for good; ``fill`` adds what only this kind has.

        One whose file is damaged or missing is written again, if these are its numbers; a damaged
        file that the index does not know is put aside.

        Raises
        ------
        ArchiveError
            If the id is taken, or the matrix not of this shape and checksum.
        StorageError
            If the disk refuses.
        WireError
            If the id is not one.
        """
        validate_id(record.id, f"a {self.noun} to be stored")
        path, found = self.path_of(record.id), checksum(matrix)
        self._check_numbers(record, "a matrix", matrix, shape)
        if found != (sha256 or found):
            raise ArchiveError(
                f"{self.noun} {record.id}: found a matrix of checksum {found}, "
                f"expected {sha256} of its record"
            )
        taken = ArchiveError(f"{self.noun} {record.id}: already stored, ids are never reused")
        known = self._index.checksums(self._table).get(record.id)
        if self._is_sound(record.id, known) or known not in {None, found}:
            raise taken
        if known is None and path.exists():
            # Kept for inspection: it may be the only trace of what was stored.
            path.replace(path.with_suffix(".damaged"))

        def whole(file: h5py.File) -> None:
            file[self.dataset] = np.asarray(matrix, "<f4")
            file[self.dataset].attrs["description"] = self.described
            fill(file)
            file.attrs["id"] = record.id
            file.attrs["sha256"] = found
            file.attrs["software_version"] = software_version()
            file.attrs["record"] = to_json(record)

        write_whole(path, whole)
        # Entered last: an index entry without its file would be a product that is missing.
        if not self._index.add(self._table, record, found) and known is None:
            raise taken
        self._unsound.pop(record.id, None)

    def _check_numbers(
        self, record: Record, name: str, values: NDArray[Any], shape: tuple[int, ...]
    ) -> None:
        if values.shape != shape or not np.isfinite(values).all():
            raise ArchiveError(
                f"{self.noun} {record.id}: found {name} of shape {values.shape}, expected a "
                f"finite one of {shape}"
            )

    def _record(self, product_id: str) -> Record:
        """Return the record in a file, as it was when the file was made."""
        path = self.path_of(product_id)
        with _open_product(path) as file:
            record = from_json(file.attrs["record"], self.kind)
        if record.id != product_id:
            text = f"found {self.noun} {record.id} in it, expected {product_id}"
            raise ArchiveError(f"{path}: {text}")
        return record

    def _matrix(self, product_id: str, sha256: str | None = None) -> NDArray[np.float32]:
        """Return the matrix in a file, which must have this checksum, or else that in the file."""
        path = self.path_of(product_id)
        with _open_product(path) as file:
            matrix = np.asarray(file[self.dataset][()], np.float32)
            expected = sha256 or file.attrs["sha256"]
        found = checksum(matrix)
        if found != expected:
            raise ArchiveError(f"{path}: damaged: found checksum {found}, expected {expected}")
        return matrix

    def _is_sound(self, product_id: str, sha256: str | None) -> bool:
        """Return whether the file of one is there and holds the numbers that were stored."""
        try:
            self._matrix(product_id, sha256)
        except ArchiveError:
            return False
        return True

    def _find_damage(self, product_ids: Iterable[str]) -> dict[str, str]:
        """Return, by id, what is wrong with files that are missing or cut; none of it is read."""
        wrong = {}
        for name in product_ids:
            try:
                with _open_product(self.path_of(name)) as file:
                    len(file[self.dataset])
            except ArchiveError as error:
                wrong[name] = str(error)
        return wrong


@contextlib.contextmanager
def _open_product(path: Path) -> Iterator[h5py.File]:
    try:
        with open_hdf5(path) as file:
            yield file
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: missing, although it was stored") from error
    except DAMAGE as error:
        raise ArchiveError(f"{path}: damaged: {error}") from error
