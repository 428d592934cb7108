"""Estimates on their way to the disk: batched, in their order, none twice; and what cannot wait."""

import asyncio
import threading

import pytest

from service.archive import AuditEntry
from service.errors import StorageError
from service.records import commands as cmd
from service.records import events as ev
from service.records.messages import as_message
from service.records.registration import OffloadState
from service.records.state import Level, LogEntry, Mode, TrackerState
from service.runtime import archiving
from service.runtime.archiving import ArchiveWriter
from service.wire import OffloadRequest
from tests.support.archive_nights import NOON, entry
from tests.support.offload import a_story
from tests.support.pace import patience
from tests.support.states import changed

EMPTY = TrackerState(system="small")


@pytest.fixture
def recorder(archive):
    return ArchiveWriter(archive, lambda: EMPTY, lambda event: None)


def measured(recorder, first, last):
    """Have the tracker take in estimates one by one."""
    every = tuple(entry(NOON + k) for k in range(last))
    for n_known in range(first, last):
        before, after = (changed(EMPTY, history=every[:n]) for n in (n_known, n_known + 1))
        recorder.changed(before, after, ())


def kept(archive):
    return [one.t_ns_utc - NOON for one in archive.nights.estimates(0, 2 * NOON, 100)]


async def test_estimates_wait_for_one_write_and_are_written_once(recorder, archive):
    measured(recorder, 0, 4)
    assert kept(archive) == []
    await recorder.flush()
    measured(recorder, 4, 6)
    await recorder.flush()
    await recorder.flush()
    assert kept(archive) == [0, 1, 2, 3, 4, 5]


async def test_what_comes_and_goes_all_night_is_in_no_audit_trail(recorder, archive):
    lines = [
        LogEntry(t_ns_utc=NOON + k, level=level, name=f"a.{level}", message=as_message("x", "x"))
        for k, level in enumerate(Level)
    ]
    recorder.changed(EMPTY, EMPTY, lines)
    await recorder.flush()
    names = {line.name for line in archive.audit_trail()}
    assert names == {f"a.{level}" for level in Level if level is not Level.DEBUG}


async def test_two_estimates_of_one_event_keep_their_order_when_the_oldest_are_forgotten(
    recorder, archive
):
    every = tuple(entry(NOON + k) for k in range(5))
    before, after = changed(EMPTY, history=every[:3]), changed(EMPTY, history=every[2:])
    recorder.changed(before, after, ())
    recorder.close()
    assert kept(archive) == [3, 4]


async def test_a_disk_that_refuses_for_long_loses_the_newest_and_says_how_many(
    recorder, archive, monkeypatch
):
    def refuse(*_):
        raise StorageError("full")

    monkeypatch.setattr(archiving, "MAX_WAITING_LINES", 3)
    with monkeypatch.context() as patch:
        patch.setattr(archive, "record", refuse)
        measured(recorder, 0, 5)
        with pytest.raises(StorageError):
            await recorder.flush()
        assert recorder.waiting == 2
    await recorder.flush()
    assert kept(archive) == [0, 1, 2]
    assert recorder.waiting == 0
    assert archive.audit_trail()[-1].text.startswith("2 lines came while the disk refused")


async def test_lines_that_were_lost_are_told_of_where_nothing_else_waits(archive, monkeypatch):
    recorder = ArchiveWriter(archive, lambda: None, lambda event: None)
    monkeypatch.setattr(archiving, "MAX_WAITING_LINES", 0)
    recorder.add(AuditEntry(t_ns_utc=1, who="Ada", name="mode", text=""))
    await recorder.flush()
    assert archive.audit_trail()[-1].text.startswith("1 lines came while the disk refused")
    assert recorder.waiting == 0


class TestDemandToMoveTheImage:
    """A service killed before the answer must not leave the next one unaware."""

    async def test_it_is_on_the_disk_before_it_is_asked(self, archive):
        story = a_story()
        recorder = ArchiveWriter(archive, lambda: story.state, lambda event: None)
        (asked,) = story.asked(OffloadRequest)
        await recorder.before(ev.Ask(request=asked))
        move = archive.tracking.read().offload
        assert (move.id, move.state) == (asked.id, OffloadState.ASKED)

    async def test_it_is_not_asked_where_the_disk_refuses(self, archive, monkeypatch):
        def refuse(*_):
            raise StorageError("full")

        story = a_story()
        recorder = ArchiveWriter(archive, lambda: story.state, lambda event: None)
        (asked,) = story.asked(OffloadRequest)
        monkeypatch.setattr(archive.tracking, "write", refuse)
        with pytest.raises(StorageError):
            await recorder.before(ev.Ask(request=asked))

    async def test_a_write_that_began_before_it_does_not_come_after_it(self, archive, monkeypatch):
        story = a_story()
        states = [changed(story.state, offload=None), story.state]
        ordered_since = changed(story.state, stopped_because="an operator")
        (asked,) = story.asked(OffloadRequest)
        writing, go_on, written = threading.Event(), threading.Event(), []

        def slowly(_archive, state, _now_ns):
            if state.alpha.offload is None:
                writing.set()
                assert go_on.wait(patience(20.0))
            written.append(state.alpha.offload)

        monkeypatch.setattr(archiving, "leave", slowly)
        recorder = ArchiveWriter(archive, lambda: states[0], lambda event: None)
        first = asyncio.create_task(recorder.keep_orders(ordered_since))
        await asyncio.to_thread(writing.wait, patience(20.0))
        del states[0]
        second = asyncio.create_task(recorder.before(ev.Ask(request=asked)))
        await asyncio.wait({second}, timeout=0.2)
        go_on.set()
        await asyncio.gather(first, second)
        assert written == [None, story.state.alpha.offload]


@pytest.mark.parametrize(
    ("order", "safer"),
    [
        (cmd.SetLoop(loop="open"), True),
        (cmd.SetLoop(loop="closed"), False),
        (cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=1, gain=0.2),)), True),
        (cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=2, gain=0.2),)), False),
        (cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=1, gain=0.5),)), False),
        (cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=1, gain=0.2),), leak=1.0), False),
        (cmd.SetLoop(leak=0.0), False),
        (cmd.SetMode(mode=Mode.HOLD), True),
        (cmd.SetMode(mode=Mode.AUTO), False),
        (cmd.Reject(id="cm-1"), True),
        (cmd.Approve(id="cm-1"), False),
    ],
)
def test_an_order_is_safer_if_it_ends_something_or_lowers_gains(order, safer):
    assert cmd.makes_safer(order, gains=(0.4, 0.4, 0.1)) is safer
