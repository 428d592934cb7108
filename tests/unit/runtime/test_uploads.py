"""The desk for fits, with jobs that only say what they were given."""

import asyncio
import errno
import hashlib
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from service.errors import (
    BusyError,
    CommandError,
    MatrixError,
    StorageError,
    TooLargeError,
    TooSlowError,
    UnknownIdError,
)
from service.files.fit_folder import FitRequest
from service.runtime import uploads
from service.runtime.uploads import FitLimits, FitQueue, FitState
from tests.support.pace import in_time

pytestmark = pytest.mark.timeout(60)

LIMITS = FitLimits(max_bytes=10_000_000, waiting=2, seconds=30.0)
REQUEST = FitRequest(
    asked={},
    own_instrument="tiny",
    own_sha256="",
    max_bytes=10_000_000,
    threads=1,
    nice=0,
    memory_mb=4000,
)
ASKED = {"dataset": "D"}
HDF5 = b"\x89HDF\r\n\x1a\n" + b"\x00" * 5_000_000


async def in_chunks(content, size=300_000):
    for start in range(0, len(content), size):
        yield content[start : start + size]


@pytest.fixture
async def opened(tmp_path):
    desks = []

    def make(job="telling", **limits):
        desk = FitQueue(
            folder=tmp_path / "uploads",
            program=(sys.executable, str(Path(__file__).with_name("fit_program.py")), job),
            request=REQUEST,
            limits=replace(LIMITS, **limits),
            clock_ns=time.time_ns,
        )
        desk.open()
        desks.append(desk)
        return desk

    yield make
    for desk in desks:
        await desk.close()


async def taken(desk, content=HDF5, asked=ASKED, length=None):
    return await desk.take(asked, in_chunks(content), length)


async def until(condition):
    async with asyncio.timeout(50.0):
        while not condition():  # noqa: ASYNC110 - nobody tells
            await asyncio.sleep(0.02)


async def finished(desk, job):
    await until(lambda: desk.job(job.id).state in {FitState.DONE, FitState.FAILED})
    await until(lambda: not (desk._folder / job.id).exists())  # its files go last
    return desk.job(job.id)


def files(tmp_path):
    return [path for path in (tmp_path / "uploads").rglob("*") if path.is_file()]


async def test_an_upload_is_kept_fitted_and_removed_but_what_figures_are_drawn_from(
    opened, tmp_path
):
    desk = opened()
    job = await taken(desk)
    assert job.state is FitState.WAITING
    assert job.n_bytes == len(HDF5)
    assert job.sha256 == hashlib.sha256(HDF5).hexdigest()
    done = await finished(desk, job)
    assert done.state is FitState.DONE
    assert done.document == {"verdict": f"accepted: {len(HDF5)} bytes of D"}
    assert done.figures == b"{}"
    assert not list((tmp_path / "uploads").iterdir())


async def test_a_fit_that_cannot_be_made_says_why(opened, tmp_path):
    desk = opened("refusing")
    failed = await finished(desk, await taken(desk))
    assert failed.state is FitState.FAILED
    assert failed.reason == "transposed"
    assert failed.document is None
    assert not files(tmp_path)


async def test_a_program_that_leaves_no_answer_is_a_fit_that_failed(opened):
    desk = opened("silent")
    failed = await finished(desk, await taken(desk))
    assert failed.reason.startswith("the fit has ended and left no answer")


async def test_fits_run_one_after_the_other(opened):
    desk = opened("sleeping")
    first, second = await taken(desk), await taken(desk)
    await until(lambda: desk.job(first.id).state is FitState.RUNNING)
    assert desk.job(second.id).state is FitState.WAITING
    assert [job.id for job in desk.jobs()] == [first.id, second.id]


async def test_what_a_fit_is_at_is_told_and_it_ends_when_it_is_given_up(opened, tmp_path):
    desk = opened("at_a_stage")
    first, second = await taken(desk), await desk.take(ASKED, in_chunks(HDF5), None, "im.h5")
    await until(lambda: desk.job(first.id).stage)
    assert desk.job(first.id).stage == "orientation"
    assert (await desk.give_up(second.id)).name == "im.h5"
    ended = await desk.give_up(first.id)
    assert (ended.state, ended.stage) == (FitState.GIVEN_UP, "")
    assert [job.state for job in desk.jobs()] == [FitState.GIVEN_UP] * 2
    assert not list((tmp_path / "uploads").iterdir())
    with pytest.raises(CommandError, match="is given-up: there is nothing to give up"):
        await desk.give_up(first.id)


async def test_too_many_unfinished_fits_are_refused_before_anything_is_read(opened):
    desk = opened("sleeping")
    await taken(desk), await taken(desk)
    untouched = in_chunks(HDF5)
    with pytest.raises(BusyError, match="found 2 fits unfinished"):
        await desk.take(ASKED, untouched, None)
    assert await anext(untouched) == HDF5[:300_000]


async def test_an_upload_that_says_it_is_too_large_is_not_read(opened, tmp_path):
    desk = opened(max_bytes=1_000_000)
    untouched = in_chunks(HDF5)
    with pytest.raises(TooLargeError, match="found 2000 MB, expected at most 1 MB"):
        await desk.take(ASKED, untouched, 2_000_000_000)
    assert await anext(untouched) == HDF5[:300_000]
    assert not list((tmp_path / "uploads").iterdir())


async def test_an_upload_that_turns_out_too_large_is_removed(opened, tmp_path):
    desk = opened(max_bytes=1_000_000)
    with pytest.raises(TooLargeError):
        await taken(desk, length=900_000)
    assert not list((tmp_path / "uploads").iterdir())
    assert not desk.jobs()


@pytest.mark.parametrize(
    ("content", "said"), [(b"", "empty body"), (b"shift,rotation", "begins with b'shift,ro'")]
)
async def test_a_body_no_matrix_could_be_in_is_refused_at_once(opened, tmp_path, content, said):
    desk = opened()
    with pytest.raises(MatrixError, match=said):
        await taken(desk, content)
    assert not list((tmp_path / "uploads").iterdir())


async def test_an_upload_that_stops_is_given_up(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(uploads, "MAX_UPLOAD_STALL_S", 0.1)

    async def stalled():
        yield HDF5[:1000]
        await asyncio.sleep(30.0)

    desk = opened()
    with pytest.raises(TooSlowError, match="nothing came"):
        await desk.take(ASKED, stalled(), None)
    assert not list((tmp_path / "uploads").iterdir())


async def test_an_upload_that_trickles_does_not_hold_its_place(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(uploads, "MAX_UPLOAD_DELAY_S", 0.3)

    async def trickling():
        yield HDF5[:1000]
        for _ in range(300):
            await asyncio.sleep(0.1)
            yield b"x"

    desk = opened(waiting=1)
    begun = time.monotonic()
    with pytest.raises(TooSlowError, match=r"expected at least 0\.2 MB a second"):
        await desk.take(ASKED, trickling(), None)
    assert in_time(begun, 5.0)
    assert (await taken(desk)).state is FitState.WAITING


async def test_a_disk_that_is_full_is_said_as_such(opened, monkeypatch):
    desk = opened()
    monkeypatch.setattr(uploads, "UPLOAD", "/dev/full")
    with pytest.raises(StorageError, match="No space left on device"):
        await taken(desk)
    assert not desk.jobs()


async def test_a_fit_whose_request_cannot_be_written_has_failed(opened, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    desk = opened()
    monkeypatch.setattr(uploads.FitRequest, "write", full)
    failed = await finished(desk, await taken(desk))
    assert failed.state is FitState.FAILED


async def test_a_fit_that_takes_too_long_is_stopped(opened, tmp_path):
    desk = opened("sleeping", seconds=1.0)
    failed = await finished(desk, await taken(desk))
    assert failed.reason == "took longer than 1 s and was stopped"
    assert not files(tmp_path)


async def test_only_the_last_finished_fits_are_remembered(opened, monkeypatch):
    monkeypatch.setattr(uploads, "FITS_KEPT", 1)
    desk = opened()
    jobs = []
    for _ in range(3):
        jobs.append(await taken(desk))
        await finished(desk, jobs[-1])
    assert [job.id for job in desk.jobs()] == [jobs[1].id, jobs[2].id]
    with pytest.raises(UnknownIdError):
        desk.job(jobs[0].id)


async def test_closing_ends_what_runs_and_clears_the_disk(opened, tmp_path):
    desk = opened("sleeping")
    await taken(desk)
    await asyncio.sleep(0.2)
    begun = time.monotonic()
    await desk.close()
    assert in_time(begun, 5.0)
    assert not (tmp_path / "uploads").exists()


async def test_opening_clears_what_an_earlier_service_left(opened, tmp_path):
    left = tmp_path / "uploads" / "fit-1"
    left.mkdir(parents=True)
    (left / "upload").write_bytes(b"old")
    opened()
    assert not list((tmp_path / "uploads").iterdir())
