"""The worker process: fits, reconstructors, verdicts.

A compute thread in the process that receives telemetry raises its latency thirty-fold; a process
with lower priority does not.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from service.model.instrument import Instrument
from service.records.state import ModelState
from service.runtime.processes import Worker, return_free_memory
from service.runtime.worker.optics_worker import OpticsWorker
from service.runtime.worker.records import Compute, Conditions, Made, Sampling

__all__ = [
    "Compute",
    "Conditions",
    "Done",
    "Made",
    "OpticsWorker",
    "Sampling",
    "run_job",
    "start_worker",
]

_open_worker: Callable[[], OpticsWorker] | None = None
"""Worker of this process; it is kept between jobs."""

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Done(Generic[R]):
    """Result of a job, and its cost."""

    result: R
    cpu_s: float
    """Processor time of the whole worker process, all its threads, seconds."""

    model: ModelState = field(default_factory=ModelState)
    """State of the model after the job."""

    arrays: Mapping[str, Any] = field(default_factory=dict)
    """Arrays of that state that the state before did not have, by their keys."""

    cluster_problem: str = ""
    """Problem of the cluster; empty if there is none."""


def start_worker(instrument: Instrument, compute: Compute, early: Worker | None = None) -> Worker:
    """Return a nice'd worker process; nothing runs before the first job but what began early."""
    return (early or Worker(__name__)).begun(functools.partial(_enter, instrument, compute))


def run_job(
    model: ModelState,
    arrays: Mapping[str, Any],
    job: Callable[Concatenate[OpticsWorker, P], R],
    *args: P.args,
    **kwargs: P.kwargs,
) -> Done[R]:
    """Run a method of the optics worker in its process, with the model in this state.

    ``arrays`` are those of the state that this process does not have yet.
    """
    if _open_worker is None:
        raise RuntimeError("not in a worker process")
    before_s, optics = time.process_time(), _open_worker()
    try:
        optics.restore(model, arrays)
        result = job(optics, *args, **kwargs)
    finally:
        optics.tidy()
        return_free_memory()  # a linearisation leaves hundreds of megabytes behind
    spent_s = time.process_time() - before_s
    return Done(
        result=result,
        cpu_s=spent_s,
        model=optics.state,
        arrays={key: optics.arrays[key] for key in optics.state.keys - model.keys},
        cluster_problem=optics.rows.problem,
    )


def _enter(instrument: Instrument, compute: Compute) -> None:
    """Prepare the worker process."""
    global _open_worker
    # The process began before the settings were read, at the service's own priority.
    os.nice(compute.nice)
    # Cached on success only: an error is raised again by the next job, in whose answer it can be
    # reported.
    _open_worker = functools.cache(lambda: OpticsWorker(instrument, compute))
    with contextlib.suppress(Exception):  # the first job meets it again, fails and says why
        _open_worker()
