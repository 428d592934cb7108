"""Operators and alarms: rules of their own that raise some, and who has seen which.

A rule forbids some acts while a condition on what is told or known holds ("do not publish while the
shutter is shut"); one that holds is an alarm like others. Its condition is on a value that the
observatory tells for a time, or on a field of the state.

As LSST's ts_watcher has it: an alarm is acknowledged, not dismissed; one that goes unseen stays
as stale; the worst it has been is kept; an acknowledgement holds until the alarm is over, or worse
than whoever gave it has seen. What an operator's order ends has been seen.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, Final

from service.errors import CommandError, UnknownIdError
from service.tracking import commands as cmd
from service.tracking.alarms import ALARMS, Alarm, Attention, Kind, Note, Remark, Severity
from service.tracking.events import Tick
from service.tracking.policy import SECOND_NS, Rule
from service.tracking.state import ObservatoryValue, Orders, TrackerState
from service.tracking.turn import Turn
from service.tracking.validity import end_alarm

RAISED_AGAIN_S = 60.0
"""After a restart of the service, for an alarm that lasts to be raised again."""


def follow(turn: Turn) -> None:
    """Keep the notes in step with the alarms, and with the time."""
    timely = isinstance(turn.event, Tick)
    if turn.state.alarms is turn.before.alarms and not timely:
        return
    notes = {note.name: note for note in turn.state.notes}
    raised = {alarm.name: alarm for alarm in turn.state.alarms}
    for alarm in raised.values():
        notes[alarm.name] = _raised(notes.get(alarm.name, Note(name=alarm.name)), alarm)
    for name, note in notes.items():
        if name not in raised:
            notes[name] = _not_raised(turn, note)
    _keep(turn, {name: _unmuted(note, turn.now_ns) for name, note in notes.items()})


def note_of(state: TrackerState, alarm: Alarm) -> Note:
    """Return what is kept of an alarm that lasts."""
    known = next((note for note in state.notes if note.name == alarm.name), Note(name=alarm.name))
    return replace(_raised(known, alarm), text=alarm.text)


def stale(state: TrackerState) -> tuple[Note, ...]:
    """Return the alarms that have gone and nobody has seen."""
    return tuple(note for note in state.notes if note.attention is Attention.STALE)


def muted(state: TrackerState) -> tuple[Note, ...]:
    """Return the alarms that are muted, whether they last or not."""
    return tuple(note for note in state.notes if note.muted is not None)


def worst(state: TrackerState) -> Severity | None:
    """Return the most severe of what lasts, or went unseen; None: there is nothing."""
    found: Severity | None = None
    for note in state.notes:
        if note.worst is not None and note.worst.above(found):
            found = note.worst
    return found


def acknowledge(turn: Turn, command: cmd.AcknowledgeAlarm) -> None:
    """Note that somebody knows of an alarm; one that is over is done with.

    Raises
    ------
    CommandError
        If it has been worse than what was seen of it.
    UnknownIdError
        If no alarm has this name.
    """
    notes, note = _noted(turn, command.name)
    seen, worst_yet = command.severity, note.worst
    if seen is not None and worst_yet is not None and worst_yet.above(seen):
        raise CommandError(
            f"{note.name} has been {worst_yet}, and {seen} was seen of it: look again"
        )
    known = replace(note, acknowledged=_remark(turn, command))
    notes[note.name] = known if note.over_ns_utc is None else _done_with(note)
    _keep(turn, notes)
    turn.log("alarm.acknowledged", f"{note.name} {command.signed}")


def mute(turn: Turn, command: cmd.MuteAlarm) -> None:
    """Keep an alarm from being shown and told for a time; all it forbids, it goes on to forbid.

    Raises
    ------
    UnknownIdError
        If no alarm has this name.
    """
    notes, note = _noted(turn, command.name)
    until_ns = turn.now_ns + round(command.for_s * SECOND_NS)
    notes[note.name] = replace(note, muted=replace(_remark(turn, command), until_ns_utc=until_ns))
    _keep(turn, notes)
    turn.log("alarm.muted", f"{note.name} for {command.for_s:.0f} s {command.signed}")


def unmute(turn: Turn, command: cmd.UnmuteAlarm) -> None:
    """Show and tell an alarm again.

    Raises
    ------
    UnknownIdError
        If no alarm has this name.
    """
    notes, note = _noted(turn, command.name)
    notes[note.name] = replace(note, muted=None)
    _keep(turn, notes)
    turn.log("alarm.unmuted", f"{note.name} {command.signed}")


def take_over(turn: Turn, orders: Orders) -> None:
    """Know what was known before a restart; what lasted then has yet to be raised again."""
    over_ns = turn.now_ns
    turn.state = replace(
        turn.state,
        notes=tuple(
            replace(note, over_ns_utc=note.over_ns_utc or over_ns) if note.worst else note
            for note in orders.seen
        ),
    )


def _raised(note: Note, alarm: Alarm) -> Note:
    severity = alarm.kind.severity
    worse = severity.above(note.worst)
    if note.worst is not None and note.over_ns_utc is None and not worse:
        return note
    return replace(
        note,
        worst=severity if worse else note.worst,
        since_ns_utc=alarm.since_ns_utc,
        text=alarm.text,
        over_ns_utc=None,
        acknowledged=None if worse else note.acknowledged,
    )


def _not_raised(turn: Turn, note: Note) -> Note:
    """Return the note of an alarm that does not last."""
    if note.worst is None:
        return note
    if note.over_ns_utc is None:
        ordered = isinstance(turn.event, cmd.Instruction)
        if ordered or note.acknowledged is not None:
            return _done_with(note)
        last = next((a.text for a in turn.before.alarms if a.name == note.name), note.text)
        return replace(note, over_ns_utc=turn.now_ns, text=last)
    waited_ns = turn.now_ns - note.over_ns_utc
    if note.acknowledged is not None and waited_ns > RAISED_AGAIN_S * SECOND_NS:
        return _done_with(note)
    return note


def _done_with(note: Note) -> Note:
    return Note(name=note.name, muted=note.muted)


def _unmuted(note: Note, now_ns: int) -> Note:
    """Return a note without a mute that has had its time."""
    until_ns = None if note.muted is None else note.muted.until_ns_utc
    return note if until_ns is None or now_ns < until_ns else replace(note, muted=None)


def _noted(turn: Turn, name: str) -> tuple[dict[str, Note], Note]:
    """Return all notes by name, and one of them, or a new one."""
    notes = {note.name: note for note in turn.state.notes}
    own = {f"{PREFIX}{rule.name}" for rule in turn.policy.rules}
    if name not in notes and name not in ALARMS and name not in own:
        raise UnknownIdError(f"alarm {name}: nobody has heard of it")
    return notes, notes.get(name, Note(name=name))


def _keep(turn: Turn, notes: dict[str, Note]) -> None:
    """Keep what says something, where it is not what is kept already."""
    kept = tuple(note for note in notes.values() if note != Note(name=note.name))
    if kept != turn.state.notes:
        turn.state = replace(turn.state, notes=kept)


def _remark(turn: Turn, command: cmd.Instruction) -> Remark:
    by = command.by or "an operator"
    return Remark(by=by, reason=command.reason, t_ns_utc=turn.now_ns)


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


def judge_rules(turn: Turn) -> None:
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


def tell_value(turn: Turn, command: cmd.SetValue) -> None:
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
