"""The archive as the rest of the service sees it."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from service.archive.index import AuditEntry, Index
from service.archive.products import MeasuredArchive, NoisyArchive
from service.archive.records import COVARIANCE_SCALE, from_json, to_json
from service.archive.store import DAMAGE, Provenance, Store
from service.archive.tracking import TrackingFile
from service.errors import ArchiveError, StorageError, UnknownIdError
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.tracking.loop_commands import table_of
from service.tracking.products import MatrixState, ReconstructorRecord
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
        self._products = Store(
            directory / "reconstructors",
            "reconstructor",
            ReconstructorRecord,
            "reconstructor",
            "(n_modes, n_slopes), metres OPD per slope",
        )
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
            self._directory.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(self._directory / "lock")
            folders = (self._products, self.measured, self.noisy)
            told = [line for folder in folders for line in folder.prepare()]
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
        n_slopes = matrix.shape[-1]
        self._products.check_numbers(record.id, "a matrix", matrix, (record.n_modes, n_slopes))
        sha256 = checksum(matrix)
        self._products.check_sum(record.id, matrix, record.sha256 or sha256)
        self._largest_bytes = max(self._largest_bytes, matrix.nbytes)

        def fill(file: h5py.File) -> None:
            file.attrs.update(_attributes(record))
            if record.optical_gains:
                _add_gains(file, record)
            if covariance is not None:
                file["covariance"] = covariance * COVARIANCE_SCALE
                file["covariance"].attrs["parameters"] = PARAMETERS
            file.create_group("provenance").attrs.update(provenance)

        self._products.write(record, matrix, fill)
        if not self._index.add(record, sha256):
            raise self._products.taken(record.id)

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor, ``(n_modes, n_slopes)``, its checksum verified.

        Raises
        ------
        UnknownIdError
            If no such reconstructor was ever stored here.
        ArchiveError
            If its file is missing, damaged, or holds other numbers than were stored.
        """
        sha256 = self._index.checksums(ReconstructorRecord).get(matrix_id)
        if sha256 is None:
            raise UnknownIdError(f"reconstructor {matrix_id}: no such matrix in the archive")
        return self._products.matrix(matrix_id, sha256)

    def update(self, record: ReconstructorRecord) -> None:
        """Remember where a reconstructor is now, one that is not stored here (the RTC's) too."""
        self.record((record,), ())

    def records(self) -> tuple[ReconstructorRecord, ...]:
        """Return what is known of every reconstructor, oldest first.

        One whose product was missing or damaged at the start has failed, with the reason.
        """
        understood, wrong = self._index.records(ReconstructorRecord)
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
            if self._products.path_of(record.id).exists():
                self._write_fate(record)
        self._index.record(records, entries)

    def probe(self) -> None:
        """Write a file as large as the largest matrix so far, and remove it.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        path = self._products.directory / "probe.part"
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

    def _adopt(self, anew: bool) -> list[str]:
        """Take in the products that the index, made ``anew`` or not, does not know."""
        known = self._index.checksums(ReconstructorRecord)
        told, taken = [], 0
        for name in self._products.ids():
            if name in known:
                continue
            try:
                record, matrix = self._products.record(name), self._products.matrix(name)
            except ArchiveError as error:
                told.append(str(error))
                continue
            fate = self._fate(name)
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
        self._unsound = self._products.unsound(sorted(self._index.checksums(ReconstructorRecord)))
        self._stand_ins.clear()
        told = [*self._unsound.values()]
        for name, text in self._index.records(ReconstructorRecord)[1].items():
            told.append(text)
            with contextlib.suppress(ArchiveError):
                self._stand_ins[name] = self._fate(name) or self._products.record(name)
        return told

    def _write_fate(self, record: ReconstructorRecord) -> None:
        """Write beside a product what has become of it, for the day when the index is lost."""
        path = self._products.path_of(record.id)
        part = path.with_suffix(".json.part")
        try:
            part.write_text(to_json(record), encoding="utf-8")
            part.replace(path.with_suffix(".json"))
        except OSError as error:
            raise StorageError(f"{part}: cannot be written: {error}") from error

    def _fate(self, matrix_id: str) -> ReconstructorRecord | None:
        """Return what has become of a product; None: nothing is known of it."""
        path = self._products.path_of(matrix_id).with_suffix(".json")
        try:
            record = from_json(path.read_text(encoding="utf-8"), ReconstructorRecord)
        except DAMAGE:
            return None
        return record if record.id == matrix_id else None

    def _judged(self, record: ReconstructorRecord) -> ReconstructorRecord:
        wrong = self._unsound.get(record.id)
        if wrong is None:
            return record
        reason = f"it was {record.state}; {wrong}"
        return replace(record, state=MatrixState.FAILED, reason=reason)


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


def _locked(path: Path) -> IO[str]:
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise ArchiveError(f"{path.parent}: in use by another service") from None
    return file
