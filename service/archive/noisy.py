"""Noisy interaction matrices: one immutable HDF5 file each, and no way to the RTC.

What lies here is in no index of reconstructors: nothing that publishes can find it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from service import __version__
from service.archive.product import DAMAGE, Provenance, swept, write_whole
from service.errors import ArchiveError, UnknownIdError
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.state import NoisyFinding, NoisyRecord, NoisyState
from service.wire import checked_id, checksum

_SCALE = np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)


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
    """A directory of noisy interaction matrices; the files are all there is to know.

    Belongs to an :class:`~service.archive.Archive`, which opens it. What a call has written is on
    the disk when it returns.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._records: dict[str, NoisyRecord] = {}

    def prepare(self) -> tuple[str, ...]:
        """Make the directory, remove what was half-written; return a line for what will not go."""
        return swept(self._directory)

    def adopt(self) -> tuple[str, ...]:
        """Learn what is there; return a line for each damaged file."""
        damaged = []
        for path in sorted(self._directory.glob("*.h5")):
            try:
                record = _record_in(path)
            except ArchiveError as error:
                damaged.append(str(error))
                continue
            self._records[record.id] = record
        return tuple(damaged)

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
        finding = _checked(record, numbers)
        path = self._path(record.id)
        if path.exists():
            raise ArchiveError(f"noisy matrix {record.id}: already stored, ids are never reused")
        write_whole(path, lambda file: _fill(file, record, finding, numbers, instrument))
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
        _verify(path)
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
        return self._path(noisy_id)

    def _path(self, noisy_id: str) -> Path:
        return self._directory / f"{noisy_id}.h5"


def _checked(record: NoisyRecord, numbers: NoisyNumbers) -> NoisyFinding:
    finding = record.finding
    if finding is None or record.state is not NoisyState.STORED:
        found = "nothing" if finding is None else "a finding"
        raise ArchiveError(
            f"noisy matrix {record.id}: found it {record.state} with {found}, expected it stored "
            "with a finding"
        )
    expected = (finding.n_slopes, len(record.modes))
    for name in ("matrix", "noise", "synthetic"):
        values = getattr(numbers, name)
        if values.shape != expected or not np.isfinite(values).all():
            raise ArchiveError(
                f"noisy matrix {record.id}: found {name} of shape {values.shape}, expected a "
                f"finite one of {expected}"
            )
    if checksum(numbers.matrix) != finding.sha256:
        raise ArchiveError(
            f"noisy matrix {record.id}: found a matrix of checksum {checksum(numbers.matrix)}, "
            f"expected {finding.sha256} of its record"
        )
    return finding


def _verify(path: Path) -> None:
    record = _record_in(path)
    try:
        with h5py.File(path, "r", locking=False) as file:
            found = checksum(np.asarray(file["interaction_matrix"][()], np.float32))
    except DAMAGE as error:
        raise ArchiveError(f"{path}: damaged: {error}") from error
    expected = "" if record.finding is None else record.finding.sha256
    if found != expected:
        raise ArchiveError(f"{path}: damaged: found checksum {found}, expected {expected}")


def _record_in(path: Path) -> NoisyRecord:
    try:
        with h5py.File(path, "r", locking=False) as file:
            record = record_from_json(file.attrs["record"])
    except FileNotFoundError as error:
        raise ArchiveError(f"{path}: missing, although it was stored") from error
    except DAMAGE as error:
        raise ArchiveError(f"{path}: damaged: {error}") from error
    if record.id != path.stem:
        raise ArchiveError(f"{path}: found noisy matrix {record.id} in it, expected {path.stem}")
    return record


def record_to_json(record: NoisyRecord) -> str:
    """Return the record as JSON, with boundary units and names."""
    values = asdict(replace(record, finding=None))
    finding = record.finding
    if finding is not None:
        values["finding"] = asdict(replace(finding, alpha=None, covariance=None)) | {
            "alpha": None if finding.alpha is None else finding.alpha.to_boundary(),
            "covariance": None
            if finding.covariance is None
            else (finding.covariance * _SCALE).tolist(),
        }
    return json.dumps(values)


def record_from_json(text: str) -> NoisyRecord:
    """Return the record that :func:`record_to_json` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the text is something else.
    """
    values = json.loads(text)
    found = values.pop("finding")
    finding = None
    if found is not None:
        alpha, covariance = found.pop("alpha"), found.pop("covariance")
        finding = NoisyFinding(
            **found,
            alpha=None if alpha is None else Misregistration.from_boundary(alpha),
            covariance=None if covariance is None else np.array(covariance) / _SCALE,
        )
    state, modes = NoisyState(values.pop("state")), tuple(values.pop("modes"))
    return NoisyRecord(**values, state=state, modes=modes, finding=finding)


def _fill(
    file: h5py.File,
    record: NoisyRecord,
    finding: NoisyFinding,
    numbers: NoisyNumbers,
    instrument: str,
) -> None:
    # what pyrcal fit reads: the matrix, its modes and the noise of its columns
    file["interaction_matrix"] = np.asarray(numbers.matrix, "<f4")
    file["interaction_matrix"].attrs["description"] = (
        "(n_slopes, n_modes), slope per metre OPD, optical gain included: a measurement to fit a "
        "model to, never one to control with"
    )
    file["noise"] = np.sqrt(np.mean(numbers.noise.astype(float) ** 2, axis=0))
    file["noise"].attrs["description"] = "(n_modes,), RMS over slopes of element_noise"
    file["element_noise"] = np.asarray(numbers.noise, "<f4")
    file["element_noise"].attrs["description"] = "(n_slopes, n_modes), 1 sigma of each element"
    file["synthetic"] = np.asarray(numbers.synthetic, "<f4")
    file["synthetic"].attrs["description"] = "(n_slopes, n_modes), the model at the fitted alpha"
    for name in ("optical_gain", "gain_sigma", "snr"):
        file[name] = getattr(numbers, name)
    if finding.covariance is not None:
        file["covariance"] = finding.covariance * _SCALE
        file["covariance"].attrs["parameters"] = PARAMETERS
    file.attrs.update(_attributes(record, finding))
    file.attrs["instrument"] = instrument
    file.attrs["software_version"] = __version__
    file.attrs["record"] = record_to_json(record)


def _attributes(record: NoisyRecord, finding: NoisyFinding) -> dict[str, Provenance]:
    """Return what a person, or another program, wants to see in the file."""
    values: dict[str, Provenance] = {
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
        "sha256": finding.sha256,
    }
    if finding.alpha is not None:
        values |= finding.alpha.to_boundary()
    return values
