"""One job in a process of its own: what it took is given back, and it can be ended at any time.

Unlike the crew's worker, which keeps the optical model between jobs and must always be near, such a
process has nothing to do with the telescope: tracking never waits for it.
"""

from __future__ import annotations

import asyncio
import resource
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from service.errors import WorkerError
from service.worker import Apart

R = TypeVar("R")


async def run_apart(
    work: Callable[[], R], *, nice: int, limit_s: float, memory_mb: int | None = None
) -> R:
    """Run ``work`` in a nice'd process and return its result; it must be picklable, like that.

    ``memory_mb`` bounds what the process may allocate, its program included.

    Raises
    ------
    PyrcalError
        What ``work`` has raised of this kind.
    WorkerError
        If it raised anything else, needs more memory, the process died, or ``limit_s`` have passed.
    """
    process = Apart(nice=nice)
    if memory_mb is not None:
        work = partial(_within, memory_mb, work)
    try:
        async with asyncio.timeout(limit_s):
            return await asyncio.to_thread(process.do, work)
    except TimeoutError as error:
        raise WorkerError(f"took longer than {limit_s:g} s and was stopped") from error
    except EOFError as error:
        raise WorkerError("the process of the job died; out of memory?") from error
    finally:
        process.kill()


def _within(memory_mb: int, work: Callable[[], R]) -> R:
    """Do the work in as much memory; in the process itself."""
    most_bytes = memory_mb * 1_000_000
    resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, most_bytes))
    try:
        return work()
    except MemoryError as error:
        text = f"needs more memory than {memory_mb} MB, the most it may have"
        raise WorkerError(text) from error
