"""Two worker processes that do what is not done yet, and a line that says how far they are."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import time
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from pathlib import Path

import numpy as np
import structlog
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from threadpoolctl import threadpool_limits

from pyrcal_studies.heritier2018.store import Store, Task, in_order

PROCESSOR_S = "processor_s"
"""Name of the array that says what a step took of a processor, seconds."""

_NICENESS = 5
_PLAIN_EVERY_S = 30.0
"""Between two lines where the bar cannot be redrawn in place."""


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
    try:
        with _progress() as bar:
            work, told_s = bar.add_task("", total=sum(task.cost_s for task in waiting)), started
            while waiting or running:
                for task in _ready(waiting, store)[: n_workers - len(running)]:
                    waiting.remove(task)
                    running[executor.submit(_work, task, store.folder)] = task
                ended, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    task = running.pop(future)
                    future.result()
                    n_done = n_steps - len(waiting) - len(running)
                    told = f"{n_done}/{n_steps}  {task.label:.48s}"
                    bar.update(work, advance=task.cost_s, description=told)
                    if not bar.console.is_terminal and time.monotonic() - told_s > _PLAIN_EVERY_S:
                        bar.console.print(f"paper {told}", markup=False)
                        told_s = time.monotonic()
    except KeyboardInterrupt:
        sys.stderr.write("\npaper: interrupted; the steps under way are finished first\n")
        raise
    finally:
        executor.shutdown(cancel_futures=True)
    return time.monotonic() - started


def processor_minutes(tasks: tuple[Task, ...], store: Store) -> float:
    """Return what all steps took of a processor, minutes."""
    return sum(float(store.read(task)[PROCESSOR_S]) for task in in_order(tasks)) / 60.0


def _progress() -> Progress:
    """Return a line: share of the work, time left by its cost, steps, what ended last."""
    return Progress(
        TextColumn("paper"),
        BarColumn(24),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
        console=Console(stderr=True),
        speed_estimate_period=3600.0,
    )


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
