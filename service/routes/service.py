"""What REST needs of the service: a snapshot to read, a place to hand commands to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Protocol

import numpy as np
from fastapi import Depends, Request
from numpy.typing import NDArray

from service.events import Command
from service.state import TrackerState, Waiting


class Link(Protocol):
    """Counters of the link to the RTC, of all sessions together since the service started."""

    @property
    def rtc_alive(self) -> bool:
        """Whether the RTC's liveliness token is there."""

    @property
    def session(self) -> str | None:
        """The session that counts; None: none has been heard."""

    @property
    def frame_age_s(self) -> float | None:
        """Seconds since the last frame arrived; None: none has."""

    @property
    def latency_p50_s(self) -> float | None:
        """Median from put to callback, seconds; None: not known."""

    @property
    def batches_received(self) -> int:
        """Well-formed batches of this session, basis and configuration."""

    @property
    def frames_received(self) -> int:
        """Frames that could be used, recovered ones included."""

    @property
    def frames_lost(self) -> int:
        """Frames missing in the sequence; falls again when they are recovered."""

    @property
    def frames_recovered(self) -> int:
        """Frames that came after later ones and still found their place."""

    @property
    def frames_duplicate(self) -> int:
        """Frames that came again."""

    @property
    def frames_late(self) -> int:
        """Frames that came when their place had been passed."""

    @property
    def frames_nonfinite(self) -> int:
        """Frames dropped because a number in them was not finite."""

    @property
    def frames_overwritten(self) -> int:
        """Frames nobody drained in time, or that a new session made void."""

    @property
    def frames_refused(self) -> Mapping[str, int]:
        """Frames of batches not used, by reason."""

    @property
    def messages_malformed(self) -> Mapping[str, int]:
        """Messages that broke the contract, by kind."""

    @property
    def statuses_received(self) -> int:
        """Status messages of the RTC."""

    @property
    def acknowledgements_received(self) -> int:
        """Acknowledgements of reconstructors."""

    @property
    def acknowledgements_unknown(self) -> int:
        """Acknowledgements for an id this process has never offered."""

    @property
    def events_dropped(self) -> int:
        """Events of the link that gave way because nobody took them."""

    @property
    def callback_errors(self) -> int:
        """Faults of the service itself while it took a message in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """What the work of the last minute cost, and whether it keeps up."""

    worker_per_s: float | None = None
    """Processor time of the worker for each second of telemetry; None: there was none."""

    by_job: Mapping[str, float] = field(default_factory=dict)
    """The same by kind of job, what costs most first."""

    service_per_s: float | None = None
    """Processor time of the service itself for each second of the clock."""

    busy_ratio: float | None = None
    """Share of the time in which the worker had a job."""

    window_s: float | None = None
    """Mean length of the windows fitted, seconds; None: none was."""

    windows_late: int = 0
    """Windows that came while another still waited for the worker, and were joined to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """Everything a reader may want to know at one moment."""

    tracker: TrackerState
    """What is known of registration and reconstructors."""

    link: Link
    """What has passed on the link."""

    now_ns: int
    """When the snapshot was taken: the service's clock, nanoseconds since the Unix epoch."""

    started_ns: int
    """When the service started, on the same clock."""

    ready: bool
    """Whether it can do its work."""

    ready_reason: str
    """What it waits for, or that it waits for nothing."""

    waiting_for: tuple[Waiting, ...] = ()
    """Whom the service waits for and what they should do, what hinders most first."""

    pace: Pace = field(default_factory=Pace)
    """What the work costs."""

    estimate_arrival_ns: int | None = None
    """When the last window that entered the estimate arrived, on the service's clock.

    None: the age is judged by the RTC's timestamps, which is wrong where the clocks differ or a
    simulated RTC runs slower than its timestamps.
    """

    archive_failures: int = 0
    """Attempts to write that the disk has refused."""

    archive_waiting: int = 0
    """Lines of the audit trail that are not on the disk yet."""


class Service(Protocol):
    """The running service as the REST application sees it."""

    def snapshot(self) -> Snapshot:
        """Return what is known now; costs next to nothing."""

    async def submit(self, command: Command) -> str:
        """Set a command in motion and return one line that says what was.

        Raises
        ------
        CommandError
            If it cannot be carried out in the present state.
        UnknownIdError
            If it names an unknown reconstructor.
        StorageError
            If it cannot be recorded; nothing has been done.
        """

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor, ``(n_modes, n_slopes)``; called from a worker thread.

        Raises
        ------
        UnknownIdError
            If there is none of this id.
        ArchiveError
            If it is damaged.
        """

    def measured_matrix(self, measurement_id: str) -> NDArray[np.float32]:
        """Return a measured interaction matrix, ``(n_slopes, n_modes)``, slope per metre OPD.

        Called from a worker thread.

        Raises
        ------
        UnknownIdError
            If there is none of this id.
        ArchiveError
            If it is damaged.
        """

    def measured_file(self, measurement_id: str) -> bytes:
        """Return the HDF5 file of a measured interaction matrix; called from a worker thread.

        Raises
        ------
        UnknownIdError
            If there is none of this id.
        ArchiveError
            If it is missing.
        """

    def noisy_file(self, noisy_id: str) -> bytes:
        """Return the HDF5 file of a noisy interaction matrix; called from a worker thread.

        Raises
        ------
        UnknownIdError
            If there is none of this id.
        ArchiveError
            If it is missing or damaged.
        """


def _service_of(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(_service_of)]
"""The service a route works for."""
