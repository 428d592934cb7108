"""Operators' own rules: while a condition on what is told or known holds, some acts are forbidden.

"Do not publish while the shutter is shut." A rule that holds is an alarm like others. Its condition
is on a value that the observatory tells for a time, or on a field of the state.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, Final

from service.errors import CommandError, UnknownIdError
from service.tracking import commands as cmd
from service.tracking.alarms import Kind
from service.tracking.policy import SECOND_NS, Rule
from service.tracking.state import ObservatoryValue, TrackerState
from service.tracking.turn import Turn
from service.tracking.validity import end_alarm

PREFIX = "rule."
"""Of the alarms of rules: no other alarm has a dot in its name."""

_COMPARE: Final[dict[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}

FIELDS: Final[dict[str, Callable[[TrackerState], cmd.Value | None]]] = {
    "state.mode": lambda state: state.mode.value,
    "state.loop": lambda state: None if state.rtc is None else state.rtc.loop.value,
    "state.n_controlled": lambda state: None if state.rtc is None else state.rtc.n_controlled,
    "state.magnitude": lambda state: None if state.rtc is None else state.rtc.magnitude,
    "state.elevation_deg": lambda state: (
        None if state.pointing is None else state.pointing.elevation_deg
    ),
    "state.azimuth_deg": lambda state: (
        None if state.pointing is None else state.pointing.azimuth_deg
    ),
}
"""What a condition may ask of the state; nothing where it is not known."""


def judge(turn: Turn) -> None:
    """Raise the alarms of the rules that hold, and end those of the others."""
    raised = {alarm.name: alarm.text for alarm in turn.state.alarms}
    for rule in turn.policy.rules:
        name, found = f"{PREFIX}{rule.name}", _found(turn, rule)
        holds = rule.holds_unknown if found is None else _COMPARE[rule.how](found, rule.than)
        text = f"{rule.text} ({rule.about} is {'not known' if found is None else said(found)})"
        if holds and raised.get(name) != text:
            turn.alarm(name, text, _kind(rule))
        elif not holds and name in raised:
            end_alarm(turn, name)


def tell(turn: Turn, command: cmd.SetValue) -> None:
    """Take a value that a rule asks for; it counts for as long as was said.

    Raises
    ------
    CommandError
        If it is of another kind than the rule compares it with.
    UnknownIdError
        If no rule asks for it.
    """
    asked = {rule.about: rule for rule in turn.policy.rules if rule.about not in FIELDS}
    if command.name not in asked:
        near = get_close_matches(command.name, asked, n=1)
        known = ", ".join(sorted(asked)) or "none"
        hint = f", did you mean {near[0]}?" if near else f"; asked for: {known}"
        raise UnknownIdError(f"value {command.name}: no rule asks for it{hint}")
    rule = asked[command.name]
    if kind_of(command.value) != kind_of(rule.than):
        raise CommandError(
            f"{command.name}: found {said(command.value)}, expected {kind_of(rule.than)}: rule "
            f"{rule.name} compares it with {said(rule.than)}"
        )
    until_ns = turn.now_ns + round(command.for_s * SECOND_NS)
    told = ObservatoryValue(
        name=command.name, value=command.value, until_ns_utc=until_ns, by=command.by
    )
    others = tuple(each for each in turn.state.told if each.name != command.name)
    turn.state = replace(turn.state, told=(*others, told))


def is_news(state: TrackerState, command: cmd.SetValue, now_ns: int) -> bool:
    """Return whether a value is told that differs from what is known."""
    return not any(
        each.name == command.name and each.until_ns_utc > now_ns and each.value == command.value
        for each in state.told
    )


def kind_of(value: cmd.Value) -> str:
    """Return what a value is, in words."""
    if isinstance(value, bool):
        return "true or false"
    return "a text" if isinstance(value, str) else "a number"


def said(value: cmd.Value) -> str:
    """Return a value as TOML and JSON write it."""
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _found(turn: Turn, rule: Rule) -> cmd.Value | None:
    if rule.about in FIELDS:
        return FIELDS[rule.about](turn.state)
    told = (each for each in turn.state.told if each.name == rule.about)
    return next((each.value for each in told if each.until_ns_utc > turn.now_ns), None)


def _kind(rule: Rule) -> Kind:
    return Kind(
        severity=rule.severity,
        means=rule.text,
        do="see to it, or change the rule in the settings",
        forbids=rule.blocks,
        because=rule.text if rule.blocks else "",
    )
