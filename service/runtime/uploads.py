"""The queue of fits of uploaded matrices."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import itertools
import json
import shutil
import time
from asyncio.subprocess import DEVNULL, PIPE
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import IO, Any

import structlog

from service import errors, files
from service.files.fit_folder import DOCUMENT, FIGURES, STAGE, UPLOAD, FitRequest

FITS_KEPT = 50
"""Finished fits that are remembered."""

MAX_UPLOAD_STALL_S = 30.0
"""Longest time without progress of an upload."""

MAX_UPLOAD_DELAY_S = 30.0
"""Tolerated delay of an upload relative to the slowest permitted rate, seconds."""

MIN_UPLOAD_RATE_BYTES_S = 200_000
"""Least pace of an upload, bytes a second: one that trickles would hold a place for ever."""

_BLOCK_BYTES = 1 << 20
"""Bytes written to the disk at once."""

_FILE_SIGNATURES = (
    b"\x89HDF\r\n\x1a\n",
    b"SIMPLE  =",
    b"\x1f\x8b",
    files.NUMPY_BEGINS,
    b"PK\x03\x04",
)
"""First bytes of HDF5, FITS, anything gzipped, NumPy, and zip."""


class FitState(StrEnum):
    """States of a fit."""

    RECEIVING = "receiving"
    """The upload is on its way."""

    WAITING = "waiting"
    """It is in the queue."""

    RUNNING = "running"
    DONE = "done"
    """There is a document; its verdict may be a refusal."""

    FAILED = "failed"
    """There is none; the reason says why."""

    GIVEN_UP = "given-up"
    """There is none: somebody has ended it."""


UNFINISHED = frozenset({FitState.RECEIVING, FitState.WAITING, FitState.RUNNING})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitJob:
    """One requested fit."""

    id: str
    """Never reused while the service runs."""

    state: FitState
    """How far it is."""

    asked_ns_utc: int
    """Time of the request, by the service's clock."""

    name: str = ""
    """Name of the matrix or file given with the request."""

    n_bytes: int = 0
    """Bytes received so far."""

    sha256: str = ""
    """Checksum of the upload; empty until it is complete."""

    reason: str = ""
    """Why it failed."""

    stage: str = ""
    """Stage while it runs: reading, modes, orientation, fit, verdict, figures."""

    document: Mapping[str, Any] | None = None
    """Result: the document that ``pyrcal fit --json`` prints."""

    figures: bytes | None = None
    """Data of its figures, JSON."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitLimits:
    """Limits of fits of uploads."""

    max_bytes: int
    """Largest upload."""

    waiting: int
    """Fits that may be unfinished at once, uploads under way included."""

    seconds: float
    """Longest fit."""


class FitQueue:
    """Takes uploads in, has them fitted one after the other, and forgets them when it ends.

    Belongs to the event loop. ``folder`` is emptied when the desk opens; an upload stays there
    until its fit is finished. ``program`` are the words that start ``pyrcal fit``; the folder of
    the fit is its last. ``request`` is what each is asked, but for what users choose.
    """

    def __init__(
        self,
        *,
        folder: Path,
        program: Sequence[str],
        request: FitRequest,
        limits: FitLimits,
        clock_ns: Callable[[], int],
    ) -> None:
        self._folder = folder
        self._program = program
        self._request = request
        self._limits = limits
        self._clock_ns = clock_ns
        self._numbers = itertools.count(1)
        self._jobs: OrderedDict[str, FitJob] = OrderedDict()
        self._turn = asyncio.Lock()
        self._running: dict[str, asyncio.Task[None]] = {}
        self._log = structlog.get_logger()

    def open(self) -> None:
        """Remove what an earlier service has left."""
        shutil.rmtree(self._folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # a full disk refuses each upload, not the service
            self._folder.mkdir(mode=0o700, parents=True)

    async def close(self) -> None:
        """End the fit that runs, drop those that wait, and remove their files."""
        tasks = list(self._running.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        shutil.rmtree(self._folder, ignore_errors=True)

    def jobs(self) -> Sequence[FitJob]:
        """Return the fits that are remembered, oldest first."""
        return tuple(self._read_stage(job) for job in self._jobs.values())

    def job(self, fit_id: str) -> FitJob:
        """Return one of them.

        Raises
        ------
        UnknownIdError
            If none has this id.
        """
        found = self._jobs.get(fit_id)
        if found is None:
            raise errors.UnknownIdError(f"unknown fit {fit_id}: the service has begun no such fit")
        return self._read_stage(found)

    async def give_up(self, fit_id: str) -> FitJob:
        """End a fit that waits or runs, and return what is left of it.

        Raises
        ------
        UnknownIdError
            If none has this id.
        CommandError
            If it is over, or its upload is still on its way.
        """
        job, task = self.job(fit_id), self._running.get(fit_id)
        if task is None or job.state not in UNFINISHED:
            raise errors.CommandError(f"fit {fit_id} is {job.state}: there is nothing to give up")
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        if self._jobs[fit_id].state in UNFINISHED:  # else it was over at the last moment
            self._put(replace(job, state=FitState.GIVEN_UP, reason="given up", stage=""))
            # one that had not begun has not tidied up
            await asyncio.to_thread(shutil.rmtree, self._folder / fit_id, ignore_errors=True)
        return self.job(fit_id)

    def _read_stage(self, job: FitJob) -> FitJob:
        """Return a fit with what it is at, as its process has written it down."""
        if job.state is not FitState.RUNNING:
            return job
        with contextlib.suppress(OSError):
            return replace(job, stage=(self._folder / job.id / STAGE).read_text("utf-8"))
        return job

    async def take(
        self,
        asked: Mapping[str, Any],
        body: AsyncIterator[bytes],
        n_bytes: int | None,
        name: str = "",
    ) -> FitJob:
        """Store an upload and queue its fit, under a ``name``.

        Raises
        ------
        TooLargeError
            If it exceeds the limit; before it is read if its length ``n_bytes`` is given.
        TooSlowError
            If it stalls, or is too slow.
        BusyError
            If too many wait already.
        MatrixError
            If it is incomplete, or no type of file that can hold a matrix.
        """
        self._check_room(n_bytes)
        job = self._remember(name)
        folder = self._folder / job.id
        try:
            await asyncio.to_thread(partial(folder.mkdir, parents=True))
            with (folder / UPLOAD).open("wb") as file:
                await self._receive(job.id, file, body)
        except OSError as error:
            await self._forget(job.id)
            raise errors.StorageError(
                f"fit: the upload cannot be kept: {error.strerror}"
            ) from error
        # Whatever ends the upload, a cancelled task included, must free its place in the queue.
        except BaseException:
            await self._forget(job.id)
            raise
        self._put(replace(self._jobs[job.id], state=FitState.WAITING))
        self._start(job.id, self._fit_job(job.id, asked))
        return self.job(job.id)

    def _check_room(self, n_bytes: int | None) -> None:
        most = self._limits.max_bytes
        if n_bytes is not None and n_bytes > most:
            raise _too_large(f"{n_bytes / 1e6:.0f} MB", most)
        unfinished = sum(job.state in UNFINISHED for job in self._jobs.values())
        if unfinished >= self._limits.waiting:
            raise errors.BusyError(
                f"found {unfinished} fits unfinished, the most there may be: try later"
            )

    def _remember(self, name: str) -> FitJob:
        now_ns = self._clock_ns()
        stamp = datetime.fromtimestamp(now_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S")
        job = FitJob(
            id=f"fit-{stamp}-{next(self._numbers)}",
            state=FitState.RECEIVING,
            asked_ns_utc=now_ns,
            name=name,
        )
        self._jobs[job.id] = job
        finished = [j.id for j in self._jobs.values() if j.state not in UNFINISHED]
        for old in finished[: max(len(finished) - FITS_KEPT, 0)]:
            del self._jobs[old]
        return job

    async def _receive(self, fit_id: str, file: IO[bytes], body: AsyncIterator[bytes]) -> None:
        """Write the body to the disk, block by block."""
        # Chunks of HTTP are some kilobytes: gathered, they cost one visit to a thread per megabyte.
        digest, n_bytes, block = hashlib.sha256(), 0, bytearray()

        async def flush() -> None:
            written = bytes(block)
            block.clear()
            digest.update(written)
            await asyncio.to_thread(file.write, written)

        async for chunk in _in_time(body):
            if n_bytes == 0 and chunk:
                _check_kind(chunk)
            n_bytes += len(chunk)
            # The stated length was checked before, but it may be missing or wrong.
            if n_bytes > self._limits.max_bytes:
                raise _too_large("more", self._limits.max_bytes)
            block += chunk
            if len(block) >= _BLOCK_BYTES:
                await flush()
        await flush()
        if n_bytes == 0:
            raise errors.MatrixError(
                "upload: found an empty body, expected an HDF5, FITS, NumPy or zip file"
            )
        self._put(replace(self._jobs[fit_id], n_bytes=n_bytes, sha256=digest.hexdigest()))

    async def _fit_job(self, fit_id: str, asked: Mapping[str, Any]) -> None:
        folder = self._folder / fit_id
        try:
            async with self._turn:
                self._put(replace(self._jobs[fit_id], state=FitState.RUNNING))
                await asyncio.to_thread(replace(self._request, asked=asked).write, folder)
                await run_program([*self._program, str(folder)], limit_s=self._limits.seconds)
            found, drawn = await asyncio.to_thread(_read_result, folder)
            done = replace(self._jobs[fit_id], state=FitState.DONE, document=found, figures=drawn)
            self._put(done)
            self._log.info("fit.done", id=fit_id, verdict=found["verdict"])
        except errors.PyrcalError as error:
            self._put(replace(self._jobs[fit_id], state=FitState.FAILED, reason=str(error)))
            self._log.warning("fit.failed", id=fit_id, text=str(error))
        except Exception as error:  # noqa: BLE001 - unfinished, it would hold a place for ever
            reason = f"failed unforeseen: {error!r}"
            self._put(replace(self._jobs[fit_id], state=FitState.FAILED, reason=reason))
            self._log.exception("fit.failed", id=fit_id)
        finally:
            await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)

    def _start(self, fit_id: str, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._running[fit_id] = task
        task.add_done_callback(lambda _: self._running.pop(fit_id))

    def _put(self, job: FitJob) -> None:
        self._jobs[job.id] = job

    async def _forget(self, fit_id: str) -> None:
        del self._jobs[fit_id]
        await asyncio.to_thread(shutil.rmtree, self._folder / fit_id, ignore_errors=True)


def _read_result(folder: Path) -> tuple[dict[str, Any], bytes]:
    """Return what a fit has found, and what its figures are drawn from."""
    try:
        found: dict[str, Any] = json.loads((folder / DOCUMENT).read_text(encoding="utf-8"))
        return found, (folder / FIGURES).read_bytes()
    except (OSError, ValueError) as error:
        raise errors.WorkerError(f"the fit has ended and left no answer: {error}") from error


async def _in_time(body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Yield the chunks of a body for as long as they keep coming, and fast enough."""
    began_s, n_bytes = time.monotonic(), 0
    while True:
        left_s = (
            MAX_UPLOAD_DELAY_S + n_bytes / MIN_UPLOAD_RATE_BYTES_S - (time.monotonic() - began_s)
        )
        try:
            async with asyncio.timeout(min(left_s, MAX_UPLOAD_STALL_S)):
                chunk = await anext(body)
        except StopAsyncIteration:
            return
        except TimeoutError as error:
            if left_s > MAX_UPLOAD_STALL_S:
                raise errors.TooSlowError(
                    f"upload: nothing came for {MAX_UPLOAD_STALL_S:g} s"
                ) from error
            raise errors.TooSlowError(
                f"upload: found {n_bytes} bytes in {time.monotonic() - began_s:.0f} s, expected at "
                f"least {MIN_UPLOAD_RATE_BYTES_S / 1e6:g} MB a second"
            ) from error
        n_bytes += len(chunk)
        yield chunk


def _check_kind(first: bytes) -> None:
    if not first.startswith(_FILE_SIGNATURES):
        raise errors.MatrixError(
            f"upload: found a body that begins with {first[:8]!r}, expected an HDF5, FITS, NumPy "
            "or zip file (curl -X POST -T FILE)"
        )


def _too_large(found: str, max_bytes: int) -> errors.TooLargeError:
    return errors.TooLargeError(
        f"upload: found {found}, expected at most {max_bytes / 1e6:.0f} MB (fits.upload_limit_mb)"
    )


# --- the program that does it


async def run_program(words: Sequence[str], *, limit_s: float) -> None:
    """Run a program to its end; it is ended after the time limit or on cancellation.

    This process holds the other end of its standard input: a program that reads it sees the end of
    the service, however it comes. Ctrl-C in the service's terminal does not reach it.

    Raises
    ------
    WorkerError
        If it cannot be started, dies, takes longer than ``limit_s``, or ends with another status
        than 0; the message is its last line on standard error.
    """
    try:
        process = await asyncio.create_subprocess_exec(
            *words, stdin=PIPE, stdout=DEVNULL, stderr=PIPE, start_new_session=True
        )
    except OSError as error:
        raise errors.WorkerError(f"{words[0]}: cannot be started: {error.strerror}") from error
    assert process.stderr is not None  # noqa: S101 - asked for above
    try:
        async with asyncio.timeout(limit_s):
            stderr = await process.stderr.read()
            status = await process.wait()
    except TimeoutError as error:
        raise errors.WorkerError(f"took longer than {limit_s:g} s and was stopped") from error
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    # Ended by a signal: usually the kernel's, which is short of memory.
    if status < 0:
        raise errors.WorkerError("the process of the job died; out of memory?")
    if status > 0:
        lines = stderr.decode(errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "without a message")
        raise errors.WorkerError(last)
