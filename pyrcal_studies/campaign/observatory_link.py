"""The service's ways out of the core, led to a simulated telescope: link, worker, archive."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.staging import Outcome, Staging
from pyrcal_studies.campaign.observatory_dome import Dome
from service.archive.products import NoisyNumbers
from service.archive.store import Provenance
from service.errors import PyrcalError, UnknownIdError, WorkerError
from service.model.slopes import SlopeRecipe
from service.runtime.worker import Done, OpticsWorker
from service.tracking.operation_records import MeasurementRecord
from service.tracking.products import ReconstructorRecord
from service.wire import Acknowledgement, Command, Manifest, Reply, split

P = ParamSpec("P")
R = TypeVar("R")


class ShortLink:
    """A link without a network: commands are carried out at once, matrices wait to be delivered."""

    def __init__(self, dome: Dome) -> None:
        self._dome = dome
        self._staging = self._new_staging()
        self.sent: list[tuple[Manifest, NDArray[np.float32]]] = []
        """Matrices on their way to the RTC."""

    def _new_staging(self) -> Staging:
        computer = self._dome.computer
        return Staging(computer.terms, limit_bytes=computer.largest_matrix_bytes)

    async def command(self, command: Command) -> Reply:
        """Return the RTC's answer."""
        return self._dome.order(command)

    async def publish(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Put a matrix on its way; ``deliver`` brings it to the RTC."""
        self.sent.append((manifest, matrix))

    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix the RTC uses."""
        active = self._dome.computer.reconstructor
        return active.manifest, active.matrix

    def offer(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Do nothing: the RTC is never late."""

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
        said = [self._staging.applied(*swap) for swap in self._dome.computer.take_swaps()]
        return [self._told(one) for one in said if one is not None]

    def void(self) -> None:
        """Forget what was on its way: the RTC has restarted."""
        self.sent.clear()
        self._staging = self._new_staging()

    def _carry_out(self, outcome: Outcome) -> list[Acknowledgement]:
        for reconstructor in outcome.staged:
            self._dome.stage(reconstructor)
        return [self._told(one) for one in outcome.acknowledgements]

    def _told(self, acknowledgement: Acknowledgement) -> Acknowledgement:
        """Return what is heard of it."""
        return acknowledgement


class OwnHands:
    """A worker that is no process of its own: the workbench itself."""

    def __init__(self, workbench: OpticsWorker) -> None:
        self.first: Callable[[], Done[None]] | None = None
        self.found_slopes: SlopeRecipe | None = None
        self.cpu_s: defaultdict[str, float] = defaultdict(float)
        """Processor time of the jobs, seconds, by name."""

        self.broken = ""
        """Why no job can be done; empty: all can."""

        self._workbench = workbench

    async def call(
        self, job: Callable[Concatenate[OpticsWorker, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the workbench now; what goes wrong is said as the worker would."""
        before_s = time.process_time()
        if self.broken:
            raise WorkerError(self.broken)
        try:
            return job(self._workbench, *args, **kwargs)
        except PyrcalError:
            raise
        except Exception as error:
            raise WorkerError(f"{job.__name__} failed in the worker: {error!r}") from error
        finally:
            self.cpu_s[job.__name__] += time.process_time() - before_s


class Kept:
    """Keeps interaction matrices in memory."""

    def __init__(self) -> None:
        self.records: list[MeasurementRecord] = []

    def store(
        self,
        record: MeasurementRecord,
        numbers: NDArray[np.float32] | NoisyNumbers,
        name: str,
    ) -> None:
        """Keep what is known of one; nobody asks for its numbers."""
        self.records.append(record)


class KeptReconstructors:
    """Keeps reconstructors in memory."""

    def __init__(self) -> None:
        self._matrices: dict[str, NDArray[np.float32]] = {}

    def store(
        self,
        record: ReconstructorRecord,
        matrix: NDArray[np.float32],
        covariance: NDArray[np.float64] | None,
        provenance: Mapping[str, Provenance],
    ) -> None:
        """Keep the numbers."""
        self._matrices[record.id] = matrix

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


class Shelf:
    """Keeps matrices in memory: a simulated night is over when its program ends."""

    def __init__(self) -> None:
        self.reconstructors = KeptReconstructors()
        self.measured, self.noisy = Kept(), Kept()
