"""Keep the archive in step with the state, and its disk in order.

What must survive is written before it takes effect. Old products are removed a little at a time,
and a disk that is almost full raises an alarm.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import fields, replace
from functools import partial
from itertools import takewhile

import msgspec
import structlog

from service.archive import Actor, Archive, AuditEntry
from service.archive.index import Sent, by_service
from service.archive.nights import TrendSample
from service.archive.retention import RetentionPolicy, due, items, low_on_space, remove
from service.errors import ArchiveError, StorageError
from service.records import events as ev
from service.records.alarms import ARCHIVE_FAILED, DISK_LOW
from service.records.commands import Command, makes_safer
from service.records.events import Effect
from service.records.operations import MeasurementRecord
from service.records.registration import HistoryEntry
from service.records.state import Level, LogEntry, TrackerState
from service.runtime.command_results import GivenCommand
from service.tracking.mode_proof import proof_to_keep
from service.tracking.policy import Policy
from service.tracking.references import find_previous
from service.tracking.resume import orders_of, resumed, saved_of, with_orders
from service.tracking.step_context import logged
from service.wire import (
    DitherRequest,
    MeasureRequest,
    OffloadRequest,
    RampRequest,
    ReferencesRequest,
)

DISK_RETRY_INTERVAL_S = 2.0
"""Interval between two attempts while the disk refuses."""

SAVE_INTERVAL_S = 5.0
"""Interval between two writes of the state for the next service; an α of that age is as good as a
new one."""

SPACE_CHECK_INTERVAL_S = 30.0
"""Interval between two checks of the free space."""

PRUNE_INTERVAL_S = 3600.0
"""Interval between two searches for old products."""

REMOVAL_PAUSE_S = 0.5
"""Pause between the removal of two products, which leaves the disk to others."""

MAX_WAITING_LINES = 10_000
"""Lines of the audit trail, and estimates, that wait for a disk; newer ones are counted and
dropped."""

RECORDED_REQUESTS = (DitherRequest, MeasureRequest, RampRequest, ReferencesRequest)
"""Effects that are executed only after their cause is on the disk. What ends something never waits.
"""

_LOGGED_FIELDS = ("who", "text", "address", "channel", "why", "answer")
"""Fields of an order that the log contains."""


class ArchiveWriter:
    """Writes reconstructors' records, the audit trail and what the next service needs.

    Belongs to the event loop; the disk is waited for in threads. What cannot be written waits and
    is tried again; the alarm lasts until a file as large as a matrix can be written.

    Parameters
    ----------
    archive
        Open.
    state
        Returns what is known now.
    post
        Takes the alarm.
    """

    def __init__(
        self,
        archive: Archive,
        state: Callable[[], TrackerState],
        post: Callable[[ev.ConditionChanged], object],
    ) -> None:
        self._archive = archive
        self._state = state
        self._post = post
        self._records: dict[str, Sent] = {}
        self._entries: list[AuditEntry] = []
        self._estimates: list[HistoryEntry] = []
        self._samples: list[TrendSample] = []
        self._lost = 0
        self._guard = threading.Lock()
        self._writing = threading.Lock()
        self._saving = asyncio.Lock()
        self._lines = asyncio.Event()
        self._trouble = ""
        self._log = structlog.get_logger()
        self.failures = 0
        """Attempts to write that the disk has refused."""

    @property
    def waiting(self) -> int:
        """Lines of the audit trail that are not on the disk yet."""
        return len(self._entries) + self._lost

    def changed(self, before: TrackerState, after: TrackerState, lines: Iterable[LogEntry]) -> None:
        """Take what a step has changed, to be written soon."""
        pairs: tuple[tuple[tuple[Sent, ...], tuple[Sent, ...]], ...] = (
            (before.matrices.reconstructors, after.matrices.reconstructors),
            (before.references.records, after.references.records),
        )
        for was, now in pairs:
            if now is was:
                continue
            old = {record.id: record for record in was}
            # Records are immutable, so identity finds the changed ones without comparing their
            # arrays.
            new = {r.id: r for r in now if old.get(r.id) is not r}
            with self._guard:
                self._records |= new
            if new:
                self._lines.set()
        if after.alpha.history is not before.alpha.history:
            last = before.alpha.history[-1:]
            # The history is bounded and drops its oldest entries, so positions in it do not
            # identify the new ones.
            new_ones = takewhile(lambda entry: entry not in last, reversed(after.alpha.history))
            with self._guard:
                room = MAX_WAITING_LINES - len(self._estimates)
                found = list(new_ones)[::-1]
                self._estimates += found[:room]
                self._lost += len(found[room:])
        for entry in lines:
            if entry.level is not Level.DEBUG:
                values = {key: getattr(entry, key) for key in ("t_ns_utc", "name", "text", "cause")}
                self.add(AuditEntry(who="service", **values))

    async def ordered(self, order: GivenCommand, actor: Actor) -> None:
        """Write down what an operator asks for, before it is done.

        What makes the loop safer never waits for the disk: it is written soon after.

        Raises
        ------
        StorageError
            If the disk refuses: it must not be done.
        """
        self._order(order, actor)
        rtc = self._state().loop.rtc
        if not makes_safer(order.command, () if rtc is None else rtc.gains):
            await self.flush()

    def answered(self, order: GivenCommand, actor: Actor, answer: str) -> None:
        """Record the answer to an order."""
        self._order(order, actor, ".answered", answer)

    def refused(self, order: GivenCommand, actor: Actor, error: Exception) -> None:
        """Record why an order was refused."""
        self._order(order, actor, ".refused", str(error))

    def _order(self, order: GivenCommand, actor: Actor, end: str = "", answer: str = "") -> None:
        command, asked = order.command, command_json(order.command, actor)
        name = f"{type(command).__name__}{end}"
        entry = actor.entry(name, asked, by=command.by, why=command.reason)
        entry = replace(entry, answer=answer, cause=order.id)
        self.add(entry)
        values = {key: getattr(entry, key) for key in _LOGGED_FIELDS if getattr(entry, key)}
        state = self._state()
        led_to = {one.id for one in _records(state) if one.cause == order.id}
        ids = ids_of(state, led_to | {getattr(command, "id", "")})
        self._log.info(entry.name, **values, **ids)

    async def before(self, effect: Effect) -> None:
        """Wait until the causes of an effect are on the disk.

        A request to move the mirror's image is saved for the next service as well: it has no other
        way to learn that the image may have moved.

        Raises
        ------
        ArchiveError
            If that fails: an action that cannot be recorded must not begin.
        """
        request = effect.request if isinstance(effect, ev.Ask) else None
        if isinstance(request, RECORDED_REQUESTS) or self._sends_new_numbers(effect):
            await self.flush()
        if isinstance(request, OffloadRequest):
            await self._save_now()

    def _sends_new_numbers(self, effect: Effect) -> bool:
        """Return True if an effect sends a matrix or references, and not earlier numbers again."""
        if isinstance(effect, ev.SendReferences):
            made = self._state().references_of(effect.id)
            return made is not None and made.shape is not None and made.parent is None
        if not isinstance(effect, ev.SendMatrix):
            return False
        # A rollback makes the loop safer, and the archive has its numbers under the earlier id.
        known, record = self._state().reconstructor, self._state().reconstructor(effect.id)
        earlier = record and known(record.parent or "")
        return not (record and earlier and earlier.sha256 == record.sha256)

    async def flush(self) -> None:
        """Write what waits.

        Raises
        ------
        StorageError
            If the disk refuses; it goes on waiting.
        """
        try:
            await asyncio.to_thread(self._write)
        except StorageError as error:
            self.failed(error)
            raise

    def failed(self, error: StorageError) -> None:
        """Raise the alarm, until the disk can be written again."""
        self.failures += 1
        # Nothing new may come for hours: the writer must try again all the same.
        self._lines.set()
        # The disk is tried every two seconds; the same failure would be a new line each time.
        if self._trouble != str(error):
            self._trouble = str(error)
            remedy = "free space there or mend the disk"
            # The open index belongs to the folder that was removed, also if another one is made.
            if not self._archive.directory.is_dir():
                remedy = "data_dir is gone: mount or restore it, then restart the service"
            text = (
                f"{error}: {remedy}; until it can be written only orders that make the loop safer "
                "are carried out, nothing is made or sent by itself, and records wait in memory"
            )
            self._post(ev.ConditionChanged(name=ARCHIVE_FAILED, text=text))

    async def run(self) -> None:
        """Write whenever there is something to be written."""
        while True:
            await self._lines.wait()
            self._lines.clear()
            try:
                await asyncio.to_thread(self._write)
                if self._trouble:
                    # A few lines may fit on a disk that is still too full for a matrix.
                    await asyncio.to_thread(self._archive.probe)
                    self._trouble = ""
                    self._post(ev.ConditionChanged(name=ARCHIVE_FAILED, text="", over=True))
            except StorageError as error:
                self.failed(error)
                await asyncio.sleep(DISK_RETRY_INTERVAL_S)

    async def save(self) -> None:
        """Keep what the service after this one needs; seldom, but for what cannot wait."""
        saved, next_s = self._state(), time.monotonic()
        while True:
            await asyncio.sleep(SAVE_INTERVAL_S / 10)
            state = self._state()
            due = is_urgent(saved, state) or time.monotonic() >= next_s
            if not (due and is_unsaved(saved, state)):
                continue
            next_s = time.monotonic() + SAVE_INTERVAL_S
            try:
                saved = await self._save_now()
                self._lines.set()  # estimates are written as seldom as what the next service needs
            except StorageError as error:
                self.failed(error)
                await asyncio.sleep(DISK_RETRY_INTERVAL_S)
            except ArchiveError as error:  # it has been put aside: the next attempt finds none
                self._log.error("archive.failed", text=str(error))

    async def _save_now(self) -> TrackerState:
        """Keep what the next service needs, and return what was kept; one at a time.

        Raises
        ------
        ArchiveError
            As :func:`leave`.
        """
        # The state is read inside the lock, so that an older state never overwrites a newer one.
        async with self._saving:
            state = self._state()
            await asyncio.to_thread(leave, self._archive, state, time.time_ns())
        return state

    async def keep_house(self, retention: RetentionPolicy) -> None:
        """Prune and watch the disk until cancelled; in threads."""
        next_s = time.monotonic() + SPACE_CHECK_INTERVAL_S
        while True:
            # While the alarm is active more space is required, so that it does not come and go at
            # the limit.
            low = self._state().alarm(DISK_LOW) is not None
            try:
                folder = self._archive.directory
                text = await asyncio.to_thread(low_on_space, folder, retention, low=low)
                if text is not None or low:
                    self._post(
                        ev.ConditionChanged(name=DISK_LOW, text=text or "", over=text is None)
                    )
                if time.monotonic() >= next_s:
                    next_s = time.monotonic() + PRUNE_INTERVAL_S
                    await self._prune(retention)
            except (OSError, ArchiveError) as error:  # a disk that refuses is reported elsewhere
                self._log.warning("archive.not-looked-after", text=str(error))
            except Exception:  # noqa: BLE001 - a bug must not end the service
                self._log.exception("archive.not-looked-after")
            await asyncio.sleep(SPACE_CHECK_INTERVAL_S)

    async def _prune(self, retention: RetentionPolicy) -> None:
        """Remove what is old or too much, one by one; what has come into use meanwhile stays."""
        every = await asyncio.to_thread(items, self._archive, needed(self._state()))
        for item, why in tuple(due(every, retention, time.time_ns())):
            # Removal may take minutes with its pauses: meanwhile a rollback may need what was old
            # before.
            if item.id in needed(self._state()):
                continue
            entry = await asyncio.to_thread(remove, self._archive, item, why)
            if entry is not None:
                self.add(entry)
            await asyncio.sleep(REMOVAL_PAUSE_S)

    async def keep_orders(self, before: TrackerState) -> None:
        """Keep what was ordered since for the service after this one now, if the disk lets it.

        A kill may come as soon as an order is answered.
        """
        if orders_of(before) == orders_of(self._state()):
            return
        try:
            await self._save_now()
        except ArchiveError as error:  # :meth:`save` tries again, and raises the alarm
            self._log.error("archive.failed", text=str(error))

    def close(self) -> None:
        """Write what still waits and what the next service needs; blocks."""
        for write in (self._write, partial(leave, self._archive, self._state(), time.time_ns())):
            try:
                write()
            except ArchiveError as error:
                self._log.error("archive.failed", text=str(error))

    def add(self, entry: AuditEntry) -> None:
        """Take a line of the audit trail, to be written soon."""
        with self._guard:
            if len(self._entries) < MAX_WAITING_LINES:
                self._entries.append(entry)
            else:
                self._lost += 1
        self._lines.set()

    def sampled(self, sample: TrendSample) -> None:
        """Take a sample of the trends; while the disk refuses, the oldest ones go."""
        with self._guard:
            self._samples = [*self._samples, sample][-MAX_WAITING_LINES:]
        self._lines.set()

    def _write(self) -> None:
        """Write all that waits as one; in a thread, one at a time."""
        with self._writing:
            # Held for copying only: the event loop takes this lock for each line and must not wait
            # for the disk.
            with self._guard:
                records, entries = dict(self._records), tuple(self._entries)
                estimates, samples = tuple(self._estimates), tuple(self._samples)
                lost = self._lost
            # The gap is recorded in the trail itself, or a reader would take it for complete.
            loss = _loss_text(lost) if lost else ()
            try:
                all_entries = (*entries, *loss)
                if records or all_entries or estimates or samples:
                    self._archive.record(tuple(records.values()), all_entries, estimates, samples)
            except StorageError:
                raise
            except ArchiveError as error:  # a damaged index is a disk that refuses, too
                raise StorageError(str(error)) from error
            with self._guard:
                del self._entries[: len(entries)]
                del self._estimates[: len(estimates)]
                # Samples are compared by identity because the oldest may have been dropped during
                # the write, which shifts positions.
                written = set(map(id, samples))
                self._samples = [one for one in self._samples if id(one) not in written]
                self._lost -= lost
                for name, record in records.items():
                    # A newer record of the same matrix may have come while this one was written: it
                    # still waits.
                    if self._records[name] is record:
                        del self._records[name]


def ids_of(state: TrackerState, matrices: Collection[str]) -> dict[str, object]:
    """Return what a line of the log is to be found by: frame, matrix in use, its matrices."""
    ids = {
        "frame": None if state.loop.rtc is None else state.loop.rtc.seq,
        "in_use": state.matrices.in_use,
        "matrices": [one.id for one in _records(state) if one.id in matrices],
    }
    return {name: found for name, found in ids.items() if found}


def find_changed_ids(before: TrackerState, after: TrackerState) -> set[str]:
    """Return the ids of the matrices, made or measured, that a step has changed."""
    known = _records(before)
    return {one.id for one in _records(after) if one not in known}


def _records(state: TrackerState) -> tuple[Sent | MeasurementRecord, ...]:
    made: tuple[Sent, ...] = (*state.matrices.reconstructors, *state.references.records)
    return (*made, *state.operations.measurements)


def command_json(command: Command, actor: Actor) -> str:
    """Return the fields of a command other than name and reason, as JSON.

    With a key, the name in the command is only what its sender calls himself.
    """
    left_out = {"reason"} | ({"by"} if command.by == actor.key or not actor.key else set())
    values = {
        field.name: getattr(command, field.name)
        for field in fields(command)
        if field.name not in left_out and getattr(command, field.name) != field.default
    }
    return msgspec.json.encode(values).decode()


def _loss_text(lost: int) -> tuple[AuditEntry]:
    text = f"{lost} lines came while the disk refused and {MAX_WAITING_LINES} waited already"
    return (by_service("archive.lost", text),)


def restore_tracking(
    archive: Archive, state: TrackerState, policy: Policy, now_ns: int
) -> TrackerState:
    """Return the state with the saved registration, if there is one and it fits.

    A damaged file costs only the α in it. Other problems of the archive are logged.
    """
    for text in archive.wrong:
        state = logged(state, "archive.damaged", text, now_ns, Level.WARNING)
    try:
        saved = archive.tracking.read()
    except ArchiveError as error:
        return logged(state, "registration.not-restored", str(error), now_ns, Level.WARNING)
    return state if saved is None else resumed(state, saved, policy, now_ns)


def leave(archive: Archive, state: TrackerState, now_ns: int) -> None:
    """Save what the next service needs; blocks until it is on the disk.

    Raises
    ------
    ArchiveError
        If the disk refuses, or what is there is damaged; it has been put aside then.
    """
    saved = saved_of(state, now_ns)
    if saved is None or not saved.tells_of_alpha:
        # A service that has measured nothing yet must not overwrite the α of the service before it.
        left = archive.tracking.read()
        if left is not None and left.system == state.system:
            saved = with_orders(left, state)
    if saved is not None:
        archive.tracking.write(saved)


def is_unsaved(before: TrackerState, after: TrackerState) -> bool:
    """Return whether something has been measured, or begun, that is not saved yet."""
    if is_urgent(before, after):
        return True
    old, new = before.alpha.registration, after.alpha.registration
    if old is None or new is None:
        return new is not None
    return (old.t_ns_utc, old.doubt) != (new.t_ns_utc, new.doubt)


def is_urgent(before: TrackerState, after: TrackerState) -> bool:
    """Return True if unsaved state must be written at once: an opened loop, an order.

    If the service were killed a second later, its successor would not know that the loop was
    opened, or would undo an operator's order, or would not know where the mirror's image was moved,
    or which modes have a wrong response.
    """
    if before.alpha.offload is not after.alpha.offload:
        return True
    if proof_to_keep(before) != proof_to_keep(after):
        return True
    return orders_of(before) != orders_of(after) or _course(before) != _course(after)


def _course(state: TrackerState) -> tuple[object, ...]:
    acquisition, rtc = state.operations.acquisition, state.loop.rtc
    if not acquisition.under_way:
        return (acquisition.stage,)
    session = None if rtc is None else rtc.session
    return acquisition.stage, acquisition.attempt, acquisition.matrix, session


def needed(state: TrackerState) -> frozenset[str]:
    """Return the ids of matrices that may be needed at any moment."""
    ids = (
        state.matrices.in_use,
        state.previous,
        state.operations.acquisition.matrix,
        state.operations.acquisition.applied,
        state.references.used_id,
        getattr(find_previous(state), "id", None),
    )
    return frozenset(one for one in ids if one is not None)
