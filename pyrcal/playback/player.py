"""Play recorded telemetry to the tracker, with the time of the recording.

Intake, estimators, worker and tracker are the service's own, so α is the same as in that night.
Only the worker's load is missing: live, windows that end while it is busy are fitted together, at
the α of a moment later.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Concatenate, Final, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from pyrcal.playback.report import Track
from service.config.settings import Settings
from service.errors import ModelError, UnknownIdError, WireError
from service.estimation.dither_windows import EndedWindow
from service.estimation.frames import FrameBlock
from service.estimation.passive import PASSIVE_INTERVAL_S
from service.estimation.random_dither import (
    Correlated,
    join_random_windows,
    noisy_matrix,
)
from service.files.recording import Message, RecordedKind
from service.link.intake import Intake
from service.link.matrices import MeasuredMatrix
from service.link.session import Endpoint
from service.model.instrument import Instrument
from service.records import events as ev
from service.records.events import Effect, Event
from service.records.messages import ABOUT
from service.records.products import ReconstructorRecord
from service.records.state import LoopState, Mode, OperatorState, TrackerState
from service.runtime.engine import Engine
from service.runtime.estimates import fit_passive, fitted, read_own_matrix
from service.runtime.policy import compute_of, policy_of
from service.runtime.worker import OpticsWorker
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import new_lines
from service.wire import DitherRequest, Manifest, Reply, Status, decode

P = ParamSpec("P")
R = TypeVar("R")

TICK_S: Final = 1.0
"""Time between two clock events of the service's tracker, seconds."""

NOT_CARRIED_OUT: Final = "unsupported: recorded telemetry"


class Player:
    """Driver of an engine without network, processes and clocks."""

    def __init__(self, instrument: Instrument, settings: Settings, system: str) -> None:
        """Prepare the optical model.

        Raises
        ------
        ModelError
            If the instrument can be fitted offline but not controlled with, or is too large.
        """
        # The loop of a recording cannot be opened, so nothing is acquired from nothing.
        policy = replace(policy_of(settings, instrument), acquires=False)
        self._optics = OpticsWorker(instrument, compute_of(settings))
        description = self._optics.describe()
        state = TrackerState(
            system=system,
            model=self._optics.state,
            # A matrix that would be made has no RTC to go to.
            operator=OperatorState(mode=Mode.HOLD),
            loop=LoopState(basis_id=instrument.basis_id, config_id=instrument.config_id),
        )
        self.track = Track(state=state)
        self._now_s, self._began_ns = 0.0, 0
        self._ticked_s = self._summed_s = 0.0
        self._intake = Intake(Endpoint(system=system), clock=lambda: self._now_s)
        modes = [mode.config_id for mode in instrument.sensor_modes]
        self._intake.expect(instrument.basis_id, instrument.config_id, modes)
        self._matrices: dict[str, NDArray[np.float32]] = {}
        self._windows: list[EndedWindow] = []
        self._unread_matrix: str | None = None
        self._random: Correlated | None = None
        self._next: tuple[str, int] | None = None
        self._engine = Engine(state, policy, self)
        self._engine.set_description(description)

    async def play(self, messages: Iterable[Message], progress: Callable[[float], None]) -> Track:
        """Play messages in the order of sending; ``progress`` receives the seconds played."""
        for message in messages:
            self._now_s = max(self._now_s, message.time_s)
            self._take(message)
            await self._look()
            await self._age()
            progress(self._now_s)
        rest_s = self._now_s - self._summed_s
        # Lets the intake give up on missing frames and release the blocks behind them.
        self._now_s += 1.0
        await self._look()
        # A short rest has a large uncertainty and would only add noise to the list.
        if rest_s > PASSIVE_INTERVAL_S / 2 or not self.track.passive:
            await self._sum_up()
        self.track.state = self._engine.state
        if self._random is not None:
            self.track.noisy = noisy_matrix(self._random)
        return self.track

    def _take(self, message: Message) -> None:
        """Process one message like the link; the link counts messages that break the contract."""
        try:
            match message.kind:
                case RecordedKind.FRAMES:
                    self._intake.frames(message.payload, message.attachment)
                case RecordedKind.STATUS:
                    self._set_clock(message)
                    self._intake.status(message.payload)
                case RecordedKind.MATRIX:
                    self._keep(message)
                case RecordedKind.LIVELINESS | RecordedKind.ACKNOWLEDGEMENT:
                    # Of the recorded service, not this one; the statuses show their effect.
                    pass
        except WireError as error:
            self._intake.malformed(message.kind.name.lower(), error)

    def _set_clock(self, message: Message) -> None:
        """Set the service's clock to the RTC's, from its first status on."""
        # Once, because a step of the RTC's clock during a night must not move the service's.
        if not self._began_ns:
            now_ns = decode(Status, message.payload).t_ns
            self._began_ns = now_ns - round(message.time_s * SECOND_NS)

    def _keep(self, message: Message) -> None:
        manifest = decode(Manifest, message.attachment)
        if len(message.payload) != manifest.layout.n_bytes:
            raise WireError(f"range: {len(message.payload)} bytes of {manifest.id}")
        matrix = np.frombuffer(message.payload, "<f4").reshape(manifest.layout.shape)
        self._matrices[manifest.id] = matrix
        self._engine.post(ev.MatrixFetched(record=ReconstructorRecord.brought(manifest)))

    async def _look(self) -> None:
        """Process frames, then the events after them, like the service."""
        # Until nothing follows: an event can release frames that waited for it.
        while True:
            blocks = self._intake.drain(before_events=True)
            self._engine.feed(blocks)
            for block in blocks:
                self._count(block)
            await self._fit_windows()
            events = self._intake.events()
            for event in events:
                # Measured matrices need the service's archive; a fit reads them from their files.
                if not isinstance(event, MeasuredMatrix):
                    self._engine.receive(event)
            await self._read_matrix()
            if not events:
                return

    def _count(self, block: FrameBlock) -> None:
        track = self.track
        if not track.n_frames:
            track.first_ns_utc = block.t0_ns_utc
        elif self._next is not None and self._next[0] == block.session:
            missing = block.first_seq - self._next[1]
            track.n_missing += missing
            track.n_gaps += missing > 0
        self._next = (block.session, block.next_seq)
        track.n_frames += block.n_frames
        track.last_ns_utc = block.next_t_ns - block.dt_ns

    async def _fit_windows(self) -> None:
        windows, self._windows = self._windows, []
        for window in windows:
            if isinstance(window, Correlated):
                self._correlate(window)
            self._engine.post(await fitted(window, self._engine.state, self, self._matrix))

    def _correlate(self, window: Correlated) -> None:
        try:
            self._random = (
                window if self._random is None else join_random_windows(self._random, window)
            )
        except ModelError:
            # Another dither began: only the last one's matrix is kept.
            self._random = window

    async def _read_matrix(self) -> None:
        """Learn the order of slopes and the unit of commands from a matrix that the RTC uses."""
        in_use, self._unread_matrix = self._unread_matrix, None
        record = None if in_use is None else self._engine.state.reconstructor(in_use)
        if in_use is None or record is None or in_use not in self._matrices:
            return
        matrix = self._matrices[in_use]
        self._engine.learn(in_use, matrix)
        for event in await read_own_matrix(record, matrix, self._engine.state, self, self._matrix):
            self._engine.post(event)

    async def _age(self) -> None:
        if self._now_s - self._ticked_s >= TICK_S:
            self._ticked_s = self._now_s
            self._engine.post(ev.Tick())
        if self._now_s - self._summed_s >= PASSIVE_INTERVAL_S:
            await self._sum_up()

    async def _sum_up(self) -> None:
        self._summed_s = self._now_s
        for event in await fit_passive(self._engine.take_sums(), self._engine.state, self):
            self._engine.post(event)

    def _matrix(self, matrix_id: str) -> NDArray[np.float32]:
        if matrix_id not in self._matrices:
            raise UnknownIdError(f"{matrix_id}: found in no message, expected before its frames")
        return self._matrices[matrix_id]

    # --- what the engine asks of its driver

    def now_ns(self) -> int:
        """Return the time of the recording, nanoseconds."""
        return self._began_ns + round(self._now_s * SECOND_NS)

    def stepped(self, before: TrackerState, event: Event) -> None:
        """Record new log entries and measurements."""
        after = self._engine.state
        passive = after.alpha.passive
        if passive is not None and passive is not before.alpha.passive:
            self.track.passive.append(passive)
        # A refused dither is an answer of this program's, which the telemetry does not show.
        self.track.lines += [
            line
            for line in new_lines(before, after)
            if line.message.values.get(ABOUT) != NOT_CARRIED_OUT
        ]
        # Not by their number: the history is limited, and drops its oldest entries.
        seen = set(before.alpha.history)
        self.track.entries += [entry for entry in after.alpha.history if entry not in seen]

    def fit(self, window: EndedWindow) -> None:
        """Queue a window for fitting."""
        self._windows.append(window)

    def swapped(self, in_use: str | None) -> None:
        """Record the matrix in use."""
        self._unread_matrix = in_use

    def sensor_mode_changed(self, config_id: str) -> None:
        """Build the model of another mode of the sensor."""
        self._optics.restore(self._engine.state.model, {})
        self._engine.set_description(self._optics.describe())
        self._unread_matrix = self._engine.state.matrices.in_use

    def perform(self, effect: Effect) -> None:
        """Answer a dither request with a refusal; other effects are ignored."""
        if isinstance(effect, ev.Ask) and isinstance(effect.request, DitherRequest):
            refused = Reply(
                id=effect.request.id, accepted=False, reason=NOT_CARRIED_OUT, start_seq=None
            )
            self._engine.post(ev.Answered(request=effect.request, reply=refused))

    async def call(
        self, job: Callable[Concatenate[OpticsWorker, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the worker synchronously."""
        self._optics.restore(self._engine.state.model, {})
        result = job(self._optics, *args, **kwargs)
        if self._optics.state != self._engine.state.model:
            self._engine.post(ev.ModelChanged(model=self._optics.state))
        return result
