"""The service without clock, task or network.

The running service and a simulated night drive the same engine; they differ in what they wait for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.estimation.description import Description
from service.estimation.dither_windows import EndedWindow, Window
from service.estimation.frames import FrameBlock
from service.estimation.passive import Passive
from service.model.slopes import likely_kind
from service.records import alarms
from service.records import events as ev
from service.records.alarms import Interlock, blocking_alarm
from service.records.estimates import WindowRefused
from service.records.events import Effect, Event
from service.records.state import TrackerState
from service.runtime.estimator_bank import (
    EstimatorBank,
    close_sums,
    process_blocks,
    with_dither,
    with_matrix,
    with_rtc,
)
from service.tracker import step
from service.tracking.operations.running import OperationKind, running_operations
from service.tracking.policy import SECOND_NS, Policy
from service.wire import Status

RECENT_WINDOW_S = 8.0
"""A window accepted within this time determines the registration."""

IDLE_GATHER_S = 0.55
"""Duration of frames gathered while nothing happens: windows are four times as long, and alarms
have a second. Usually a status, which is processed at once, ends the wait earlier."""

Step = Callable[[TrackerState, Event, Policy, int, str], tuple[TrackerState, tuple[Effect, ...]]]


class Driver(Protocol):
    """Executes what takes time on behalf of the engine."""

    def now_ns(self) -> int:
        """Return the time, nanoseconds UTC."""

    def stepped(self, before: TrackerState, event: Event) -> None:
        """Process that an event has led from one state to another."""

    def perform(self, effect: Effect) -> None:
        """Begin an effect; its result is posted as an event."""

    def fit(self, window: EndedWindow) -> None:
        """Take a window of telemetry that is to be fitted."""

    def swapped(self, in_use: str | None) -> None:
        """Note that the RTC uses another reconstructor, or an unknown one."""

    def sensor_mode_changed(self, config_id: str) -> None:
        """Have the model of another mode of the sensor made, and hand in its description."""


class Engine:
    """Tracker state and streaming estimators, driven by events and blocks.

    Parameters
    ----------
    state
        State at the start.
    policy
        Settings of the user; ``prepared`` adds the model's.
    driver
        Executes effects that take time.
    step
        The tracker's step; a test or a recorder may wrap it.
    """

    def __init__(
        self, state: TrackerState, policy: Policy, driver: Driver, step: Step = step
    ) -> None:
        self.state = state
        self.policy = policy
        self.bank: EstimatorBank | None = None
        """None until the optical model is prepared."""

        self._driver = driver
        self._step = step
        self._mode_information = policy.mode_information
        self._checked_out: tuple[EstimatorBank, TrackerState] | None = None

    def set_description(self, description: Description) -> None:
        """Take what the optical model expects of telemetry: estimators begin to listen."""
        self.bank = EstimatorBank.of(description)
        self._mode_information = description.mode_information
        self.policy = replace(self.policy, start=description.start)
        self._weigh_modes()

    def begin_anew(self) -> None:
        """Reset all estimators.

        The matrices are kept, because they are not passed again before the next swap.
        """
        self._checked_out = None
        if self.bank is not None:
            before = self.bank.loop
            anew = EstimatorBank.of(before.description)
            self.bank = replace(anew, loop=replace(anew.loop, matrices=before.matrices))
            self._follow()

    def post(self, event: Event, cause: str = "") -> tuple[Effect, ...]:
        """Pass an event to the tracker and start the effects that it requests.

        ``cause``: id of the effect or order that led to the event, if there is one.

        Raises
        ------
        CommandError
            If it is an operator's command that cannot be carried out now; the state is
            unchanged.
        UnknownIdError
            If it names an unknown reconstructor.
        """
        before = self.state
        now_ns = self._driver.now_ns()
        # If the step refuses the event it raises before the assignment, and the state stays as it
        # was.
        self.state, effects = self._step(before, event, self.policy, now_ns, cause)
        # Log and audit lines of the step come before any effect begins, whose own lines follow from
        # them.
        self._driver.stepped(before, event)
        if self.state.matrices.mode_proof.own_weights != before.matrices.mode_proof.own_weights:
            self._weigh_modes()
        self._note_sensor_mode(before)
        # Estimators follow before effects begin: frames after a new dither must find it known.
        self._follow()
        for effect in effects:
            self._driver.perform(effect)
        if self.state.matrices.in_use != before.matrices.in_use:
            self._driver.swapped(self.state.matrices.in_use)
        return effects

    def _weigh_modes(self) -> None:
        """Let modes that the model explains badly count less where those to dither are chosen."""
        information, weights = self._mode_information, self.state.matrices.mode_proof.own_weights
        if information is not None and len(weights) == len(information):
            information = information * np.array(weights)[:, None, None]
        self.policy = replace(self.policy, mode_information=information)

    def _note_sensor_mode(self, before: TrackerState) -> None:
        """Stop listening where the sensor's mode has changed, until its model is there."""
        config_id = self.state.loop.config_id
        if config_id is None or config_id == before.loop.config_id:
            return
        # Telemetry of the new mode does not fit the models of the old one.
        if config_id in self.policy.sensor_modes:
            self.bank = self._checked_out = None
            self._driver.sensor_mode_changed(config_id)

    def receive(self, event: Event) -> None:
        """Take in what came over the link besides frames."""
        self.post(event)
        if self.bank is not None:
            for news in detect_shape_change(self.bank, self.state):
                self.post(news)

    def feed(self, blocks: Iterable[FrameBlock]) -> None:
        """Take in frames; windows that end in them are handed on to be fitted."""
        bank = self.checkout()
        if bank is None:
            return
        windows: list[Window] = []
        try:
            bank, windows = process_blocks(bank, blocks)
        finally:
            self.checkin(bank, windows)

    def checkout(self) -> EstimatorBank | None:
        """Return the estimators for another thread; None while the model is being prepared.

        Until they are returned they follow no change, have no sums, and learn no matrix. If the
        other thread fails, it returns them unchanged.
        """
        self._checked_out = None if self.bank is None else (self.bank, self.state)
        return self.bank

    def checkin(self, bank: EstimatorBank, windows: Iterable[Window]) -> None:
        """Take the estimators back after frames, unless they were reset meanwhile."""
        # The estimators were reset while the other thread worked with the old ones.
        if self._checked_out is None:
            return
        (before, state), self._checked_out = self._checked_out, None
        self.bank = bank
        # Events came meanwhile: the estimators have not seen them yet.
        if self.state is not state:
            self._follow()
        for window in windows:
            if isinstance(window, WindowRefused):
                self.post(ev.WindowLost(refused=window))
            else:
                self._driver.fit(window)
        for event in detect_changes(before, self.bank, self.state):
            self.post(event)

    @property
    def gather_s(self) -> float:
        """Seconds of frames that may wait before they are taken in: each visit costs as much.

        Longer while α is followed and nothing else happens: no alarm, no matrix made or tried.
        """
        state, now_ns = self.state, self._driver.now_ns()
        # Each visit costs the same, so that frames are gathered only while no decision waits for
        # them.
        if state.alpha.registration is None or state.alarms.active or state.on_probation:
            return 0.0
        dithers = (OperationKind.OWN_DITHER, OperationKind.OTHER_DITHER)
        steady = all(running.kind in dithers for running in running_operations(state, now_ns))
        return IDLE_GATHER_S if steady else 0.0

    def take_sums(self) -> Passive | str | None:
        """Return the sums of ordinary telemetry and begin new ones, or why there are none yet.

        None if telemetry is skipped next to a dither. To be called every ``PASSIVE_INTERVAL_S``.
        """
        if self.bank is None:
            return "no passive estimate: the optical model is being prepared"
        registration, now_ns = self.state.alpha.registration, self._driver.now_ns()
        has_windows = (
            registration is not None
            and not registration.doubt
            and now_ns - registration.window_ns_utc < RECENT_WINDOW_S * SECOND_NS
        )
        self.bank, sums = close_sums(self.bank, has_windows=has_windows)
        return sums

    def learn(self, matrix_id: str, matrix: NDArray[np.float32]) -> None:
        """Know the numbers of a reconstructor, to compare commands with them."""
        if self.bank is not None:
            self.bank = with_matrix(self.bank, matrix_id, matrix)

    def _follow(self) -> None:
        """Keep the estimators in step with the RTC and the dither."""
        if self.bank is None or self._checked_out is not None:
            return
        self.bank, note = follow_state(self.bank, self.state, self.policy)
        if note is not None:
            self.post(note)


def follow_state(
    bank: EstimatorBank, state: TrackerState, policy: Policy
) -> tuple[EstimatorBank, ev.DitherUnusable | None]:
    """Keep the streaming estimators in step with the RTC and the dither.

    Returns them, with a message for the tracker when the dither cannot be demodulated.
    """
    if blocking_alarm(state.alarms.active, Interlock.ASK) is not None:
        return with_rtc(bank, None), None
    bank = with_rtc(bank, state.loop.rtc)
    before, bank = bank, with_dither(bank, state.dithers.dither, policy.window_s)
    dither = bank.loop.dither
    # Reported once per dither, not with every event that follows.
    if dither is None or dither is before.loop.dither or not dither.why_unreadable:
        return bank, None
    return bank, ev.DitherUnusable(text=dither.why_unreadable)


def detect_changes(before: EstimatorBank, bank: EstimatorBank, state: TrackerState) -> list[Event]:
    """Return what blocks of telemetry have brought besides windows, estimator by estimator."""
    found: list[Event] = []
    for entry, was, member in zip(bank.entries, before.members, bank.members, strict=True):
        if entry.events is not None:
            found += entry.events(was, member, bank.loop, state)
        for name, text, over in entry.conditions(member):
            t_ns = bank.loop.received_ns_utc
            found += ev.ConditionChanged.detect(state, name, text, over, t_ns)
    return found


def detect_shape_change(bank: EstimatorBank, state: TrackerState) -> list[ev.ConditionChanged]:
    """Return whether it has changed that the RTC's telemetry fits the instrument file."""
    if state.loop.rtc is None:
        return []
    wrong = shape_mismatch(bank.loop.description, state.loop.rtc)
    over = "the RTC's telemetry fits the instrument file again"
    return ev.ConditionChanged.detect(state, alarms.OTHER_INSTRUMENT, wrong, over)


def shape_mismatch(description: Description, rtc: Status) -> str | None:
    """Return why this RTC's telemetry is not of the instrument in the file, or None."""
    if (rtc.n_slopes, rtc.n_modes) == (description.n_slopes, description.n_modes):
        return None
    return (
        f"the RTC has {rtc.n_slopes} slopes and {rtc.n_modes} modes, the instrument file "
        f"{description.n_slopes} and {description.n_modes}: wrong instrument file?"
        f"{likely_kind(rtc.n_slopes, description.n_slopes)}"
    )
