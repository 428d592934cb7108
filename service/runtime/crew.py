"""The worker process as the event loop sees it: one job at a time, replaced when it dies."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from service.errors import WorkerError
from service.worker import Done, Workbench, Worker, run_job

P = ParamSpec("P")
R = TypeVar("R")


class Crew:
    """Hands jobs to a worker made by ``hire``; a dead one costs one job, not the service."""

    def __init__(self, hire: Callable[[], Worker]) -> None:
        self._hire = hire
        self._worker: Worker | None = None
        self._turn = asyncio.Lock()
        self.first: Callable[[], Done[None]] | None = None
        """What every new worker does before anything else; None: nothing."""

        self.n_lost = 0
        self.cpu_s: defaultdict[str, float] = defaultdict(float)
        """Processor time of the worker by name of the job, seconds; a job that fails is not in."""

    async def call(
        self, job: Callable[Concatenate[Workbench, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the workbench and return its result.

        Raises
        ------
        WorkerError
            If the worker process died, and a new one is there for the next job; or if the job
            failed in a way nobody foresaw, which must not end the service.
        """
        async with self._turn:
            done = await self._done(job.__name__, partial(run_job, job, *args, **kwargs))
        self.cpu_s[job.__name__] += done.cpu_s
        return done.result

    async def _done(self, name: str, work: Callable[[], Done[R]]) -> Done[R]:
        hired = self._worker is None
        worker = self._worker = self._worker or self._hire()
        try:
            if hired and self.first is not None:
                await asyncio.to_thread(worker.run, self.first)
            return await asyncio.to_thread(worker.run, work)
        except EOFError as error:
            self.n_lost += 1
            self.dismiss()
            raise WorkerError(f"the worker process died during {name}") from error
        except WorkerError as error:
            raise WorkerError(f"{name} {error}") from error
        except asyncio.CancelledError:
            self.dismiss()  # it would go on with what nobody waits for
            raise

    def dismiss(self) -> None:
        """End the worker, whatever it is at; the next job finds a new one."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.kill()
