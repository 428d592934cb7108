"""Interaction matrices the RTC has measured: one immutable HDF5 file each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from service import __version__
from service.archive.index import Index
from service.archive.product import Provenance, check_whole, opened, swept, write_whole
from service.archive.records import measurement_from_json, measurement_to_json
from service.errors import ArchiveError, UnknownIdError
from service.state import MeasurementRecord
from service.wire import checked_id, checksum


class MeasuredArchive:
    """A directory of measured matrices and their part of the index.

    Belongs to an :class:`~service.archive.Archive`, which opens it. What a call has written is on
    the disk when it returns.
    """

    def __init__(self, directory: Path, index: Index) -> None:
        self._directory = directory
        self._index = index

    def prepare(self) -> tuple[str, ...]:
        """Make the directory and remove what was half-written; return a line for what will not go.

        The index is not needed yet.
        """
        return swept(self._directory)

    def adopt(self) -> tuple[str, ...]:
        """Enter complete files the index does not know; return a line for all that is wrong."""
        understood, wrong = self._index.measurements()
        damaged = list(wrong.values())
        for record in understood:
            try:
                check_whole(self._path(record.id), "interaction_matrix")
            except ArchiveError as error:
                damaged.append(str(error))
        known = {record.id for record in understood} | wrong.keys()
        for path in sorted(self._directory.glob("*.h5")):
            if path.stem in known:
                continue
            try:
                record, matrix = _read(path)
            except ArchiveError as error:
                damaged.append(str(error))
                continue
            self._index.add_measurement(record, checksum(matrix))
        return tuple(damaged)

    def store(
        self, record: MeasurementRecord, matrix: NDArray[np.float32], instrument: str
    ) -> None:
        """Write a measured matrix for good; the same one again changes nothing.

        Parameters
        ----------
        record
            How it was measured; its ``sha256`` must be the matrix'.
        matrix
            ``(n_slopes, n_modes)``, slope per metre OPD.
        instrument
            Name of the instrument it was measured on.

        Raises
        ------
        ArchiveError
            If the id has another matrix, the matrix is not what the record says, or the disk
            refuses.
        WireError
            If the id is not one.
        """
        checked_id(record.id, "a measured matrix to be stored")
        expected = (record.n_slopes, len(record.modes))
        if matrix.shape != expected or not np.isfinite(matrix).all():
            raise ArchiveError(
                f"measurement {record.id}: found a matrix of shape {matrix.shape}, "
                f"expected a finite one of {expected}"
            )
        sha256 = checksum(matrix)
        if record.sha256 != sha256:
            raise ArchiveError(
                f"measurement {record.id}: found a matrix of checksum {sha256}, "
                f"expected {record.sha256} of its record"
            )
        before = self._index.measurement_sha256(record.id)
        if before == sha256:
            return
        path = self._path(record.id)
        if before is not None or path.exists():
            raise ArchiveError(f"measurement {record.id}: already stored, ids are never reused")
        write_whole(path, lambda file: _fill(file, record, matrix, instrument))
        self._index.add_measurement(record, sha256)

    def records(self) -> tuple[MeasurementRecord, ...]:
        """Return what is known of every measured matrix, oldest first."""
        return tuple(self._index.measurements()[0])

    def matrix(self, measurement_id: str) -> NDArray[np.float32]:
        """Return a measured matrix, ``(n_slopes, n_modes)``, its checksum verified.

        Raises
        ------
        UnknownIdError
            If no such matrix was ever stored here.
        ArchiveError
            If its file is missing, damaged, or holds other numbers than were stored.
        """
        sha256, path = self._known(measurement_id), self._path(measurement_id)
        _, matrix = _read(path)
        found = checksum(matrix)
        if found != sha256:
            raise ArchiveError(f"{path}: damaged: found checksum {found}, expected {sha256}")
        return matrix

    def file(self, measurement_id: str) -> bytes:
        """Return the HDF5 file as it was written, once its matrix is verified.

        Raises
        ------
        UnknownIdError, ArchiveError
            As :meth:`matrix`.
        """
        self.matrix(measurement_id)
        return self._path(measurement_id).read_bytes()

    def _known(self, measurement_id: str) -> str:
        sha256 = self._index.measurement_sha256(measurement_id)
        if sha256 is None:
            raise UnknownIdError(f"measurement {measurement_id}: no such matrix in the archive")
        return sha256

    def _path(self, measurement_id: str) -> Path:
        return self._directory / f"{measurement_id}.h5"


def _read(path: Path) -> tuple[MeasurementRecord, NDArray[np.float32]]:
    with opened(path) as file:
        record = measurement_from_json(file.attrs["record"])
        matrix = np.asarray(file["interaction_matrix"][()], np.float32)
    if record.id != path.stem:
        raise ArchiveError(f"{path}: found measurement {record.id} in it, expected {path.stem}")
    if checksum(matrix) != record.sha256:
        raise ArchiveError(
            f"{path}: damaged: found checksum {checksum(matrix)}, expected {record.sha256}"
        )
    return record, matrix


def _fill(
    file: h5py.File, record: MeasurementRecord, matrix: NDArray[np.float32], instrument: str
) -> None:
    file["interaction_matrix"] = np.asarray(matrix, "<f4")
    file["interaction_matrix"].attrs["description"] = "(n_slopes, n_modes), slope per metre OPD"
    file.attrs.update(_attributes(record))
    file.attrs["instrument"] = instrument
    file.attrs["software_version"] = __version__
    file.attrs["record"] = measurement_to_json(replace(record, overdue_since_ns_utc=None))


def _attributes(record: MeasurementRecord) -> dict[str, Provenance]:
    """Return what a person, or another program, wants to see in the file."""
    return {
        "id": record.id,
        "pattern": str(record.pattern),
        "modes": np.array(record.modes, dtype=np.int64),
        "amplitude_m": np.array(record.amplitude_m),
        "n_average": record.n_average or 1,
        "double_pass": bool(record.double_pass),
        "session": record.session or "",
        "basis_id": record.basis_id or "",
        "config_id": record.config_id or "",
        "created_ns": record.created_ns_utc or 0,
        "sha256": record.sha256,
    }
