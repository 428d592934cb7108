"""Acknowledge, mute and remember alarms.

The rules are those of LSST's ts_watcher. An alarm is acknowledged, not dismissed. One that ends
without being acknowledged stays as stale. Its highest severity is kept. An acknowledgement holds
until the alarm ends or becomes more severe than it was then. An alarm that an operator's order ends
counts as acknowledged.
"""

from __future__ import annotations

from dataclasses import replace

from service.errors import CommandError, UnknownIdError
from service.records import alarms
from service.records import commands as cmd
from service.records.alarms import Alarm, AlarmRecord, AlarmState, OperatorNote, Severity
from service.records.state import Orders, TrackerState
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext

RESTART_GRACE_S = 60.0
"""Time after a restart of the service for an active alarm to be raised again."""


def update_records(context: StepContext, *, ordered: bool) -> None:
    """Keep the notes in step with the alarms, and with the time.

    ``ordered``: an operator has given a command, and what it ends has been seen.
    """
    notes = {record.name: record for record in context.alarms.records}
    raised = {alarm.name: alarm for alarm in context.alarms.active}
    for alarm in raised.values():
        notes[alarm.name] = _with_alarm(notes.get(alarm.name, AlarmRecord(name=alarm.name)), alarm)
    for name, record in notes.items():
        if name not in raised:
            notes[name] = _without_alarm(context, record, ordered=ordered)
    _store(
        context, {name: _without_old_mute(record, context.now_ns) for name, record in notes.items()}
    )


def record_of(state: TrackerState, alarm: Alarm) -> AlarmRecord:
    """Return what is kept of an alarm that lasts."""
    known = _find(state, alarm.name) or AlarmRecord(name=alarm.name)
    return replace(_with_alarm(known, alarm), text=alarm.text)


def stale_records(state: TrackerState) -> tuple[AlarmRecord, ...]:
    """Return the alarms that ended without being acknowledged."""
    return tuple(
        record for record in state.alarms.records if record.alarm_state is AlarmState.STALE
    )


def muted_records(state: TrackerState) -> tuple[AlarmRecord, ...]:
    """Return the alarms that are muted, whether they last or not."""
    return tuple(record for record in state.alarms.records if record.muted is not None)


def worst_severity(state: TrackerState) -> Severity | None:
    """Return the most severe of what lasts, or went unseen; None: there is nothing."""
    found = (record.worst for record in state.alarms.records if record.worst is not None)
    return max(found, key=lambda worst: worst.rank, default=None)


def acknowledge(context: StepContext, command: cmd.AcknowledgeAlarm) -> None:
    """Acknowledge an alarm; an ended one disappears.

    Raises
    ------
    CommandError
        If it has been worse than what was seen of it.
    UnknownIdError
        If no alarm has this name.
    """
    record = _record_named(context, command.name)
    seen, worst_yet = command.severity, record.worst
    if seen is not None and worst_yet is not None and worst_yet.above(seen):
        raise CommandError(f"{record.name} has been {worst_yet}, and {seen} was seen: look again")
    acknowledged = replace(record, acknowledged=_operator_note(context, command))
    _put(context, acknowledged if record.over_ns_utc is None else _blank(record))
    context.log("alarm.acknowledged", f"{record.name} {command.signed}")


def mute(context: StepContext, command: cmd.MuteAlarm) -> None:
    """Hide an alarm for a time; what it forbids stays forbidden.

    Raises
    ------
    UnknownIdError
        If no alarm has this name.
    """
    record = _record_named(context, command.name)
    until_ns = context.now_ns + round(command.for_s * SECOND_NS)
    muted = replace(_operator_note(context, command), until_ns_utc=until_ns)
    _put(context, replace(record, muted=muted))
    context.log("alarm.muted", f"{record.name} for {command.for_s:.0f} s {command.signed}")


def unmute(context: StepContext, command: cmd.UnmuteAlarm) -> None:
    """Show an alarm again.

    Raises
    ------
    UnknownIdError
        If no alarm has this name.
    """
    record = _record_named(context, command.name)
    _put(context, replace(record, muted=None))
    context.log("alarm.unmuted", f"{record.name} {command.signed}")


def restore_records(context: StepContext, orders: Orders) -> None:
    """Know what was known before a restart; what lasted then has yet to be raised again."""
    over_ns = context.now_ns
    records = tuple(
        replace(record, over_ns_utc=record.over_ns_utc or over_ns) if record.worst else record
        for record in orders.seen
    )
    context.alarms = replace(context.alarms, records=records)


def _with_alarm(record: AlarmRecord, alarm: Alarm) -> AlarmRecord:
    severity = alarm.definition.severity
    worse = severity.above(record.worst)
    if record.worst is not None and record.over_ns_utc is None and not worse:
        return record
    return replace(
        record,
        worst=severity if worse else record.worst,
        since_ns_utc=alarm.since_ns_utc,
        text=alarm.text,
        over_ns_utc=None,
        # An acknowledgement is of what was seen: an alarm that became more severe must be seen
        # again.
        acknowledged=None if worse else record.acknowledged,
    )


def _without_alarm(context: StepContext, record: AlarmRecord, *, ordered: bool) -> AlarmRecord:
    """Return the note of an alarm that does not last."""
    if record.worst is None:
        return record
    if record.over_ns_utc is None:
        if ordered or record.acknowledged is not None:
            return _blank(record)
        # The alarm has just ended: only the state before the event still has its last text.
        last = next(
            (a.text for a in context.before.alarms.active if a.name == record.name), record.text
        )
        return replace(record, over_ns_utc=context.now_ns, text=last)
    waited_ns = context.now_ns - record.over_ns_utc
    # After a restart an alarm that goes on is raised again within this time, and must find its
    # acknowledgement.
    if record.acknowledged is not None and waited_ns > RESTART_GRACE_S * SECOND_NS:
        return _blank(record)
    return record


def _blank(record: AlarmRecord) -> AlarmRecord:
    return AlarmRecord(name=record.name, muted=record.muted)


def _without_old_mute(record: AlarmRecord, now_ns: int) -> AlarmRecord:
    """Return a note without a mute that has had its time."""
    until_ns = None if record.muted is None else record.muted.until_ns_utc
    return record if until_ns is None or now_ns < until_ns else replace(record, muted=None)


def _record_named(context: StepContext, name: str) -> AlarmRecord:
    """Return what is kept of an alarm, or a new record."""
    own = {f"{alarms.RULE_PREFIX}{rule.name}" for rule in context.policy.rules}
    known = _find(context.state, name)
    if known is None and name not in alarms.ALARMS and name not in own:
        raise UnknownIdError(f"unknown alarm {name}")
    return known or AlarmRecord(name=name)


def _find(state: TrackerState, name: str) -> AlarmRecord | None:
    return next((record for record in state.alarms.records if record.name == name), None)


def _put(context: StepContext, record: AlarmRecord) -> None:
    """Keep a record in the place of the one of its name."""
    _store(context, {each.name: each for each in (*context.alarms.records, record)})


def _store(context: StepContext, notes: dict[str, AlarmRecord]) -> None:
    """Keep what says something, where it is not what is kept already."""
    kept = tuple(record for record in notes.values() if record != AlarmRecord(name=record.name))
    if kept != context.alarms.records:
        context.alarms = replace(context.alarms, records=kept)


def _operator_note(context: StepContext, command: cmd.Instruction) -> OperatorNote:
    by = command.by or "an operator"
    return OperatorNote(by=by, reason=command.reason, t_ns_utc=context.now_ns)
