import asyncio
import multiprocessing
import os
from functools import partial

import pytest

from service.errors import MatrixError, WorkerError
from service.runtime.workers import run_in_process
from tests.unit.runtime.jobs import (
    asleep_at,
    failing,
    hungry,
    killed,
    modest,
    refusing,
    who,
)

pytestmark = [pytest.mark.timeout(60), pytest.mark.usefixtures("light_processes")]


async def gone(folder):
    """Whether the process of the job, which waits for a minute, is there no more."""
    pid = int((folder / "pid").read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


async def test_every_job_has_a_process_of_its_own_and_it_is_nice():
    first, second = [await run_in_process(who, nice=4, limit_s=30.0) for _ in range(2)]
    assert len({first[0], second[0], os.getpid()}) == 3
    assert first[1] == second[1] == os.nice(0) + 4


async def test_what_a_job_refuses_is_said_as_it_said_it():
    with pytest.raises(MatrixError, match=r"^transposed$"):
        await run_in_process(refusing, nice=0, limit_s=30.0)


async def test_an_unforeseen_failure_is_a_lost_job():
    with pytest.raises(WorkerError, match="a bug in a job"):
        await run_in_process(failing, nice=0, limit_s=30.0)


async def test_a_killed_process_is_a_lost_job():
    with pytest.raises(WorkerError, match="died"):
        await run_in_process(killed, nice=0, limit_s=30.0)


async def test_a_job_that_takes_too_long_is_stopped(tmp_path):
    before = set(multiprocessing.active_children())  # a worker that other tests share
    with pytest.raises(WorkerError, match="longer than 3 s"):
        await run_in_process(partial(asleep_at, tmp_path), nice=0, limit_s=3.0)
    assert set(multiprocessing.active_children()) <= before


async def test_a_job_nobody_waits_for_is_stopped(tmp_path):
    waiting = asyncio.create_task(
        run_in_process(partial(asleep_at, tmp_path), nice=0, limit_s=60.0)
    )
    while not any(path.stat().st_size for path in tmp_path.iterdir()):  # noqa: ASYNC110 - it tells
        await asyncio.sleep(0.05)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    await gone(tmp_path)


async def test_a_job_that_needs_more_memory_than_it_may_have_is_told_how_much_that_is():
    with pytest.raises(WorkerError, match="needs more memory than 1500 MB"):
        await run_in_process(hungry, nice=0, limit_s=30.0, memory_mb=1500)


async def test_a_job_within_its_memory_is_done():
    assert await run_in_process(modest, nice=0, limit_s=30.0, memory_mb=1500) == 1e6
