"""The worker process as the event loop sees it: one job at a time, replaced when it dies."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from service.errors import PyrcalError, WorkerError
from service.worker import Workbench, run_job

P = ParamSpec("P")
R = TypeVar("R")


class Crew:
    """Hands jobs to an executor made by ``hire``; a dead worker costs one job, not the service."""

    def __init__(self, hire: Callable[[], Executor]) -> None:
        self._hire = hire
        self._executor: Executor | None = None
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
        if self._executor is None:
            self._executor = self._hire()
        work = partial(run_job, job, *args, **kwargs)
        executor = self._executor
        try:
            done = await asyncio.get_running_loop().run_in_executor(executor, work)
        except BrokenProcessPool as error:
            if self._executor is executor:
                self._executor = None
                self.n_lost += 1
            raise WorkerError(f"the worker process died during {job.__name__}") from error
        except PyrcalError:
            raise
        except Exception as error:
            raise WorkerError(f"{job.__name__} failed in the worker: {error!r}") from error
        self.cpu_s[job.__name__] += done.cpu_s
        return done.result

    def dismiss(self) -> None:
        """End the worker; jobs that wait are dropped."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=False, cancel_futures=True)
