"""A night whose service keeps what it knows on a disk, may be killed and is begun again from it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from typing_extensions import override

from pyrcal_studies.campaign.observatory import Latencies, Observatory
from pyrcal_studies.campaign.observatory_dome import Dome
from pyrcal_studies.campaign.observatory_link import ShortLink
from service.archive import Archive
from service.runtime.archiving import (
    SAVE_INTERVAL_S,
    is_unsaved,
    is_urgent,
    leave,
    restore_tracking,
)
from service.runtime.worker import OpticsWorker
from service.tracking.events import Event
from service.tracking.policy import Policy
from service.tracking.resume import restored
from service.tracking.state import MatrixStates, Mode, OperatorState, TrackerState

DOWN_S = 3.0
"""From the end of a service until the next one listens."""


class KeptNight(Observatory):
    """With a ``folder`` the service can be killed and begun again."""

    def __init__(
        self,
        policy: Policy,
        mode: Mode,
        bench: OpticsWorker,
        folder: Path | None,
        *,
        latencies: Latencies,
        dome: Dome,
        link: Callable[[Any], ShortLink],
    ) -> None:
        self._policy, self._mode, self._folder = policy, mode, folder
        self._archive = None if folder is None else _opened(folder)
        self._saved: TrackerState | None = None
        self._saved_s = 0.0
        super().__init__(
            (),
            policy,
            mode,
            bench,
            latencies=latencies,
            with_poles=False,
            dome=dome,
            link=link,
            archive=self._archive,
        )

    def kill(self) -> None:
        """End the service as ``kill -9`` does; another takes up what is on the disk.

        What was on its way to the RTC arrives; telescope and RTC go on.

        Raises
        ------
        ValueError
            If the night has no folder to begin again from.
        """
        if self._archive is None or self._folder is None:
            raise ValueError("kill: found a night without a folder; expected one that has")
        self._arrive()
        self._agenda.clear()
        self._idle_worker()
        self._archive.close()
        begun_s = self.time_s + DOWN_S
        while self.time_s < begun_s:
            self.dome.play()
            for _ in self._link.swapped():
                self._note_swap()
        self._archive = self._shelf = _opened(self._folder)
        self._actions = self._new_actions()
        state = TrackerState(
            system=self.state.system,
            operator=OperatorState(mode=self._mode),
            matrices=MatrixStates(reconstructors=restored(self._archive.reconstructors.records())),
        )
        self._engine.state = restore_tracking(self._archive, state, self._policy, self.now_ns())
        self._engine.begin_anew()
        self._begin()

    def close(self) -> None:
        """Close the archive."""
        if self._archive is not None:
            self._archive.close()

    @override
    def stepped(self, before: TrackerState, event: Event) -> None:
        """Keep what the tracker heard, and write what the service would."""
        super().stepped(before, event)
        after = self.state
        if (
            self._archive is not None
            and after.matrices.reconstructors is not before.matrices.reconstructors
        ):
            old = {record.id: record for record in before.matrices.reconstructors}
            news = tuple(r for r in after.matrices.reconstructors if old.get(r.id) is not r)
            self._archive.record(news, (), ())

    def save(self) -> None:
        """Write what the next service needs as seldom as the service does."""
        archive, state = self._archive, self.state
        before, due = self._saved, self.time_s >= self._saved_s + SAVE_INTERVAL_S
        if archive is None:
            return
        if before is None or ((due or is_urgent(before, state)) and is_unsaved(before, state)):
            leave(archive, state, self.now_ns())
            self._saved, self._saved_s = state, self.time_s


def _opened(folder: Path) -> Archive:
    archive = Archive(folder)
    archive.open()
    return archive
