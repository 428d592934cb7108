"""Recordings of telemetry, and what is known of each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import msgspec
from typing_extensions import override

from service.archive.store import Folder
from service.errors import ArchiveError, ConfigurationError, StorageError
from service.files.recording import Recording

RUNNING: Final = "running"
STORED: Final = "stored"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingRecord:
    """The record of a recording."""

    id: str
    state: str
    """"running" or "stored"."""

    created_ns_utc: int
    """When it began, the service's clock."""

    duration_s: float
    """How long it was to take."""

    who: str
    why: str
    before_s: float = 0.0
    """Of what had come before it began that is in it, seconds."""

    reason: str = ""
    """Why it ended before its time; empty: it did not."""

    n_bytes: int = 0
    n_dropped: int = 0
    """Messages that are not in it: the disk was too slow."""


class Recordings(Folder):
    """The folder of recordings: beside each, as JSON, what is known of it.

    They are kept until somebody removes them, and are no part of what ``keep_gb`` limits.
    """

    noun = "recording"
    counted = False
    lost_with_it = "it cannot be replayed, nor exported"

    def stored(self) -> frozenset[str]:
        """Return the ids of those that lie here."""
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
        path = self.path_of(record.id).with_suffix(".json")
        try:
            path.write_bytes(msgspec.json.encode(record))
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error}") from error

    @override
    def kept(self, records: Iterable[RecordingRecord]) -> dict[str, str]:
        """Return who has asked for each."""
        return {one.id: f"asked for by {one.who}: {one.why}" for one in records}

    def matrix(self, recording_id: str) -> None:
        """Read a whole recording, as those of other folders read a matrix.

        Raises
        ------
        ArchiveError
            If it cannot be read.
        """
        try:
            with Recording(self.path_of(recording_id)) as recording:
                for _ in recording.messages():
                    pass
        except (ConfigurationError, OSError, RuntimeError, ValueError, KeyError) as error:
            raise ArchiveError(f"{self.path_of(recording_id)}: damaged: {error}") from error
