"""Alarms of the link, and what the service waits for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Final

import numpy as np

from service.link.guard import describe_expiry, describe_flood, describe_refusals
from service.link.intake import COALESCED, OLD
from service.link.statistics import (
    MALFORMED,
    MAX_AGE_S,
    STATISTICS_PERIOD_S,
    USED,
    Disposition,
    LinkStatistics,
)
from service.model.misregistration import at_boundary
from service.records import alarms
from service.records import events as ev
from service.records.alarms import Alarm, Interlock, Prerequisite, Responsible, alarm_blocks
from service.records.messages import Message, as_message, compose
from service.records.operations import AcquisitionStage
from service.records.products import MatrixState, ReconstructorRecord
from service.records.registration import MeasuredGains
from service.records.state import Mode, TrackerState
from service.runtime.losses import FRAMES_TIMEOUT_S, silence
from service.runtime.snapshot import ModeGainTable, present_gains
from service.tracking.operations.running import operating
from service.tracking.policy import SECOND_NS
from service.tracking.reconstructors import check_return, explain_unread_matrix
from service.tracking.update_policy import MIN_PROPOSAL_LIFETIME_S, is_outdated
from service.wire import TEXT_LIMIT, AlarmMessage, GainsMessage, StateMessage

AlarmTexts = frozenset[tuple[str, str]]

STATUS_TIMEOUT_S: Final = 3.0
"""A status that has not come for so long is waited for."""

FIRST_REOPENING_DELAY_S: Final = 10.0
"""Time with the RTC's token and no message after which the link is opened again for the first time.
"""

MAX_REOPENING_DELAY_S: Final = 300.0
"""Longest time between two such attempts."""

FAULT_REPORT_DURATION_S: Final = 10.0
"""A message that broke the contract is complained of for so long."""

MAX_UNUSED_SHARE: Final = 0.1
"""Fraction of frames lost by faults of their own that raises an alarm."""

MAX_STATUSES_HZ: Final = 25.0
"""More than twice what the contract allows is a flood."""

COMPLAINT_TIMEOUT_NS: Final = 3 * SECOND_NS
"""A complaint that has not been made for so long is over."""

FAULT_OUTCOMES: Final = ("leap", "sequence", "shape", MALFORMED)
"""Outcomes of frames that always mean a violation of the contract."""

OUTCOMES_WITH_ALARM: Final = ("basis", "config", OLD)
"""Outcomes of frames that have an alarm of their own."""

MIN_LOGGED_DURATION_NS: Final = 2 * SECOND_NS
"""Conditions that last no longer than this are not logged."""

LOG_INTERVAL_NS: Final = 60 * SECOND_NS
"""Least time between two records of the same."""

DERIVED_EACH_SECOND: Final = frozenset(
    name
    for name, alarm in alarms.ALARMS.items()
    if alarm.origin
    in ("runtime/readiness.py", "runtime/losses.py", "runtime/supervisor.py", "api.py")
)
"""Alarms that are derived each second, and end when they are not derived any more."""


NOTHING_ELSE: Final[Mapping[str, str | Message | None]] = {}


def complaints(link: LinkStatistics) -> dict[str, Message]:
    """Return the alarms of what came in the last seconds, by name."""
    made = {
        alarms.FRAMES_UNUSED: _explain_unused(link),
        alarms.TELEMETRY_OLD: _explain_age(link),
        alarms.MESSAGES_REFUSED: _explain_refused(link),
        alarms.STATUS_FLOOD: _flood(link),
        alarms.LINK_FLOODED: describe_flood(link.waiting_connections),
        alarms.LINK_REFUSED: describe_refusals(link.refusals),
        alarms.CERTIFICATE_ENDING: describe_expiry(link.ending_certificates),
    }
    return {name: message for name, message in made.items() if message is not None}


def _explain_unused(link: LinkStatistics) -> Message | None:
    """Return which frames come and are not used, and why, or None."""
    frames = [disposition for disposition in link.dispositions if disposition.kind == "frames"]
    came, used = sum(f.n for f in frames), sum(f.n for f in frames if f.outcome == USED)
    lost = [f for f in frames if f.outcome not in OUTCOMES_WITH_ALARM and _is_lost(f, link, used)]
    faults = [f for f in lost if f.outcome in FAULT_OUTCOMES and f.age_s < FAULT_REPORT_DURATION_S]
    # A few lost frames are normal on a network; violations of the contract are always reported.
    if sum(f.n for f in lost) <= MAX_UNUSED_SHARE * came:
        lost = faults
    lost = [f for f in lost if f.n or f in faults]
    if not lost:
        return None
    return compose(
        "link.frames-unused",
        ", ".join(sorted(f.outcome for f in lost)),
        details="; ".join(f"{f.n} {f.outcome} ({f.text})" for f in lost[:3]),
        n_frames=came,
        period_s=STATISTICS_PERIOD_S,
        n_used=used,
    )


def _explain_age(link: LinkStatistics) -> Message | None:
    """Return that the frames that come are old, or None if they are not or none come."""
    come = link.frame_age_s is not None and link.frame_age_s < FRAMES_TIMEOUT_S
    if not come or link.telemetry_age_s <= MAX_AGE_S:
        return None
    return compose("link.telemetry-old", age_s=link.telemetry_age_s, most_s=MAX_AGE_S)


def _is_lost(disposition: Disposition, link: LinkStatistics, used: int) -> bool:
    """Return whether frames that met this fate are missed."""
    match disposition.outcome:
        case "used":
            return False
        case "duplicate":
            return not used
        case "session":  # another may be taking over; next to one that sends it is a second RTC
            return not used and link.session_waiting is None
        case _:
            return True


def _explain_refused(link: LinkStatistics) -> Message | None:
    """Return which messages besides frames broke the contract of late, or None."""
    bad = [f for f in link.dispositions if f.outcome == MALFORMED and f.kind != "frames"]
    bad = [f for f in bad if f.age_s < FAULT_REPORT_DURATION_S]
    if not bad:
        return None
    details = "; ".join(f"{f.kind}: {f.text}" for f in bad)
    kinds = ", ".join(sorted(f.kind for f in bad))
    return compose("link.messages-refused", kinds, details=details)


def _flood(link: LinkStatistics) -> Message | None:
    rate_hz = sum(f.n for f in link.dispositions if f.kind == "status") / STATISTICS_PERIOD_S
    if rate_hz <= MAX_STATUSES_HZ:
        return None
    spared = any(f.outcome == COALESCED and f.n for f in link.dispositions)
    taken = "the latest is taken twice a second" if spared else "each says something else"
    return compose("link.status-flood", taken, rate_hz=rate_hz)


def detect_link_changes(
    link: LinkStatistics,
    state: TrackerState,
    now_ns: int,
    also: Mapping[str, str | Message | None] = NOTHING_ELSE,
) -> list[ev.Event]:
    """Return the alarms of the link that begin, continue or end.

    ``also`` are alarms of other sources by name; None or an empty text for none. A message that
    differs in its numbers only is kept, because it is no news.
    """
    made, found = complaints(link), []
    if not any(
        f.outcome in OUTCOMES_WITH_ALARM and f.age_s < STATISTICS_PERIOD_S
        for f in link.dispositions
    ):
        # Frames of another basis or configuration do come: their own alarms name the cause, and "no
        # frames" would hide it.
        also = silence(state.loop.rtc, link.frame_age_s) | dict(also)
    made |= {name: as_message(name, text) for name, text in also.items() if text}
    raised = {
        alarm.name: alarm for alarm in state.alarms.active if alarm.name in DERIVED_EACH_SECOND
    }
    # The text of an alarm follows its counters and its present cause; only its beginning is logged.
    found += [ev.ConditionChanged(name=name, text=message) for name, message in made.items()]
    for name, alarm in raised.items():
        # An alarm that came and went each second would hide the others.
        if name not in made and now_ns - alarm.seen_ns_utc > COMPLAINT_TIMEOUT_NS:
            found.append(ev.ConditionChanged(name=name, text="over", over=True))
    return list(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadinessInputs:
    """All that what the service waits for is derived from."""

    state: TrackerState
    link: LinkStatistics
    preparing: bool
    """The worker prepares the optical model."""

    worker_problem: str = ""
    """Problem of the worker; empty if there is none."""

    rest_missing: str = ""
    """Reason why REST does not listen; empty if it does."""

    reading: bool = False
    """The RTC's own reconstructor is being read, and windows wait for that."""

    @property
    def frames_come(self) -> bool:
        """Return True if frames, used or not, have arrived recently."""
        return any(f.kind == "frames" and f.age_s < 1.0 for f in self.link.dispositions)

    @property
    def status_silent_s(self) -> float:
        """Return the time since the last accepted status, seconds."""
        age_s = self.link.status_age_s
        return self.link.session_age_s if age_s is None else age_s


def waiting_for(inputs: ReadinessInputs) -> tuple[Prerequisite, ...]:
    """Return whom the service waits for and what they should do, what hinders most first."""
    found = [waiting for look in _LOOKS for waiting in look(inputs)]
    return tuple(sorted(found, key=lambda waiting: not waiting.blocks))


def _for_the_worker(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    if inputs.preparing:
        text = "the optical model is being prepared: wait"
        yield Prerequisite(name="model", responsible=Responsible.WORKER, text=text, blocks=True)
    if inputs.worker_problem:
        text = f"{inputs.worker_problem}: until it, or another, has done a job"
        yield Prerequisite(
            name=alarms.WORKER_LOST, responsible=Responsible.WORKER, text=text, blocks=True
        )
    if inputs.reading:
        text = (
            f"the RTC's own reconstructor {inputs.state.matrices.in_use} is being read: windows of "
            "telemetry are fitted after that, from the registration that it shows"
        )
        yield Prerequisite(name="own-matrix", responsible=Responsible.WORKER, text=text)
    if inputs.state.matrices.making_since_ns_utc is not None:
        text = "a reconstructor is being computed and judged: wait"
        yield Prerequisite(name="matrix", responsible=Responsible.WORKER, text=text)


def _for_the_network(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    """Yield what of the network is not there; without a link no RTC can be blamed."""
    missing, party = inputs.link.missing, Responsible.NETWORK
    if inputs.rest_missing:
        yield Prerequisite(name="rest", responsible=party, text=inputs.rest_missing)
    if missing:
        yield Prerequisite(name="link", responsible=party, text=missing, blocks=True)
    else:
        yield from _for_messages(inputs)


def _for_messages(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    """Yield what of the RTC's telemetry does not come."""
    link, where, rtc = inputs.link, f"ao/v1/{inputs.state.system}", inputs.state.loop.rtc
    # An RTC that is gone cannot be in trouble: its last status is only a memory.
    if rtc is not None and rtc.trouble and link.rtc_alive:
        yield Prerequisite(
            name="rtc-trouble", responsible=Responsible.RTC, text=rtc.trouble, blocks=True
        )
    no_status = inputs.status_silent_s >= STATUS_TIMEOUT_S
    if inputs.frames_come:
        if no_status:
            text = (
                "frames come, and no status that could be used for "
                f"{STATUS_TIMEOUT_S:.0f} s: send one on "
                f"{where}/tel/status 1 to 10 times a second"
            )
            yield Prerequisite(name="status", responsible=Responsible.RTC, text=text, blocks=True)
    elif not link.rtc_alive:
        text = f"no RTC is there: start it, as a zenoh client of this service, system {where}"
        yield Prerequisite(name="rtc", responsible=Responsible.RTC, text=text)
    elif link.session is None or no_status:
        text = (
            f"its token is present, but no message arrives; it must send {where}/tel/frames and "
            f"tel/status (after {FIRST_REOPENING_DELAY_S:.0f} s the service opens the link again, "
            "in case an old connection is left)"
        )
        yield Prerequisite(name="telemetry", responsible=Responsible.RTC, text=text)
    elif link.frame_age_s is None or link.frame_age_s >= FRAMES_TIMEOUT_S:
        text = f"it sends statuses and no frames: send them on {where}/tel/frames"
        yield Prerequisite(name="frames", responsible=Responsible.RTC, text=text)
    if link.session_waiting is not None and inputs.frames_come:
        text = (
            f"session {link.session_waiting} is taken for the RTC's once {link.session} has been "
            "silent for 2 s"
        )
        yield Prerequisite(name="session", responsible=Responsible.RTC, text=text)


def _for_frames(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    message, fates = _explain_unused(inputs.link), inputs.link.dispositions
    if message is not None and not any(
        f.n for f in fates if f.kind == "frames" and f.outcome == USED
    ):
        yield Prerequisite(
            name=alarms.FRAMES_UNUSED, responsible=Responsible.RTC, text=str(message), blocks=True
        )


def _for_the_matrix(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    """Yield what must be known of the reconstructor in use, or sent."""
    state, rtc = inputs.state, inputs.state.loop.rtc
    if rtc is not None and rtc.cm_id is None:
        text = (
            "its status names no reconstructor (cm_id is nil): the loop is not judged until it "
            f"does; rtc/cm/applied is asked meanwhile{_describe_rtc(state)}"
        )
        yield Prerequisite(name="matrix-name", responsible=Responsible.RTC, text=text)
    elif rtc is not None and (
        explain_unread_matrix(state, rtc.cm_id)
        or (rtc.cm_id and state.reconstructor(rtc.cm_id) is None)
    ):
        text = f"its reconstructor {rtc.cm_id}: offer it on rtc/cm/applied{_describe_rtc(state)}"
        yield Prerequisite(name="matrix-in-use", responsible=Responsible.RTC, text=text)
    # Without an RTC, or during an alarm that forbids all decisions, it is out of date, and another
    # text says what to do.
    decides = alarms.blocking_alarm(state.alarms.active, Interlock.DECIDE) is None
    if state.matrices.hindrance and decides and rtc is not None:
        yield Prerequisite(
            name="new-matrix", responsible=Responsible.OPERATOR, text=state.matrices.hindrance
        )
    no_return = check_return(state)
    for record in state.matrices.reconstructors:
        if record.on_its_way:
            text = f"reconstructor {record.id} was sent: acknowledge that it is applied"
            yield Prerequisite(name="acknowledgement", responsible=Responsible.RTC, text=text)
        elif record.state is MatrixState.PROPOSED and (
            state.operator.mode is not Mode.AUTO or no_return
        ):
            text = f"reconstructor {record.id} is proposed: approve or reject it"
            more = [no_return or "", _explain_replacement(state, record)]
            yield Prerequisite(
                name="approval",
                responsible=Responsible.OPERATOR,
                text="; ".join((text, *filter(None, more))),
            )


def _explain_replacement(state: TrackerState, record: ReconstructorRecord) -> str:
    """Return that a proposal will be replaced, and when; empty: it fits α."""
    if state.operator.mode is Mode.HOLD or not is_outdated(state, record):
        return ""
    until_s = record.created_ns_utc / SECOND_NS + MIN_PROPOSAL_LIFETIME_S
    then = datetime.fromtimestamp(until_s, UTC)
    return f"α has moved on since: a newer one follows after {then:%H:%M:%S} UTC"


def _describe_rtc(state: TrackerState) -> str:
    return f" (last: {state.matrices.read_back_error})" if state.matrices.read_back_error else ""


def _for_alarms(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    """Yield the alarms that keep the service from its job: their texts say what to do."""
    for alarm in inputs.state.alarms.active:
        acts = [
            interlock
            for interlock in (Interlock.ASK, Interlock.DECIDE, Interlock.MEASURE)
            if alarm_blocks(alarm, interlock)
        ]
        party = alarm.definition.responsible
        if acts or party is not None:
            party = party or Responsible.OPERATOR
            hinders = Interlock.ASK in acts
            yield Prerequisite(name=alarm.name, responsible=party, text=alarm.text, blocks=hinders)


def _for_the_operator(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    state, rtc = inputs.state, inputs.state.loop.rtc
    orders = {
        "mode": (
            state.operator.mode is Mode.HOLD,
            "mode is hold: no reconstructor is made. Set mode propose or auto to have new ones",
        ),
        "dither-stopped": (
            state.dithers.stopped,
            "the dither was stopped by an operator: start it when α is to be measured again",
        ),
        "interrupted": (
            state.operations.acquisition.stage is AcquisitionStage.INTERRUPTED,
            f"the acquisition was interrupted: {state.operations.acquisition.text}",
        ),
    }
    for name, (is_so, text) in orders.items():
        if is_so:
            yield Prerequisite(name=name, responsible=Responsible.OPERATOR, text=text)
    if rtc is not None and state.dithers.dither is not None and state.alpha.registration is None:
        text = f"{state.dithers.dither.id}: the first window of telemetry that holds it"
        yield Prerequisite(name="window", responsible=Responsible.RTC, text=text)


def _for_measurements(inputs: ReadinessInputs) -> Iterator[Prerequisite]:
    state = inputs.state
    if state.measuring is not None:
        text = f"interaction matrix {state.measuring.id} is being measured: wait, or give it up"
        yield Prerequisite(name="measurement", responsible=Responsible.RTC, text=text)
    if state.noisy_measurement is not None:
        text = (
            f"noisy interaction matrix {state.noisy_measurement.id} is gathered: wait, or "
            f"give it up"
        )
        yield Prerequisite(name="noisy-matrix", responsible=Responsible.RTC, text=text)
    if state.operations.acquisition.under_way:
        text = f"an acquisition is under way: {state.operations.acquisition.text}"
        yield Prerequisite(name="acquiring", responsible=Responsible.RTC, text=text)


_LOOKS: Final[tuple[Callable[[ReadinessInputs], Iterator[Prerequisite]], ...]] = (
    _for_the_worker,
    _for_the_network,
    _for_frames,
    _for_alarms,
    _for_the_matrix,
    _for_measurements,
    _for_the_operator,
)


class Revival:
    """Opens the link again when the RTC's token exists and no message arrives.

    After both ends were suspended, zenoh may keep a dead connection under the RTC's name. It
    carries the token and nothing else, and the router accepts no second connection of that name:
    the RTC runs, and nothing of it arrives until one of the ends opens a new session.
    """

    __slots__ = ("_since_s", "_wait_s")

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._wait_s = FIRST_REOPENING_DELAY_S

    def due(self, link: LinkStatistics, now_s: float) -> bool:
        """Return whether it is time; each time in vain, it is twice as long to the next."""
        # Any message counts, even a malformed one: it proves that the connection works.
        received = any(disposition.age_s < STATUS_TIMEOUT_S for disposition in link.dispositions)
        if received:
            self._wait_s = FIRST_REOPENING_DELAY_S
        if received or not link.rtc_alive:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        if now_s - self._since_s < self._wait_s:
            return False
        # Reopening interrupts the link, so that attempts without success become rarer.
        self._since_s, self._wait_s = None, min(2 * self._wait_s, MAX_REOPENING_DELAY_S)
        return True


class ReadinessLog:
    """Logs conditions that the service waits for, once they have lasted, and not too often."""

    __slots__ = ("_logged_ns", "_since_ns")

    def __init__(self) -> None:
        self._since_ns: dict[str, int] = {}
        self._logged_ns: dict[str, int] = {}

    def due_lines(
        self, waiting: tuple[Prerequisite, ...], alarms: tuple[Alarm, ...], now_ns: int
    ) -> list[str]:
        """Return what is to be put on record now; alarms are by themselves."""
        # Rebuilt from what is there now, so that a condition that returns starts its time again.
        self._since_ns = {w.name: self._since_ns.get(w.name, now_ns) for w in waiting}
        named = {alarm.name for alarm in alarms}
        due = [wait for wait in waiting if wait.name not in named and self._due(wait.name, now_ns)]
        self._logged_ns |= {wait.name: now_ns for wait in due}
        return [f"{wait.responsible}: {wait.text}" for wait in due]

    def _due(self, name: str, now_ns: int) -> bool:
        since_ns, logged_ns = self._since_ns[name], self._logged_ns.get(name)
        if now_ns - since_ns < MIN_LOGGED_DURATION_NS:
            return False
        return logged_ns is None or (logged_ns < since_ns and now_ns - logged_ns >= LOG_INTERVAL_NS)


def state_message(
    state: TrackerState, now_ns: int, waiting: tuple[Prerequisite, ...] = ()
) -> StateMessage:
    """Return the short state that is published on the network."""
    registration = state.alpha.registration
    hindered = "; ".join(wait.text for wait in waiting if wait.blocks)
    return StateMessage(
        system=state.system,
        t_ns=now_ns,
        mode=state.operator.mode.value,
        alpha=None if registration is None else registration.alpha.to_boundary(),
        sigma=None if registration is None else at_boundary(registration.shown_sigma),
        in_use=state.matrices.in_use,
        validity=None if registration is None else registration.validity.level.value,
        waiting_for=tuple(f"{w.responsible}: {w.text}"[:TEXT_LIMIT] for w in waiting),
        operation=operating(state, hindered, now_ns).words,
    )


def gains_message(state: TrackerState) -> GainsMessage | None:
    """Return the optical gains that are published on the network; None if none was measured."""
    found = present_gains(state)
    return None if found is None or not found.measured else _gains_message(state.system, found)


@lru_cache(maxsize=1)  # it is published every second, and changes with each dithered window
def _gains_message(system: str, found: MeasuredGains) -> GainsMessage:
    table = ModeGainTable.of(found)
    return GainsMessage(
        system=system,
        t_ns=found.t_ns_utc or 0,
        modes=tuple(gain.mode for gain in found.measured),
        optical_gain=np.array(table.optical_gain, "<f4").tobytes(),
        sigma=np.array(table.sigma, "<f4").tobytes(),
        reference_id=found.reference_id,
        magnitude=found.magnitude,
        frame_rate_hz=found.frame_rate_hz,
    )


def alarm_messages(
    system: str, before: AlarmTexts, now: AlarmTexts, now_ns: int
) -> Iterator[AlarmMessage]:
    """Yield what changes between two sets of alarms, as the wire says it."""
    for name, text in now ^ before:
        active, short = (name, text) in now, text[:TEXT_LIMIT]
        yield AlarmMessage(system=system, t_ns=now_ns, name=name, active=active, text=short)
