"""What a Dask cluster adds to tasks: two of its workers against two processes here, in turn.

Run: ``python -m benchmarks.cluster --cluster tcp://HOST:PORT``, with two workers of one thread. A
task is D of FLAO at α of its own, ``--repeats`` times; it sends back one D.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from typing import Any

from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.files.disk_cache import DiskCache
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.runtime.cluster import Cluster

N_WORKERS = 2

Outcome = tuple[float, float, NDArray[Any]]


@cache
def _model() -> InteractionModel:
    instrument = load_instrument("flao-lbt")
    return InteractionModel(instrument, DiskCache(None).basis(instrument))


def work(number: int, repeats: int) -> Outcome:
    """Return what the task took by the clock and of the processor, and its last D."""
    with threadpool_limits(1):
        begun, begun_cpu, model = time.monotonic(), time.process_time(), _model()
        for k in range(repeats):
            found = model.interaction_matrix(
                Misregistration(shift_x_subap=0.01 * number + 1e-4 * k)
            )
        return time.monotonic() - begun, time.process_time() - begun_cpu, found


def _timed(what: str, run: Callable[[], Iterable[Outcome]]) -> None:
    """Print what the tasks took, and how much of the time of two workers no task had."""
    begun, begun_cpu = time.monotonic(), time.process_time()
    done = list(run())
    clock_s, here_s = time.monotonic() - begun, time.process_time() - begun_cpu
    lasted_s, cpu_s = (sum(one[which] for one in done) for which in (0, 1))
    least_s = min(one[1] for one in done)
    idle = 1.0 - lasted_s / (N_WORKERS * clock_s)
    print(
        f"{what}: {len(done)} tasks of {lasted_s / len(done):.2f} s, {cpu_s / len(done):.2f} of "
        f"a processor (at least {least_s:.2f}), in {clock_s:.1f} s: {idle:.1%} of two "
        f"workers without one; {here_s:.2f} s of processor here"
    )


def main() -> None:
    """Run the same tasks by both, in turn."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cluster")
    parser.add_argument("--cluster", required=True, metavar="tcp://HOST:PORT")
    parser.add_argument("--tasks", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=4, help="D of a task")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    from benchmarks import cluster as as_imported  # a worker has another __main__

    task, numbers = partial(as_imported.work, repeats=given.repeats), range(given.tasks)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(N_WORKERS, spawn) as pool, Cluster(given.cluster) as cluster:
        list(pool.map(task, range(N_WORKERS)))  # models are made
        dict(cluster.each(task, range(N_WORKERS)))
        for _ in range(given.rounds):
            _timed("processes", lambda: pool.map(task, numbers))
            _timed("cluster  ", lambda: (one for _, one in cluster.each(task, numbers)))


if __name__ == "__main__":
    main()
