"""A process of its own for the workbench, nice'd and gone when its parent is gone."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Concatenate, Generic, ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

from service.model.instrument import Instrument
from service.worker.bench import Workbench
from service.worker.records import Compute

_open_workbench: Callable[[], Workbench] | None = None
"""Of the worker process; an executor has no other place for what outlives a job."""

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Done(Generic[R]):
    """What came of a job, and what it cost."""

    result: R
    cpu_s: float
    """Processor time of the whole worker process, all its threads, seconds. The first job's holds
    the making of the workbench."""


def start_worker(instrument: Instrument, compute: Compute) -> ProcessPoolExecutor:
    """Return an executor of one nice'd worker process; nothing runs before the first job."""
    return ProcessPoolExecutor(
        max_workers=1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_enter,
        initargs=(instrument, compute),
    )


def run_job(
    job: Callable[Concatenate[Workbench, P], R], *args: P.args, **kwargs: P.kwargs
) -> Done[R]:
    """Run a method of the workbench in the worker process."""
    if _open_workbench is None:
        raise RuntimeError("not in a worker process")
    before_s = time.process_time()
    result = job(_open_workbench(), *args, **kwargs)
    return Done(result=result, cpu_s=time.process_time() - before_s)


def _enter(instrument: Instrument, compute: Compute) -> None:
    """Prepare the worker process."""
    global _open_workbench
    be_polite(compute.nice)
    # made by the first job, so that an impossible instrument fails that job and says why
    _open_workbench = functools.cache(lambda: Workbench(instrument, compute))


def be_polite(nice: int) -> None:
    """Make this process nice, one BLAS thread wide, and gone when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(nice)
    threading.Thread(target=_follow_parent, daemon=True).start()
    threadpool_limits(1)


def _follow_parent() -> None:
    """End with the service, even when it was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        with contextlib.suppress(OSError):
            parent.join()
        os._exit(1)
