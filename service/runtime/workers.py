"""The worker as the event loop uses it: one job at a time."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import time
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Concatenate, ParamSpec, TypeVar

from service.errors import WorkerError
from service.records import events as ev
from service.records.alarms import CLUSTER_LOST, WORKER_BEHIND, WORKER_LOST
from service.records.state import ModelState, TrackerState
from service.runtime.processes import Worker
from service.runtime.snapshot import WorkerLoad
from service.runtime.worker import Done, OpticsWorker, run_job
from service.runtime.worker.records import patience_s

P = ParamSpec("P")
R = TypeVar("R")

STALL_REPORT_S = 5.0
"""A worker that has taken no processor time for so long is named,"""

STALL_KILL_S = 15.0
"""and for so long, killed: one of the lowest priority gets a hundredth of a loaded core."""

FIRST_JOB_LIMIT_S = 900.0
"""Processor time of a job of which none has been done yet; ten times the largest telescopes'."""

MIN_JOB_LIMIT_S = 60.0
JOB_LIMIT_RATIO = 20.0
"""Processor time of a job, over the longest one of its kind so far."""

MAX_JOB_ATTEMPTS = 3
"""Workers that may die while the model is prepared before the service gives up."""

WORKER_CHECK_INTERVAL_S = 0.5
"""Interval between two checks of a worker's processor time."""


class WorkerPool:
    """Hands jobs to a worker made by ``start``; a dead or hung one costs one job, not the service.

    Belongs to the event loop. What is most urgent goes first: a job says how long it may wait. One
    that has begun ``early`` is the first.
    """

    def __init__(self, start: Callable[[], Worker], early: Worker | None = None) -> None:
        self._start = start
        self._worker = early
        self.model: Callable[[], ModelState] = ModelState
        """Returns the model that jobs are done with."""

        self.changed: Callable[[ModelState], object] = _ignore
        """Called with the model after a job that has changed it."""

        self._arrays: dict[str, Any] = {}
        self._sent: frozenset[str] = frozenset()
        self._threads: ThreadPoolExecutor | None = None
        self._waiting: list[tuple[float, int, asyncio.Future[None]]] = []
        self._numbers = itertools.count()
        self._turn: asyncio.Future[None] | None = None
        self._owner: asyncio.Task[object] | None = None
        self._limit_s: dict[str, float] = {}
        self._longest_s: defaultdict[str, float] = defaultdict(float)
        self._busy_s = 0.0
        self._busy_since_s: float | None = None
        self.n_lost = 0
        self.problem = ""
        """Problem of the worker until it has completed a job again; empty if there is none."""

        self.cluster_problem = ""
        """Problem of the cluster in its last job; empty if there is none."""

        self._cpu_s: defaultdict[str, float] = defaultdict(float)
        self._under_way: tuple[str, float] | None = None

    @property
    def cpu_s(self) -> dict[str, float]:
        """Processor time of the worker by name of the job, the one under way included, seconds."""
        if self._under_way is None:
            return dict(self._cpu_s)
        name, cpu_s = self._under_way
        return {**self._cpu_s, name: self._cpu_s.get(name, 0.0) + cpu_s}

    @property
    def busy_s(self) -> float:
        """Seconds of the clock in which the worker has had a job."""
        since_s = self._busy_since_s
        return self._busy_s + (0.0 if since_s is None else time.monotonic() - since_s)

    @contextlib.asynccontextmanager
    async def turn(self, job: Callable[..., object]) -> AsyncIterator[None]:
        """Have the worker for this job: what it is of is then chosen as late as can be.

        ``call`` waits for its turn by itself; within this block it has it.
        """
        mine: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        due_s = time.monotonic() + patience_s(job)
        # The number decides between equal times, in order of arrival; futures cannot be compared.
        heapq.heappush(self._waiting, (due_s, next(self._numbers), mine))
        self._admit()
        try:
            await mine
            self._owner = asyncio.current_task()
            yield
        finally:
            # If the task was cancelled while it waited, its place in the heap is skipped by _admit.
            mine.cancel()
            if self._turn is mine:
                self._turn = self._owner = None
                self._admit()

    async def call(
        self, job: Callable[Concatenate[OpticsWorker, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the workbench and return its result.

        Raises
        ------
        WorkerError
            If the worker process died, or hung and was killed, and a new one is there for the next
            job; or if the job raised an unexpected exception, which must not end the service.
        """
        # The turn is already this task's: another request would wait for itself.
        if self._owner is asyncio.current_task():
            return await self._done(job, args, kwargs)
        async with self.turn(job):
            return await self._done(job, args, kwargs)

    def close(self) -> None:
        """End the worker, whatever it is at; the next job finds a new one."""
        worker, self._worker = self._worker, None
        threads, self._threads = self._threads, None
        if worker is not None:
            worker.kill()
        if threads is not None:
            threads.shutdown(wait=False)

    def _admit(self) -> None:
        while self._turn is None and self._waiting:
            *_, first = heapq.heappop(self._waiting)
            if not first.done():  # nobody waits for it any more
                self._turn = first
                first.set_result(None)

    async def _done(
        self, job: Callable[..., R], args: tuple[object, ...], kwargs: dict[str, object]
    ) -> R:
        name, model = job.__name__, self.model()
        worker = self._worker or self._start()
        if worker is not self._worker:
            self._worker, self._sent = worker, frozenset()
        arrays = {key: self._arrays[key] for key in model.keys - self._sent}
        work = partial(run_job, model, arrays, job, *args, **kwargs)
        # a thread of its own: one that waited for other threads would look like a hung worker
        self._threads = threads = self._threads or ThreadPoolExecutor(1)
        self._busy_since_s = time.monotonic()
        under_way = asyncio.get_running_loop().run_in_executor(threads, worker.run, work)
        # where nobody waits for it to the end, it says nothing
        under_way.add_done_callback(lambda job: job.cancelled() or job.exception())
        try:
            await self._watch(name, worker, under_way)
            done = under_way.result()
            self._under_way = (name, done.cpu_s)
        except EOFError as error:
            raise WorkerError(self._lost(f"the worker process died during {name}")) from error
        except TimeoutError as error:
            raise WorkerError(self._lost(f"{error} and was killed")) from error
        except WorkerError as error:
            raise WorkerError(f"{name} {error}") from error
        except asyncio.CancelledError:
            self.close()  # it would go on with what nobody waits for
            raise
        finally:
            self._busy_s, self._busy_since_s = self.busy_s, None
            self._cpu_s, self._under_way = defaultdict(float, self.cpu_s), None
        self.problem = ""
        self.cluster_problem = done.cluster_problem
        self._longest_s[name] = max(self._longest_s[name], done.cpu_s)
        # Limits are of processor time: on a loaded machine a healthy job takes long by the clock.
        self._limit_s[name] = max(MIN_JOB_LIMIT_S, JOB_LIMIT_RATIO * self._longest_s[name])
        self._arrays |= done.arrays
        self._sent = done.model.keys
        if done.model != model:
            self.changed(done.model)
        # The change may have been refused, or the model may be of another mode by now.
        kept = self.model().keys
        self._arrays = {key: one for key, one in self._arrays.items() if key in kept}
        return done.result

    async def _watch(self, name: str, worker: Worker, under_way: asyncio.Future[Done[R]]) -> None:
        """Wait for a job.

        Raises
        ------
        TimeoutError
            If the worker has stopped, or takes far longer than such a job ever has.
        """
        begun_cpu_s = last_cpu_s = worker.cpu_s()
        moved_s, limit_s = time.monotonic(), self._limit_s.get(name, FIRST_JOB_LIMIT_S)
        while not (await asyncio.wait({under_way}, timeout=WORKER_CHECK_INTERVAL_S))[0]:
            cpu_s, now_s = worker.cpu_s(), time.monotonic()
            self._under_way = (name, cpu_s - begun_cpu_s)
            if cpu_s != last_cpu_s:
                last_cpu_s, moved_s, self.problem = cpu_s, now_s, ""
            still_s = now_s - moved_s
            if still_s >= STALL_REPORT_S:
                self.problem = f"the worker has stood still for {still_s:.0f} s in {name}"
            if still_s >= STALL_KILL_S:
                raise TimeoutError(self.problem)
            if cpu_s - begun_cpu_s > limit_s:
                self._limit_s[name] = 2 * limit_s  # a telescope where it takes so long
                raise TimeoutError(f"the worker took more than {limit_s:.0f} s for {name}")

    def _lost(self, text: str) -> str:
        self.n_lost += 1
        self.close()
        self.problem = text
        return text


async def with_another_worker(
    job: Callable[[], Awaitable[R]], lost: Callable[[str], object] = lambda _: None
) -> R:
    """Return the result of a job, repeated if its worker died; ``lost`` is called with the reason.

    Raises
    ------
    WorkerError
        If several have died of it.
    """
    for _ in range(MAX_JOB_ATTEMPTS - 1):
        try:
            return await job()
        except WorkerError as error:
            lost(str(error))
    return await job()


def _ignore(_model: ModelState) -> None:
    pass


# --- how the work keeps pace with the telemetry: what it costs, and what is reported if it does not


LOAD_AVERAGING_TIME_S = 60.0
"""Duration of the load average."""

MIN_LOAD_HISTORY_S = 20.0
"""Time before which the worker is not reported as late: a matrix is being made meanwhile."""

N_LATE_WINDOWS = 3
"""Windows that came before the worker had a hand free for the one before them, to be behind;"""

OVERLOAD_SHARE, RELIEF_SHARE = 0.8, 0.65
"""and the share of the time in which it has a job: above the first it is behind, and below the
second, or with no late window in a minute, it is not any more."""

MIN_PROCESSOR_SHARE = 0.6
"""Processor time of the worker over the time it is at work: with less the machine is loaded."""


JOB_PREFIX = "job "
"""Prefix of a job's name in the counters."""


class WorkerLoadMeter:
    """Meters the cost of work; ``look`` at it once a second."""

    def __init__(self, workers: WorkerPool) -> None:
        self._workers = workers
        self._counted: defaultdict[str, float] = defaultdict(float)
        self._marks = deque([self._mark()])
        self._behind = False

    def count_frames(self, seconds: float) -> None:
        """Count telemetry that was taken in."""
        self._counted["telemetry_s"] += seconds

    def was_late(self) -> None:
        """Count a window that came while another one still waited."""
        self._counted["late"] += 1

    def fitted(self, window_s: float) -> None:
        """Count a window that the worker has begun with."""
        self._counted["fitted"] += 1
        self._counted["fitted_s"] += window_s

    def look(self) -> WorkerLoad:
        """Record the present load and return the average."""
        now = self._mark()
        self._marks.append(now)
        while (
            len(self._marks) > 2
            and now["clock_s"] - self._marks[1]["clock_s"] >= LOAD_AVERAGING_TIME_S
        ):
            self._marks.popleft()
        return self.worker_load

    @property
    def worker_load(self) -> WorkerLoad:
        """Cost of the work of the last minute."""
        spent = self._spent()
        lasted_s, telemetry_s = max(spent["clock_s"], 1e-9), spent["telemetry_s"]
        fitted = spent["fitted"]
        jobs = {
            key.removeprefix(JOB_PREFIX): s
            for key, s in spent.items()
            if key.startswith(JOB_PREFIX)
        }
        per_s = {name: s / telemetry_s for name, s in jobs.items() if s > 0} if telemetry_s else {}
        return WorkerLoad(
            worker_per_s=sum(per_s.values()) if telemetry_s else None,
            by_job=dict(sorted(per_s.items(), key=lambda item: -item[1])),
            service_per_s=spent["service_s"] / lasted_s,
            busy_ratio=spent["busy_s"] / lasted_s,
            window_s=spent["fitted_s"] / fitted if fitted else None,
            windows_late=round(spent["late"]),
        )

    def detect_changes(self, state: TrackerState) -> list[ev.ConditionChanged]:
        """Return which alarms of the worker come or go."""
        lost = self._workers.problem
        if lost:
            lost = f"{lost}; another one takes over, what it was at is lost. If it comes again: is "
            lost += "there memory enough, and does the machine get to run it?"
        alone = self._workers.cluster_problem
        if alone:
            alone += "; until then the worker computes alone"
        keeps_up = "the worker keeps up with the telemetry again"
        return [
            *ev.ConditionChanged.detect(state, WORKER_LOST, lost, "the worker does its work again"),
            *ev.ConditionChanged.detect(state, WORKER_BEHIND, self._explain_delay(), keeps_up),
            *ev.ConditionChanged.detect(state, CLUSTER_LOST, alone, "the cluster helps again"),
        ]

    def _explain_delay(self) -> str:
        load, spent = self.worker_load, self._spent()
        if spent["clock_s"] < MIN_LOAD_HISTORY_S or load.busy_ratio is None:
            return ""
        if self._behind:
            # Two limits, so that the alarm does not come and go at one.
            self._behind = load.busy_ratio > RELIEF_SHARE and load.windows_late > 0
        else:
            self._behind = load.busy_ratio > OVERLOAD_SHARE and load.windows_late >= N_LATE_WINDOWS
        if not self._behind:
            return ""
        most = ", ".join(f"{name} {share:.2f}" for name, share in list(load.by_job.items())[:3])
        got = sum(s for key, s in spent.items() if key.startswith(JOB_PREFIX))
        share = got / max(spent["busy_s"], 1e-9)
        cause = (
            f"the machine is loaded: of a second at work it gets {share:.1f} s of a processor"
            if share < MIN_PROCESSOR_SHARE
            else "the machine is too slow for this instrument"
        )
        return (
            f"the worker does not keep up: it is busy {load.busy_ratio:.0%} of the time and takes "
            f"{load.worker_per_s or 0.0:.2f} s of processor time for each second of telemetry "
            f"({most or 'nothing done yet'}); {cause}. Windows are now {load.window_s or 0.0:.1f} "
            "s long and α comes as much later; end other work there, or control and dither less"
        )

    def _mark(self) -> defaultdict[str, float]:
        """Return all counters as they are now."""
        jobs = {f"{JOB_PREFIX}{name}": s for name, s in self._workers.cpu_s.items()}
        clocks = {"clock_s": time.monotonic(), "service_s": time.process_time()}
        busy = {"busy_s": self._workers.busy_s}
        return defaultdict(float, self._counted | jobs | clocks | busy)

    def _spent(self) -> defaultdict[str, float]:
        """Return what every counter has come to in the time that is remembered."""
        first, last = self._marks[0], self._marks[-1]
        return defaultdict(float, {key: n - first[key] for key, n in last.items()})
