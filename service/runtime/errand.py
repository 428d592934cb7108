"""One job in a process of its own: what it took is given back, and it can be ended at any time.

Unlike the crew's worker, which keeps the optical model between jobs and must always be near, such a
process has nothing to do with the telescope: tracking never waits for it.
"""

from __future__ import annotations

import asyncio
import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TypeVar, cast

from service.errors import PyrcalError, WorkerError
from service.worker import be_polite

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
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(theirs, work, nice), daemon=True)
    await asyncio.to_thread(process.start)
    theirs.close()  # else nobody would notice that the other end is gone
    try:
        async with asyncio.timeout(limit_s):
            answer = await asyncio.to_thread(_heard, ours)
    except TimeoutError as error:
        raise WorkerError(f"took longer than {limit_s:g} s and was stopped") from error
    finally:
        process.kill()
        await asyncio.to_thread(_ended, process, ours)
    if isinstance(answer, PyrcalError):
        raise answer
    return cast(R, answer)


def _heard(ours: Connection) -> object:
    try:
        return ours.recv()
    except (EOFError, OSError):
        return WorkerError("the process of the job died; out of memory?")


def _ended(process: BaseProcess, ours: Connection) -> None:
    process.join()
    ours.close()


def _run(theirs: Connection, work: Callable[[], object], nice: int) -> None:
    """Be the process: do the work and send what came of it."""
    be_polite(nice)
    try:
        answer = work()
    except PyrcalError as error:
        answer = error
    except Exception as error:  # noqa: BLE001 - sent home, where it is a failed job
        answer = WorkerError(f"failed unforeseen: {error!r}")
    theirs.send(answer)
