"""The context of one step: state, log, alarms, effects."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Generic, TypeVar

from service.errors import CommandError
from service.estimation.loop import NO_RTC
from service.model.misregistration import Misregistration
from service.records.alarms import Alarm, AlarmDefinition, Interlock, blocking_alarm
from service.records.events import Effect
from service.records.messages import Message, as_message, compose, widen
from service.records.operations import Acquisition, Dither, DitherPolicyState, Probation
from service.records.registration import Registration
from service.records.state import (
    AlarmStates,
    AlphaState,
    DitherState,
    Failure,
    Level,
    LogEntry,
    LoopState,
    MatrixStates,
    ModelState,
    Operations,
    OperatorState,
    ReferenceStates,
    TrackerState,
    WindowCounts,
)
from service.tracking.policy import SECOND_NS, Policy
from service.wire import Status

LOG_LENGTH = 500
FAILURES_KEPT = 20

BURST_NS = 60 * SECOND_NS
"""A line that repeats within this time is counted, not logged."""

REPEATING = frozenset(
    {
        "acknowledgement.unknown",
        "dither.lost",
        "dither.unusable",
        "job.failed",
        "measurement.ignored",
        "message.malformed",
        "reconstructor.not-offered",
        "watchdog.failed",
        "window.outlier",
        "window.refused",
    }
)
"""Lines that repeat though their numbers differ: what becomes of telemetry, and of actions that are
tried again."""

LOOKED_BACK = 30
"""So many lines back the beginning of a burst is looked for."""

PartT = TypeVar("PartT")


class _Part(Generic[PartT]):
    """A part of the state, or of one of its records; assigning replaces it."""

    __slots__ = ("_name", "_record")

    def __init__(self, record: str = "state", name: str = "") -> None:
        self._record, self._name = record, name

    def __set_name__(self, owner: type, name: str) -> None:
        # A part has the name of the attribute unless another one is given.
        self._name = self._name or name

    def __get__(self, context: StepContext, owner: type) -> PartT:
        part: PartT = getattr(getattr(context, self._record), self._name)
        return part

    def __set__(self, context: StepContext, part: PartT) -> None:
        changes: dict[str, Any] = {self._name: part}
        setattr(context, self._record, replace(getattr(context, self._record), **changes))


class StepContext:
    """One event being worked out: the state as it becomes, and what is to be done about it.

    It lasts as long as ``service.tracker.step``; before and after it states are values. It does not
    hold the event: only the functions of ``service.tracker.REACTIONS`` are given that.
    """

    __slots__ = ("before", "cause", "effects", "now_ns", "policy", "state")

    def __init__(self, state: TrackerState, policy: Policy, now_ns: int, cause: str = "") -> None:
        self.before = state
        """State before the event."""

        self.state = state
        self.policy = policy
        self.now_ns = now_ns
        self.cause = cause
        """Id of what has led to the event, or its own: effects, lines and records keep it."""

        self.effects: list[Effect] = []

    operator = _Part[OperatorState]()
    alpha = _Part[AlphaState]()
    windows = _Part[WindowCounts]()
    matrices = _Part[MatrixStates]()
    references = _Part[ReferenceStates]()
    operations = _Part[Operations]()
    dithers = _Part[DitherState]()
    loop = _Part[LoopState]()
    model = _Part[ModelState]()
    alarms = _Part[AlarmStates]()
    acquisition = _Part[Acquisition]("operations")
    probation = _Part[Probation | None]("operations")
    dither = _Part[Dither | None]("dithers")
    dither_policy = _Part[DitherPolicyState]("dithers", "policy")

    @property
    def registration(self) -> Registration | None:
        """The registration; None: unknown."""
        return self.state.alpha.registration

    @property
    def nominal(self) -> Misregistration:
        """Return the registration by the pointing law, or that of the instrument file."""
        return self.state.alpha.law.nominal or self.policy.start

    @property
    def start_of_fits(self) -> Misregistration:
        """Return the starting point of fits while α is unknown."""
        return (
            self.state.alpha.law.nominal or self.state.alpha.own_matrix_alpha or self.policy.start
        )

    @property
    def rtc(self) -> Status | None:
        """The RTC by its last status; None: none is there."""
        return self.state.loop.rtc

    def ask(self, effect: Effect) -> None:
        """Have something done."""
        self.effects.append(replace(effect, cause=self.cause))

    @contextmanager
    def because_of(self, cause: str) -> Iterator[None]:
        """Attribute everything within the block to a cause; if empty, to that of the event.

        An acknowledgement, a status or a tick does not contain its cause.
        """
        own, self.cause = self.cause, cause or self.cause
        # Not in ``finally``: an exception ends the step, and with it the context.
        yield
        self.cause = own

    def fail(self, text: str) -> None:
        """Note that a request failed, and why, under the id of its cause."""
        failures = (*self.operator.failures, Failure(cause=self.cause, text=text))
        self.operator = replace(self.operator, failures=failures[-FAILURES_KEPT:])

    def blocking_alarm(self, interlock: Interlock) -> Alarm | None:
        """Return an alarm that forbids this now, or None."""
        return blocking_alarm(self.state.alarms.active, interlock)

    def alarm_text(self, name: str) -> str | None:
        """Return the text of an alarm that lasts; None: it does not."""
        alarm = self.state.alarm(name)
        return None if alarm is None else alarm.text

    def put_off(self, *, dither_s: float = 0.0, make_s: float = 0.0) -> None:
        """Ask for no dither, make no reconstructor for so long; 0: that one is not put off."""
        dither_ns, make_ns = (
            self.now_ns + round(s * SECOND_NS) if s else 0 for s in (dither_s, make_s)
        )
        # A pause that was asked for before is never shortened.
        self._put_off_until(
            max(self.dithers.no_dither_before_ns_utc, dither_ns),
            max(self.matrices.no_making_before_ns_utc, make_ns),
        )

    def retry_all(self) -> None:
        """Put nothing off any more."""
        self._put_off_until(0, 0)

    def _put_off_until(self, dither_ns: int, make_ns: int) -> None:
        self.dithers = replace(self.dithers, no_dither_before_ns_utc=dither_ns)
        self.matrices = replace(self.matrices, no_making_before_ns_utc=make_ns)

    def log(self, name: str, text: str | Message, level: Level = Level.INFO) -> LogEntry:
        """Add a line to the log, and return it; one that repeats is counted instead."""
        self.state = logged(self.state, name, text, self.now_ns, level, self.cause)
        # The line may not be the last one: a repeated one is counted where it was first logged.
        lines = (line for line in reversed(self.state.log) if line.name == name)
        return max(lines, key=lambda line: line.last_ns_utc or line.t_ns_utc)

    def warn(self, name: str, text: str | Message) -> None:
        """Add a warning to the log."""
        self.log(name, text, Level.WARNING)

    def raise_alarm(
        self, name: str, text: str | Message, own: AlarmDefinition | None = None
    ) -> None:
        """Raise an alarm; one already raised keeps its beginning.

        ``own``: what is to be known of it, where it is not as the table has it.
        """
        before = self.state.alarm(name)
        t_ns = 0 if self.rtc is None else self.rtc.t_ns
        message = as_message(name, text)
        first = before or Alarm(name=name, since_ns_utc=self.now_ns, message=message, t_ns_utc=t_ns)
        others = tuple(alarm for alarm in self.state.alarms.active if alarm.name != name)
        raised = replace(first, message=message, seen_ns_utc=self.now_ns, own=own)
        self.alarms = replace(self.alarms, active=(*others, raised))
        # One that goes on changes its text many times a minute: only its beginning is logged.
        if before is None:
            self.log(name, message, Level.ALARM)

    def clear_alarm(self, name: str) -> None:
        """End an alarm, if it is raised."""
        others = tuple(alarm for alarm in self.state.alarms.active if alarm.name != name)
        if len(others) < len(self.state.alarms.active):
            self.alarms = replace(self.alarms, active=others)
            self.log(name, f"{name}: over")


def logged(
    state: TrackerState,
    name: str,
    text: str | Message,
    now_ns: int,
    level: Level = Level.INFO,
    cause: str = "",
) -> TrackerState:
    """Return the state with one more line in its log; one that repeats is counted instead."""
    message = as_message(name, text)
    entry = LogEntry(t_ns_utc=now_ns, level=level, name=name, message=message, cause=cause)
    for back, before in enumerate(reversed(state.log[-LOOKED_BACK:]), start=1):
        # the very last line may be any; what lies between makes a story of two equal ones
        if (back == 1 or name in REPEATING) and _same(before, entry):
            log = list(state.log)
            log[-back] = replace(
                before,
                times=before.times + 1,
                last_ns_utc=now_ns,
                ranges=widen(before.ranges or widen({}, before.message), message),
            )
            return replace(state, log=tuple(log))
    return replace(state, log=(*state.log, entry)[-LOG_LENGTH:])


def _same(before: LogEntry, entry: LogEntry) -> bool:
    if before.name != entry.name or entry.t_ns_utc - before.t_ns_utc >= BURST_NS:
        return False
    if entry.name in REPEATING:
        return before.message.key == entry.message.key
    return before.text == entry.text


def _burst_message(entry: LogEntry) -> Message:
    """Return the summary of a burst: the range of each number, how often, and when."""
    first, last = (
        datetime.fromtimestamp(t / SECOND_NS, UTC) for t in (entry.t_ns_utc, entry.last_ns_utc)
    )
    return compose(
        "log.burst",
        entry.message.key,
        text=entry.message.format_ranges(entry.ranges),
        times=entry.times,
        lasted_s=(entry.last_ns_utc - entry.t_ns_utc) / SECOND_NS,
        first=f"{first:%H:%M:%S}",
        last=f"{last:%H:%M:%S}",
    )


def log_bursts(context: StepContext) -> None:
    """Log each burst that has ended: time, count, and range of its numbers.

    The line has the time of the burst's end, not that of logging.
    """
    for entry in context.state.log:
        if entry.times > 1 and context.now_ns - entry.t_ns_utc >= BURST_NS:
            message = _burst_message(entry)
            line = replace(entry, t_ns_utc=entry.last_ns_utc, message=message, times=1, ranges={})
            log = (replace(e, times=1, ranges={}) if e is entry else e for e in context.state.log)
            context.state = replace(context.state, log=(*log, line)[-LOG_LENGTH:])


def new_lines(before: TrackerState, after: TrackerState) -> list[LogEntry]:
    """Return the lines that were added; one that was only counted is not among them."""
    if after.log is before.log:
        return []
    earlier = {entry.line for entry in before.log}
    return [entry for entry in after.log if entry.line not in earlier]


def present(rtc: Status | None) -> Status:
    """Return the RTC, for what is done only where one is there.

    Raises
    ------
    CommandError
        If none is.
    """
    if rtc is None:
        raise CommandError(NO_RTC)
    return rtc
