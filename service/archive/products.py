"""The kinds of products: reconstructors, measured and noisy matrices, recordings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

import h5py
import msgspec
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.archive.index import Sent
from service.archive.serialisation import from_json, to_json
from service.archive.store import DAMAGE, Folder, Provenance, Store
from service.control.gains import gain_table
from service.errors import ArchiveError, ConfigurationError, StorageError
from service.files.container import put_covariance
from service.files.durable import replace_file
from service.files.recording import Recording
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.records.operations import MeasurementRecord, MeasureState, NoisyFinding
from service.records.products import MatrixState, ReconstructorRecord, ReferencesRecord
from service.wire import checksum

PROBE_BYTES = 1 << 20
"""Least that must fit on the disk for it to be called writable."""

RUNNING: Final = "running"
STORED: Final = "stored"
"""States of a recording."""

SentT = TypeVar("SentT", bound=Sent)

_ALIVE = {
    MatrixState.PROPOSED: "waits for an operator",
    MatrixState.PUBLISHED: "on its way to the RTC",
    MatrixState.STAGED: "held by the RTC",
    MatrixState.APPLIED: "in use",
}


class SentArchive(Store[SentT]):
    """Products that go to the RTC, each with a file of its fate, for a lost index."""

    lost_with_it = "it cannot be sent, nor gone back to; what is known of it is in the index"

    @override
    def kept(self, records: Iterable[SentT]) -> dict[str, str]:
        """Return what is in use, or on its way, and what it was made from."""
        alive = [record for record in records if record.state in _ALIVE]
        parents = {r.parent: f"{r.id} was made from it" for r in alive if r.parent}
        return {**parents, **{record.id: _ALIVE[record.state] for record in alive}}

    @override
    def records(self) -> tuple[SentT, ...]:
        """Return what is known of each, oldest first.

        One whose product was missing or damaged at the start has failed, with the reason.
        """
        return tuple(self._judged(record) for record in super().records())

    def write_state(self, record: SentT) -> None:
        """Write the present state of a stored product to the file next to it.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        path = self.path_of(record.id)
        # A record without a stored matrix is in the index only.
        if not path.exists():
            return
        _write_sidecar(path, to_json(record).encode())

    @override
    def _became(self, record: SentT, *, anew: bool) -> SentT:
        try:
            text = self.path_of(record.id).with_suffix(".json").read_text(encoding="utf-8")
            fate = from_json(text, self.kind)
        except DAMAGE:
            fate = None
        if fate is not None and fate.id == record.id:
            return fate
        # Without the index nobody knows whether it was ever sent: it must not wait for approval
        # again.
        if anew:
            reason = "what became of it was lost with the index"
            return replace(record, state=MatrixState.DISCARDED, reason=reason)
        return record

    def _judged(self, record: SentT) -> SentT:
        wrong = self._unsound.get(record.id)
        if wrong is None:
            return record
        reason = f"it was {record.state}; {wrong}"
        return replace(record, state=MatrixState.FAILED, reason=reason)


class ReconstructorArchive(SentArchive[ReconstructorRecord]):
    """Reconstructors."""

    kind = ReconstructorRecord
    noun = dataset = "reconstructor"
    described = "(n_modes, n_slopes), metres OPD per slope"

    largest_bytes = PROBE_BYTES
    """Size of the largest matrix so far: this much must fit on the disk."""

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

        def fill(file: h5py.File) -> None:
            file.attrs.update(_attributes(record))
            if record.optical_gains:
                _add_gains(file, record)
            if covariance is not None:
                put_covariance(file, covariance)
            file.create_group("provenance").attrs.update(provenance)

        self.largest_bytes = max(self.largest_bytes, matrix.nbytes)
        self._write(record, matrix, (record.n_modes, matrix.shape[-1]), record.sha256, fill)


class ReferencesArchive(SentArchive[ReferencesRecord]):
    """Offsets of reference slopes."""

    kind = ReferencesRecord
    noun = "reference slopes"
    dataset = "reference_offset"
    described = "(n_slopes,), to be subtracted beyond the RTC's own reference slopes"

    def store(self, record: ReferencesRecord, offset: NDArray[np.float32]) -> None:
        """Write an offset ``(n_slopes,)`` for good.

        Raises
        ------
        ArchiveError
            If the id is taken, the offset is not what the record says, or the disk refuses.
        WireError
            If the id is not one.
        """
        of_modes = np.array(record.coefficients_m)
        self._write(
            record,
            offset,
            offset.shape,
            record.sha256,
            lambda file: file.attrs.update({"coefficients_m": of_modes}),
        )


class MeasuredArchive(Store[MeasurementRecord]):
    """Interaction matrices the RTC has measured."""

    kind = MeasurementRecord
    noun = "measurement"
    described = "(n_slopes, n_modes), slope per metre OPD"

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
        if self._index.checksums(self._table).get(record.id) == record.sha256 == checksum(matrix):
            return
        attributes = {
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
        shape = (record.n_slopes or 0, len(record.modes))
        self._write(
            record, matrix, shape, record.sha256, lambda file: file.attrs.update(attributes)
        )


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


class NoisyArchive(Store[MeasurementRecord]):
    """Noisy interaction matrices: nothing that publishes a reconstructor can find one."""

    kind = MeasurementRecord
    noun = "noisy matrix"
    described = (
        f"{MeasuredArchive.described}, optical gain included: a measurement to fit a model to, "
        "never one to control with"
    )

    def store(self, record: MeasurementRecord, numbers: NoisyNumbers, instrument: str) -> None:
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
        finding = record.finding
        if finding is None or record.state is not MeasureState.STORED:
            found = "nothing" if finding is None else "a finding"
            raise ArchiveError(
                f"noisy matrix {record.id}: found it {record.state} with {found}, expected it "
                "stored with a finding"
            )
        shape = (finding.n_slopes, len(record.modes))
        for name in ("matrix", "noise", "synthetic"):
            self._check_numbers(record, name, getattr(numbers, name), shape)
        self._write(
            record,
            numbers.matrix,
            shape,
            finding.sha256,
            lambda file: _fill(file, record, finding, numbers, instrument),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingRecord:
    """The record of a recording."""

    id: str
    state: str
    """"running" or "stored"."""

    created_ns_utc: int
    """Time of its start, by the service's clock."""

    duration_s: float
    """Requested duration, seconds."""

    who: str
    why: str
    before_s: float = 0.0
    """Duration of included telemetry from before the start, seconds."""

    reason: str = ""
    """Why it ended before its time; empty: it did not."""

    n_bytes: int = 0
    n_dropped: int = 0
    """Messages that are not in it: the disk was too slow."""


class Recordings(Folder):
    """Folder of recordings, each with its metadata in a JSON file of the same name.

    Recordings are kept until they are removed by an order, and do not count towards ``keep_gb``.
    """

    noun = "recording"
    counted = False
    lost_with_it = "it cannot be replayed, nor exported"

    def stored(self) -> frozenset[str]:
        """Return the ids of those stored here."""
        return frozenset(path.stem for path in self.directory.glob("*.h5"))

    def adopt(self, *, anew: bool) -> list[str]:
        """Call those ended that a service before this one has left; nothing is wrong with them."""
        for record in self.records():
            if record.state == RUNNING:
                self.write(replace(record, state=STORED, reason="the service has ended meanwhile"))
        return []

    def records(self) -> tuple[RecordingRecord, ...]:
        """Return what is known of each, oldest first; of one without a record that it is there."""
        found = [self._record(name) for name in self.stored()]
        return tuple(sorted(found, key=lambda record: record.created_ns_utc))

    def _record(self, recording_id: str) -> RecordingRecord:
        path = self.path_of(recording_id)
        try:
            raw = path.with_suffix(".json").read_bytes()
            return msgspec.json.decode(raw, type=RecordingRecord)
        except (OSError, msgspec.MsgspecError):
            # A recording whose record is lost is still listed, with what its file shows.
            made_ns = path.stat().st_mtime_ns if path.exists() else 0
            return RecordingRecord(
                id=recording_id,
                state=STORED,
                created_ns_utc=made_ns,
                duration_s=0.0,
                who="",
                why="",
            )

    def write(self, record: RecordingRecord) -> None:
        """Remember what is known of one.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        _write_sidecar(self.path_of(record.id), msgspec.json.encode(record))

    @override
    def kept(self, records: Iterable[RecordingRecord]) -> dict[str, str]:
        """Return who has requested each."""
        return {one.id: f"requested by {one.who}: {one.why}" for one in records}

    def matrix(self, recording_id: str) -> None:
        """Read a whole recording, as those of other folders read a matrix.

        Raises
        ------
        ArchiveError
            If it cannot be read.
        """
        try:
            with Recording(self.path_of(recording_id)) as recording:
                # Reading finds the damage: a recording has no checksum.
                for _ in recording.messages():
                    pass
        except (ConfigurationError, OSError, RuntimeError, ValueError, KeyError) as error:
            raise ArchiveError(f"{self.path_of(recording_id)}: damaged: {error}") from error


def _write_sidecar(path: Path, text: bytes) -> None:
    """Write JSON next to a product; concurrent readers find the previous text, complete.

    Raises
    ------
    StorageError
        If the disk refuses.
    """
    sidecar = path.with_suffix(".json")
    try:
        replace_file(sidecar, text)
    except OSError as error:
        raise StorageError(f"{sidecar}: cannot be written: {error}") from error


def _fill(
    file: h5py.File,
    record: MeasurementRecord,
    finding: NoisyFinding,
    numbers: NoisyNumbers,
    instrument: str,
) -> None:
    # pyrcal fit reads the noise of the columns with the matrix and its modes
    power = np.einsum("ij,ij->j", numbers.noise, numbers.noise, dtype=np.float64)
    file["noise"] = np.sqrt(power / len(numbers.noise))
    file["noise"].attrs["description"] = "(n_modes,), RMS over slopes of element_noise"
    file["element_noise"] = np.asarray(numbers.noise, "<f4")
    file["element_noise"].attrs["description"] = "(n_slopes, n_modes), 1 sigma of each element"
    file["synthetic"] = np.asarray(numbers.synthetic, "<f4")
    file["synthetic"].attrs["description"] = "(n_slopes, n_modes), the model at the fitted alpha"
    for name in ("optical_gain", "gain_sigma", "snr"):
        file[name] = getattr(numbers, name)
    if finding.covariance is not None:
        put_covariance(file, finding.covariance)
    file.attrs.update(
        {
            "modes": np.array(record.modes, dtype=np.int64),
            "amplitude_m": record.each_m,
            "total_m": record.total_m,
            "seed": record.seed or 0,
            "duration_s": record.duration_s or 0.0,
            "n_frames": finding.n_frames,
            "n_missing": finding.n_missing,
            "element_snr": finding.snr,
            "session": finding.session,
            "cm_id": finding.cm_id or "",
            "basis_id": record.basis_id or "",
            "config_id": record.config_id or "",
            "created_ns": finding.created_ns_utc,
            "instrument": instrument,
        }
        | ({} if finding.alpha is None else finding.alpha.to_boundary())
    )


def _attributes(record: ReconstructorRecord) -> dict[str, Provenance]:
    """Return the attributes of the file, each with its unit in its name."""
    values: dict[str, Provenance] = {
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
    """Store the table of loop gains next to the matrix, which does not contain them."""
    table = gain_table(record.optical_gains, record.n_modes)
    group = file.create_group("gains")
    group.attrs["description"] = "optical gain of every mode; not part of the reconstructor"
    group.attrs["measured_modes"] = [gain.mode for gain in record.optical_gains]
    group.attrs["measured_gain"] = [gain.gain for gain in record.optical_gains]
    group.attrs["measured_sigma"] = [gain.sigma for gain in record.optical_gains]
    group["optical_gain"] = table.optical_gain
    group["relative_sigma"] = table.relative_sigma
    group["factor"] = table.factors
    group["factor"].attrs["description"] = "multiplies one loop gain for all modes"
