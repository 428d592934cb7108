"""The service's ways out of the core, led to a simulated telescope: link, worker, archive."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.archive import Archive
from service.archive.product import Provenance
from service.errors import PyrcalError, UnknownIdError, WorkerError
from service.rtc_bridge import Bridge, Endpoint
from service.runtime.workers import WorkerPool
from service.state import ReconstructorRecord
from service.wire import Acknowledgement, Command, Manifest, Reply, split
from service.worker import Workbench, Worker
from sim_rtc.reconstructors import Outcome, Staging, Verdict
from studies.campaign.observatory_dome import Dome

P = ParamSpec("P")
R = TypeVar("R")


class ShortLink(Bridge):
    """A link without a network: commands are carried out at once, matrices wait to be delivered."""

    def __init__(self, dome: Dome) -> None:
        super().__init__(Endpoint(system=dome.computer.identity.system))
        self._dome = dome
        self._staging = Staging(dome.computer.terms, limit_bytes=dome.computer.largest_matrix_bytes)
        self.sent: list[tuple[Manifest, NDArray[np.float32]]] = []
        """Matrices on their way to the RTC."""

    @override
    async def command(self, command: Command) -> Reply:
        """Return the RTC's answer."""
        return self._dome.order(command)

    @override
    async def publish(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Put a matrix on its way; ``deliver`` brings it to the RTC."""
        self.sent.append((manifest, matrix))

    @override
    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix the RTC uses."""
        active = self._dome.computer.snapshot().reconstructor
        return active.manifest, active.matrix

    @override
    def offer(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Do nothing: the RTC is never late."""

    @override
    def set_current(self, matrix_id: str | None) -> None:
        """Do nothing: the RTC is never late."""

    def deliver(self, manifest: Manifest, matrix: NDArray[np.float32]) -> list[Acknowledgement]:
        """Hand the RTC a matrix the way it comes over the wire, and return what it says."""
        parts = split(matrix, manifest.layout.chunk_bytes)
        for index, part in enumerate(parts):
            self._carry_out(self._staging.chunk(manifest.id, index, part))
        return self._carry_out(self._staging.commit(manifest, self._dome.time_s))

    def swapped(self) -> list[Acknowledgement]:
        """Return what the RTC says of the matrices it has begun to use."""
        verdicts = [self._staging.applied(*swap) for swap in self._dome.computer.take_swaps()]
        return [self._told(verdict) for verdict in verdicts if verdict is not None]

    def void(self) -> None:
        """Forget what was on its way: the RTC has restarted."""
        self.sent.clear()
        self._staging.void()

    def _carry_out(self, outcome: Outcome) -> list[Acknowledgement]:
        for reconstructor in outcome.staged:
            self._dome.stage(reconstructor)
        return [self._told(verdict) for verdict in outcome.verdicts]

    def _told(self, verdict: Verdict) -> Acknowledgement:
        return Acknowledgement(
            session=self._dome.computer.snapshot().session,
            id=verdict.id,
            sha256=verdict.sha256,
            state=verdict.state,
            reason=verdict.reason,
            frame_seq=verdict.frame_seq,
        )


class OwnHands(WorkerPool):
    """A worker that is no process of its own: the workbench itself."""

    def __init__(self, workbench: Workbench) -> None:
        super().__init__(_nobody)
        self._workbench = workbench

    @override
    async def call(
        self, job: Callable[Concatenate[Workbench, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the workbench now; what goes wrong is said as the worker would."""
        before_s = time.process_time()
        try:
            return job(self._workbench, *args, **kwargs)
        except PyrcalError:
            raise
        except Exception as error:
            raise WorkerError(f"{job.__name__} failed in the worker: {error!r}") from error
        finally:
            self.cpu_s[job.__name__] += time.process_time() - before_s


class Shelf(Archive):
    """Keeps reconstructors in memory: a simulated night is over when its program ends."""

    def __init__(self) -> None:
        super().__init__(Path("nowhere"))
        self._matrices: dict[str, NDArray[np.float32]] = {}

    @override
    def store(
        self,
        record: ReconstructorRecord,
        matrix: NDArray[np.float32],
        covariance: NDArray[np.float64] | None,
        provenance: Mapping[str, Provenance],
    ) -> None:
        """Keep the numbers."""
        self._matrices[record.id] = matrix

    @override
    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor, ``(n_modes, n_slopes)``.

        Raises
        ------
        UnknownIdError
            If it was never stored here.
        """
        if matrix_id not in self._matrices:
            raise UnknownIdError(f"no reconstructor {matrix_id}")
        return self._matrices[matrix_id]


def _nobody() -> Worker:
    raise WorkerError("a simulated night has no worker process")
