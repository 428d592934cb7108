"""The service without clock, task or network: what an event or a block of telemetry changes.

The running service and a simulated night drive the same engine; they differ in what they wait for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.description import Description
from service.estimation.dither_monitor import LOUDER, DitherMeasurement
from service.estimation.frames import FrameBlock
from service.estimation.lockin import Spectra
from service.estimation.passive import Passive
from service.estimation.random_dither import Correlated
from service.estimation.windows import WindowRefused
from service.model.slopes import likely_kind
from service.runtime.estimator_bank import (
    VERDICTS,
    EstimatorBank,
    Window,
    process_block,
    with_dither,
    with_matrix,
    with_rtc,
)
from service.runtime.passive_sums import take_passive_sums
from service.tracker import step
from service.tracking import alarms
from service.tracking import events as ev
from service.tracking.alarms import Interlock, blocking_alarm
from service.tracking.dither import SILENT_S
from service.tracking.events import Effect, Event
from service.tracking.operations.running import OperationKind, under_way
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.state import TrackerState
from service.wire import Status

TOLD_S = 8.0
"""A window that was accepted since then has told where the mirror is."""

STEADY_GATHER_S = 0.55
"""Of frames, while nothing happens: windows last four times as long, and alarms have a second. Most
often a status, which is heard at once, ends the wait before."""

Step = Callable[[TrackerState, Event, Policy, int, str], tuple[TrackerState, tuple[Effect, ...]]]


class Driver(Protocol):
    """What the engine leaves to whoever drives it, because it takes time."""

    def now_ns(self) -> int:
        """Return the time, nanoseconds UTC."""

    def stepped(self, before: TrackerState, event: Event) -> None:
        """Hear that an event has led from this state to another."""

    def perform(self, effect: Effect) -> None:
        """Begin what the tracker wants done; what comes of it is posted as an event."""

    def fit(self, window: Spectra | Correlated) -> None:
        """Take a window of telemetry that is to be fitted."""

    def swapped(self, in_use: str | None) -> None:
        """Hear that the RTC uses another reconstructor, None: nobody knows which."""


class Engine:
    """What the service knows, and the streaming estimators that follow the RTC it knows of.

    Parameters
    ----------
    state
        What is known at the start.
    policy
        The user's numbers; ``prepared`` adds the model's.
    driver
        Does what takes time.
    step
        The tracker; another one may write down what it is told.
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
        self._checked_out: tuple[EstimatorBank, TrackerState] | None = None

    def set_description(self, description: Description) -> None:
        """Take what the optical model expects of telemetry: estimators begin to listen."""
        self.bank = EstimatorBank(description=description)
        self.policy = replace(
            self.policy, mode_information=description.mode_information, start=description.start
        )

    def begin_anew(self) -> None:
        """Give up what the estimators have gathered; they listen from here on."""
        self._checked_out = None
        if self.bank is not None:
            self.bank = EstimatorBank(description=self.bank.description)
            self._follow()

    def post(self, event: Event, cause: str = "") -> tuple[Effect, ...]:
        """Let the tracker react, and set in motion what it wants done.

        ``cause``: id of what has led to the event, an effect's where it comes of one.

        Raises
        ------
        CommandError
            If it is an operator's command that cannot be carried out now; the state stands.
        UnknownIdError
            If it names an unknown reconstructor.
        """
        before = self.state
        now_ns = self._driver.now_ns()
        self.state, effects = self._step(before, event, self.policy, now_ns, cause)
        self._driver.stepped(before, event)
        self._follow()
        for effect in effects:
            self._driver.perform(effect)
        if self.state.matrices.in_use != before.matrices.in_use:
            self._driver.swapped(self.state.matrices.in_use)
        return effects

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
        """Return the estimators, to look at frames elsewhere; None: the model is being prepared.

        Until they are given back they follow nothing, and nobody may have sums of them, or teach
        them a matrix. A look that fails gives them back as they were.
        """
        self._checked_out = None if self.bank is None else (self.bank, self.state)
        return self.bank

    def checkin(self, bank: EstimatorBank, windows: Iterable[Window]) -> None:
        """Take the estimators as they are after frames, unless they have begun anew meanwhile."""
        if self._checked_out is None:
            return
        (before, state), self._checked_out = self._checked_out, None
        self.bank = bank
        if self.state is not state:
            self._follow()
        for window in windows:
            if isinstance(window, WindowRefused):
                self.post(ev.WindowLost(refused=window))
            else:
                self._driver.fit(window)
        for event in detect_changes(before.dither_silent_s, self.bank, self.state):
            self.post(event)

    @property
    def gather_s(self) -> float:
        """Seconds of frames that may wait before they are taken in: each visit costs as much.

        Longer while α is followed and nothing else happens: no alarm, no matrix made or tried.
        """
        state, now_ns = self.state, self._driver.now_ns()
        if state.alpha.registration is None or state.alarms.active or state.on_probation:
            return 0.0
        dithers = (OperationKind.OWN_DITHER, OperationKind.OTHER_DITHER)
        steady = all(running.kind in dithers for running in under_way(state, now_ns))
        return STEADY_GATHER_S if steady else 0.0

    def take_sums(self) -> Passive | str | None:
        """Return the sums of ordinary telemetry and begin new ones, or why there are none yet.

        None: some is left out beside a dither. Ask every ``PASSIVE_INTERVAL_S``.
        """
        if self.bank is None:
            return "no passive estimate: the optical model is being prepared"
        registration, now_ns = self.state.alpha.registration, self._driver.now_ns()
        told = (
            registration is not None
            and not registration.doubt
            and now_ns - registration.window_ns_utc < TOLD_S * SECOND_NS
        )
        self.bank, sums = take_passive_sums(self.bank, has_windows=told)
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


def process_blocks(
    bank: EstimatorBank, blocks: Iterable[FrameBlock]
) -> tuple[EstimatorBank, list[Window]]:
    """Return the estimators after these frames, and the windows that ended in them."""
    windows: list[Window] = []
    for block in blocks:
        bank, ended = process_block(bank, block)
        windows += ended
    return bank, windows


def follow_state(
    bank: EstimatorBank, state: TrackerState, policy: Policy
) -> tuple[EstimatorBank, ev.DitherUnusable | None]:
    """Keep the streaming estimators in step with the RTC and the dither.

    Returns the streams, and what to tell the tracker when the dither cannot be read.
    """
    if blocking_alarm(state.alarms.active, Interlock.ASK) is not None:
        return with_rtc(bank, None), None
    bank = with_rtc(bank, state.loop.rtc)
    dither = state.dithers.dither
    try:
        return with_dither(bank, dither, policy.window_s), None
    except ModelError as error:
        unusable = None if dither is None else replace(dither, asked_ns_utc=0)
        return replace(bank, cutter=None, dither=unusable), ev.DitherUnusable(text=str(error))


def detect_changes(was_silent_s: float, bank: EstimatorBank, state: TrackerState) -> list[Event]:
    """Return what blocks of telemetry have brought besides windows.

    A dither that should be in the frames is missed twice a second; ``was_silent_s`` is for how
    long it had been before these blocks.
    """
    found: list[Event] = []
    silent_s, dither = bank.dither_silent_s, bank.dither
    due = silent_s >= SILENT_S and int(2 * silent_s) > int(2 * was_silent_s)
    if dither is not None and due:
        found.append(ev.DitherSilent(id=dither.id, silent_s=silent_s))
    if dither is not None and bank.dither_measurement is not None:
        found += _detect_other_dither(dither.id, bank.dither_measurement, state)
        found += _answered(bank, state)
    lines = () if bank.vibrations is None else bank.vibrations.lines_hz
    if bank.vibrations is not None and lines != state.loop.vibrations_hz:
        found.append(ev.Vibrations(lines_hz=lines))
    for name, trouble, over in detect_conditions(bank):
        found += ev.ConditionChanged.detect(state, name, trouble, over, bank.received_ns_utc)
    holds = bank.rejection.holds
    if holds is not None and holds is not state.loop.holds:
        found.append(ev.LoopHeld(holds=holds))
    judged, trial = bank.comparison.found, state.operations.probation
    if judged is not None and trial is not None and trial.awaits(judged.before, judged.after):
        found.append(ev.Compared(finding=judged))
    return found


def _detect_other_dither(
    dither_id: str, measurement: DitherMeasurement, state: TrackerState
) -> list[Event]:
    """Return what the frames hold of the dither, where it is told for the first time or is over."""
    told = state.dithers.policy
    raised = state.alarm(alarms.NOT_AS_ASKED) or state.alarm(alarms.OVER_BUDGET)
    louder = measurement.found_m > LOUDER * told.amiss_m
    news = told.amiss_id != dither_id or louder if measurement.text else raised
    if not news:
        return []
    return [
        ev.DitherMeasured(
            id=dither_id,
            found_m=measurement.found_m,
            asked_m=measurement.asked_m,
            text=measurement.text,
        )
    ]


def _answered(bank: EstimatorBank, state: TrackerState) -> list[Event]:
    """Return that the slopes do not answer the dither, or do so again.

    Of an open loop, and of one that is being closed, the optical gain may be next to nothing.
    """
    found = None if bank.dither_measurement is None else bank.dither_measurement.unanswered
    raised = state.alarm(alarms.MIRROR_SILENT) is not None
    closed = len(bank.in_loop) > 0 and not state.operations.acquisition.under_way
    if found is None or not closed or not (found or raised):
        return []
    text = found or "the slopes answer the dither again"
    t_ns = bank.received_ns_utc
    return [
        ev.ConditionChanged(name=alarms.MIRROR_SILENT, text=text, over=not found, t_ns_utc=t_ns)
    ]


def detect_shape_change(bank: EstimatorBank, state: TrackerState) -> list[ev.ConditionChanged]:
    """Return whether it has changed that the RTC's telemetry fits the instrument file."""
    if state.loop.rtc is None:
        return []
    wrong = shape_mismatch(bank.description, state.loop.rtc)
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


def detect_conditions(bank: EstimatorBank) -> list[tuple[str, str | None, str]]:
    """Return name, text (None: all is well) and what is said when it is over, of each alarm."""
    health, edge, off = bank.health, bank.edge, bank.command_residual
    diverging = (
        f"the loop is diverging: its high modes carry {health.ratio:.0f} times what turbulence "
        "asks of them; open the loop, lower the gain or control fewer modes"
    )
    slipped = (
        f"an outer actuator stands {edge.ratio:.0f} sigma from where turbulence would have it: "
        "the edge has slipped, whatever the slopes say; open the loop and close it again with "
        "fewer modes or a leak of 0.99"
    )
    absurd = (
        f"commands are {health.ratio:.3g} times what turbulence asks: {health.unit}; nothing is "
        "measured, made or sent until the RTC sends metres"
    )
    unlawful = (
        f"the RTC's loop is not what its status tells: {'; '.join(bank.control_law_errors[-1:])}; "
        f"mend "
        "its status, or its loop"
    )
    n_verdicts = len(bank.control_law_errors)
    return [
        (alarms.SLOPES_STAND, bank.standstill.text, "the slopes change again"),
        (
            alarms.WRONG_UNIT,
            absurd if health.absurd else None,
            "commands are what a mirror can play",
        ),
        (
            alarms.WRONG_LOOP,
            unlawful if n_verdicts >= VERDICTS else None,
            "the loop is as told again",
        ),
        (alarms.DIVERGING, diverging if health.diverging else None, "the high modes are calm"),
        (alarms.EDGE_SLIP, slipped if edge.slipped else None, "the outer ring is back"),
        (
            alarms.OFF_LOOP,
            None if off is None else off.text,
            "commands obey the loop equation again",
        ),
    ]
