"""What a Dask cluster takes for rows of a large D: of arrays, and of instrument and modes.

Run: ``python -m benchmarks.cluster_rows --cluster tcp://HOST:PORT``, with two workers of one
thread. D and four derivatives of an instrument whose modes are random, which costs the same: rows
from its middle, by two processes here and by the cluster in turn, each time at another α. What is
sent is counted as it is pickled; processor time is that of all processes, the scheduler's too.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import pickle
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.local import LocalShapes
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from service.model.surface import mirror_surface
from service.runtime.cluster import Cluster
from service.runtime.worker.remote_rows import RemoteRows

N_WORKERS = 2

_parts: tuple[object, ...] = ()
"""Of a process here: instrument and modes."""


class _AskedError(Exception):
    """Ends a computation where its rows are asked for."""


def basis_of(name: str, n_modes: int) -> ModalBasis:
    """Return random modes of an instrument's own functions."""
    mirror = load_instrument(name).analytic_mirror
    size = (len(mirror.positions_m), n_modes)
    strokes = np.random.default_rng(1).normal(size=size)
    return ModalBasis(
        surface=mirror_surface(mirror, load_instrument(name).subaperture_m),
        mode_to_actuator=strokes,
        coefficients=strokes,
        variance_m2=np.ones(n_modes),
    )


def rows_at(model: InteractionModel, asked: list[Any], number: int) -> Any:  # noqa: ANN401 - rows of its sensor
    """Return the function of rows of D and its derivatives at an α of its own."""
    asked.clear()
    with contextlib.suppress(_AskedError):
        model.linearise(Misregistration(shift_x_subap=0.01 * number, rotation_rad=0.01))
    return asked[0]


def _asking(asked: list[Any]) -> Callable[[Any, Iterable[int]], Iterator[Any]]:
    def mapper(function: Any, items: Iterable[int]) -> Iterator[Any]:  # noqa: ANN401 - any function
        if not hasattr(function, "elsewhere"):
            return map(function, items)
        asked.append(function)
        raise _AskedError

    return mapper


def _enter(parts: tuple[object, ...]) -> None:
    global _parts
    _parts = parts
    threadpool_limits(1)


def _row_here(row: int, rows: RemoteRows) -> tuple[float, float]:
    begun_s = time.process_time()
    found = rows(row, *_parts)
    return float(found[0, 0]), time.process_time() - begun_s


def _spent_s(_: int = 0) -> float:
    return time.process_time()


def _by_processes(pool: ProcessPoolExecutor, function: Any, numbers: list[int]) -> None:  # noqa: ANN401
    begun_s = time.monotonic()
    work = partial(_row_here, rows=RemoteRows.of(function.elsewhere))
    spent = [cpu_s for _, cpu_s in pool.map(work, numbers)]
    print(
        f"processes: {sum(spent) / len(numbers):.3f} s of processor a row, in "
        f"{time.monotonic() - begun_s:.1f} s",
        flush=True,
    )


def _by_cluster(cluster: Cluster, function: Any, numbers: list[int], what: str) -> None:  # noqa: ANN401
    client = cluster._client  # noqa: SLF001 - its processes' clocks are asked for
    there = function.elsewhere
    sent = function if there is None else RemoteRows.of(there)

    def clocks() -> dict[str, float]:
        at_work = sum(client.run(_spent_s).values())
        scheduler = client.run_on_scheduler(_spent_s)
        return {"workers": at_work, "scheduler": scheduler, "here": time.process_time()}

    before, begun_s = clocks(), time.monotonic()
    if there is None:
        answers = list(cluster.each(sent, numbers, is_large=True))
    else:
        answers = list(cluster.each(sent, numbers, parts=there.parts))
    lasted_s = time.monotonic() - begun_s
    spent = {name: (clock - before[name]) / len(numbers) for name, clock in clocks().items()}
    n_bytes = len(pickle.dumps(sent))
    back = sum(answer.nbytes for _, answer in answers) / len(numbers)
    each = ", ".join(f"{name} {cpu_s:.3f}" for name, cpu_s in spent.items())
    print(
        f"cluster, {what}: {sum(spent.values()):.3f} s of processor a row ({each}), in "
        f"{lasted_s:.1f} s; {n_bytes / 1e6:.3f} MB sent a worker, {back / 1e6:.1f} back a row",
        flush=True,
    )


def main() -> None:
    """Compute rows by both, in turn."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cluster_rows")
    parser.add_argument("--cluster", required=True, metavar="tcp://HOST:PORT")
    parser.add_argument("--instrument", default="metis-elt")
    parser.add_argument("--modes", type=int, default=4300)
    parser.add_argument("--rows", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=2)
    given = parser.parse_args()
    from benchmarks import cluster_rows as as_imported  # a process has another __main__

    threadpool_limits(1)
    instrument, asked = load_instrument(given.instrument), list[Any]()
    basis = as_imported.basis_of(given.instrument, given.modes)
    model = InteractionModel(instrument, basis, kept_bytes=0, mapper=_asking(asked))
    middle = instrument.wfs.n_subapertures // 2
    numbers = list(range(middle - given.rows // 2, middle - given.rows // 2 + given.rows))
    parts = rows_at(model, asked, 0).elsewhere.parts
    again, modes = (len(pickle.dumps(part)) / 1e6 for part in parts)
    print(f"once a worker: instrument {again:.3f} MB, modes {modes:.1f} MB", flush=True)
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(N_WORKERS, spawn, as_imported._enter, (parts,))  # noqa: SLF001
    with pool, Cluster(given.cluster) as cluster:
        for number in range(given.rounds + 1):
            function = rows_at(model, asked, number)
            rows = numbers if number else numbers[:N_WORKERS]  # at first all is made and sent
            as_imported._by_processes(pool, function, rows)  # noqa: SLF001
            as_imported._by_cluster(cluster, function, rows, "instrument and modes")  # noqa: SLF001
            plain = replace(function, shapes=_without_drawing(function.shapes))
            as_imported._by_cluster(cluster, plain, rows, "arrays")  # noqa: SLF001


def _without_drawing(shapes: LocalShapes) -> LocalShapes:
    return replace(shapes, drawing=None)


if __name__ == "__main__":
    main()
