"""Results of orders in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from service.errors import CommandError, LinkError
from service.records import commands as cmd
from service.records.alarms import AlarmRecord
from service.records.commands import Command
from service.records.messages import Message, compose
from service.records.operations import CommandState, MeasureState
from service.records.products import MatrixState, ReconstructorRecord
from service.records.state import TrackerState
from service.tracking.alarm_records import muted_records
from service.tracking.alarm_rules import format_value
from service.tracking.dither_request import total_m
from service.tracking.reconstructors import check_sendable
from service.tracking.references import explain_waiting

_ON_ITS_WAY = {
    MatrixState.PROPOSED: "command.judged-again",
    MatrixState.PUBLISHED: "command.sent",
    MatrixState.STAGED: "command.staged",
}
"""Codes of results while a matrix is on its way."""


@dataclass(frozen=True, slots=True)
class CommandResult:
    """Result of an order, as far as it is known."""

    message: Message
    final: bool = True
    """True if waiting for the RTC or for a verdict would not change the result."""


@dataclass(frozen=True, slots=True)
class GivenCommand:
    """A command that was given."""

    command: Command
    id: str
    """The cause of all that it leads to."""

    def result(self, now: TrackerState) -> CommandResult:
        """Return the present result of the command.

        Raises
        ------
        CommandError
            If RTC or gate have refused it, or it has failed.
        LinkError
            If the RTC did not answer in its time.
        """
        tell = _REPORTED_LATER.get(type(self.command), _done)
        result = tell(self.command, self.id, now)
        failure = "" if result.final else now.failure(self.id)
        if failure:
            raise CommandError(failure)
        return result


def _sent(command: cmd.Approve, _: str, now: TrackerState) -> CommandResult:
    """Report the approved reconstructor's way to the RTC."""
    return _of_matrix(now, command.id)


def _report_republished(
    command: cmd.Publish | cmd.Rollback, cause: str, now: TrackerState
) -> CommandResult:
    """Report the reconstructor that goes out again, under an id of its own."""
    copies = [each for each in now.matrices.reconstructors if each.cause == cause]
    if not copies:
        source = command.id if isinstance(command, cmd.Publish) else now.previous
        return CommandResult(compose("command.judged-first", id=source or ""), final=False)
    copy = copies[-1]
    if copy.state is MatrixState.REFUSED and isinstance(command, cmd.Rollback):
        raise CommandError(f"{_why_not(copy)}; ordered with anyway, it goes out all the same")
    sent = _of_matrix(now, copy.id)
    again = compose(
        "command.again",
        sent.message.key,
        sent=str(sent.message),
        parent=copy.parent or "",
        mode=now.operator.mode,
    )
    return CommandResult(again, sent.final)


def _of_references(
    _: cmd.ApproveReferences | cmd.RollBackReferences | cmd.ClearShape,
    cause: str,
    now: TrackerState,
) -> CommandResult:
    """Report the way of references to the RTC."""
    sent = [record for record in now.references.records if record.cause == cause]
    if not sent:
        return CommandResult(compose("command.no-references"))
    record = sent[-1]
    if record.on_its_way:
        return CommandResult(compose("command.sent", id=record.id), final=False)
    if record.state is MatrixState.FAILED:
        raise LinkError(record.reason)
    if record.state is MatrixState.REJECTED:
        raise CommandError(record.reason)
    return CommandResult(compose("command.references-used", id=record.id))


def _of_matrix(now: TrackerState, name: str) -> CommandResult:
    record = now.reconstructor(name)
    if record is None:
        raise CommandError(f"{name} is not known any more")
    held = check_sendable(now, record) if record.state is MatrixState.PROPOSED else None
    if held is not None and not now.failure(record.cause):
        return CommandResult(compose("command.not-sent", id=name, reason=held))
    code = _ON_ITS_WAY.get(record.state)
    if code is not None:
        return CommandResult(compose(code, id=name), final=False)
    if record.state is MatrixState.FAILED:
        raise LinkError(record.reason)
    if not record.was_used:
        raise CommandError(_why_not(record))
    frame_seq = record.applied_frame_seq or 0
    return CommandResult(compose("command.applied", id=name, frame_seq=frame_seq))


def _why_not(record: ReconstructorRecord) -> str:
    who = {MatrixState.REJECTED: "the RTC", MatrixState.REFUSED: "the gate"}.get(record.state)
    if who is None:
        return f"{record.id} is {record.state}: {record.reason}"
    gate = record.gate
    reason = record.reason if gate is None or gate.accepted else gate.reason
    return f"{who} refused {record.id}: {reason}"


def _dither(_: cmd.StartDither, cause: str, now: TrackerState) -> CommandResult:
    dither = now.dithers.dither
    if dither is None or dither.cause != cause:
        gone = "the dither is not followed any more: see the events"
        raise CommandError(now.failure(cause) or gone)
    found_nm, budget_nm = 1e9 * total_m(dither.request), 1e9 * now.dithers.policy.budget_m
    if dither.start_seq is None:
        sent = compose("command.dither-sent", id=dither.id, found_nm=found_nm, budget_nm=budget_nm)
        return CommandResult(sent, final=False)
    plays = compose(
        "command.dither-plays",
        id=dither.id,
        frame_seq=dither.start_seq,
        found_nm=found_nm,
        budget_nm=budget_nm,
    )
    return CommandResult(plays)


def _loop(_: cmd.SetLoop | cmd.Ramp, cause: str, now: TrackerState) -> CommandResult:
    found = now.loop.command
    if found is None or found.cause != cause:
        return CommandResult(compose("command.loop-overtaken"))
    match found.state:
        case CommandState.ASKED:
            return CommandResult(compose("command.loop-sent", found.text), final=False)
        case CommandState.ACCEPTED:
            return CommandResult(compose("command.loop-accepted", found.text))
        case CommandState.REFUSED:
            raise CommandError(f"the RTC refused: {found.reason}")
        case CommandState.FAILED:
            raise LinkError(found.reason)


def _measurement(
    command: cmd.Measure | cmd.MeasureNoisy, _: str, now: TrackerState
) -> CommandResult:
    name = command.id
    record = now.measurement(name)
    if record is None:
        raise CommandError(f"{name} is not known any more")
    match record.state:
        case MeasureState.REFUSED:
            raise CommandError(f"the RTC refused: {record.reason}")
        case MeasureState.FAILED:
            raise LinkError(record.reason)
        case MeasureState.WAITING:
            return CommandResult(compose("command.measurement-waits", id=name), final=False)
        case MeasureState.ASKED:
            return CommandResult(compose("command.sent", id=name), final=False)
        case state if record.start_seq is None:
            return CommandResult(compose("command.measurement", state, id=name))
        case state:
            seq = record.start_seq
            return CommandResult(compose("command.measures", state, id=name, frame_seq=seq))


def _stopped(_: cmd.StopEverything, __: str, now: TrackerState) -> CommandResult:
    playing = None if now.loop.rtc is None else now.loop.rtc.dither_id
    because = now.operator.stopped_because
    if playing is None:
        return CommandResult(compose("command.stopped", because))
    return CommandResult(compose("command.stopping", because, playing=playing), final=False)


def _no_dither(_: cmd.StopDither, __: str, now: TrackerState) -> CommandResult:
    playing = None if now.loop.rtc is None else now.loop.rtc.dither_id
    if playing is None:
        return CommandResult(compose("command.no-dither"))
    return CommandResult(compose("command.dither-stopping", playing=playing), final=False)


_REPORTED_LATER: Final[dict[type, Callable[[Any, str, TrackerState], CommandResult]]] = {
    cmd.Approve: _sent,
    cmd.Publish: _report_republished,
    cmd.Rollback: _report_republished,
    cmd.ApproveReferences: _of_references,
    cmd.RollBackReferences: _of_references,
    cmd.ClearShape: _of_references,
    cmd.StartDither: _dither,
    cmd.StopDither: _no_dither,
    cmd.SetLoop: _loop,
    cmd.Ramp: _loop,
    cmd.Measure: _measurement,
    cmd.MeasureNoisy: _measurement,
    cmd.StopEverything: _stopped,
}
"""Orders whose result depends on the RTC or on a verdict; the others are done when they are
answered."""


def _done(  # noqa: C901 - one line for each command
    command: Command, _: str, now: TrackerState
) -> CommandResult:
    """Report the state after a command that the service carries out by itself."""
    mode, doing = now.operator.mode, now.operations.acquisition.text
    match command:
        case cmd.SetMode():
            message = compose("command.mode", mode)
        case cmd.Resume() if now.dithers.stopped:
            message = compose("command.released-without-dither", mode)
        case cmd.Resume():
            message = compose("command.released", mode)
        case cmd.Refit():
            message = compose("command.refit", mode=mode)
        case cmd.LoadShape():
            shape = now.references.shape
            waiting = explain_waiting(now) or "references are being made"
            message = compose("command.shape", waiting, id=shape.id if shape else "")
        case cmd.Reject(id=name) | cmd.RejectReferences(id=name):
            message = compose("command.discarded", id=name)
        case cmd.Acquire():
            message = compose("command.acquires", doing)
        case cmd.AbortAcquisition():
            message = compose("command.acquisition-ended", doing)
        case cmd.GiveUp(id=name):
            record = now.measurement(name)
            reason = record.reason if record else "given up"
            message = compose("command.given-up", reason, id=name)
        case cmd.SetPointing(elevation_deg=up, azimuth_deg=round_):
            message = compose("command.pointing", elevation_deg=up, azimuth_deg=round_)
        case cmd.SetValue(name=name, value=value, for_s=for_s):
            message = compose("command.value", name, value=format_value(value), for_s=for_s)
        case cmd.UnmuteAlarm(name=name):
            message = compose("command.unmuted", name)
        case cmd.AcknowledgeAlarm(name=name) | cmd.MuteAlarm(name=name):
            message = compose("command.alarm", name, state=_describe_alarm(now, name))
        case _:
            raise TypeError(f"found {type(command).__name__}; expected it in _REPORTED_LATER")
    return CommandResult(message)


def _describe_alarm(now: TrackerState, name: str) -> str:
    """Return the state of an alarm that was acknowledged or muted."""
    record = next(
        (record for record in now.alarms.records if record.name == name), AlarmRecord(name=name)
    )
    parts = []
    if record.acknowledged is not None:
        parts.append("acknowledged; it stays until it is over")
    elif record.worst is None:
        parts.append("over and done with")
    if record.muted is not None:
        left_s = ((record.muted.until_ns_utc or 0) - record.muted.t_ns_utc) / 1e9
        parts.append(f"muted for {left_s:.0f} s, with {len(muted_records(now))} muted in all")
    return ", ".join(parts)
