"""Spread rows over the worker's own threads and, where it pays, a Dask cluster that helps.

The cluster is never waited for: threads take rows from the first on, it takes them from the last,
and a row that it has not answered when a thread is free is computed here as well. Whatever becomes
of it costs time alone.
"""

from __future__ import annotations

import contextlib
import itertools
import operator
import pickle
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from service.errors import ClusterError
from service.model.local import MadeElsewhere
from service.model.sensors.sensor import Array, RowTask
from service.runtime.cluster import Cluster

MIN_REMOTE_ROW_S = 0.2
"""Shortest computation of a row that is sent to a worker of the cluster: Dask and the transfer take
some milliseconds."""

MIN_REMOTE_JOB_S = 4.0
"""Shortest computation, with the threads of this machine, that is sent to the cluster: the transfer
of the shapes takes tenths of a second."""

CLUSTER_SEARCH_INTERVAL_S = 10.0
"""Interval between two checks for the cluster."""

RECEIVER_THREAD = "help of the cluster"
"""Name of the thread that takes in what the cluster answers."""

Row = Callable[[int], Any]


class SharedRows:
    """A mapper of rows: threads here, and the cluster at an address, if one is given."""

    def __init__(self, n_threads: int, address: str | None = None) -> None:
        self._threads = ThreadPoolExecutor(n_threads)
        self._n_threads = n_threads
        self._cluster: Cluster | None = None
        self.problem = ""
        """Problem of the cluster; empty if there is none, or no cluster is used."""

        if address is not None:
            threading.Thread(target=self._watch, args=(address,), daemon=True).start()

    def map(self, function: Row, rows: Iterable[int]) -> Iterator[Any]:
        """Yield what a function makes of each row, in their order."""
        rows, cluster = list(rows), self._cluster
        if cluster is None or len(rows) < 2 or not isinstance(function, RowTask):
            yield from self._threads.map(function, rows)
            return
        begun = time.monotonic()
        # One row is computed here to time it: only long products gain from the cluster.
        yield function(rows[0])
        row_s = time.monotonic() - begun
        if row_s < MIN_REMOTE_ROW_S or row_s * len(rows) / self._n_threads < MIN_REMOTE_JOB_S:
            yield from self._threads.map(function, rows[1:])
        else:
            yield from self._share(cluster, function, rows[1:])

    def _share(self, cluster: Cluster, function: Row, rows: list[int]) -> Iterator[Any]:
        answers: list[Future[Any]] = [Future() for _ in rows]
        # next() of itertools.count is atomic under the interpreter's lock, so that threads share it
        # without one of their own.
        enough, places = threading.Event(), itertools.count()
        help_out = partial(self._have_help, cluster, function, rows, answers, enough)
        threading.Thread(target=help_out, name=RECEIVER_THREAD, daemon=True).start()
        for _ in range(self._n_threads):
            self._threads.submit(_compute, function, rows, answers, places, enough)
        try:
            for place in range(len(answers)):
                yield answers[place].result()
                # Rows are megabytes: one that was handed on is released at once.
                answers[place] = _DISCARDED_RESULT
        finally:
            enough.set()

    def _have_help(
        self,
        cluster: Cluster,
        function: Row,
        rows: list[int],
        answers: list[Future[Any]],
        enough: threading.Event,
    ) -> None:
        try:
            for number, answer in _request_rows(cluster, function, rows[::-1], enough):
                _give(answers[-1 - number], answer)
        except ClusterError as error:
            self._let_go(cluster, str(error))
        except Exception as error:  # noqa: BLE001 - the same row is computed here, and may fail so
            self._let_go(cluster, f"{cluster.address}: a row failed there: {error!r}")

    def _watch(self, address: str) -> None:
        """Connect, see that the cluster is still there, connect again, for good."""
        while True:
            cluster = self._cluster
            try:
                if cluster is None:
                    self._cluster, self.problem = Cluster(address), ""
                else:
                    cluster.check()
            except ClusterError as error:
                self._let_go(cluster, str(error))
            time.sleep(CLUSTER_SEARCH_INTERVAL_S)

    def _let_go(self, cluster: Cluster | None, problem: str) -> None:
        if self._cluster is cluster:
            self._cluster, self.problem = None, problem
        if cluster is not None:
            cluster.close()


_DISCARDED_RESULT: Future[Any] = Future()
"""Placeholder of a result that is not needed any more."""
_DISCARDED_RESULT.set_result(None)


def _request_rows(
    cluster: Cluster, function: Row, rows: list[int], enough: threading.Event
) -> Iterator[tuple[int, Any]]:
    """Ask a cluster for rows: it gets what they are made from, where that is known, else all."""
    there = function.elsewhere if isinstance(function, RowTask) else None
    if there is None:
        return cluster.each(function, rows, is_large=True, enough=enough)
    return cluster.each(RemoteRows.of(there), rows, parts=there.parts, enough=enough)


def _give(answer: Future[Any], found: Any) -> None:  # noqa: ANN401 - a row of anything
    with contextlib.suppress(InvalidStateError):  # somebody else was faster
        answer.set_result(found)


def _compute(
    function: Row,
    rows: list[int],
    answers: list[Future[Any]],
    places: Iterator[int],
    enough: threading.Event,
) -> None:
    """Compute one row after another that has no answer, though the cluster may be at it."""
    for place in places:
        if place >= len(rows) or enough.is_set():
            return
        answer = answers[place]
        if not answer.done():
            try:
                _give(answer, function(rows[place]))
            except BaseException as error:  # noqa: BLE001 - raised where rows are put together
                with contextlib.suppress(InvalidStateError):
                    answer.set_exception(error)


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteRows:
    """Rows of D(α) computed by a Dask worker with a model of its own.

    Instrument and modes are sent once and kept there. Of each matrix only α and the numbers of its
    rows are sent: kilobytes.
    """

    described: bytes
    """Pickled instrument and modes, which identify the model."""

    @classmethod
    def of(cls, rows: MadeElsewhere) -> RemoteRows:
        """Return what is sent of a function of rows: all but its parts."""
        return cls(described=pickle.dumps((rows.prepare, rows.make)))

    def __call__(self, row: int, *parts: object) -> Array:
        """Return a row, of what this process has made of the parts before, or makes of them now."""
        return _HERE.rows(self.described, parts)(row)


class _Kept:
    """The last model and the last function of rows of this process."""

    def __init__(self) -> None:
        self._making = threading.Lock()
        self._parts: tuple[object, ...] = ()
        self._model: Any = None
        self._described = b""
        self._rows: RowTask | None = None

    def rows(self, described: bytes, parts: tuple[object, ...]) -> RowTask:
        """Return a function of rows; one thread makes it, the others wait."""
        with self._making:
            known = len(parts) == len(self._parts) and all(map(operator.is_, parts, self._parts))
            if self._rows is None or not known or described != self._described:
                self._rows = None  # before the next one takes memory
                prepare, make = pickle.loads(described)  # of this very program
                if not known:
                    self._model = None
                    self._model, self._parts = prepare(*parts), parts
                self._rows, self._described = make(self._model), described
            return self._rows


_HERE = _Kept()
