"""What lies in the archive besides reconstructors: measured and noisy interaction matrices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from service.archive.index import Index
from service.archive.records import COVARIANCE_SCALE
from service.archive.store import Store
from service.errors import ArchiveError, UnknownIdError
from service.model.misregistration import PARAMETERS
from service.tracking.products import MeasurementRecord, NoisyFinding, NoisyRecord, NoisyState
from service.wire import checked_id, checksum


class MeasuredArchive:
    """Interaction matrices the RTC has measured: files, and their part of the index.

    Belongs to an :class:`~service.archive.Archive`, which opens it.
    """

    def __init__(self, directory: Path, index: Index) -> None:
        self._index = index
        self._store = Store(
            directory,
            "measurement",
            MeasurementRecord,
            "interaction_matrix",
            "(n_slopes, n_modes), slope per metre OPD",
        )

    def prepare(self) -> tuple[str, ...]:
        """Make the folder and clear it up, as :meth:`Store.prepare`; needs no index yet."""
        return self._store.prepare()

    def adopt(self) -> tuple[str, ...]:
        """Enter complete files the index does not know; return a line for all that is wrong."""
        understood, wrong = self._index.records(MeasurementRecord)
        known = {record.id for record in understood} | wrong.keys()
        told = [*wrong.values(), *self._store.unsound(r.id for r in understood).values()]
        for name in self._store.ids():
            if name in known:
                continue
            try:
                record, matrix = self._store.record(name), self._store.matrix(name)
            except ArchiveError as error:
                told.append(str(error))
                continue
            self._index.add(record, checksum(matrix))
        return tuple(told)

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
        expected = (record.n_slopes or 0, len(record.modes))
        self._store.check_numbers(record.id, "a matrix", matrix, expected)
        self._store.check_sum(record.id, matrix, record.sha256)
        before = self._index.checksums(MeasurementRecord).get(record.id)
        if before == record.sha256:
            return
        if before is not None:
            raise self._store.taken(record.id)

        def fill(file: h5py.File) -> None:
            file.attrs.update(
                {
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
                    "instrument": instrument,
                }
            )

        self._store.write(record, matrix, fill)
        self._index.add(record, record.sha256)

    def records(self) -> tuple[MeasurementRecord, ...]:
        """Return what is known of every measured matrix, oldest first."""
        return tuple(self._index.records(MeasurementRecord)[0])

    def matrix(self, measurement_id: str) -> NDArray[np.float32]:
        """Return a measured matrix, ``(n_slopes, n_modes)``, its checksum verified.

        Raises
        ------
        UnknownIdError
            If no such matrix was ever stored here.
        ArchiveError
            If its file is missing, damaged, or holds other numbers than were stored.
        """
        sha256 = self._index.checksums(MeasurementRecord).get(measurement_id)
        if sha256 is None:
            raise UnknownIdError(f"measurement {measurement_id}: no such matrix in the archive")
        self._store.record(measurement_id)
        return self._store.matrix(measurement_id, sha256)

    def file(self, measurement_id: str) -> bytes:
        """Return the HDF5 file as it was written, once its matrix is verified.

        Raises
        ------
        UnknownIdError, ArchiveError
            As :meth:`matrix`.
        """
        self.matrix(measurement_id)
        return self._store.path_of(measurement_id).read_bytes()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyNumbers:
    """The numbers of a noisy interaction matrix; columns in the order of its record's modes."""

    matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` slope per metre OPD, optical gain included, the RTC's own slopes."""

    noise: NDArray[np.float32]
    """``(n_slopes, n_modes)`` 1 σ of each element."""

    synthetic: NDArray[np.float32]
    """``(n_slopes, n_modes)`` D(α) at the registration fitted to it or, without one, the last."""

    optical_gain: NDArray[np.float64]
    """``(n_modes,)`` gain of each mode against the model; NaN: none could be fitted."""

    gain_sigma: NDArray[np.float64]
    """``(n_modes,)`` 1 σ of it."""

    snr: NDArray[np.float64]
    """``(n_modes,)`` RMS signal of a column's elements over their noise."""


class NoisyArchive:
    """Noisy interaction matrices: a folder of files, which are all there is to know.

    What lies here is in no index of reconstructors: nothing that publishes can find it. Belongs to
    an :class:`~service.archive.Archive`, which opens it.
    """

    def __init__(self, directory: Path) -> None:
        self._records: dict[str, NoisyRecord] = {}
        self._store = Store(
            directory,
            "noisy matrix",
            NoisyRecord,
            "interaction_matrix",
            "(n_slopes, n_modes), slope per metre OPD, optical gain included: a measurement to fit "
            "a model to, never one to control with",
        )

    def prepare(self) -> tuple[str, ...]:
        """Make the folder and clear it up, as :meth:`Store.prepare`."""
        return self._store.prepare()

    def adopt(self) -> tuple[str, ...]:
        """Learn what is there; return a line for each damaged file."""
        told = []
        for name in self._store.ids():
            try:
                self._records[name] = self._store.record(name)
            except ArchiveError as error:
                told.append(str(error))
        return tuple(told)

    def store(self, record: NoisyRecord, numbers: NoisyNumbers, instrument: str) -> None:
        """Write one for good.

        Parameters
        ----------
        record
            With its finding, whose ``sha256`` must be the matrix'.
        numbers
            All of its arrays.
        instrument
            Name of the instrument it was measured on.

        Raises
        ------
        ArchiveError
            If the id is taken, the arrays are not what the record says, or the disk refuses.
        WireError
            If the id is not one.
        """
        checked_id(record.id, "a noisy matrix to be stored")
        finding = record.finding
        if finding is None or record.state is not NoisyState.STORED:
            found = "nothing" if finding is None else "a finding"
            raise ArchiveError(
                f"noisy matrix {record.id}: found it {record.state} with {found}, expected it "
                "stored with a finding"
            )
        expected = (finding.n_slopes, len(record.modes))
        for name in ("matrix", "noise", "synthetic"):
            self._store.check_numbers(record.id, name, getattr(numbers, name), expected)
        self._store.check_sum(record.id, numbers.matrix, finding.sha256)
        self._store.write(
            record, numbers.matrix, lambda file: _fill(file, record, finding, numbers, instrument)
        )
        self._records[record.id] = record

    def records(self) -> tuple[NoisyRecord, ...]:
        """Return what is known of every one that is stored, oldest first."""
        return tuple(sorted(self._records.values(), key=lambda record: record.asked_ns_utc))

    def file(self, noisy_id: str) -> bytes:
        """Return the HDF5 file as it was written, once its matrix is verified.

        Raises
        ------
        UnknownIdError
            If none of this id was ever stored here.
        ArchiveError
            If its file is missing or damaged.
        """
        path = self.path(noisy_id)
        self._store.matrix(noisy_id)
        return path.read_bytes()

    def path(self, noisy_id: str) -> Path:
        """Return where the file of a stored one is.

        Raises
        ------
        UnknownIdError
            If none of this id was ever stored here.
        """
        if noisy_id not in self._records:
            raise UnknownIdError(f"noisy matrix {noisy_id}: no such matrix in the archive")
        return self._store.path_of(noisy_id)


def _fill(
    file: h5py.File,
    record: NoisyRecord,
    finding: NoisyFinding,
    numbers: NoisyNumbers,
    instrument: str,
) -> None:
    # beside the matrix and its modes, pyrcal fit reads the noise of the columns
    file["noise"] = np.sqrt(np.mean(numbers.noise.astype(float) ** 2, axis=0))
    file["noise"].attrs["description"] = "(n_modes,), RMS over slopes of element_noise"
    file["element_noise"] = np.asarray(numbers.noise, "<f4")
    file["element_noise"].attrs["description"] = "(n_slopes, n_modes), 1 sigma of each element"
    file["synthetic"] = np.asarray(numbers.synthetic, "<f4")
    file["synthetic"].attrs["description"] = "(n_slopes, n_modes), the model at the fitted alpha"
    for name in ("optical_gain", "gain_sigma", "snr"):
        file[name] = getattr(numbers, name)
    if finding.covariance is not None:
        file["covariance"] = finding.covariance * COVARIANCE_SCALE
        file["covariance"].attrs["parameters"] = PARAMETERS
    file.attrs.update(
        {
            "id": record.id,
            "modes": np.array(record.modes, dtype=np.int64),
            "amplitude_m": record.amplitude_m,
            "total_m": record.total_m,
            "seed": record.seed,
            "duration_s": record.duration_s,
            "n_frames": finding.n_frames,
            "n_missing": finding.n_missing,
            "element_snr": finding.snr,
            "session": finding.session,
            "cm_id": finding.cm_id or "",
            "basis_id": record.basis_id,
            "config_id": record.config_id,
            "created_ns": finding.created_ns_utc,
            "instrument": instrument,
        }
        | ({} if finding.alpha is None else finding.alpha.to_boundary())
    )
