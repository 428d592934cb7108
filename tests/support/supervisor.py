"""What tests of several modules share of unit.runtime.test_supervisor."""

from __future__ import annotations

import asyncio
import contextlib
from types import SimpleNamespace

from service.estimation.windows import Telemetry
from tests.support.pace import Deadline


class Window(SimpleNamespace):
    """A window of telemetry with no more than a test is about."""

    refuse = Telemetry.refuse


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
