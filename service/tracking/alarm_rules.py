"""Alarms that follow from the state: one table of rules.

The source of each alarm is in alarms.toml (``origin``). An alarm that can be derived from the state
has its rule here. One that an event reports is raised where that event is processed, and ends by
its condition in ``LASTING`` if the state shows that its cause is gone. Operators' own rules forbid
actions while a condition on a reported value, or on a field of the state, holds ("do not publish
while the shutter is closed").
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

from service.errors import CommandError, UnknownIdError
from service.estimation.loop import explain_open_loop
from service.files.toml import nearest
from service.model.pointing_law import ANGLES
from service.records import alarms
from service.records import commands as cmd
from service.records.alarms import RULE_PREFIX, AlarmDefinition
from service.records.messages import Message
from service.records.operations import AcquisitionStage
from service.records.products import MatrixState
from service.records.state import ObservatoryValue, TrackerState
from service.tracking import dither, dither_plan, mode_proof, validity, window_processing
from service.tracking.dither_request import MAX_STOP_DELAY_S
from service.tracking.operations.acquisition import has_missed_enough
from service.tracking.operations.probation import explain_opening
from service.tracking.policy import SECOND_NS, Rule
from service.tracking.step_context import StepContext

REPEATED_ALARM_TIMEOUT_S = 15.0
"""An alarm that is repeated while it lasts is over after this much silence."""

MAX_CLOCK_LEAD_S: Final = 5.0
"""Largest lead of an RTC's clock on UTC. GPS time leads by 18 s, TAI by 37 s; frames that are late
on their way seem to lag, never to lead."""

MAX_CLOCK_LAG_S: Final = 600.0
"""Largest lag of the time stamps behind UTC: more is no delay of the telemetry, but the clock."""


def derive_alarms(context: StepContext) -> None:
    """Raise what the state says is the matter, and end what is over."""
    raised = {alarm.name for alarm in context.alarms.active}
    for name, rule in RULES.items():
        text = rule(context)
        # Nearly all rules are silent at every event, and were before.
        if text is not None or name in raised:
            _update(context, name, text, _definition(context, name))
    for alarm in context.alarms.active:
        lasts = LASTING.get(alarm.name)
        if lasts is not None and not lasts(context):
            validity.end_alarm(context, alarm.name)
    for own in context.policy.rules:
        _update(context, f"{RULE_PREFIX}{own.name}", _rule_text(context, own), _own_definition(own))


def _update(
    context: StepContext,
    name: str,
    text: str | Message | None,
    definition: AlarmDefinition | None,
) -> None:
    """Raise an alarm with this text, or end it; one that goes on as it is is let be."""
    raised = context.state.alarm(name)
    if text is None:
        if raised is not None:
            validity.end_alarm(context, name)
    elif raised is None or (raised.text, raised.own) != (str(text), definition):
        context.raise_alarm(name, text, definition)


def _definition(context: StepContext, name: str) -> AlarmDefinition | None:
    """Return what an alarm is where that is not as the table has it, else None."""
    margin = context.matrices.margin
    if name == alarms.SHORT_MARGIN and margin is not None and margin.unstable:
        return alarms.as_critical(name)
    return None


def _stopped(context: StepContext) -> str | None:
    who = context.operator.stopped_because
    return f"{who}: nothing is dithered, made or sent until the stop is released" if who else None


def _loop_open(context: StepContext) -> str | None:
    """Return that the loop is open and nothing has opened it.

    Asked of each status: what had the loop open may end before a status shows that it is closed.
    """
    rtc, acquisition, measuring = context.rtc, context.acquisition, context.state.measuring
    if rtc is None or rtc is context.before.loop.rtc:
        return context.alarm_text(alarms.LOOP_OPEN)
    # the alarm of an interrupted acquisition tells more, and not to close the loop on any matrix
    interrupted = acquisition.stage is AcquisitionStage.INTERRUPTED
    opened = acquisition.under_way or (measuring is not None and measuring.opens_loop)
    if rtc.in_loop or interrupted or opened:
        return None
    return f"{explain_open_loop(rtc)}: close it to calibrate"


def explain_clock(lead_s: float) -> str | None:
    """Return how time stamps ``lead_s`` seconds ahead of UTC are wrong; None if they are not."""
    if -MAX_CLOCK_LAG_S <= lead_s <= MAX_CLOCK_LEAD_S:
        return None
    side = "ahead of" if lead_s > 0.0 else "behind"
    return f"time stamps are {abs(lead_s):.0f} s {side} UTC"


def _clock(context: StepContext) -> str | None:
    """Return how the RTC's clock is wrong; asked of each status, because it comes with its time."""
    rtc, before = context.rtc, context.alarm_text(alarms.RTC_CLOCK)
    if rtc is None or rtc is context.before.loop.rtc:
        return before
    found = explain_clock((rtc.t_ns - context.now_ns) / SECOND_NS)
    return found and (before or f"the RTC's {found}")


def _other_numbers(context: StepContext) -> str | None:
    mismatched = context.matrices.mismatched_id
    record = context.state.reconstructor(mismatched)
    if record is not None and record.state is MatrixState.FAILED:
        return record.reason
    return None if mismatched is None else context.alarm_text(alarms.OTHER_SUM)


def _margin(context: StepContext) -> str | None:
    margin = context.matrices.margin
    if margin is None or margin.accepted:
        return None
    return f"{context.matrices.in_use}: {margin.reason}"


def _acquisition(context: StepContext) -> str | None:
    ended = {AcquisitionStage.FAILED, AcquisitionStage.INTERRUPTED}
    return context.acquisition.text if context.acquisition.stage in ended else None


def _not_found(context: StepContext) -> str | None:
    if context.acquisition.under_way or not context.acquisition.misses:
        return None
    # Hysteresis: an alarm that is raised lasts until a window finds the registration.
    if not (context.loop.holds and has_missed_enough(context.state)):
        return context.alarm_text(alarms.NOT_FOUND)
    proof = context.matrices.mode_proof
    if proof.own_response_ratio is not None and not proof.strange:
        misfit = proof.own_misfit_ratio
        left = "" if misfit is None else f" ({misfit:.0%} left unexplained)"
        return (
            f"No window gives a registration: {context.windows.refused_because}. Order and signs "
            "of modes and slopes are not the cause: the model recognises the modes of the RTC's "
            f"own matrix{left}. Set mirror.nominal_rotation_deg to the rotation of a fit of a "
            "measured matrix (pyrcal fit), or run pyrcal loop acquire, which opens the loop and "
            "searches from far away."
        )
    return (
        "window after window finds no registration, though the loop holds well: modes or slopes "
        "are probably in another order, or of another sign, than the instrument file says; "
        "compare both with it, or measure an interaction matrix; the loop is left closed (acquire "
        "opens it to look from afar)"
    )


def _not_stopped(context: StepContext) -> str | None:
    """Return that the RTC plays a dither that it was asked to stop, or None."""
    rtc, memory = context.rtc, context.dither_policy
    if rtc is None or memory.unwanted_id is None or rtc.dither_id != memory.unwanted_id:
        return None
    if context.now_ns - memory.stopped_ns_utc < MAX_STOP_DELAY_S * SECOND_NS:
        return None
    why = dither_plan.check_dither_strength(context, rtc) or dither_plan.check_dither_wanted(
        context, rtc
    )
    return why and (
        f"{why}, and the RTC goes on playing {memory.unwanted_id}: it is asked every "
        f"{dither.STOP_REQUEST_INTERVAL_S:.0f} s to stop it; stop it at the RTC"
    )


def _jump_suspected(context: StepContext) -> str | None:
    registration = context.registration
    if registration is None or not (registration.doubt and registration.doubt_voids):
        return None
    jump = registration.suspected_jump
    return registration.doubt if jump is None else jump.text


RULES: Final[dict[str, Callable[[StepContext], str | Message | None]]] = {
    "stopped": _stopped,
    alarms.LOOP_OPEN: _loop_open,
    alarms.RTC_CLOCK: _clock,
    "acquisition": _acquisition,
    alarms.NOT_FOUND: _not_found,
    alarms.OTHER_SUM: _other_numbers,
    alarms.MISAPPLIED: lambda context: context.matrices.misapplied or None,
    alarms.REFERENCES_MISAPPLIED: lambda context: context.references.difference or None,
    alarms.SHORT_MARGIN: _margin,
    alarms.LOOP_OPENED: explain_opening,
    alarms.NOT_STOPPED: _not_stopped,
    alarms.MODES_CONTRARY: mode_proof.contrary_text,
    alarms.MODES_UNEVEN: mode_proof.explain_uneven,
    alarms.SUSPECTED: _jump_suspected,
    "pointing-law": lambda context: context.alpha.law.problem or None,
    "law-leap": lambda context: getattr(context.alpha.law.leap, "text", "") or None,
    alarms.STALE: validity.stale_text,
    # the last: windows may be refused for what another alarm says
    alarms.WINDOWS_REFUSED: window_processing.explain_refusals,
}
"""Text of each alarm as a function of state, policy and time; None if the alarm is not active.

An alarm name that no other code uses is written here only, without a constant in alarms.py. A rule
with hysteresis asks whether its alarm is already active: alarms are part of the state."""


def _not_used_since(context: StepContext) -> bool:
    """Return whether the reconstructor that was sent last has never been in use."""
    newest_first = reversed(context.matrices.reconstructors)
    sent = max(newest_first, key=lambda record: record.published_ns_utc or 0, default=None)
    return sent is None or not sent.was_used


def _is_not_as_asked(context: StepContext) -> bool:
    """Return True if the last dither is still the one that differed from its request."""
    return context.dither_policy.mismatched_id is not None and not _is_given_up(context)


def _is_over_budget(context: StepContext) -> bool:
    """Return whether no dither has been played as it may since one was too strong."""
    memory, own, rtc = context.dither_policy, context.dither, context.rtc
    if memory.unwanted_id is not None:
        return True
    plays = own is not None and rtc is not None and rtc.dither_id == own.id
    # Ends with the next dither that plays without being too strong, or when none is wanted.
    return not (plays and not memory.loud_text) and not _is_given_up(context)


def _is_given_up(context: StepContext) -> bool:
    """Return whether no dither is wanted, and none plays that is not."""
    unwanted = context.dithers.stopped or not context.policy.dither_enabled
    return unwanted and context.dither_policy.unwanted_id is None


def _is_repeated(name: str, context: StepContext) -> bool:
    alarm, timeout_ns = context.state.alarm(name), REPEATED_ALARM_TIMEOUT_S * SECOND_NS
    return alarm is not None and context.now_ns - alarm.seen_ns_utc <= timeout_ns


LASTING: Final[dict[str, Callable[[StepContext], bool]]] = {
    alarms.VANISHED: lambda context: context.rtc is None,
    alarms.SECOND_RTC: partial(_is_repeated, alarms.SECOND_RTC),
    alarms.OTHER_BASIS: partial(_is_repeated, alarms.OTHER_BASIS),
    alarms.RENAMED: lambda context: context.rtc is not None,
    alarms.UNDECLARED: partial(_is_repeated, alarms.UNDECLARED),
    alarms.NO_DITHER: lambda context: context.dither is None or context.dither.start_seq is None,
    alarms.NOT_AS_ASKED: _is_not_as_asked,
    alarms.OVER_BUDGET: _is_over_budget,
    alarms.NOT_ACKNOWLEDGED: _not_used_since,
    alarms.DISAGREES: lambda context: bool(context.registration and context.registration.doubt),
    alarms.NOT_RESTORED: lambda context: context.registration is None,
}
"""Conditions under which an alarm raised by an event stays active; all others are ended by an
event."""

_COMPARE: Final[dict[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}

FIELDS: Final[dict[str, Callable[[TrackerState], cmd.Value | None]]] = {
    "state.mode": lambda state: state.operator.mode.value,
    "state.loop": lambda state: None if state.loop.rtc is None else state.loop.rtc.loop.value,
    "state.n_controlled": lambda state: getattr(state.loop.rtc, "n_controlled", None),
    "state.magnitude": lambda state: getattr(state.loop.rtc, "magnitude", None),
    "state.elevation_deg": lambda state: getattr(state.alpha.pointing, "elevation_deg", None),
    "state.azimuth_deg": lambda state: getattr(state.alpha.pointing, "azimuth_deg", None),
}
"""Fields of the state that a condition may use; None where the value is unknown."""


def _rule_text(context: StepContext, rule: Rule) -> str | None:
    """Return what an operators' rule says that holds now, else None."""
    # Values of the observatory expire: a program that stopped reporting leaves the value unknown.
    found = _value_of(context, rule)
    holds = rule.holds_unknown if found is None else _COMPARE[rule.how](found, rule.than)
    shown = "not known" if found is None else format_value(found)
    return f"{rule.text} ({rule.about} is {shown})" if holds else None


def _own_definition(rule: Rule) -> AlarmDefinition:
    return AlarmDefinition(
        severity=rule.severity,
        means=rule.text,
        do="Remove the cause, or change the rule in the settings.",
        blocks=rule.blocks,
        because=rule.text if rule.blocks else "",
    )


def set_value(context: StepContext, command: cmd.SetValue) -> None:
    """Store a value of the observatory for its time of validity.

    Raises
    ------
    CommandError
        If its type differs from that of the rule or pointing law that uses it.
    UnknownIdError
        If neither a rule nor the pointing law uses it.
    """
    asked = _values_asked_for(context)
    if command.name not in asked:
        hint = nearest(command.name, asked)
        raise UnknownIdError(f"value {command.name}: no rule uses it{hint}")
    kind, because = asked[command.name]
    if kind_of(command.value) != kind:
        found = format_value(command.value)
        raise CommandError(f"{command.name}: found {found}, expected {kind}: {because}")
    until_ns = context.now_ns + round(command.for_s * SECOND_NS)
    value = ObservatoryValue(
        name=command.name, value=command.value, until_ns_utc=until_ns, by=command.by
    )
    others = tuple(each for each in context.alarms.observatory_values if each.name != command.name)
    context.alarms = replace(context.alarms, observatory_values=(*others, value))


def _values_asked_for(context: StepContext) -> dict[str, tuple[str, str]]:
    """Return the kind of each value that is used, and who uses it, by its name."""
    law = context.policy.law
    names = () if law is None else law.names - frozenset(ANGLES)
    of_law = dict.fromkeys(names, ("a number", "the law of pointing needs it"))
    return of_law | {
        rule.about: (
            kind_of(rule.than),
            f"rule {rule.name} compares it with {format_value(rule.than)}",
        )
        for rule in context.policy.rules
        if rule.about not in FIELDS
    }


def changes_value(state: TrackerState, command: cmd.SetValue, now_ns: int) -> bool:
    """Return whether a value is reported that differs from what is known."""
    return not any(
        each.name == command.name and each.until_ns_utc > now_ns and each.value == command.value
        for each in state.alarms.observatory_values
    )


def kind_of(value: cmd.Value) -> str:
    """Return what a value is, in words."""
    if isinstance(value, bool):
        return "true or false"
    return "a text" if isinstance(value, str) else "a number"


def format_value(value: cmd.Value) -> str:
    """Return a value as TOML and JSON write it."""
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _value_of(context: StepContext, rule: Rule) -> cmd.Value | None:
    if rule.about in FIELDS:
        return FIELDS[rule.about](context.state)
    reported = (each for each in context.alarms.observatory_values if each.name == rule.about)
    return next((each.value for each in reported if each.until_ns_utc > context.now_ns), None)
