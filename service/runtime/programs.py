"""Programs that the service starts for what it does not do itself; they end with it."""

from __future__ import annotations

import asyncio
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Sequence

from service.errors import WorkerError


async def run_program(words: Sequence[str], *, limit_s: float) -> None:
    """Run a program to its end; it is ended when the time is over, or nobody waits for it.

    It holds the other end of its standard input: one that reads it sees when the service ends,
    however that does. Ctrl-C in the service's terminal does not reach it.

    Raises
    ------
    WorkerError
        If it cannot be started, dies, takes longer than ``limit_s``, or ends with another status
        than 0: what it said last on standard error.
    """
    try:
        process = await asyncio.create_subprocess_exec(
            *words, stdin=PIPE, stdout=DEVNULL, stderr=PIPE, start_new_session=True
        )
    except OSError as error:
        raise WorkerError(f"{words[0]}: cannot be started: {error.strerror}") from error
    assert process.stderr is not None  # noqa: S101 - asked for above
    try:
        async with asyncio.timeout(limit_s):
            said = await process.stderr.read()
            status = await process.wait()
    except TimeoutError as error:
        raise WorkerError(f"took longer than {limit_s:g} s and was stopped") from error
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if status < 0:
        raise WorkerError("the process of the job died; out of memory?")
    if status > 0:
        lines = said.decode(errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "it said nothing")
        raise WorkerError(last)
