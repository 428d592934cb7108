"""Interfaces of RTC, worker and archive; simulated nights have others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.archive.products import NoisyNumbers
from service.archive.store import Provenance
from service.records.operations import MeasurementRecord
from service.records.products import ReconstructorRecord, ReferencesRecord
from service.runtime.worker import OpticsWorker
from service.wire import Command, Manifest, ReferencesInUse, Reply

P = ParamSpec("P")
R = TypeVar("R")
Numbers = TypeVar("Numbers", contravariant=True)


class RtcPort(Protocol):
    """The RTC as actions see it; :class:`service.rtc_bridge.Bridge` is the real one."""

    async def command(self, command: Command, /) -> Reply:
        """Send a command and return the RTC's answer, accepted or not."""

    async def publish(self, manifest: Manifest, matrix: NDArray[np.float32], /) -> None:
        """Send a reconstructor ``(n_modes, n_slopes)`` and the order to use it."""

    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the reconstructor the RTC uses."""

    async def fetch_references(self) -> ReferencesInUse:
        """Return the offset of the RTC's reference slopes."""

    def offer(self, manifest: Manifest, matrix: NDArray[np.float32], /) -> None:
        """Let an RTC ask for a reconstructor without sending it."""

    def set_current(self, matrix_id: str | None, /) -> None:
        """Say which offer a late RTC should use; None: none."""


class WorkerPort(Protocol):
    """Interface of the worker; :class:`service.runtime.workers.WorkerPool` is the real one."""

    async def call(
        self, job: Callable[Concatenate[OpticsWorker, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the workbench and return its result."""


class MeasuredPort(Protocol[Numbers]):
    """Store of measured interaction matrices of one kind."""

    def store(self, record: MeasurementRecord, numbers: Numbers, name: str, /) -> None:
        """Keep one of the instrument of that name."""


class ReconstructorPort(Protocol):
    """Store of reconstructors."""

    def store(
        self,
        record: ReconstructorRecord,
        matrix: NDArray[np.float32],
        covariance: NDArray[np.float64] | None,
        provenance: Mapping[str, Provenance],
        /,
    ) -> None:
        """Keep a reconstructor ``(n_modes, n_slopes)`` and what it was made from."""

    def matrix(self, matrix_id: str, /) -> NDArray[np.float32]:
        """Return a reconstructor that was kept; UnknownIdError if there is none."""


class ReferencesPort(Protocol):
    """Store of reference slopes."""

    def store(self, record: ReferencesRecord, offset: NDArray[np.float32], /) -> None:
        """Keep an offset ``(n_slopes,)``."""

    def matrix(self, reference_id: str, /) -> NDArray[np.float32]:
        """Return an offset that was kept; UnknownIdError if there is none."""


class StorePort(Protocol):
    """Stores of matrices; :class:`service.archive.Archive` is the real one."""

    @property
    def reconstructors(self) -> ReconstructorPort:
        """Reconstructors."""

    @property
    def references(self) -> ReferencesPort:
        """Reference slopes."""

    @property
    def measured(self) -> MeasuredPort[NDArray[np.float32]]:
        """Return matrices measured by the RTC, ``(n_slopes, n_modes)``."""

    @property
    def noisy(self) -> MeasuredPort[NoisyNumbers]:
        """Noisy ones, of random dithers."""
