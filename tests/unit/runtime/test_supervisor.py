"""The one task that owns the state, beside a real worker, archive and (idle) link."""

import asyncio
import contextlib
import resource
import shutil
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.archive import Actor, AuditEntry, Channel, Range
from service.errors import ArchiveError, CommandError, PyrcalError, UnknownIdError
from service.records import commands as cmd
from service.records import events as ev
from service.records.messages import as_message, compose
from service.records.state import Level, LogEntry, Mode, TrackerState
from service.rtc_bridge import Bridge, Endpoint
from service.runtime import supervisor as supervising
from service.runtime.archiving import restore_tracking
from service.runtime.engine import follow_state
from service.runtime.supervisor import Supervisor
from service.wire import checksum
from tests.support.acquiring import Acquiring
from tests.support.cable import free_port
from tests.support.fake_rtc import client_session
from tests.support.link import applied, send
from tests.support.pace import in_time, patience
from tests.support.situations import POLICY, Story, record
from tests.support.states import changed, tracker_state
from tests.support.supervisor import Window, running, until

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def bridge():
    endpoint = Endpoint(system="small", listen=(f"tcp/127.0.0.1:{free_port()}",))
    with Bridge(endpoint) as bridge:
        yield bridge


@pytest.fixture
def supervisor(workers, archive, bridge, actions):
    return supervisor_of(workers, archive, bridge, actions)


def supervisor_of(workers, archive, bridge, actions):
    return Supervisor(
        state=tracker_state(system="small", mode=Mode.HOLD),
        policy=replace(POLICY),
        bridge=bridge,
        workers=workers,
        archive=archive,
        actions=actions,
    )


async def test_it_is_ready_when_the_model_is(supervisor):
    before = supervisor.snapshot()
    assert not before.ready
    async with running(supervisor):
        log = supervisor.snapshot().tracker.log
        assert log[0].name == "service.ready"
        assert log[0].text == "224 slopes, 90 modes"


async def test_what_the_instrument_leaves_out_is_known_at_any_moment(supervisor, monkeypatch):
    said = ("mirror.segments_deg: no mode has a mean step across any of the 6 gaps",)
    instrument = replace(supervisor.instrument, remarks=said)
    monkeypatch.setattr(Supervisor, "instrument", instrument)
    assert supervisor.snapshot().instrument_remarks == said


async def test_a_command_changes_the_state_and_enters_the_audit_trail(supervisor, archive):
    text = await supervisor.submit(cmd.SetMode(mode=Mode.AUTO))
    assert text == compose("command.mode", Mode.AUTO)
    assert supervisor.snapshot().tracker.operator.mode is Mode.AUTO
    (entry,) = archive.audit_trail()  # the answer's own line may take its time
    assert (entry.who, entry.name) == ("operator", "SetMode")
    assert entry.text == '{"mode":"auto"}'


async def test_the_audit_trail_says_who_why_from_where_and_what_was_answered(supervisor, archive):
    actor = Actor(address="10.0.0.7", channel=Channel.PAGE)
    async with running(supervisor):
        order = cmd.SetMode(mode=Mode.AUTO, by="Ada", reason="clouds have gone")
        answer = await supervisor.submit(order, actor)
        await supervisor.submit(cmd.SetMode(mode=Mode.HOLD), actor)
        await until(lambda: len(orders(archive)) == 4)
    asked, answered, anonymous, _ = orders(archive)
    for entry in (asked, answered):
        assert (entry.who, entry.address, entry.channel) == ("Ada", "10.0.0.7", "page")
        assert (entry.why, entry.text) == ("clouds have gone", '{"mode":"auto"}')
    assert (asked.name, asked.answer) == ("SetMode", "")
    assert (answered.name, answered.answer) == ("SetMode.answered", str(answer))
    assert anonymous.who == "10.0.0.7"


async def test_a_note_whose_answer_is_out_can_be_read_in_the_trail(supervisor, archive):
    await supervisor.audited(Actor().entry("annotation", "dome shutter moved"))
    (entry,) = archive.audit_trail()
    assert (entry.name, entry.text) == ("annotation", "dome shutter moved")


async def test_an_order_its_answer_and_what_it_led_to_share_an_id_in_trail_and_log(
    supervisor, archive
):
    async with running(supervisor):
        await supervisor.submit(cmd.SetMode(mode=Mode.AUTO))
        await until(lambda: len(orders(archive)) == 2)
    cause = orders(archive)[0].cause
    assert cause.startswith("set-mode-20")
    trail = [entry.name for entry in archive.audit_trail() if entry.cause == cause]
    assert sorted(trail) == ["SetMode", "SetMode.answered", "mode"]
    (line,) = [line for line in supervisor.snapshot().tracker.log if line.cause == cause]
    assert (line.name, line.text) == ("mode", "mode is auto")


def orders(archive):
    return [entry for entry in archive.audit_trail(Range(limit=1000)) if entry.channel]


async def test_a_command_that_cannot_be_carried_out_is_the_callers_to_hear_of(supervisor):
    before = supervisor.snapshot().tracker
    with pytest.raises(CommandError, match="no RTC is there"):
        await supervisor.submit(cmd.Refit())
    assert supervisor.snapshot().tracker is before


async def test_what_happens_is_written_to_the_archive_in_order(supervisor, archive):
    async with running(supervisor):
        await supervisor.submit(cmd.SetMode(mode=Mode.AUTO))
        await supervisor.submit(cmd.SetMode(mode=Mode.PROPOSE))

        def names():
            return [entry.text for entry in archive.audit_trail() if entry.who == "service"]

        await until(lambda: "mode is propose" in names())
    found = names()
    assert found.index("224 slopes, 90 modes") < found.index("mode is auto")
    assert found.index("mode is auto") < found.index("mode is propose")


async def test_a_reconstructor_on_the_shelf_is_known_after_a_restart(supervisor, archive):
    async with running(supervisor):
        supervisor._post(ev.MatrixMade(record=record("cm-1"), wanted=False))
        await until(lambda: archive.reconstructors.records())
    assert [kept.id for kept in archive.reconstructors.records()] == ["cm-1"]


async def test_a_deed_that_fails_is_on_record_and_the_service_goes_on(supervisor):
    async with running(supervisor):
        await supervisor.submit(cmd.StopDither())
        await until(lambda: any(e.name == "job.failed" for e in supervisor.snapshot().tracker.log))
        assert supervisor.snapshot().ready


async def test_cancelled_it_ends_at_once(supervisor):
    async with running(supervisor):
        began = time.monotonic()
    assert in_time(began, 1.0)


@pytest.mark.parametrize("turns", range(8))
async def test_cancelled_in_the_very_moment_a_bell_rings_it_ends(supervisor, bridge, turns):
    """Where the two meet is a matter of one turn of the event loop: every turn is tried."""
    task = asyncio.create_task(supervisor.run())
    await until(lambda: supervisor.snapshot().ready, 30.0)
    await asyncio.sleep(0.01)  # it listens now
    bridge.events()  # the bell may ring again
    bridge._intake._wake()
    for _ in range(turns):
        await asyncio.sleep(0)
    task.cancel()
    done, _ = await asyncio.wait({task}, timeout=patience(0.5))
    for left in asyncio.all_tasks() - {asyncio.current_task()}:
        left.cancel()
    assert done, "the first cancel was swallowed"


async def test_alpha_outlives_the_service_that_measured_it(supervisor, archive):
    """As __main__ does it: what one has left, the next takes up from the same directory."""
    before = told(Story(Mode.HOLD).meet(), n_windows=3)
    know(supervisor, registration=before)
    async with running(supervisor):
        assert archive.tracking.read() is None
    again = restore_tracking(archive, TrackerState(system="small"), POLICY, time.time_ns())
    assert again.alpha.registration.alpha == before.alpha
    assert again.alpha.registration.n_windows == 0


async def test_a_damaged_file_costs_alpha_and_not_the_start(archive, tmp_path):
    (tmp_path / "tracking.json").write_text("{")
    state = restore_tracking(archive, TrackerState(system="small"), POLICY, time.time_ns())
    assert state.alpha.registration is None
    assert "damaged" in state.log[-1].text
    assert (tmp_path / "tracking.damaged").exists()


async def test_what_is_wrong_in_the_archive_is_on_record_from_the_start(archive):
    (archive.directory / "reconstructors" / "old.h5").mkdir()
    archive.close()
    archive.open()
    state = restore_tracking(archive, TrackerState(system="small"), POLICY, time.time_ns())
    (entry,) = [entry for entry in state.log if entry.name == "archive.damaged"]
    assert "old.h5" in entry.text
    assert entry.level is Level.WARNING


async def test_what_was_restored_is_on_record(supervisor, archive):
    know(
        supervisor,
        log=(LogEntry(t_ns_utc=1, level=Level.INFO, name="old", message=as_message("x", "news")),),
    )
    async with running(supervisor):
        await until(lambda: any(e.name == "old" for e in archive.audit_trail()))


async def test_it_is_saved_while_the_service_runs_and_not_only_at_its_end(
    supervisor, archive, monkeypatch
):
    monkeypatch.setattr("service.runtime.archiving.SAVE_INTERVAL_S", 0.01)
    async with running(supervisor):
        known = told(Story(Mode.HOLD).meet(), n_windows=1)
        know(supervisor, registration=known)
        await until(lambda: archive.tracking.read() is not None)


async def test_an_acquisition_is_saved_at_once_and_not_when_alpha_next_would_be(
    supervisor, archive, monkeypatch
):
    """Five seconds later is too late for a service that is killed."""
    monkeypatch.setattr("service.runtime.archiving.SAVE_INTERVAL_S", 1.0)
    story = Acquiring()
    story.see(n_windows=3)
    async with running(supervisor):
        know(supervisor, registration=story.state.alpha.registration)
        await until(lambda: archive.tracking.read() is not None)
        story.tell(cmd.Acquire())
        know(supervisor, registration=None, acquisition=story.state.operations.acquisition)
        began = time.monotonic()
        await until(lambda: archive.tracking.read().acquisition is not None)
        assert in_time(began, 0.5)


def told(story, n_windows):
    story.see(n_windows=n_windows)
    return story.state.alpha.registration


async def test_a_bug_in_an_estimator_costs_what_it_has_gathered(supervisor, bridge, monkeypatch):
    def broken(streams, block):
        raise ValueError("an inhomogeneous shape")

    async with running(supervisor):
        know(supervisor, rtc=Story(Mode.HOLD).meet().state.loop.rtc)
        monkeypatch.setattr("service.runtime.estimator_bank.process_block", broken)
        monkeypatch.setattr(
            bridge, "drain", lambda **_: [SimpleNamespace(n_frames=50, dt_ns=10**6)]
        )
        await until(lambda: "internal.error" in [e.name for e in supervisor._engine.state.log])
        monkeypatch.undo()
        entry = next(e for e in supervisor._engine.state.log if e.name == "internal.error")
        assert "an inhomogeneous shape" in entry.text
        assert "telemetry was dropped" in entry.text
        assert supervisor._engine.bank.loop.rtc is not None
        assert supervisor.snapshot().ready


async def test_a_bug_in_a_task_is_told_and_ends_no_service(supervisor, monkeypatch):
    def broken(state):
        raise ValueError("a shelf that is bent")

    async with running(supervisor):
        monkeypatch.setattr(supervisor._actions, "offer", broken)
        supervisor.swapped(None)
        await until(lambda: "internal.error" in [e.name for e in supervisor._engine.state.log])
        entry = next(e for e in supervisor._engine.state.log if e.name == "internal.error")
        assert "the offer of the matrix in use was dropped" in entry.text
        assert "a shelf that is bent" in entry.text
        assert supervisor.snapshot().ready


async def test_frames_that_the_link_cannot_hand_on_end_no_service(supervisor, bridge, monkeypatch):
    def broken(**_):
        raise ValueError("a ring that is bent")

    async with running(supervisor):
        monkeypatch.setattr(bridge, "drain", broken)
        await until(lambda: "internal.error" in [e.name for e in supervisor._engine.state.log])
        monkeypatch.undo()
        know(supervisor, rtc=Story(Mode.HOLD).meet().state.loop.rtc)
        await until(lambda: supervisor._engine.bank.loop.rtc is not None)
        entry = next(e for e in supervisor._engine.state.log if e.name == "internal.error")
        assert "a ring that is bent" in entry.text


async def test_an_intake_that_hangs_is_named_though_the_process_lives(
    supervisor, bridge, monkeypatch
):
    gone_on = threading.Event()
    async with running(supervisor):
        assert not supervisor.snapshot().stalled
        monkeypatch.setattr(supervising, "MAX_ROUND_S", 0.3)
        monkeypatch.setattr(bridge, "drain", lambda **_: gone_on.wait(60.0) and [])
        await until(lambda: "the intake of telemetry has stood" in supervisor.snapshot().stalled)
        gone_on.set()
        monkeypatch.undo()
        await until(lambda: not supervisor.snapshot().stalled)


async def test_frames_are_looked_at_before_what_was_told_after_them(
    supervisor, bridge, monkeypatch
):
    """A status that shows the end of a dither must not cost the window that has just ended."""
    order = []

    def seen(streams, block):
        order.append(block.first_seq)
        return streams, []

    async with running(supervisor):
        know(supervisor, rtc=Story(Mode.HOLD).meet().state.loop.rtc)
        send(bridge._intake, 0)
        await until(lambda: bridge._intake.events() == [] and not bridge.drain())
        monkeypatch.setattr("service.runtime.estimator_bank.process_block", seen)
        monkeypatch.setattr(supervisor._engine, "receive", lambda told: order.append(told.id))
        send(bridge._intake, 10)
        applied(bridge._intake, "s1")
        send(bridge._intake, 20)
        await until(lambda: len(order) == 3)
    assert order == [10, "cm-1", 20]


async def test_an_order_is_carried_out_while_frames_are_looked_at(supervisor, bridge, monkeypatch):
    looking, go_on = threading.Event(), threading.Event()

    def slowly(streams, block):
        looking.set()
        assert go_on.wait(patience(20.0))
        return replace(streams, loop=replace(streams.loop, received_ns_utc=1)), []

    async with running(supervisor):
        blocks = [SimpleNamespace(n_frames=50, dt_ns=10**6)]
        monkeypatch.setattr("service.runtime.estimator_bank.process_block", slowly)
        monkeypatch.setattr(bridge, "drain", lambda **_: [blocks.pop()] if blocks else [])
        await until(looking.is_set, 20.0)
        know(supervisor, rtc=Story(Mode.HOLD).meet().state.loop.rtc)
        assert await supervisor.submit(cmd.SetMode(mode=Mode.AUTO)) == compose(
            "command.mode", Mode.AUTO
        )
        assert supervisor._engine.bank.loop.received_ns_utc != 1
        go_on.set()
        await until(lambda: supervisor._engine.bank.loop.received_ns_utc == 1, 20.0)
        assert supervisor._engine.bank.loop.rtc is not None  # what was heard meanwhile is followed


async def test_estimators_that_break_whatever_is_posted_begin_anew(supervisor, monkeypatch):
    def broken(streams, state, policy):
        if streams.loop.received_ns_utc == 1:
            raise ValueError("samples of two matrices")
        return follow_state(streams, state, policy)

    async with running(supervisor):
        monkeypatch.setattr("service.runtime.engine.follow_state", broken)
        async with (
            supervisor._telemetry_lock
        ):  # what is lent to somebody is not what it was when it is back
            bank = supervisor._engine.bank
            matrices = (("cm-1", np.ones((2, 3), np.float32)),)
            marked = replace(bank.loop, received_ns_utc=1, matrices=matrices)
            supervisor._engine.bank = replace(bank, loop=marked)
        await until(lambda: supervisor._engine.bank.loop.received_ns_utc != 1)
        assert supervisor._engine.bank.loop.matrices is matrices  # nobody hands them in again
        entry = next(e for e in supervisor._engine.state.log if e.name == "internal.error")
        assert "a tick was dropped" in entry.text
        assert "samples of two matrices" in entry.text
        assert supervisor.snapshot().ready


# --- a disk that refuses


@contextlib.contextmanager
def full_disk(archive):
    """SQLite may grow no further, and no file may become longer than it is."""
    index = archive.index
    connection = index._connection
    with index._lock:  # the supervisor's recorder writes through the same connection
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.execute("PRAGMA max_page_count = 1")
    for length in (4000, 400, 40, 1, 1):
        with contextlib.suppress(ArchiveError):
            while True:
                archive.record(
                    (), (AuditEntry(t_ns_utc=1, who="somebody", name="else", text="x" * length),)
                )
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        with index._lock:
            connection.execute("PRAGMA max_page_count = 1000000")


def know(supervisor, **known):
    """Have the service know something that nobody has told it."""
    supervisor._engine.state = changed(supervisor._engine.state, **known)


def trail(archive, who):
    entries = archive.audit_trail(Range(limit=100_000))
    return [(entry.name, entry.answer or entry.text) for entry in entries if entry.who == who]


def alarm_of(supervisor, name):
    alarms = supervisor.snapshot().tracker.alarms.active
    return next((alarm for alarm in alarms if alarm.name == name), None)


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr("service.runtime.archiving.DISK_RETRY_INTERVAL_S", 0.05)


async def test_an_order_that_cannot_be_recorded_is_not_carried_out(supervisor, archive, impatient):
    async with running(supervisor):
        with full_disk(archive):
            with pytest.raises(ArchiveError, match=r"index\.sqlite: .*full \(SQLITE_FULL\)"):
                await supervisor.submit(cmd.SetMode(mode=Mode.AUTO))
            assert supervisor.snapshot().tracker.operator.mode is Mode.HOLD
            alarm = alarm_of(supervisor, "archive-failed")
            assert "index.sqlite" in alarm.text
            assert supervisor.snapshot().archive_failures > 0
            assert supervisor.snapshot().archive_waiting > 0
        await until(lambda: alarm_of(supervisor, "archive-failed") is None)
        await supervisor.submit(cmd.SetMode(mode=Mode.PROPOSE))
    names = [name for name, _ in trail(archive, "operator")]
    assert names == ["SetMode", "SetMode.refused", "SetMode", "SetMode.answered"]


@pytest.mark.parametrize(
    "order",
    [
        cmd.SetMode(mode=Mode.HOLD),
        cmd.StopDither(),
        cmd.StopEverything(),
        cmd.SetLoop(loop="open"),
        cmd.Rollback(anyway=True),
        cmd.AbortAcquisition(),
    ],
)
async def test_what_makes_the_loop_safer_needs_no_disk(supervisor, archive, impatient, order):
    """It is carried out, or refused for what the RTC says, and on record once the disk is back."""
    async with running(supervisor):
        know(supervisor, mode=Mode.AUTO)
        with full_disk(archive):
            with contextlib.suppress(CommandError, UnknownIdError):
                await supervisor.submit(order)
            state = supervisor.snapshot().tracker
            done = state.operator.mode is Mode.HOLD or bool(state.operator.stopped_because)
            assert done or not isinstance(order, cmd.SetMode | cmd.StopEverything)
            await until(lambda: alarm_of(supervisor, "archive-failed"))
        await until(lambda: alarm_of(supervisor, "archive-failed") is None)
    kind = type(order).__name__
    names = [name for name, _ in trail(archive, "operator")]
    assert names[0] == kind
    assert names[1] in {f"{kind}.answered", f"{kind}.refused"}


async def test_a_data_directory_that_is_gone_is_called_so(supervisor, archive, impatient):
    async with running(supervisor):
        shutil.move(archive.directory, f"{archive.directory}-elsewhere")
        with contextlib.suppress(ArchiveError):
            await supervisor.submit(cmd.SetMode(mode=Mode.AUTO))
        await until(lambda: alarm_of(supervisor, "archive-failed"))
        text = alarm_of(supervisor, "archive-failed").text
        shutil.move(f"{archive.directory}-elsewhere", archive.directory)
    assert "data_dir is gone" in text
    assert "free space" not in text


async def test_what_could_not_be_written_is_written_once_it_can_be_and_only_once(
    supervisor, archive, impatient
):
    async with running(supervisor):
        with full_disk(archive):
            supervisor._post(ev.MatrixMade(record=record("cm-1"), wanted=False))
            supervisor._post(ev.LogEvent(name="note", text="first"))
            await until(lambda: alarm_of(supervisor, "archive-failed"))
            supervisor._post(ev.LogEvent(name="note", text="second"))
            await asyncio.sleep(0.2)
            assert archive.reconstructors.records() == ()
        await until(lambda: alarm_of(supervisor, "archive-failed") is None)
    assert [kept.id for kept in archive.reconstructors.records()] == ["cm-1"]
    told = [text for name, text in trail(archive, "service") if name == "note"]
    assert told == ["first", "second"]


async def test_an_index_that_is_damaged_meanwhile_does_not_end_the_service(
    supervisor, archive, monkeypatch, impatient
):
    def damaged(*_):
        raise ArchiveError("index.sqlite: damaged: move it away")

    async with running(supervisor):
        with monkeypatch.context() as patch:
            patch.setattr(archive, "record", damaged)
            supervisor._post(ev.LogEvent(name="note", text="first"))
            await until(lambda: alarm_of(supervisor, "archive-failed"))
            with pytest.raises(ArchiveError, match="move it away"):
                await supervisor.submit(cmd.SetMode(mode=Mode.AUTO))
        await until(lambda: alarm_of(supervisor, "archive-failed") is None)
        assert supervisor.snapshot().tracker.operator.mode is Mode.HOLD
    assert ("note", "first") in trail(archive, "service")


async def test_a_service_that_ends_while_the_disk_refuses_still_writes_what_waits(
    supervisor, archive
):
    async with running(supervisor):
        with full_disk(archive):
            supervisor._post(ev.LogEvent(name="note", text="last words"))
            await until(lambda: alarm_of(supervisor, "archive-failed"))
    assert ("note", "last words") in trail(archive, "service")


@pytest.mark.parametrize(("parent", "is_sent"), [(None, False), ("cm-0", False), ("cm-2", True)])
async def test_a_matrix_is_not_sent_while_it_cannot_be_recorded_why(
    supervisor, archive, bridge, monkeypatch, impatient, parent, is_sent
):
    """But for the numbers of an earlier one, which take back what made the loop worse."""
    sent = []

    async def publish(manifest, _matrix):
        sent.append(manifest.id)

    monkeypatch.setattr(bridge, "publish", publish)
    matrix = np.zeros((3, 4), np.float32)
    new = record("cm-1", n_modes=3, sha256=checksum(matrix), parent=parent)
    archive.reconstructors.store(new, matrix, None, {})
    story = Story(Mode.HOLD).meet()
    earlier = record("cm-0", sha256="b" * 64), record("cm-2", sha256=new.sha256)
    known = changed(story.state, reconstructors=(*earlier, new))
    supervisor._engine.state = known
    effect = ev.SendMatrix(id="cm-1", n_modes=known.loop.rtc.n_controlled, gains=None)
    with full_disk(archive):
        supervisor._post(ev.LogEvent(name="why", text="it is sent"))
        await supervisor._do(effect, known)
        assert sent == ["cm-1"] * is_sent
    await supervisor._do(effect, known)
    assert sent[-1:] == ["cm-1"]


async def test_a_matrix_that_cannot_be_stored_is_never_heard_of_and_the_disk_is_named(
    supervisor, archive, monkeypatch, impatient
):
    """A line still fits on the disk, a matrix does not: the alarm lasts until one does."""
    matrix = np.zeros((300, 4000), np.float32)
    made = record("cm-9", n_modes=300)

    async def make(_effect, _state):
        await asyncio.to_thread(archive.reconstructors.store, made, matrix, None, {})
        return ev.MatrixMade(record=made, wanted=False)

    monkeypatch.setattr(supervisor._actions, "perform", make)
    async with running(supervisor):
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, limits[1]))
        try:
            await supervisor._do(ev.MakeMatrix(n_modes=300, why="test"), supervisor._engine.state)
            assert "cm-9.h5: cannot be written" in alarm_of(supervisor, "archive-failed").text
            await asyncio.sleep(0.3)
            assert alarm_of(supervisor, "archive-failed") is not None
            assert supervisor.snapshot().tracker.reconstructor("cm-9") is None
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        await until(lambda: alarm_of(supervisor, "archive-failed") is None)
    assert not list(archive.reconstructors.directory.iterdir())


async def test_a_refused_order_is_audited_with_the_reason(supervisor, archive):
    async with running(supervisor):
        with pytest.raises(CommandError):
            await supervisor.submit(cmd.Approve(id="cm-7"))
        await until(lambda: len(trail(archive, "operator")) == 2)
    (asked, _), (refused, why) = trail(archive, "operator")
    assert (asked, refused) == ("Approve", "Approve.refused")
    assert "unknown reconstructor cm-7" in why


@pytest.mark.parametrize("order", [cmd.SetMode(mode=Mode.AUTO), cmd.StopDither()])
async def test_an_order_is_saved_for_the_next_service_before_it_is_answered(
    supervisor, archive, order
):
    async with running(supervisor):
        await supervisor.submit(order)
        saved = archive.tracking.read()
    assert saved is not None
    assert saved.orders.mode is Mode.AUTO or saved.orders.dither_stopped


async def test_what_the_rtc_refuses_is_audited_too(supervisor, archive):
    async with running(supervisor):
        know(supervisor, rtc=Story(Mode.HOLD).meet().state.loop.rtc)
        with pytest.raises(PyrcalError):
            await supervisor.submit(cmd.SetLoop(loop="open"))
        await until(lambda: len(trail(archive, "operator")) == 2)
    assert trail(archive, "operator")[1][0] == "SetLoop.refused"


async def test_alpha_that_could_not_be_saved_is_an_alarm_and_saved_later(
    supervisor, archive, monkeypatch, impatient
):
    monkeypatch.setattr("service.runtime.archiving.SAVE_INTERVAL_S", 0.01)
    part = archive.directory / "tracking.json.part"
    async with running(supervisor):
        part.mkdir()
        known = told(Story(Mode.HOLD).meet(), n_windows=1)
        know(supervisor, registration=known)
        await until(lambda: alarm_of(supervisor, "archive-failed"))
        part.rmdir()
        await until(lambda: archive.tracking.read() is not None)
        await until(lambda: alarm_of(supervisor, "archive-failed") is None)


async def test_a_token_without_a_message_has_the_link_opened_anew_and_is_told(
    supervisor, bridge, monkeypatch
):
    monkeypatch.setattr("service.runtime.readiness.FIRST_REOPENING_DELAY_S", 1.0)
    async with running(supervisor):

        def logged():
            return [entry.name for entry in supervisor.snapshot().tracker.log]

        first = bridge._session
        bridge._intake.liveliness(alive=True)
        await until(lambda: "link.reopened" in logged(), 15.0)
        assert bridge._session not in {None, first}
        assert not bridge.statistics().rtc_alive
        # it goes on as before: a token is seen, and its end
        with client_session(bridge._endpoint.listen[0]) as rtc:
            token = rtc.liveliness().declare_token("ao/v1/small/alive/rtc")
            await until(lambda: bridge.statistics().rtc_alive)
            token.undeclare()
            await until(lambda: not bridge.statistics().rtc_alive)


async def test_a_link_whose_port_is_taken_is_opened_once_it_is_free(workers, archive, actions):
    port = free_port()
    bridge = Bridge(Endpoint(system="small", listen=(f"tcp/127.0.0.1:{port}",)))
    supervisor = supervisor_of(workers, archive, bridge, actions)
    with socket.create_server(("127.0.0.1", port)):
        task = asyncio.create_task(supervisor.run())

        def waits():
            return {wait.name: wait for wait in supervisor.snapshot().waiting_for}

        await until(lambda: "already in use" in waits()["link"].text, 15.0)
        # REST and the ticks go on meanwhile
        await until(lambda: "model" not in waits(), 30.0)
        assert not supervisor.snapshot().ready
        log = [entry.name for entry in supervisor.snapshot().tracker.log]
        assert log.count("link.waiting") == 1
        assert "rtc-vanished" not in log
    await until(lambda: supervisor.snapshot().ready, 15.0)
    assert not bridge.statistics().missing
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    bridge.close()


async def test_a_window_waits_until_the_rtcs_own_matrix_has_been_read(supervisor, monkeypatch):
    """A fit about the nominal registration may be far off; the matrix tells where to begin."""
    done, fits = asyncio.Event(), []

    async def read_slowly(*_):
        await done.wait()

    async def fit(window, *_):
        fits.append(window)
        return ev.LogEvent(name="fitted", text="")

    monkeypatch.setattr(supervisor, "_hear_out", read_slowly)
    monkeypatch.setattr("service.runtime.supervisor.fitted", fit)
    supervisor._actions._remember("own", np.zeros((45, 224), np.float32))
    async with running(supervisor):
        supervisor.swapped("own")
        windows = [Window(t_end_ns_utc=n * 60_000_000_000) for n in range(2)]
        for window in windows:
            supervisor.fit(window)
        names = [wait.name for wait in supervisor.snapshot().waiting_for]
        assert "own-matrix" in names
        # the first is too old to be joined; that is no fault of the telemetry
        assert supervisor.snapshot().tracker.windows.run == 0
        await asyncio.sleep(0.2)
        assert not fits
        done.set()
        await until(lambda: fits == windows[1:])
        assert "own-matrix" not in [wait.name for wait in supervisor.snapshot().waiting_for]
