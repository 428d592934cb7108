"""What tests of several modules share of unit.runtime.test_supervisor."""

from __future__ import annotations

import asyncio
import contextlib

from tests.support.pace import Deadline


async def until(condition, timeout_s=5.0):
    deadline = Deadline(timeout_s)
    while not condition():
        assert not deadline.passed, f"not within {deadline}"
        await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def running(supervisor):
    task = asyncio.create_task(supervisor.run())
    try:
        await until(lambda: supervisor.snapshot().ready, 30.0)
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
