"""The archive as the rest of the service uses it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Self

from service.archive import products
from service.archive.index import AuditEntry, Index, Pin, Range, Sent, begun_ns_utc
from service.archive.nights import Nights, TrendSample
from service.archive.serialisation import TrackingFile
from service.archive.store import FOLDER_MODE, Store
from service.errors import ArchiveError, StorageError, UnknownIdError
from service.files.durable import lock_file
from service.records.operations import MeasurementRecord
from service.records.products import ReconstructorRecord
from service.records.registration import HistoryEntry


class Archive:
    """Reconstructors, their states and the audit trail, in one directory.

    A call returns when its data is on the disk, so a service that is killed at any moment finds,
    after its restart, everything whose storage was reported, and no incomplete files. Calls may
    come from any thread and are executed one at a time; a call waits for the disk (tens of
    milliseconds for a FLAO matrix), so it must not run on an event loop with other work.

    Parameters
    ----------
    directory
        Made by :meth:`open` where it does not exist.
    noon_utc_h
        UTC hour of local noon, where one night ends and the next begins.
    """

    def __init__(self, directory: Path, noon_utc_h: int = 12) -> None:
        self.directory = directory
        self.index = Index(directory / "index.sqlite")
        """Index: state of each product, and the audit trail."""
        self.reconstructors = products.ReconstructorArchive(
            directory / "reconstructors", self.index
        )
        """Reconstructors made here or read from the RTC, and the fate of each."""
        self.references = products.ReferencesArchive(directory / "reference_slopes", self.index)
        """Offsets of reference slopes made here, and the fate of each."""
        self.measured = products.MeasuredArchive(directory / "interaction_matrices", self.index)
        """Interaction matrices the RTC has measured."""
        self.noisy = products.NoisyArchive(directory / "noisy_matrices", self.index)
        """Noisy interaction matrices of random dithers."""
        self.recordings = products.Recordings(directory / "recordings")
        """Recordings of telemetry that somebody requested."""
        self.stores: tuple[Store[Any] | products.Recordings, ...] = (
            self.reconstructors,
            self.references,
            self.measured,
            self.noisy,
            self.recordings,
        )
        self.tracking = TrackingFile(directory / "tracking.json")
        """Saved registration, for the next service."""
        self.nights = Nights(self.index.asked, self.index.add_row, noon_utc_h)
        """Nights: estimates of α, events, trends, notes."""
        self._lock: IO[str] | None = None
        self._on_disk = False
        self.wrong: tuple[str, ...] = ()
        """Problems that :meth:`open` has found, one line each."""

    def __enter__(self) -> Self:
        """Use an archive that is open; it is closed at the end."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def open(self) -> tuple[str, ...]:
        """Make the directory, open the index and bring it up to date with the products.

        A product that was complete but not yet in the index when the service was killed is indexed
        now; incomplete files are removed. A missing index is rebuilt from the products and the
        state files next to them.

        Returns
        -------
        One line for each problem: a product missing or damaged, an unreadable record, a file that
        cannot be removed, a lost index. Other products are not affected.

        Raises
        ------
        ArchiveError
            If the directory cannot be made, is in use by another service, or the index is
            damaged. A full disk is no error: the index is read into memory, and new records are
            refused until there is room.
        """
        try:
            self.directory.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            # Before anything is read: products are adopted below, which two services must not do at
            # once.
            self._lock = _lock_archive(self.directory / "lock")
        except OSError as error:
            self.close()
            raise ArchiveError(f"{self.directory}: cannot be used: {error}") from error
        try:
            lines = self._take_in()
        except StorageError as error:
            lines = self._take_into_memory(error)
        except ArchiveError:
            self.close()
            raise
        self.wrong = tuple(lines)
        return self.wrong

    def _take_in(self) -> list[str]:
        """Bring folders and index up to date with each other; return a line for what is wrong."""
        try:
            lines = [line for folder in self.stores for line in folder.prepare()]
        except OSError as error:
            raise StorageError(f"{self.directory}: cannot be used: {error}") from error
        anew = self.index.open()
        lines += [line for folder in self.stores for line in folder.adopt(anew=anew)]
        # A new archive has neither index nor products; products without an index mean a loss.
        if anew and (n_products := len(self.reconstructors.records())):
            lost = self.directory / "index.sqlite"
            text = f"missing; rebuilt from {n_products} products; the audit trail begins here"
            lines.append(f"{lost}: {text}")
        self._on_disk = True
        return lines

    def _take_into_memory(self, error: StorageError) -> list[str]:
        """Do the same in memory, for as long as the disk refuses to be written."""
        anew = self.index.open_copy()
        lines = [line for folder in self.stores for line in folder.adopt(anew=anew)]
        # After the adoption, which changes the copy.
        self.index.forbid_writing()
        return [*lines, f"{error}: the service runs on what it could read, and records nothing yet"]

    def look(self) -> None:
        """Open the archive to read it, even while a service uses it; nothing is updated.

        Raises
        ------
        ArchiveError
            If there is none, or it cannot be read.
        """
        if not (self.directory / "index.sqlite").is_file():
            raise ArchiveError(
                f"{self.directory}: found no index.sqlite, expected the data_dir of a service"
            )
        self.index.look()

    def pin(self, pin: Pin) -> None:
        """Keep a product for ever.

        Raises
        ------
        UnknownIdError
            If its numbers are not here.
        StorageError
            If the disk refuses.
        """
        if not any(pin.id in store.stored() for store in self.stores):
            raise UnknownIdError(f"{pin.id}: no such product in the archive")
        self.index.pin(pin)

    def unpin(self, product_id: str) -> None:
        """Let a product go when its time has come.

        Raises
        ------
        UnknownIdError
            If it was not pinned.
        StorageError
            If the disk refuses.
        """
        if not self.index.unpin(product_id):
            raise UnknownIdError(f"{product_id}: it is not pinned")

    def close(self) -> None:
        """Close the index and let another service use the directory."""
        self.index.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def record(
        self,
        records: Sequence[Sent],
        entries: Sequence[AuditEntry],
        estimates: Sequence[HistoryEntry] = (),
        samples: Sequence[TrendSample] = (),
    ) -> None:
        """Remember where products sent are, add to audit trail and history: all or nothing.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        # The disk refused when the archive was opened: the index is still the copy in memory.
        if not self._on_disk:
            self._take_in()
        for record in records:
            # Files before the index: the index can be rebuilt from them.
            if isinstance(record, ReconstructorRecord):
                self.reconstructors.write_state(record)
            else:
                self.references.write_state(record)
        self.index.record(records, entries, estimates, samples)

    def measurements(self) -> tuple[MeasurementRecord, ...]:
        """Return what is known of each measured interaction matrix, oldest first."""
        both = (*self.measured.records(), *self.noisy.records())
        return tuple(sorted(both, key=begun_ns_utc))

    def probe(self) -> None:
        """Write a file as large as the largest matrix so far, and remove it.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        path = self.reconstructors.directory / "probe.part"
        try:
            with path.open("wb") as file:
                for start in range(0, self.reconstructors.largest_bytes, products.PROBE_BYTES):
                    left = self.reconstructors.largest_bytes - start
                    # Real zeros are written, because a sparse file would take no space.
                    file.write(bytes(min(products.PROBE_BYTES, left)))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error}") from error
        finally:
            # The file does not exist if the disk refused to open it.
            path.unlink(missing_ok=True)

    def audit_trail(self, part: Range | None = None) -> tuple[AuditEntry, ...]:
        """Return the entries of a part of the audit trail, oldest first; None: the last ones."""
        return self.index.audit_trail(part or Range())


def _lock_archive(path: Path) -> IO[str]:
    file = path.open("a")
    try:
        lock_file(file, path.parent)
    except BlockingIOError:
        file.close()
        raise ArchiveError(f"{path.parent}: in use by another service") from None
    except (OSError, StorageError):
        file.close()
        raise
    return file
