"""Results on disk, each under a name that says what it was computed from.

A task is a frozen record of everything that decides its result; those it builds on are among its
fields. Its name is a digest of all that, so another parameter is another file, and a result is
never taken for that of another question.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Record = Mapping[str, NDArray[Any]]
"""Named arrays: what a task comes to."""


class Task(Protocol):
    """One step, small enough to be repeated and large enough to be worth keeping."""

    @property
    def label(self) -> str:
        """What the progress bar shows."""

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""

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
