"""Results on disk, each under a name that says what it was computed from.

A task is a frozen record of everything that decides its result; those it builds on are among its
fields. Its name is a digest of all that, so another parameter is another file, and a result is
never taken for that of another question. Two worker processes compute what is missing.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import structlog
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.errors import say

Record = Mapping[str, NDArray[Any]]
"""Named arrays: what a task comes to."""


class Task(Protocol):
    """One step, small enough to be repeated and large enough to be worth keeping."""

    @property
    def needs(self) -> tuple[Task, ...]:
        """Tasks whose results must be there first."""

    def compute(self, store: Store) -> Record:
        """Return the result, reading those it needs from the store."""


class Store:
    """A folder of results."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, task: Task) -> Path:
        """Return where the result of this task is or will be."""
        digest = hashlib.sha256(repr(task).encode()).hexdigest()[:16]
        return self.folder / f"{type(task).__name__}-{digest}.npz"

    def has(self, task: Task) -> bool:
        """Return whether the task has been done."""
        return self.path(task).exists()

    def read(self, task: Task) -> Record:
        """Return the result of a task that has been done."""
        with np.load(self.path(task), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}

    def write(self, task: Task, record: Record) -> None:
        """Keep a result; a run that is cut off leaves a whole file or none."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.path(task)
        unfinished = path.with_suffix(f".{os.getpid()}.part")
        with unfinished.open("wb") as file:
            np.savez(file, **record)  # type: ignore[arg-type]
        unfinished.replace(path)


def in_order(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
    """Return the tasks and all they need, once each, every one after those it needs."""
    found: dict[str, Task] = {}

    def visit(task: Task) -> None:
        name = repr(task)
        if name in found:
            return
        for needed in task.needs:
            visit(needed)
        found[name] = task

    for task in tasks:
        visit(task)
    return tuple(found.values())


PROCESSOR_S = "processor_s"
"""Name of the array that says what a step took of a processor, seconds."""

_NICENESS = 5
_SHOWN_EVERY_S = 10.0
"""Time between two lines on the progress."""


def carry_out(
    tasks: tuple[Task, ...], store: Store, *, n_workers: int, executor: Executor | None = None
) -> float:
    """Do what is not in the store yet, dependencies first; return the seconds it took.

    Without an executor it makes one of ``n_workers`` processes; at its end it is shut down.
    """
    waiting = [task for task in in_order(tasks) if not store.has(task)]
    if not waiting:
        return 0.0
    n_steps, started = len(waiting), time.monotonic()
    if executor is None:
        executor = ProcessPoolExecutor(
            n_workers, multiprocessing.get_context("spawn"), initializer=_settle_in
        )
    running: dict[Future[None], Task] = {}
    shown_s = 0.0
    try:
        while waiting or running:
            for task in _ready(waiting, store)[: n_workers - len(running)]:
                waiting.remove(task)
                running[executor.submit(_work, task, store.folder)] = task
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                task = running.pop(future)
                future.result()
                left = len(waiting) + len(running)
                if time.monotonic() - shown_s > _SHOWN_EVERY_S or not left:
                    shown_s = time.monotonic()
                    say(f"paper: {n_steps - left} of {n_steps} steps, {type(task).__name__}")
    except KeyboardInterrupt:
        sys.stderr.write("\npaper: interrupted; the steps under way are finished first\n")
        raise
    finally:
        executor.shutdown(cancel_futures=True)
    return time.monotonic() - started


def processor_minutes(tasks: tuple[Task, ...], store: Store) -> float:
    """Return what all steps took of a processor, minutes."""
    return sum(float(store.read(task)[PROCESSOR_S]) for task in in_order(tasks)) / 60.0


def _ready(waiting: list[Task], store: Store) -> list[Task]:
    return [task for task in waiting if all(store.has(needed) for needed in task.needs)]


def _settle_in() -> None:
    os.nice(_NICENESS)
    # Ctrl-C reaches every process of the terminal: what is nearly done shall be kept.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # what the simulator tells its log would go to standard output, where only the report's name is
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))


def _work(task: Task, folder: Path) -> None:
    store = Store(folder)
    # One BLAS thread to a worker: nested threads would slow the frame loop down several times.
    with threadpool_limits(1):
        started = time.process_time()
        record = task.compute(store)
        store.write(task, {**record, PROCESSOR_S: np.array(time.process_time() - started)})
