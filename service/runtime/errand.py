"""One job in a process of its own: what it took is given back, and it can be ended at any time.

Unlike the crew's worker, which keeps the optical model between jobs and must always be near, such a
process has nothing to do with the telescope: tracking never waits for it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from service.errors import WorkerError
from service.worker import Apart

R = TypeVar("R")


async def run_apart(work: Callable[[], R], *, nice: int, limit_s: float) -> R:
    """Run ``work`` in a nice'd process and return its result; it must be picklable, like that.

    Raises
    ------
    PyrcalError
        What ``work`` has raised of this kind.
    WorkerError
        If it raised anything else, the process died, or ``limit_s`` have passed.
    """
    process = Apart(nice=nice)
    try:
        async with asyncio.timeout(limit_s):
            return await asyncio.to_thread(process.do, work)
    except TimeoutError as error:
        raise WorkerError(f"took longer than {limit_s:g} s and was stopped") from error
    except EOFError as error:
        raise WorkerError("the process of the job died; out of memory?") from error
    finally:
        process.kill()
