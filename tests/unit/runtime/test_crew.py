import asyncio
import multiprocessing
import os
import signal
import time

import pytest

from service.errors import WorkerError
from service.runtime.crew import Crew
from service.worker import Workbench, start_worker
from tests.unit.runtime.small import COMPUTE, small_instrument

pytestmark = pytest.mark.timeout(60)


def process_id(_bench: Workbench) -> int:
    return os.getpid()


def niceness(_bench: Workbench) -> int:
    return os.nice(0)


def interrupted(_bench: Workbench) -> str:
    """Survive what Ctrl-C sends to the whole process group."""
    os.kill(os.getpid(), signal.SIGINT)
    return "still here"


def killed(_bench: Workbench) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def spinning(_bench: Workbench) -> None:
    end_s = time.process_time() + 0.2
    while time.process_time() < end_s:
        pass


def failing(_bench: Workbench) -> None:
    raise ValueError("a bug in a job")


@pytest.fixture
def hired():
    return []


@pytest.fixture
def crew(hired):
    instrument = small_instrument()

    def hire():
        hired.append(start_worker(instrument, COMPUTE))
        return hired[-1]

    crew = Crew(hire)
    yield crew
    crew.dismiss()
    for executor in hired:
        executor.shutdown(wait=True, cancel_futures=True)


async def test_nobody_is_hired_before_there_is_work(crew, hired):
    assert not hired
    assert await crew.call(process_id) != os.getpid()
    assert len(hired) == 1


async def test_jobs_share_one_worker_and_its_workbench(crew):
    first, second = await asyncio.gather(crew.call(process_id), crew.call(process_id))
    assert first == second
    assert (await crew.call(Workbench.describe)).n_modes == 90


async def test_a_killed_worker_costs_one_job_and_the_next_one_works(crew, hired):
    before = await crew.call(process_id)
    with pytest.raises(WorkerError, match="died during killed"):
        await crew.call(killed)
    assert await crew.call(process_id) != before
    assert (crew.n_lost, len(hired)) == (1, 2)


async def test_jobs_that_waited_for_a_killed_worker_are_lost_together(crew, hired):
    lost = await asyncio.gather(
        crew.call(killed), crew.call(process_id), crew.call(process_id), return_exceptions=True
    )
    assert all(isinstance(outcome, WorkerError) for outcome in lost)
    assert (crew.n_lost, len(hired)) == (1, 1)
    assert await crew.call(process_id)


async def test_a_job_that_raises_keeps_its_worker(crew, hired):
    before = await crew.call(process_id)
    with pytest.raises(WorkerError, match=r"failing failed in the worker.*a bug in a job"):
        await crew.call(failing)
    assert await crew.call(process_id) == before
    assert crew.n_lost == 0


async def test_the_worker_tells_the_processor_time_of_every_kind_of_job(crew):
    for _ in range(2):
        await crew.call(spinning)
    await crew.call(process_id)
    assert set(crew.cpu_s) == {"spinning", "process_id"}
    assert 0.4 <= crew.cpu_s["spinning"] < 2.0


async def test_an_interrupt_from_the_keyboard_is_the_services_business(crew):
    assert await crew.call(interrupted) == "still here"


async def test_the_worker_is_polite():
    executor = start_worker(small_instrument(), type(COMPUTE)(threads=1, nice=5))
    crew = Crew(lambda: executor)
    try:
        assert await crew.call(niceness) == os.nice(0) + 5
    finally:
        crew.dismiss()
        executor.shutdown(wait=True)


async def test_dismissing_ends_the_worker(crew, hired):
    await crew.call(process_id)
    crew.dismiss()
    for process in multiprocessing.active_children():
        process.join(5.0)
    assert not multiprocessing.active_children()
    crew.dismiss()
