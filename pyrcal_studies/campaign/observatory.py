"""The whole service against a simulated telescope, in simulated time: no network, no processes.

What the service does is the service's own code: streams, worker, tracker, actions, translation of
the wire. Only what waits is replaced: an agenda says when each thing is over, by the frames' time,
so a night takes as long as it computes and is the same every time.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.campaign.observatory_checks import Publication, Swap, published, true_radius
from pyrcal_studies.campaign.observatory_dome import Dome
from pyrcal_studies.campaign.observatory_link import OwnHands, Shelf, ShortLink
from service.errors import PyrcalError
from service.estimation.dither_windows import EndedWindow
from service.estimation.loop import select_gains
from service.estimation.passive_sums import PASSIVE_INTERVAL_S
from service.estimation.random_dither import Correlated
from service.runtime.actions import Actions, Publishing, present_conditions
from service.runtime.engine import Engine
from service.runtime.estimates import PendingWindow, fit_passive, fitted, read_own_matrix
from service.runtime.ports import StorePort
from service.runtime.worker import OpticsWorker
from service.runtime.worker.records import patience_s
from service.tracker import step
from service.tracking import events as ev
from service.tracking.commands import Command
from service.tracking.events import Effect, Event
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.products import MatrixState, ReconstructorRecord
from service.tracking.state import LoopState, Mode, OperatorState, TrackerState
from service.wire import CHUNK_LIMIT, Manifest, Status, checksum

_Job = tuple[float, Callable[[], None]]
"""How long the worker is at something, seconds, and what it has done then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Latencies:
    """How long things take at the telescope, seconds of simulated time.

    The worker does one thing after the other, the most urgent first, as the service's does.
    """

    fit_s: float = 0.5
    make_s: float = 2.0
    judge_s: float = 1.0
    watch_s: float = 0.5
    command_s: float = 0.1
    """Until the RTC's answer is here; it acts at once."""

    send_s: float = 0.1
    """Until a matrix is staged; the RTC swaps with its next frames."""

    fetch_s: float = 0.3
    listen_s: float = 0.5
    """Until a matrix of the RTC's own has been compared with the instrument file."""

    status_s: float = 0.2
    """Between two status messages of the RTC."""

    tick_s: float = 1.0
    """Between two looks of the service at what it waits for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Glance:
    """What the service held to be true at the end of a block."""

    time_s: float
    alpha: NDArray[np.float64] | None
    """``(4,)`` the tracker's registration, numeric units; None: not known."""

    sigma: NDArray[np.float64] | None
    """``(4,)`` 1 σ, floor included."""

    alarms: tuple[str, ...]


@dataclass(order=True, slots=True)
class _Due:
    """Something that will have happened."""

    t_ns: int
    number: int
    """Of two at the same time the one first put down comes first."""

    happen: Callable[[], None] = field(compare=False)


class Observatory:
    """A night in simulated time; ``advance`` lets it pass."""

    def __init__(
        self,
        options: Sequence[str],
        policy: Policy,
        mode: Mode,
        workbench: OpticsWorker,
        *,
        latencies: Latencies | None = None,
        pole_radius_bound: float = 0.95,
        with_poles: bool = True,
        dome: Dome | None = None,
        link: Callable[[Any], ShortLink] = ShortLink,
        archive: StorePort | None = None,
    ) -> None:
        """Take the simulator's command line, ``--plant linear --seed 1``, and the policy.

        ``with_poles`` finds the true poles of every swap, seconds on a diffractive telescope.
        ``dome`` and ``link`` are another telescope and the way to it; without an ``archive``
        matrices are kept in memory.
        """
        self.dome = dome or Dome(options)
        self.latencies = latencies or Latencies()
        system = self.dome.computer.identity.system
        about = self.dome.instrument
        state = TrackerState(
            system=system,
            operator=OperatorState(mode=mode),
            loop=LoopState(basis_id=about.basis_id, config_id=about.config_id),
        )
        self._engine = Engine(state, policy, self, step=self.step)
        self._engine.set_description(workbench.describe())
        self.glances: list[Glance] = []
        self.swaps: list[Swap] = []
        self.events: list[tuple[float, Event]] = []
        """All that the tracker heard and when, status and ticks left out."""

        self._link = link(self.dome)
        self._workers = OwnHands(workbench)
        self._shelf: StorePort = archive or Shelf()
        self._publishing = Publishing(
            system=system, chunk_bytes=CHUNK_LIMIT, pole_radius_bound=pole_radius_bound
        )
        self._actions = self._new_actions()
        self._n_restarts = 0
        self._agenda: list[_Due] = []
        self._numbers = itertools.count()
        self._with_poles = with_poles
        self._idle_worker()
        self._begin()

    @property
    def state(self) -> TrackerState:
        """What the service knows now."""
        return self._engine.state

    @property
    def time_s(self) -> float:
        """Seconds since the night began."""
        return self.dome.time_s

    @property
    def worker_cpu_s(self) -> dict[str, float]:
        """Processor time the worker's jobs have taken, seconds, by name."""
        return dict(self._workers.cpu_s)

    def advance(self, seconds: float) -> None:
        """Let so much time pass.

        Raises
        ------
        TypeError
            If the service wants something done that no observatory here can do.
        """
        until_s = self.time_s + seconds
        while self.time_s < until_s - 1e-9:
            blocks = self.dome.play()
            self._happen()
            self._engine.feed(blocks)
            self._acknowledged()
            self._look()

    def command(self, command: Command) -> None:
        """Do what an operator would: raises what the tracker refuses."""
        self._post(command)

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return one of the last reconstructors ``(n_modes, n_slopes)``."""
        return self._actions.matrix(matrix_id)

    def force(self, matrix: NDArray[np.float32]) -> None:
        """Have the service send a matrix that the gate has never seen as if it had accepted it."""
        state, n_modes = self.state, len(matrix)
        registration, rtc, margin = state.alpha.registration, state.loop.rtc, state.matrices.margin
        if registration is None or rtc is None or margin is None:
            raise ValueError("force: found no α, no RTC or no verdict; expected a night under way")
        record = ReconstructorRecord(
            id=f"forced-{self.dome.frame}",
            state=MatrixState.PROPOSED,
            n_modes=n_modes,
            created_ns_utc=self.dome.now_ns,
            alpha=registration.alpha,
            sigma=registration.sigma,
            parent=state.matrices.in_use,
            sha256=checksum(matrix),
            gate=margin,
            judged=present_conditions(state, select_gains(rtc, n_modes)),
        )
        self._shelf.reconstructors.store(record, matrix, registration.total_covariance, {})
        self._post(ev.MatrixMade(record=record, wanted=True))

    def publications(self) -> list[Publication]:
        """Return what has come of every matrix that was swapped in, so far."""
        jumps = (*self.dome.jump_times_s, *(swap.time_s for swap in self.swaps), self.time_s)
        return [
            published(
                swap, self.dome.moments, min((t for t in jumps if t > swap.time_s), default=0.0)
            )
            for swap in self.swaps
        ]

    def restart_rtc(self) -> None:
        """Let the RTC begin again with the matrix it started the night with."""
        self._n_restarts += 1
        self.dome.restart()
        self._link.void()
        self._hear(ev.SessionStarted(session=self.dome.computer.session))

    def _new_actions(self) -> Actions:
        """Return what carries out effects, nothing in its memory."""
        return Actions(
            bridge=self._link,
            workers=self._workers,
            archive=self._shelf,
            instrument=self.dome.instrument,
            publishing=self._publishing,
            clock_ns=lambda: self.now_ns(),
        )

    def _begin(self) -> None:
        self._post(ev.LogEvent(name="service.ready", text="a night in simulated time"))
        self._hear(ev.LogEvent(name="rtc.appeared", text="the RTC is there"))
        session = self.dome.computer.session
        self._hear(ev.SessionStarted(session=session))
        self._every(self.latencies.status_s, self._hear_status)
        self._every(self.latencies.tick_s, lambda: self._post(ev.Tick()))
        self._in(PASSIVE_INTERVAL_S, self._watch)

    def _idle_worker(self) -> None:
        self._jobs: list[tuple[float, int, Callable[[], _Job]]] = []
        self._busy = self._fitting = False
        self._backlog = PendingWindow()

    def _at(self, t_ns: int, happen: Callable[[], None]) -> None:
        heapq.heappush(self._agenda, _Due(t_ns, next(self._numbers), happen))

    def _in(self, seconds: float, happen: Callable[[], None]) -> None:
        self._at(self.dome.now_ns + round(seconds * SECOND_NS), happen)

    def _every(self, seconds: float, happen: Callable[[], None]) -> None:
        def again() -> None:
            happen()
            self._in(seconds, again)

        self._in(seconds, again)

    def _work(self, job: Callable[..., object], begin: Callable[[], _Job]) -> None:
        """Have the worker begin something once it has a hand free, and what is more urgent done."""
        due_s = self.time_s + patience_s(job)
        heapq.heappush(self._jobs, (due_s, next(self._numbers), begin))
        self._work_on()

    def _work_on(self) -> None:
        while self._jobs and not self._busy:
            *_, begin = heapq.heappop(self._jobs)
            lasts_s, done = begin()

            def over(done: Callable[[], None] = done) -> None:
                self._busy = False
                done()
                self._work_on()

            self._busy = True
            self._in(lasts_s, over)

    def _happen(self) -> None:
        """Let everything happen that is due."""
        while self._agenda and self._agenda[0].t_ns <= self.dome.now_ns:
            heapq.heappop(self._agenda).happen()

    def _hear(self, event: Event) -> None:
        self._engine.receive(event)

    def _hear_status(self) -> None:
        self._hear(self.dome.status())

    def _acknowledged(self) -> None:
        for answer in self._link.swapped():
            self._note_swap()
            self._hear(answer)

    def _note_swap(self) -> None:
        rtc = self.dome.computer
        matrix, optics = rtc.reconstructor.matrix, self.dome.optics
        record = self.state.reconstructor(rtc.reconstructor.manifest.id)
        swap = Swap(
            id=rtc.reconstructor.manifest.id,
            made_for=None if record is None else record.alpha,
            gate=None if record is None else record.gate,
            n_modes=len(matrix),
            time_s=self.time_s,
            alpha=self.dome.alpha,
            radius=true_radius(matrix, optics, rtc.settings) if self._with_poles else None,
        )
        self.swaps.append(swap)

    def _look(self) -> None:
        registration = self.state.alpha.registration
        self.glances.append(
            Glance(
                time_s=self.time_s,
                alpha=None if registration is None else registration.alpha.vector,
                sigma=None if registration is None else registration.sigma,
                alarms=tuple(alarm.name for alarm in self.state.alarms.active),
            )
        )

    def fit(self, window: EndedWindow) -> None:
        """Fit a window at once if the worker has a hand free, else after what it is at."""
        if isinstance(window, Correlated):
            self._actions.noisy.take(window, self.state)
        given_up = self._backlog.put(window)
        if given_up is not None:
            self._post(ev.WindowLost(refused=given_up))
        if not self._fitting:
            self._fitting = True
            self._work(OpticsWorker.fit, self._fit_next)

    def _fit_next(self) -> _Job:
        window = self._backlog.take()
        if window is None:
            self._fitting = False
            return 0.0, _nothing
        event = asyncio.run(fitted(window, self.state, self._workers, self._actions.matrix))

        def done() -> None:
            self._post(event)
            self._work(OpticsWorker.fit, self._fit_next)

        return self.latencies.fit_s, done

    def _watch(self) -> None:
        self._work(OpticsWorker.fit_passive, self._look_at_sums)

    def _look_at_sums(self) -> _Job:
        sums = self._engine.take_sums()
        events = asyncio.run(fit_passive(sums, self.state, self._workers))

        def done() -> None:
            for event in events:
                self._post(event)
            self._in(PASSIVE_INTERVAL_S, self._watch)

        return self.latencies.watch_s if events else 0.0, done

    def _post(self, event: Event, cause: str = "") -> None:
        self._engine.post(event, cause)

    def now_ns(self) -> int:
        """Return the time, nanoseconds UTC."""
        return self.dome.now_ns

    def step(
        self, state: TrackerState, event: Event, policy: Policy, now_ns: int, cause: str
    ) -> tuple[TrackerState, tuple[Effect, ...]]:
        """Let the tracker decide."""
        return step(state, event, policy, now_ns, cause)

    def stepped(self, before: TrackerState, event: Event) -> None:
        """Keep what the tracker heard."""
        if not isinstance(event, ev.Tick | Status):
            self.events.append((self.time_s, event))

    def perform(self, effect: Effect) -> None:
        """Do what the tracker wants done."""
        self._do(effect, self.state)

    def swapped(self, in_use: str | None) -> None:
        """Watch what a matrix does that has come into use."""
        if in_use is not None:
            self._hear_out(in_use)

    def sensor_mode_changed(self, config_id: str) -> None:
        """Have the worker model another mode of the sensor, as soon as it has a hand free."""

        def begin() -> _Job:
            description = asyncio.run(self._actions.enter_sensor_mode(config_id))

            def done() -> None:
                if self.state.loop.config_id == config_id:
                    self._engine.set_description(description)
                    self._post(ev.LogEvent(name="service.ready", text=config_id))
                    self.swapped(self.state.matrices.in_use)

            return self.latencies.make_s, done

        self._work(OpticsWorker.enter_mode, begin)

    def _hear_out(self, in_use: str) -> None:
        """Watch what the matrix in use does, and learn from it how the RTC speaks."""
        matrix, record = self._actions.matrix(in_use), self.state.reconstructor(in_use)
        self._engine.learn(in_use, matrix)
        if record is not None:
            read = read_own_matrix(record, matrix, self.state, self._workers, self._actions.matrix)
            for event in asyncio.run(read):
                self._in(self.latencies.listen_s, partial(self._post, event))

    def _do(self, effect: Effect, state: TrackerState) -> None:
        """Carry an effect out; what comes of it is heard when it would be."""
        job, lasts_s = self._takes(effect)

        def begin() -> _Job:
            event = self._performed(effect, state)
            return lasts_s, lambda: self._done(event, effect.cause)

        if job is not None:
            self._work(job, begin)
        else:
            _, done = begin()
            self._in(lasts_s, done)

    def _performed(self, effect: Effect, state: TrackerState) -> Event | None:
        try:
            event = asyncio.run(self._actions.perform(effect, state))
        except PyrcalError as error:
            event = ev.JobFailed(effect=effect, text=str(error))
        while self._link.sent:
            sent = partial(self._deliver, self._n_restarts, *self._link.sent.pop())
            self._in(self.latencies.send_s, sent)
        return event

    def _arrive(self) -> None:
        """Let every matrix that is on its way to the RTC come there."""
        for due in sorted(self._agenda):
            if isinstance(due.happen, partial) and due.happen.func == self._deliver:
                due.happen()

    def _deliver(self, n_restarts: int, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        if n_restarts != self._n_restarts:
            return  # on its way to a process that is gone, and its connection with it
        for answer in self._link.deliver(manifest, matrix):
            self._hear(answer)

    def _done(self, event: Event | None, cause: str) -> None:
        if event is not None:
            self._post(event, cause)

    def _takes(self, effect: Effect) -> tuple[Callable[..., object] | None, float]:
        """Return the worker's job that an effect asks for, if any, and how long it takes."""
        wait = self.latencies
        match effect:
            case ev.MakeMatrix():
                return OpticsWorker.make, wait.make_s
            case ev.JudgeMatrix():
                return OpticsWorker.margin, wait.judge_s
            case ev.RepublishMatrix(judged=True) | ev.JudgeProposal():
                return OpticsWorker.judge, wait.judge_s
            case ev.FetchMatrix():
                return None, wait.fetch_s
            case ev.RepublishMatrix() | ev.SendMatrix() | ev.Ask() | ev.FinishNoisy():
                return None, wait.command_s
            case _:
                raise TypeError(
                    f"observatory: found {type(effect).__name__}; expected an effect whose "
                    "duration is known here (pyrcal_studies.campaign.observatory)"
                )


def _nothing() -> None:
    pass
