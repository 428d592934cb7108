"""Two worker processes that do what is not done yet, and a line that says how far they are."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from threadpoolctl import threadpool_limits

from studies.heritier2018.store import Store, Task, in_order

_NICENESS = 5
_BAR_CELLS = 24
_PLAIN_EVERY_S = 30.0
"""Between two lines where the bar cannot be redrawn in place."""


@dataclass(slots=True, kw_only=True)
class Progress:
    """One line: share of the work done, steps, what ended last, time left."""

    total_s: float
    """Cost of all that is to be done in this run, seconds on one core."""

    n_steps: int
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    done_s: float = 0.0
    n_done: int = 0
    _started: float = field(default_factory=time.monotonic)
    _shown: float = float("-inf")

    def step(self, task: Task) -> None:
        """Count a task that has ended."""
        self.done_s += task.cost_s
        self.n_done += 1
        self._show(task.label)

    def left_s(self) -> float:
        """Return how long the rest will take if it goes on like this; 0 before the first step."""
        if not self.done_s:
            return 0.0
        return (time.monotonic() - self._started) * (self.total_s / self.done_s - 1.0)

    def line(self, label: str) -> str:
        """Return the line, without its end."""
        share = self.done_s / self.total_s if self.total_s else 1.0
        full = round(share * _BAR_CELLS)
        bar = "#" * full + "." * (_BAR_CELLS - full)
        minutes, seconds = divmod(round(self.left_s()), 60)
        return (
            f"paper [{bar}] {share:4.0%}  {self.n_done}/{self.n_steps}  "
            f"{minutes}:{seconds:02d} left  {label:.48s}"
        )

    def _show(self, label: str) -> None:
        last = self.n_done == self.n_steps
        if self.stream.isatty():
            self.stream.write("\r\x1b[K" + self.line(label) + ("\n" if last else ""))
        elif last or time.monotonic() - self._shown > _PLAIN_EVERY_S:
            self._shown = time.monotonic()
            self.stream.write(self.line(label) + "\n")
        self.stream.flush()


def carry_out(
    tasks: tuple[Task, ...], store: Store, *, n_workers: int, executor: Executor | None = None
) -> float:
    """Do what is not in the store yet, dependencies first; return the seconds it took.

    Without an executor it makes one of ``n_workers`` processes; at its end it is shut down.
    """
    waiting = [task for task in in_order(tasks) if not store.has(task)]
    if not waiting:
        return 0.0
    started = time.monotonic()
    progress = Progress(total_s=sum(task.cost_s for task in waiting), n_steps=len(waiting))
    if executor is None:
        executor = ProcessPoolExecutor(
            n_workers, multiprocessing.get_context("spawn"), initializer=_settle_in
        )
    running: dict[Future[None], Task] = {}
    try:
        while waiting or running:
            for task in _ready(waiting, store)[: n_workers - len(running)]:
                waiting.remove(task)
                running[executor.submit(_work, task, store.folder)] = task
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                task = running.pop(future)
                future.result()
                progress.step(task)
    except KeyboardInterrupt:
        progress.stream.write("\npaper: interrupted; the steps under way are finished first\n")
        raise
    finally:
        executor.shutdown(cancel_futures=True)
    return time.monotonic() - started


def _ready(waiting: list[Task], store: Store) -> list[Task]:
    return [task for task in waiting if all(store.has(needed) for needed in task.needs)]


def _settle_in() -> None:
    os.nice(_NICENESS)
    # Ctrl-C reaches every process of the terminal: what is nearly done shall be kept.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(task: Task, folder: Path) -> None:
    store = Store(folder)
    # One BLAS thread to a worker: nested threads would slow the frame loop down several times.
    with threadpool_limits(1):
        store.write(task, task.compute(store))
