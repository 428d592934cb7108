"""The archive as the rest of the service sees it."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Self

import numpy as np
from numpy.typing import NDArray

from service.archive.index import AuditEntry, Index
from service.archive.measured import MeasuredArchive
from service.archive.noisy import NoisyArchive
from service.archive.product import (
    Provenance,
    check_whole,
    read_fate,
    read_matrix,
    read_product,
    swept,
    write_fate,
    write_product,
)
from service.archive.tracking import TrackingFile
from service.errors import ArchiveError, StorageError, UnknownIdError
from service.state import MatrixState, ReconstructorRecord
from service.wire import checked_id, checksum

PROBE_BYTES = 1 << 20
"""Least that must fit on the disk for it to be called writable."""


class Archive:
    """Reconstructors, their states and the audit trail, below one directory.

    A call returns when what it wrote is on the disk, so a service killed at any moment finds after
    its restart everything it was told is stored, and nothing half-written. Calls may come from
    any thread and are carried out one at a time; a call waits for the disk (tens of milliseconds
    for a FLAO matrix), so it does not belong on an event loop that serves others.

    Parameters
    ----------
    directory
        Made by :meth:`open` where it does not exist.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._products = directory / "reconstructors"
        self._index = Index(directory / "index.sqlite")
        self.measured = MeasuredArchive(directory / "interaction_matrices", self._index)
        """Interaction matrices the RTC has measured."""
        self.noisy = NoisyArchive(directory / "noisy_matrices")
        """Noisy interaction matrices of random dithers."""
        self.tracking = TrackingFile(directory / "tracking.json")
        """What is known of the registration, for the service after this one."""
        self._lock: IO[str] | None = None
        self._largest_bytes = PROBE_BYTES
        self._unsound: dict[str, str] = {}
        self._stand_ins: dict[str, ReconstructorRecord] = {}
        self.wrong: tuple[str, ...] = ()
        """What :meth:`open` has found wrong, a line for each."""

    def __enter__(self) -> Self:
        """Use an archive that is open; it is closed at the end."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def open(self) -> tuple[str, ...]:
        """Make the directory, open the index and bring it up to date with the products.

        A product that was complete but not yet in the index when the service was killed is taken
        in now; what was half-written is removed. An index that is not there is made of the products
        and of what lies beside each on what became of it.

        Returns
        -------
        One line for each thing that is wrong: a product missing or damaged, a record that is not
        understood, what cannot be removed, a lost index. The others are not affected.

        Raises
        ------
        ArchiveError
            If the directory cannot be written, is in use by another service, or the index is
            damaged.
        """
        try:
            self._products.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(self._directory / "lock")
            told = [*swept(self._products), *self.measured.prepare(), *self.noisy.prepare()]
        except OSError as error:
            self.close()
            raise ArchiveError(f"{self._directory}: cannot be used: {error}") from error
        try:
            anew = self._index.open()
            told += [*self._adopt(anew), *self._doubted()]
            self.wrong = (*told, *self.measured.adopt(), *self.noisy.adopt())
        except ArchiveError:
            self.close()
            raise
        return self.wrong

    def close(self) -> None:
        """Close the index and let another service use the directory."""
        self._index.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def store(
        self,
        record: ReconstructorRecord,
        matrix: NDArray[np.float32],
        covariance: NDArray[np.float64] | None,
        provenance: Mapping[str, Provenance],
    ) -> None:
        """Write a reconstructor for good.

        Parameters
        ----------
        record
            What is known of it; its ``sha256``, where given, must be the matrix'.
        matrix
            ``(n_modes, n_slopes)``, metres per slope.
        covariance
            ``(4, 4)`` of its registration, floor included, numeric units (rotation in radians);
            None: not known.
        provenance
            What it was made from (instrument, software version, session...): attributes of the
            file's group ``provenance``.

        Raises
        ------
        ArchiveError
            If the id is taken, the matrix is not what the record says, or the disk refuses.
        WireError
            If the id is not one.
        """
        checked_id(record.id, "a reconstructor to be stored")
        if matrix.ndim != 2 or matrix.shape[0] != record.n_modes:
            raise ArchiveError(
                f"reconstructor {record.id}: found a matrix of shape {matrix.shape}, "
                f"expected ({record.n_modes}, n_slopes)"
            )
        if not np.isfinite(matrix).all():
            raise ArchiveError(f"reconstructor {record.id}: not all of its numbers are finite")
        sha256 = checksum(matrix)
        if record.sha256 not in {"", sha256}:
            raise ArchiveError(
                f"reconstructor {record.id}: found a matrix of checksum {sha256}, "
                f"expected {record.sha256} of its record"
            )
        self._largest_bytes = max(self._largest_bytes, matrix.nbytes)
        path = self._path(record.id)
        if path.exists():
            raise ArchiveError(f"reconstructor {record.id}: already stored, ids are never reused")
        write_product(path, record, matrix, covariance, provenance)
        self._index.add(record, sha256)

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor, ``(n_modes, n_slopes)``, its checksum verified.

        Raises
        ------
        UnknownIdError
            If no such reconstructor was ever stored here.
        ArchiveError
            If its file is missing, damaged, or holds other numbers than were stored.
        """
        sha256 = self._index.product_sha256(matrix_id)
        if sha256 is None:
            raise UnknownIdError(f"reconstructor {matrix_id}: no such matrix in the archive")
        matrix = read_matrix(self._path(matrix_id))
        found = checksum(matrix)
        if found != sha256:
            raise ArchiveError(
                f"{self._path(matrix_id)}: damaged: found checksum {found}, expected {sha256}"
            )
        return matrix

    def update(self, record: ReconstructorRecord) -> None:
        """Remember where a reconstructor is now, one that is not stored here (the RTC's) too."""
        self.record((record,), ())

    def records(self) -> tuple[ReconstructorRecord, ...]:
        """Return what is known of every reconstructor, oldest first.

        One whose product was missing or damaged at the start has failed, with the reason.
        """
        understood, wrong = self._index.records()
        known = [*understood, *(r for name, r in self._stand_ins.items() if name in wrong)]
        known.sort(key=lambda record: record.created_ns_utc)
        return tuple(self._judged(record) for record in known)

    def audit(self, t_ns_utc: int, who: str, name: str, text: str) -> None:
        """Add to the audit trail, which only ever grows."""
        self._index.record((), (AuditEntry(t_ns_utc=t_ns_utc, who=who, name=name, text=text),))

    def record(self, records: Sequence[ReconstructorRecord], entries: Sequence[AuditEntry]) -> None:
        """Remember where reconstructors are now and add to the audit trail: all or nothing.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        for record in records:
            path = self._path(record.id)
            if path.exists():
                write_fate(path, record)
        self._index.record(records, entries)

    def probe(self) -> None:
        """Write a file as large as the largest matrix so far, and remove it.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        path = self._products / "probe.part"
        try:
            with path.open("wb") as file:
                file.write(bytes(self._largest_bytes))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error}") from error
        finally:
            path.unlink(missing_ok=True)

    def audit_trail(self, limit: int = 100) -> tuple[AuditEntry, ...]:
        """Return the last ``limit`` entries of the audit trail, oldest first."""
        return self._index.audit_trail(limit)

    def _path(self, matrix_id: str) -> Path:
        return self._products / f"{matrix_id}.h5"

    def _adopt(self, anew: bool) -> list[str]:
        """Take in the products that the index, made ``anew`` or not, does not know."""
        known = self._index.stored_ids()
        told, taken = [], 0
        for path in sorted(self._products.glob("*.h5")):
            if path.stem in known:
                continue
            try:
                record, matrix = read_product(path)
            except ArchiveError as error:
                told.append(str(error))
                continue
            fate = read_fate(path)
            if fate is None and anew:
                reason = "what became of it was lost with the index"
                fate = replace(record, state=MatrixState.DISCARDED, reason=reason)
            self._index.add(fate or record, checksum(matrix))
            taken += 1
        if anew and taken:
            lost = self._directory / "index.sqlite"
            text = f"was not there: made anew of {taken} products; the audit trail begins here"
            told.append(f"{lost}: {text}")
        return told

    def _doubted(self) -> list[str]:
        """Look at every product, and at every record that is not understood."""
        self._unsound.clear()
        self._stand_ins.clear()
        told = []
        for name in sorted(self._index.stored_ids()):
            try:
                check_whole(self._path(name), "reconstructor")
            except ArchiveError as error:
                self._unsound[name] = str(error)
                told.append(str(error))
        for name, text in self._index.records()[1].items():
            told.append(text)
            with contextlib.suppress(ArchiveError):
                path = self._path(name)
                self._stand_ins[name] = read_fate(path) or read_product(path)[0]
        return told

    def _judged(self, record: ReconstructorRecord) -> ReconstructorRecord:
        wrong = self._unsound.get(record.id)
        if wrong is None:
            return record
        reason = f"it was {record.state}; {wrong}"
        return replace(record, state=MatrixState.FAILED, reason=reason)


def _locked(path: Path) -> IO[str]:
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise ArchiveError(f"{path.parent}: in use by another service") from None
    return file
