import asyncio
import multiprocessing
import os
import signal
import time

import pytest

from service.errors import WorkerError
from service.records.alarms import Alarm
from service.records.messages import as_message
from service.records.state import ModelState, TrackerState
from service.runtime import workers as crew_module
from service.runtime import workers as workers_module
from service.runtime.estimates import work_out
from service.runtime.processes import Worker
from service.runtime.worker import OpticsWorker, start_worker
from service.runtime.workers import WorkerLoadMeter, WorkerPool
from tests.support.jobs import (
    asleep,
    endless,
    failing,
    interrupted,
    killed,
    measured,
    measuring,
    napping,
    niceness,
    process_id,
    spinning,
)
from tests.support.pace import in_time
from tests.support.small import COMPUTE, small_instrument
from tests.support.states import tracker_state

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def hired():
    return []


@pytest.fixture
def workers(hired):
    instrument = small_instrument()

    def start():
        hired.append(start_worker(instrument, COMPUTE))
        return hired[-1]

    workers = WorkerPool(start)
    yield workers
    workers.close()


@pytest.fixture(scope="module")
def shared():
    """Of tests that leave its worker as they found it."""
    workers = WorkerPool(lambda: start_worker(small_instrument(), COMPUTE))
    yield workers
    workers.close()


async def test_nobody_is_hired_before_there_is_work(workers, hired):
    assert not hired
    assert await workers.call(process_id) != os.getpid()
    assert len(hired) == 1


async def test_jobs_share_one_worker_and_its_workbench(shared):
    first, second = await asyncio.gather(shared.call(process_id), shared.call(process_id))
    assert first == second
    assert (await shared.call(OpticsWorker.describe)).n_modes == 90


async def test_jobs_that_waited_for_a_killed_worker_are_done_by_the_next(workers, hired):
    lost, first, second = await asyncio.gather(
        workers.call(killed),
        workers.call(process_id),
        workers.call(process_id),
        return_exceptions=True,
    )
    assert isinstance(lost, WorkerError)
    assert first == second
    assert (workers.n_lost, len(hired)) == (1, 2)


async def test_a_job_that_raises_keeps_its_worker(shared):
    before = await shared.call(process_id)
    with pytest.raises(WorkerError, match=r"failing failed unforeseen.*a bug in a job"):
        await shared.call(failing)
    assert await shared.call(process_id) == before
    assert shared.n_lost == 0


async def test_the_worker_tells_the_processor_time_of_every_kind_of_job(workers):
    for _ in range(2):
        await workers.call(spinning)
    await workers.call(process_id)
    assert set(workers.cpu_s) == {"spinning", "process_id"}
    assert 0.4 <= workers.cpu_s["spinning"] < 2.0


async def test_it_tells_that_of_a_job_under_way_as_well(workers, monkeypatch):
    await workers.call(process_id)
    monkeypatch.setattr("service.runtime.workers.WORKER_CHECK_INTERVAL_S", 0.02)
    under_way = asyncio.ensure_future(workers.call(spinning))
    begun = asyncio.Event()
    while not begun.is_set():
        await asyncio.wait({under_way}, timeout=0.01)
        if workers.cpu_s.get("spinning"):
            begun.set()
    assert not under_way.done()
    await under_way
    assert 0.2 <= workers.cpu_s["spinning"] < 1.0


async def test_an_interrupt_from_the_keyboard_is_the_services_business(shared):
    assert await shared.call(interrupted) == "still here"


async def test_a_worker_that_began_early_is_the_first_one_and_as_polite():
    worker = Worker("service.runtime.worker").begin()
    early = worker.pid
    start_worker(small_instrument(), type(COMPUTE)(threads=1, nice=5), worker)
    assert early is not None
    workers = WorkerPool(lambda: worker, worker)
    try:
        assert await workers.call(process_id) == early
        assert await workers.call(niceness) == os.nice(0) + 5
        other = start_worker(small_instrument(), COMPUTE)
        assert other.pid is None
    finally:
        workers.close()


@pytest.mark.parametrize("number", [signal.SIGCONT, signal.SIGSTOP])
async def test_dismissing_ends_the_worker_whatever_it_is_at(workers, hired, number):
    await workers.call(process_id)
    waiting = asyncio.create_task(workers.call(asleep))
    await asyncio.sleep(0.1)
    os.kill(hired[0].pid, number)
    began = time.monotonic()
    workers.close()
    assert hired[0].pid not in {child.pid for child in multiprocessing.active_children()}
    with pytest.raises(WorkerError, match="died during asleep"):
        await waiting
    assert in_time(began, 1.0)
    workers.close()


async def test_what_nobody_waits_for_any_more_is_not_finished(workers, hired):
    await workers.call(process_id)
    waiting = asyncio.create_task(workers.call(asleep))
    await asyncio.sleep(0.1)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert hired[0].pid not in {child.pid for child in multiprocessing.active_children()}
    assert await workers.call(process_id) == hired[1].pid


async def test_a_worker_that_takes_a_dead_ones_place_has_its_model(workers, monkeypatch):
    states, sent = [ModelState()], []
    workers.model, workers.changed = lambda: states[-1], states.append
    run = Worker.run
    monkeypatch.setattr(Worker, "run", lambda *a: sent.append(len(a[1].args[1])) or run(*a))
    await workers.call(measuring, 3.0)
    assert await workers.call(measured) == [3.0]
    with pytest.raises(WorkerError):
        await workers.call(killed)
    assert await workers.call(measured) == [3.0]
    await workers.call(measuring, 4.0)
    assert await workers.call(measured) == [4.0]
    assert len(states) == 3
    # once to the process that had not measured it, and never to one that has
    assert sent == [0, 0, 0, 1, 0, 0]
    # no array of a model that the service has given up is kept
    states.append(ModelState())
    assert await workers.call(measured) == []
    assert workers._arrays == {}


async def test_what_is_urgent_goes_first_and_what_waits_long_has_its_turn(workers, monkeypatch):
    order = []

    async def turn(job):
        async with workers.turn(job):
            order.append(job.__name__)
            await asyncio.sleep(0.05)

    of = OpticsWorker
    first = asyncio.create_task(turn(of.describe))
    await asyncio.sleep(0)
    jobs = (of.margin, of.fit_passive, of.make, work_out, of.fit, of.judge)
    await asyncio.gather(first, *(asyncio.create_task(turn(job)) for job in jobs))
    assert order == ["describe", "fit", "judge", "make", "work_out", "fit_passive", "margin"]

    order.clear()
    monkeypatch.setattr(of.fit_passive, "patience_s", 0.1)
    tasks = [asyncio.create_task(turn(of.describe)), asyncio.create_task(turn(of.fit_passive))]
    for _ in range(8):  # more windows than a look has patience for
        await asyncio.sleep(0.03)
        tasks.append(asyncio.create_task(turn(of.fit)))
    await asyncio.gather(*tasks)
    assert order.index("fit_passive") < 5


async def test_within_a_turn_calls_are_done_at_once(shared):
    async with shared.turn(OpticsWorker.fit):
        assert await shared.call(process_id)
    async with asyncio.timeout(5.0):
        assert await shared.call(process_id)


async def test_a_turn_nobody_takes_any_more_is_passed_on(shared):
    async with shared.turn(OpticsWorker.fit):
        waiting = asyncio.create_task(shared.call(process_id))
        await asyncio.sleep(0)
        waiting.cancel()
    async with asyncio.timeout(20.0):
        assert await shared.call(process_id)


async def test_a_worker_that_stands_still_is_named_then_killed_and_replaced(
    workers, hired, monkeypatch
):
    monkeypatch.setattr(crew_module, "STALL_REPORT_S", 0.6)
    before = await workers.call(process_id)
    os.kill(before, signal.SIGSTOP)
    job = asyncio.create_task(workers.call(process_id))
    while not workers.problem:  # noqa: ASYNC110 - nobody tells
        await asyncio.sleep(0.05)
    assert "has stood still for" in workers.problem
    with monkeypatch.context() as impatient:
        impatient.setattr(crew_module, "STALL_KILL_S", 0.6)
        with pytest.raises(WorkerError, match=r"stood still for \d+ s in process_id and was kil"):
            await job
    assert "was killed" in workers.problem
    assert await workers.call(process_id) != before
    assert workers.problem == ""
    assert (workers.n_lost, len(hired)) == (1, 2)


async def test_a_worker_that_never_comes_to_an_end_is_killed(workers, hired, monkeypatch):
    await workers.call(process_id)
    monkeypatch.setattr("service.runtime.workers.FIRST_JOB_LIMIT_S", 0.5)
    with pytest.raises(WorkerError, match="took more than 0 s for endless and was killed"):
        await workers.call(endless)
    assert await workers.call(process_id) == hired[1].pid


async def test_a_job_that_rightly_takes_long_is_let_finish_in_the_end(workers, monkeypatch):
    await workers.call(process_id)
    monkeypatch.setattr("service.runtime.workers.FIRST_JOB_LIMIT_S", 0.2)
    for _ in range(5):
        try:
            assert await workers.call(spinning) is None
            break
        except WorkerError:
            continue
    else:
        pytest.fail("it never was")


async def test_a_job_that_waits_for_the_disk_a_moment_is_not_a_hung_one(shared, monkeypatch):
    monkeypatch.setattr("service.runtime.workers.STALL_REPORT_S", 0.6)
    await shared.call(napping)
    assert shared.problem == ""
    assert shared.n_lost == 0


# --- the pace of the workers


QUIET = TrackerState(system="small")


def alarmed(name):
    return tracker_state(
        system="small", active=(Alarm(name=name, message=as_message("x", ""), since_ns_utc=1),)
    )


class Clocks:
    """A worker and a machine as a test would have them."""

    def __init__(self):
        self.now_s = self.service_s = 0.0
        self.busy_s, self.cpu_s = 0.0, {}
        self.problem = self.cluster_problem = ""

    def monotonic(self):
        return self.now_s

    def process_time(self):
        return self.service_s


@pytest.fixture
def clocks(monkeypatch):
    clocks = Clocks()
    monkeypatch.setattr(workers_module, "time", clocks)
    return clocks


def work(clocks, meter, seconds, *, busy=0.3, cpu=0.25, late=False):
    """Let seconds pass: telemetry at half its speed, a window of 2 s each two seconds."""
    for second in range(seconds):
        clocks.now_s += 1.0
        clocks.service_s += 0.08
        clocks.busy_s += busy
        clocks.cpu_s["fit"] = clocks.cpu_s.get("fit", 0.0) + 0.8 * cpu
        clocks.cpu_s["margin"] = clocks.cpu_s.get("margin", 0.0) + 0.2 * cpu
        meter.count_frames(0.5)
        if second % 2:
            meter.fitted(2.0)
            if late:
                meter.was_late()
        meter.look()


def test_costs_are_told_for_each_second_of_telemetry_and_by_job(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 10)
    load = meter.worker_load
    assert load.worker_per_s == pytest.approx(0.25 / 0.5)
    assert load.by_job == pytest.approx({"fit": 0.4, "margin": 0.1})
    assert list(load.by_job) == ["fit", "margin"]
    assert load.service_per_s == pytest.approx(0.08)
    assert (load.busy_ratio, load.window_s, load.windows_late) == (pytest.approx(0.3), 2.0, 0)


def test_it_is_of_the_last_minute(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 100, cpu=0.9)
    work(clocks, meter, 61, cpu=0.1)
    assert meter.worker_load.worker_per_s == pytest.approx(0.2)


def test_without_telemetry_a_cost_per_second_of_it_is_not_known(clocks):
    meter = WorkerLoadMeter(clocks)
    clocks.now_s = 5.0
    meter.look()
    assert meter.worker_load.worker_per_s is None
    assert meter.worker_load.window_s is None


def test_a_worker_that_does_not_keep_up_is_named_with_cause_and_cure(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 30, busy=0.97, cpu=0.9, late=True)
    (trouble,) = meter.detect_changes(QUIET)
    assert (trouble.name, trouble.over) == ("worker-behind", False)
    assert "1.80 s of processor time for each second of telemetry (fit 1.44, margin" in trouble.text
    assert "Windows are now 2.0 s long" in trouble.text


def test_a_cluster_that_does_not_help_is_named_for_as_long_as_that_lasts(clocks):
    meter = WorkerLoadMeter(clocks)
    clocks.cluster_problem = "tcp://there:8786: found no Dask scheduler there"
    (trouble,) = meter.detect_changes(QUIET)
    assert (trouble.name, trouble.over) == ("cluster-lost", False)
    assert trouble.text == f"{clocks.cluster_problem}; until then the worker computes alone"
    clocks.cluster_problem = ""
    (over,) = meter.detect_changes(alarmed("cluster-lost"))
    assert (over.name, over.over) == ("cluster-lost", True)
    assert meter.detect_changes(QUIET) == []


def test_a_loaded_machine_is_told_from_a_slow_one(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 30, busy=0.97, cpu=0.2, late=True)
    (trouble,) = meter.detect_changes(QUIET)
    assert "the machine is loaded: of a second at work it gets 0.2 s" in trouble.text


def test_a_matrix_that_takes_some_seconds_is_no_reason_for_an_alarm(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 6, busy=1.0, late=True)
    assert not meter.detect_changes(QUIET)
    work(clocks, meter, 30)
    assert not meter.detect_changes(QUIET)


def test_the_alarm_lasts_until_the_worker_is_at_ease_again(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 60, busy=0.97, cpu=0.9, late=True)
    assert meter.detect_changes(QUIET)
    work(clocks, meter, 10, busy=0.8, late=True)
    assert not meter.detect_changes(alarmed("worker-behind"))
    work(clocks, meter, 60, busy=0.8)
    (over,) = meter.detect_changes(alarmed("worker-behind"))
    assert over.over


def test_a_lost_worker_is_an_alarm_until_another_has_done_a_job(clocks):
    meter = WorkerLoadMeter(clocks)
    clocks.problem = "the worker process died during fit"
    (trouble,) = meter.detect_changes(QUIET)
    assert (trouble.name, trouble.over) == ("worker-lost", False)
    assert not meter.detect_changes(alarmed("worker-lost"))
    clocks.problem = ""
    (over,) = meter.detect_changes(alarmed("worker-lost"))
    assert over.over
