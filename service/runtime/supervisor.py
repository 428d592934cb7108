"""The task that owns the state."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
import structlog
from numpy.typing import NDArray

from service import rtc_bridge
from service.archive import Actor, Archive, AuditEntry
from service.archive.retention import EVERYTHING, RetentionPolicy
from service.errors import LinkError, PyrcalError, StorageError
from service.estimation import dither_windows, frames, lockin, passive, random_dither
from service.estimation.description import Description
from service.link import matrices, statistics
from service.model.instrument import Instrument
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import CLOCK_LEAPT, Prerequisite
from service.records.estimates import RefusalKind
from service.records.events import Effect, Event
from service.records.messages import Message, compose
from service.records.operations import MeasureState
from service.records.state import Level, TrackerState
from service.runtime import archiving, command_results, readiness, worker
from service.runtime.actions import Actions
from service.runtime.clock import ServiceClock
from service.runtime.engine import Engine
from service.runtime.estimates import PendingWindow, fit_passive, fitted, read_own_matrix
from service.runtime.estimator_bank import EstimatorBank, Fed, process_blocks
from service.runtime.losses import Losses
from service.runtime.snapshot import Snapshot, in_words
from service.runtime.telemetry_recorder import TelemetryRecorder, TrendSampler
from service.runtime.workers import WorkerLoadMeter, WorkerPool, with_another_worker
from service.tracking.alarm_rules import changes_value
from service.tracking.policy import Policy
from service.tracking.step_context import new_lines

LINK_RETRY_INTERVAL_S = 1.0
"""Interval of attempts to open the link, and of checks whether it is still open, seconds."""

LINK_POLL_INTERVAL_S = 0.16
"""Between two visits to the link at the least: each costs two milliseconds, whatever there is."""

ORDER_REPLY_TIMEOUT_S = 3.0
"""Time for the RTC or the gate to answer before the response to an order is sent."""

NOT_READ = "the RTC's own reconstructor had not been read yet: the window was given up"

RESULT_POLL_INTERVAL_S = 0.02
OPERATOR = Actor()
_LEVELS = {Level.ALARM: "error"}
"""Names of structlog's where they are others."""


class Supervisor:
    """The running service; also what REST reads and commands."""

    def __init__(
        self,
        *,
        state: TrackerState,
        policy: Policy,
        bridge: rtc_bridge.Bridge,
        workers: WorkerPool,
        archive: Archive,
        actions: Actions,
        retention: RetentionPolicy = EVERYTHING,
        clock: ServiceClock | None = None,
    ) -> None:
        self._clock = clock or ServiceClock()
        self._engine = Engine(state, policy, self)
        self._bridge = bridge
        self._workers = workers
        workers.model = lambda: self._engine.state.model
        workers.changed = lambda model: self._post(ev.ModelChanged(model=model))
        self.archive = archive
        """Products and their history; a call waits for the disk."""
        self.newest_frames: frames.FrameBlock | None = None
        """The last telemetry that came; None: none has."""
        self._writer = archiving.ArchiveWriter(archive, lambda: self._engine.state, self._post)
        self._actions = actions
        self._retention = retention
        self.recordings = TelemetryRecorder(
            archive=archive,
            retention=retention,
            system=state.system,
            tap=bridge.keep,
            audit=self._writer.add,
        )
        """Telemetry kept on request."""
        self.complaints: dict[str, Callable[[], str | Message | None]] = {
            CLOCK_LEAPT: self._clock.complaint
        }
        """Functions that return the text of an alarm, or nothing for none; called each second."""
        self._pending_window = PendingWindow()
        self._n_readings = 0
        self._own_matrix_read = asyncio.Event()
        """Clear while the RTC's own reconstructor is being read and α is unknown."""
        self._own_matrix_read.set()
        self._worker_load = WorkerLoadMeter(workers)
        self._trends = TrendSampler(
            state=lambda: self._engine.state,
            frames=lambda: self.newest_frames,
            matrix=self.matrix,
            keep=self._writer.sampled,
        )
        self._telemetry_executor = ThreadPoolExecutor(1, "telemetry")
        self._telemetry_lock = asyncio.Lock()
        """Held while estimators are used or changed."""
        self._running: set[asyncio.Task[None]] = set()
        self._heartbeat = Heartbeat()
        self._rest_missing = ""
        self._broken = ""
        """Last unforeseen error."""
        self._started_ns = self._clock.now_ns()
        self._log = structlog.get_logger().bind(system=state.system)

    @property
    def instrument(self) -> Instrument:
        """The telescope it works for."""
        file, mode = self._actions.instrument, self._engine.state.model.sensor_mode
        return file if mode is None else file.in_mode(mode)

    @property
    def policy(self) -> Policy:
        """The user's numbers that it goes by."""
        return self._engine.policy

    def snapshot(self) -> Snapshot:
        """Return what is known now."""
        link = self._bridge.statistics()
        waiting = self._waiting_for(link)
        return Snapshot(
            tracker=self._engine.state,
            link=link,
            now_ns=self._clock.now_ns(),
            started_ns=self._started_ns,
            policy=self.policy,
            ready=not any(wait.blocks for wait in waiting),
            ready_reason=in_words(waiting),
            waiting_for=waiting,
            worker_load=self._worker_load.worker_load,
            archive_failures=self._writer.failures,
            archive_waiting=self._writer.waiting,
            instrument_remarks=self.instrument.remarks,
            stalled=self._heartbeat.stalled,
        )

    def _waiting_for(self, link: statistics.LinkStatistics) -> tuple[Prerequisite, ...]:
        """Return whom the service waits for now."""
        inputs = readiness.ReadinessInputs(
            state=self._engine.state,
            link=link,
            preparing=self._engine.bank is None,
            worker_problem=self._workers.problem,
            rest_missing=self._rest_missing,
            reading=not self._own_matrix_read.is_set(),
        )
        return readiness.waiting_for(inputs)

    def await_rest(self, missing: str) -> None:
        """Take note of what keeps REST from listening; empty if nothing does."""
        if missing and missing != self._rest_missing:
            self._note("api.waiting", missing, Level.WARNING)
        self._rest_missing = missing

    def audit(self, entry: AuditEntry) -> None:
        """Take a line of the audit trail that is of no command."""
        self._writer.add(entry)

    async def audited(self, entry: AuditEntry) -> None:
        """Take a line of the audit trail, and wait until it can be read there.

        One that the disk refuses waits for it, and the state says so.
        """
        self._writer.add(entry)
        with contextlib.suppress(StorageError):
            await self._writer.flush()

    async def submit(
        self, command: cmd.Command, actor: Actor = OPERATOR, order_id: str = ""
    ) -> Message:
        """Carry out an operator's command; return one sentence on what came of it.

        It is on record before it is done, and so is why it is refused. What it leads to has its
        ``order_id``; empty: it is given one.

        Raises
        ------
        CommandError
            If it cannot be carried out in the present state.
        UnknownIdError
            If it names an unknown reconstructor.
        StorageError
            If it cannot be recorded; nothing has been done. Orders that make the loop safer are
            carried out first and recorded when the disk allows it.
        """
        state, now_ns = self._engine.state, self._clock.now_ns()
        order = command_results.GivenCommand(
            command, order_id or ev.new_id(ev.kebab(type(command)), now_ns)
        )
        again = isinstance(command, cmd.SetValue) and not changes_value(state, command, now_ns)
        if again or isinstance(command, cmd.SetPointing):  # every second, and changes nothing
            return await self._result_of(order)
        try:
            # The order is on the disk before the tracker gets it (docs/decisions/0034-archive-and-
            # audit.md).
            await self._writer.ordered(order, actor)
        except StorageError as error:
            self._writer.refused(order, actor, error)
            raise
        try:
            # After the order is on record, so that the audit trail has refused orders too.
            actor.check()
            answer = await self._result_of(order)
        except PyrcalError as error:
            self._writer.refused(order, actor, error)
            raise
        self._writer.answered(order, actor, str(answer))
        await self._writer.keep_orders(state)
        return answer

    async def _result_of(self, order: command_results.GivenCommand) -> Message:
        """Do what is asked, and say what the RTC says to it where that takes but a moment."""
        running = set(self._running)
        self._post(order.command, order.id)
        asked = self._running - running
        # The RTC answers these commands within a moment, and its answer is the result.
        if asked and isinstance(order.command, cmd.Measure | cmd.SetLoop | cmd.Ramp):
            await asyncio.wait(asked)
        until_s = time.monotonic() + ORDER_REPLY_TIMEOUT_S
        while True:
            answer = order.result(self._engine.state)
            if answer.final or time.monotonic() > until_s:
                return answer.message
            await asyncio.sleep(RESULT_POLL_INTERVAL_S)

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor ``(n_modes, n_slopes)``."""
        return self._actions.matrix(matrix_id)

    async def run(self) -> None:
        """Work until cancelled: prepare the model, then listen, tick, fit, watch and record."""
        # Lines that were logged while the state was restored have not been written anywhere yet.
        self._tell(replace(self._engine.state, log=()))
        try:
            await self._work()
        finally:
            for action in self._running:
                action.cancel()
            await asyncio.gather(*self._running, return_exceptions=True)
            self._telemetry_executor.shutdown(wait=False)
            # Last: actions that were cancelled may have left lines for the audit trail.
            self._writer.close()

    async def _work(self) -> None:
        async with asyncio.TaskGroup() as group:
            # These run before the model is prepared, which takes seconds to minutes: orders and
            # alarms are recorded meanwhile, and RTCs can connect.
            group.create_task(self._keep_link())
            group.create_task(self._writer.run())
            group.create_task(self._writer.save())
            group.create_task(self.recordings.run())
            group.create_task(self._writer.keep_house(self._retention))
            await self._prepare()
            for work in (self._listen, self._tick, self._fit, self._fit_passive, self._trends.run):
                group.create_task(work())

    @property
    def description(self) -> Description | None:
        """The model's expectation of telemetry; None: being prepared."""
        return None if self._engine.bank is None else self._engine.bank.loop.description

    async def _prepare(self) -> None:
        """Let the estimators listen to what the model expects; a worker that dies is replaced."""
        describe = partial(self._workers.call, worker.OpticsWorker.describe)
        config_id = self._engine.state.loop.config_id
        lost = partial(self._note, "worker.lost", level=Level.WARNING)
        description = await with_another_worker(describe, lost)
        if self._engine.state.loop.config_id == config_id:  # else another mode is prepared
            self._engine.set_description(description)
            text = f"{description.n_slopes} slopes, {description.n_modes} modes"
            self._post(ev.LogEvent(name="service.ready", text=text))
            self.swapped(self._engine.state.matrices.in_use)

    async def _listen(self) -> None:
        """Take what the link has: frames, then the events after them."""
        rung = asyncio.Event()
        loop = asyncio.get_running_loop()
        # Frames do not wake it: they come many times a second and are gathered. An event acts at
        # once.
        self._bridge.set_wakeup(lambda: loop.call_soon_threadsafe(rung.set), for_frames=False)
        while True:
            self._heartbeat.beat("the intake of telemetry")
            await asyncio.sleep(LINK_POLL_INTERVAL_S)
            # asyncio.wait_for of Python 3.11 swallows a cancel that meets the bell
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._engine.gather_s - LINK_POLL_INTERVAL_S):
                    await rung.wait()
            # Cleared before the link is read: what comes during the read rings again and is not
            # missed.
            rung.clear()
            # Frames before events: the last window of a dither must end before the event that stops
            # it.
            await self._feed()
            for event in self._bridge.events():
                if isinstance(event, matrices.MeasuredMatrix):
                    self._start("a measured matrix", self._keep_measured(event))
                    continue
                with self._survive_errors("an event of the link"):
                    self._engine.receive(event)

    async def _feed(self) -> None:
        """Take in frames, in a thread: who asks something meanwhile has an answer."""
        loop = asyncio.get_running_loop()
        async with self._telemetry_lock:
            bank = self._engine.checkout()
            if bank is None:
                return
            blocks: list[frames.FrameBlock] = []
            found: Fed = bank, []
            with self._survive_errors("telemetry"):
                try:
                    blocks, found = await loop.run_in_executor(
                        self._telemetry_executor, self._take_in, bank
                    )
                finally:
                    # In any case, also after an error: without it the engine would never follow a
                    # change again.
                    self._engine.checkin(*found)
            self.newest_frames = blocks[-1] if blocks else self.newest_frames
            for block in blocks:
                self._worker_load.count_frames(block.n_frames * block.dt_ns * 1e-9)

    def _take_in(self, bank: EstimatorBank) -> tuple[list[frames.FrameBlock], Fed]:
        blocks = self._bridge.drain(before_events=True)
        return blocks, process_blocks(bank, blocks)

    @contextlib.contextmanager
    def _survive_errors(self, what: str) -> Iterator[None]:
        """Continue after an unforeseen error: log it and reset the estimators.

        The estimators are reset before anything is posted, because each event advances them.
        """
        try:
            yield
        except Exception as error:  # noqa: BLE001 - a bug must not end the service
            text = f"{what} was dropped, internal error: {error!r}; please report it"
            if text != self._broken:  # its traceback once, not with every batch of frames
                self._log.exception("internal.error", text=text)
            self._broken = text
            self._engine.begin_anew()
            self._note("internal.error", text, Level.ALARM)

    def fit(self, window: dither_windows.EndedWindow) -> None:
        """Put a window where the worker finds it."""
        if isinstance(window, random_dither.Correlated):
            # Before the window is joined with another: each counts once in the sum.
            self._actions.noisy.take(window, self._engine.state)
        if self._pending_window.waits:
            self._worker_load.was_late()
        given_up = self._pending_window.put(window)
        if given_up is not None:
            if not self._own_matrix_read.is_set():
                given_up = replace(given_up, reason=NOT_READ, kind=RefusalKind.VOID)
            self._post(ev.WindowLost(refused=given_up))

    async def _tick(self) -> None:
        alarms: frozenset[tuple[str, str]] = frozenset()
        readiness_log, losses = readiness.ReadinessLog(), Losses()
        while True:
            self._heartbeat.beat("the tick")
            link = self._bridge.statistics()
            with self._survive_errors("a tick"):
                self._post(ev.Tick())
            self._worker_load.look()
            for trouble in self._worker_load.detect_changes(self._engine.state):
                self._post(trouble)
            now_ns = self._clock.now_ns()
            lost = losses.complaint(link, time.monotonic())
            also = lost | {name: complain() for name, complain in self.complaints.items()}
            for event in readiness.detect_link_changes(link, self._engine.state, now_ns, also):
                self._post(event)
            waiting = self._waiting_for(link)
            for text in readiness_log.due_lines(waiting, self._engine.state.alarms.active, now_ns):
                self._note("waiting", text, Level.INFO)
            self._bridge.publish_state(readiness.state_message(self._engine.state, now_ns, waiting))
            gains = readiness.gains_message(self._engine.state)
            if gains is not None:
                self._bridge.publish_gains(gains)
            raised = frozenset((a.name, a.text) for a in self._engine.state.alarms.active)
            for message in readiness.alarm_messages(
                self._engine.state.system, alarms, raised, now_ns
            ):
                self._bridge.publish_alarm(message)
            alarms = raised
            await asyncio.sleep(1.0)

    async def _keep_link(self) -> None:
        """Open the link once its network is there, and again when nothing arrives on it.

        After a power cut the service may start before its router, its name server or its address.
        """
        revival, noted = readiness.Revival(), ""
        while True:
            link = self._bridge.statistics()
            if link.missing or revival.due(link, time.monotonic()):
                try:
                    await asyncio.to_thread(self._bridge.reopen)
                except LinkError as error:
                    if noted != str(error):
                        noted = str(error)
                        self._note("link.waiting", f"{noted}; tried each second", Level.WARNING)
                else:
                    noted = ""
                    if not link.missing:
                        text = (
                            "no message of an RTC that is there arrived: the link was opened again"
                        )
                        self._note("link.reopened", text, Level.WARNING)
            await asyncio.sleep(LINK_RETRY_INTERVAL_S)

    async def _fit(self) -> None:
        while True:
            await self._pending_window.some()
            # a fit about the nominal registration may end in a wrong place, and takes longer
            await self._own_matrix_read.wait()
            await self._fit_window()

    # One window, and the sums of one estimate, are fitted in functions of their own: a loop would
    # hold their 25 MB until the next one comes.
    async def _fit_window(self) -> None:
        async with self._workers.turn(worker.OpticsWorker.fit):
            # Taken only now that the worker is free: until then later windows are joined to it.
            window = self._pending_window.take()
            if window is None:
                return
            if isinstance(window, lockin.Spectra):
                self._worker_load.fitted(window.window_s)
            event = await fitted(window, self._engine.state, self._workers, self._actions.matrix)
        self._post(event)

    async def _fit_passive(self) -> None:
        while True:
            await asyncio.sleep(passive.PASSIVE_INTERVAL_S)
            await self._fit_sums()

    async def _fit_sums(self) -> None:
        async with self._workers.turn(worker.OpticsWorker.fit_passive):
            async with self._telemetry_lock:
                sums = self._engine.take_sums()
            events = await fit_passive(sums, self._engine.state, self._workers)
        for event in events:
            self._post(event)

    def _post(self, event: Event, cause: str = "") -> tuple[Effect, ...]:
        return self._engine.post(event, cause)

    def now_ns(self) -> int:
        """Return the time, nanoseconds UTC."""
        return self._clock.now_ns()

    def stepped(self, before: TrackerState, event: Event) -> None:
        """Log what is new in the state's log, at its level, and have it recorded."""
        self._tell(before)

    def perform(self, effect: Effect) -> None:
        """Begin an effect as a task."""
        self._start(type(effect).__name__, self._do(effect, self._engine.state))

    def swapped(self, in_use: str | None) -> None:
        """Offer the matrix in use to the RTC, and watch its effect.

        While α is unknown, windows wait until the matrix has been read, because it determines where
        fits begin.
        """
        if in_use is not None and self._engine.state.alpha.registration is None:
            self._own_matrix_read.clear()
        # Readings may overlap if the RTC swaps twice; windows wait for the last of them.
        self._n_readings += 1
        self._start("the offer of the matrix in use", self._offer(in_use))

    def sensor_mode_changed(self, config_id: str) -> None:
        """Have the model of another mode of the sensor made."""
        self._start("another mode of the sensor", self._prepare())

    def _start(self, what: str, action: Coroutine[Any, Any, None]) -> None:
        """Begin a task; a bug in it costs what it was about, not the service."""

        async def survived() -> None:
            with self._survive_errors(what):
                await action

        task = asyncio.get_running_loop().create_task(survived())
        # The event loop keeps only weak references to tasks: without this one it could vanish while
        # it runs.
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    async def _offer(self, in_use: str | None) -> None:
        """Offer the matrix in use to an RTC that comes late or asks again; watch what it does."""
        try:
            await asyncio.to_thread(self._actions.offer, self._engine.state)
            if in_use is not None and self._engine.bank is not None:
                await self._hear_out(in_use, await self._learn(in_use))
        except PyrcalError as error:
            self._note("reconstructor.not-offered", str(error), Level.WARNING)
        finally:
            self._n_readings -= 1
            if not self._n_readings:
                self._own_matrix_read.set()

    async def _learn(self, matrix_id: str) -> NDArray[np.float32]:
        """Compare commands with a matrix, from its first frame on if it has only been sent."""
        matrix = await asyncio.to_thread(self._actions.matrix, matrix_id)
        async with self._telemetry_lock:
            self._engine.learn(matrix_id, matrix)
        return matrix

    async def _hear_out(self, in_use: str, matrix: NDArray[np.float32]) -> None:
        """Learn from the matrix in use how the RTC lists its slopes and counts its commands."""
        record = self._engine.state.reconstructor(in_use)
        if record is None:
            return
        for event in await read_own_matrix(
            record, matrix, self._engine.state, self._workers, self._actions.matrix
        ):
            # The RTC may have swapped its matrix while this one was read.
            if self._engine.state.matrices.in_use == in_use:
                self._post(event)

    async def _do(self, effect: Effect, state: TrackerState) -> None:
        try:
            # Nothing is done that cannot be recorded (docs/decisions/0034-archive-and-audit.md).
            await self._writer.before(effect)
            if isinstance(effect, ev.SendMatrix):
                await self._learn(effect.id)
            event = await self._actions.perform(effect, state)
        except StorageError as error:
            self._writer.failed(error)
            event = ev.JobFailed(effect=effect, text=str(error))
        except PyrcalError as error:
            event = ev.JobFailed(effect=effect, text=str(error))
        except Exception as error:  # noqa: BLE001 - a bug in one action must not end the service
            self._log.exception("action.broken", effect=type(effect).__name__)
            event = ev.JobFailed(effect=effect, text=f"internal error: {error!r}")
        if event is not None:
            self._post(event, effect.cause)

    async def _keep_measured(self, received: matrices.MeasuredMatrix) -> None:
        known = self._engine.state.measurement(received.manifest.id)
        given_up = known is not None and known.state is MeasureState.GIVEN_UP
        if known is not None and (given_up or known.pattern is None):
            why = "it had been given up" if given_up else "a noisy one had this id"
            text = compose("measurement.late", why, id=known.id)
            self._note("measurement.ignored", text, Level.INFO)
            return
        try:
            self._post(await self._actions.keep_measured(received))
        except PyrcalError as error:
            if isinstance(error, StorageError):
                self._writer.failed(error)
            self._note("measurement.not-kept", str(error), Level.WARNING)

    def _note(self, name: str, text: str | Message, level: Level) -> None:
        self._post(ev.LogEvent(name=name, text=text, level=level))

    def _tell(self, before: TrackerState) -> None:
        """Log what is new in the state's log, at its level, and have it recorded."""
        after = self._engine.state
        entries = new_lines(before, after)
        ids = archiving.ids_of(after, archiving.find_changed_ids(before, after)) if entries else {}
        for entry in entries:
            write = getattr(self._log, _LEVELS.get(entry.level, entry.level.value))
            write(entry.name, text=entry.text, **ids)
        self._writer.changed(before, self._engine.state, entries)


MAX_ROUND_S: Final = 30.0
"""Longest time between two rounds: a round takes a second at most, but some on a machine that is
overloaded or swaps."""


class Heartbeat:
    """Time at which each part of the service last began a round of its work.

    A part is watched from its first round on.

    Parameters
    ----------
    now_s
        Monotonic clock, seconds.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._beats_s: dict[str, float] = {}

    def beat(self, part: str) -> None:
        """Take note that a part goes on."""
        self._beats_s[part] = self._now_s()

    @property
    def stalled(self) -> str:
        """Return the part that has stopped, and for how long; empty if all are running."""
        ages_s = {part: self._now_s() - beat_s for part, beat_s in self._beats_s.items()}
        return "; ".join(
            f"{part} has stood still for {age_s:.0f} s, expected a round within {MAX_ROUND_S:g} s: "
            "restart the service"
            for part, age_s in ages_s.items()
            if age_s > MAX_ROUND_S
        )
