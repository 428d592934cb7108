"""Programs that the service starts: what they say, and that none outlives whoever waits for it."""

import asyncio
import os
import sys

import pytest

from service.errors import WorkerError
from service.runtime.uploads import run_program

pytestmark = pytest.mark.timeout(60)

ASLEEP = """
import os, sys, time
with open(sys.argv[1], "w") as file:
    file.write(str(os.getpid()))
time.sleep(60.0)
"""


def python(text, *words):
    return [sys.executable, "-c", text, *map(str, words)]


async def begun(path):
    while not path.exists() or not path.read_text():  # noqa: ASYNC110 - it tells
        await asyncio.sleep(0.05)
    return int(path.read_text())


def assert_gone(pid):
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


async def test_a_program_that_ends_well_is_waited_for(tmp_path):
    await run_program(python("open(__import__('sys').argv[1], 'w')", tmp_path / "f"), limit_s=30.0)
    assert (tmp_path / "f").exists()


async def test_what_it_said_last_is_why_it_was_not_done():
    with pytest.raises(WorkerError, match=r"^transposed$"):
        await run_program(python("import sys; sys.exit('a warning\\ntransposed\\n')"), limit_s=30.0)


async def test_a_killed_program_is_a_lost_job():
    with pytest.raises(WorkerError, match="died"):
        await run_program(python("import os; os.kill(os.getpid(), 9)"), limit_s=30.0)


async def test_a_program_that_is_not_there_is_told(tmp_path):
    with pytest.raises(WorkerError, match="cannot be started: No such file"):
        await run_program([str(tmp_path / "nothing")], limit_s=30.0)


async def test_one_that_takes_too_long_is_stopped(tmp_path):
    with pytest.raises(WorkerError, match="longer than 1 s"):
        await run_program(python(ASLEEP, tmp_path / "pid"), limit_s=1.0)
    assert_gone(await begun(tmp_path / "pid"))


async def test_one_nobody_waits_for_is_stopped(tmp_path):
    words = python(ASLEEP, tmp_path / "pid")
    waiting = asyncio.create_task(run_program(words, limit_s=60.0))
    pid = await begun(tmp_path / "pid")
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert_gone(pid)
