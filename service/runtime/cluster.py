"""Tasks on a running Dask cluster whose workers run this very version of pyrcal.

Quick to import: ``distributed`` (the extra ``cluster``) is imported when a cluster is used.
"""

from __future__ import annotations

import contextlib
import platform
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import scipy

import service
from service.errors import ClusterError, shown
from service.files.disk_cache import code_sha256
from service.runtime.processes import set_allocator

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar("Item")
Result = TypeVar("Result")
Versions = Mapping[str, str]

CONNECT_TIMEOUT_S = 5.0
"""A scheduler that does not answer within so long is not there."""

FETCH_TIMEOUT_S = 30.0
"""Time after which a missing result is requested again."""

CLUSTER_CHECK_INTERVAL_S = 1.0
"""Interval between two checks of scheduler and workers."""

MAX_EMPTY_S = 20.0
"""A cluster that has had no worker for so long has lost them: a nanny restarts one in less."""

PACKAGES = ("service", "sim_rtc", "pyrcal_studies")
"""Packages whose code a task may run."""


class Cluster:
    """A running Dask scheduler with its workers, all of the versions that run here.

    A worker that dies costs its tasks' time: another one does them again.
    """

    def __init__(self, address: str) -> None:
        """Connect to the scheduler at ``address``, like ``tcp://HOST:8786``.

        Raises
        ------
        ClusterError
            If there is none, it has no worker, or one runs another version.
        """
        self.address = address
        self._client = _connect_client(address)
        self._seen_s = time.monotonic()
        # Two jobs that share parts would otherwise scatter each of them twice.
        self._submitting = threading.Lock()
        self._parts: list[tuple[object, Future]] = []
        """Functions and data that the workers already have."""

        self._checked: set[str] = set()
        """Workers that are of this version."""

        try:
            self._check_versions()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Cluster:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the cluster; what is under way there is called off."""
        self.close()

    def close(self) -> None:
        """Leave the cluster."""
        with contextlib.suppress(Exception):  # of one that is gone
            self._client.close(timeout=1.0)

    @property
    def _start(self) -> str:
        return f"start some with: dask worker --nthreads 1 {self.address}"

    @property
    def n_threads(self) -> int:
        """Tasks that run at the same time.

        Raises
        ------
        ClusterError
            If the scheduler does not answer.
        """
        return sum(worker["nthreads"] for worker in self._workers().values())

    def check(self) -> None:
        """See that there is a cluster still.

        Raises
        ------
        ClusterError
            If the scheduler does not answer, or has no worker.
        """
        if not self._workers():
            raise ClusterError(f"{self.address}: found no worker any more; {self._start}")

    def each(
        self,
        function: Callable[..., Result],
        items: Sequence[Item],
        *,
        parts: Sequence[object] = (),
        is_large: bool = False,
        enough: threading.Event | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the number of an item and what the function makes of it, as they come.

        What the function raises is raised here. It is given the ``parts`` after each item: they
        stay with the workers for the next time, as long as they are the same objects. A function
        that ``is_large``, megabytes, is sent to each worker once. Ends early when somebody has
        ``enough``.

        Raises
        ------
        ClusterError
            If the scheduler or all workers are gone, or a worker that came later runs another
            version.
        """
        waiting: dict[Future, int] = {}
        self._check_workers()
        try:
            futures = self._submit(function, items, parts, is_large=is_large)
            waiting |= {future: number for number, future in enumerate(futures)}
            while waiting and not (enough and enough.is_set()):
                for future in self._wait_for_first(waiting):
                    yield waiting.pop(future), self._result_of(future)
        finally:
            with contextlib.suppress(Exception):  # of one that is gone
                self._client.cancel(list(waiting))

    def _submit(
        self,
        function: Callable[..., Result],
        items: Sequence[Item],
        parts: Sequence[object],
        *,
        is_large: bool,
    ) -> list[Future]:
        try:
            with self._submitting:
                there = self._sent(parts)
            futures = self._client.map(
                _perform,
                items,
                function=self._scatter(function) if is_large else function,
                expected=own_versions(),
                parts=there,
                # A pure task would be named by a hash of its arguments, which are megabytes.
                pure=False,
            )
        except Exception as error:
            raise self._lost(error) from error
        return list(futures)

    def _sent(self, parts: Sequence[object]) -> list[Future]:
        """Return parts as every worker has them; those that it had before are not sent again."""
        if not parts:
            return []
        # Scattered data has no recipe: if the workers that had it died, it must be sent again.
        there = {id(part): future for part, future in self._parts if future.status == "finished"}
        found = [there.get(id(part)) or self._scatter(part) for part in parts]
        # The part itself is kept with its future: while it is alive its id cannot be reused by
        # another object.
        self._parts = list(zip(parts, found, strict=True))
        return found

    def _scatter(self, what: object) -> Future:
        return self._client.scatter(what, broadcast=True, hash=False)

    def _wait_for_first(self, waiting: Mapping[Future, int]) -> list[Future]:
        """Wait for the first of them, for no longer than a look; return those that are done."""
        from distributed import CancelledError, wait

        # wait() of distributed uses the default client of the thread, and this one is not the
        # default.
        with self._client.as_current(), contextlib.suppress(TimeoutError, CancelledError):
            wait(list(waiting), timeout=CLUSTER_CHECK_INTERVAL_S, return_when="FIRST_COMPLETED")
        done = [future for future in waiting if future.done()]
        if not done:
            self._look()
        return done

    def _look(self) -> None:
        """Refuse to wait any longer for what does not answer, or has no worker."""
        if self._workers():
            self._seen_s = time.monotonic()
        elif time.monotonic() - self._seen_s > MAX_EMPTY_S:
            raise ClusterError(
                f"{self.address}: the cluster has had no worker for {MAX_EMPTY_S:.0f} s; "
                f"{self._start}"
            )

    def _result_of(self, future: Future) -> Any:  # noqa: ANN401 - whatever the function returns
        from distributed import KilledWorker

        while True:
            try:
                return future.result(timeout=FETCH_TIMEOUT_S)
            except KilledWorker as error:
                raise ClusterError(
                    f"{self.address}: a task has ended every worker that had it, last "
                    f"{error.last_worker.address}; has it memory enough? (--memory-limit)"
                ) from error
            except Exception as error:
                if future.status == "error":  # the task's own
                    raise
                if not isinstance(error, TimeoutError):
                    raise self._lost(error) from error
                self._look()  # its worker died with the result: another one makes it again

    def _workers(self) -> dict[str, dict[str, Any]]:
        client = self._client
        try:
            if client.status != "running":
                raise OSError(f"connection {client.status}")
            found = client.sync(
                client.scheduler.identity, callback_timeout=CONNECT_TIMEOUT_S, n_workers=-1
            )
        except Exception as error:
            raise self._lost(error) from error
        return dict(found["workers"])

    def _lost(self, error: BaseException) -> ClusterError:
        why = shown(str(error).partition("\n")[0]) or type(error).__name__
        return ClusterError(
            f"{self.address}: the Dask scheduler does not answer any more ({why}); start it and "
            "its workers again"
        )

    def _check_versions(self) -> None:
        try:
            versions = self._client.run_on_scheduler(own_versions)
        except Exception as error:
            raise ClusterError(_other_version(self.address, "the scheduler", error)) from error
        self._compare({"the scheduler": versions})
        self._check_workers()
        if not self._checked:
            raise ClusterError(f"{self.address}: found a scheduler without workers; {self._start}")

    def _check_workers(self) -> None:
        """Reject workers of another version; only new workers are asked.

        A worker without pyrcal ends when it is given a task, without any explanation.
        """
        came = sorted(set(self._workers()) - self._checked)
        if came:
            try:
                versions = self._client.run(own_versions, workers=came, on_error="return")
            except Exception as error:
                raise self._lost(error) from error
            self._compare(versions)
            self._checked |= set(versions)

    def _compare(self, versions: Mapping[str, object]) -> None:
        for who, found in versions.items():
            if found != own_versions():
                raise ClusterError(_other_version(self.address, who, found))


@cache
def own_versions() -> Versions:
    """Return the versions of all that a task's result depends on, as they are in this process."""
    import distributed

    home = Path(service.__file__).parent.parent
    code = code_sha256(*(home / name for name in PACKAGES))
    return {
        "pyrcal": f"{service.__version__} (code {code[:8]})",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "distributed": distributed.__version__,
    }


def _perform(
    item: Item,
    function: Callable[..., Result],
    expected: Versions,
    parts: Sequence[object] = (),
) -> Result:
    """Do a task on a worker, also on one that has come after the others were asked."""
    _keep_freed_memory()
    # A worker may join between the check and the task. Another version would return wrong numbers.
    found = own_versions()
    if found != expected:
        raise ClusterError(_other_version(platform.node(), "a worker", found, expected))
    return function(item, *parts)


@cache
def _keep_freed_memory() -> None:
    """Have this process keep what it frees for the next array, up to 256 MB.

    Dask's nanny has a worker give back all above 64 KB at once: a product then takes 2.5 times the
    processor time.
    """
    set_allocator(map_bytes=32 << 20, keep_bytes=256 << 20)


def _other_version(where: str, who: str, found: object, expected: Versions | None = None) -> str:
    here = expected or own_versions()
    if isinstance(found, dict):
        names = [name for name in here if found.get(name) != here[name]]
        what = ", ".join(f"{name} {found.get(name)}" for name in names)
        meant = ", ".join(f"{name} {here[name]}" for name in names)
        difference = f"found {what}, expected {meant}"
    else:
        difference = f"found no pyrcal that reports its version ({shown(str(found))})"
    return f"{where}: {who}: {difference}; start scheduler and workers from this very installation"


def _connect_client(address: str) -> Client:
    try:
        import dask.config

        # Our message is one line about the failure; these loggers would add tracebacks to it.
        quiet = dict.fromkeys(("distributed", "distributed.client"), "critical")
        dask.config.set({"logging": quiet})
        from distributed import Client
    except ImportError as error:
        raise ClusterError(
            f"{address}: found no package distributed ({error}); install it: "
            "pip install 'pyrcal[cluster]'"
        ) from error
    try:
        return Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except Exception as error:
        why = shown(str(error).partition("\n")[0])
        raise ClusterError(
            f"{address}: found no Dask scheduler there ({why}); start one with dask scheduler, or "
            "leave --cluster out"
        ) from error
