"""Results of orders in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from service.errors import CommandError, LinkError
from service.records import commands as cmd
from service.records.alarms import AlarmRecord
from service.records.commands import Command
from service.records.operations import CommandState, MeasureState
from service.records.products import MatrixState, ReconstructorRecord
from service.records.state import TrackerState
from service.tracking.alarm_records import muted_records
from service.tracking.alarm_rules import format_value
from service.tracking.dither_request import total_m
from service.tracking.reconstructors import check_sendable

SILENT = "sent, the RTC has not answered yet"

_ON_ITS_WAY = {
    MatrixState.PROPOSED: "is being judged again before it is sent",
    MatrixState.PUBLISHED: SILENT,
    MatrixState.STAGED: "sent, the RTC holds it and has not applied it yet",
}


@dataclass(frozen=True, slots=True)
class CommandResult:
    """Text and id of an order's result."""

    text: str
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
        tell = _TOLD_LATER.get(type(self.command), _done)
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
        return CommandResult(f"{source} is being judged before it is sent again", final=False)
    copy = copies[-1]
    if copy.state is MatrixState.REFUSED and isinstance(command, cmd.Rollback):
        raise CommandError(f"{_why_not(copy)}; ordered with anyway, it goes out all the same")
    sent = _of_matrix(now, copy.id)
    text = f"{sent.text}; it is {copy.parent} again; mode is {now.operator.mode}"
    return CommandResult(text, sent.final)


def _of_matrix(now: TrackerState, name: str) -> CommandResult:
    record = now.reconstructor(name)
    if record is None:
        raise CommandError(f"{name} is not known any more")
    held = check_sendable(now, record) if record.state is MatrixState.PROPOSED else None
    if held is not None and not now.failure(record.cause):
        return CommandResult(f"{name} is proposed and not sent: {held}")
    words = _ON_ITS_WAY.get(record.state)
    if words is not None:
        return CommandResult(f"{name} {words}", final=False)
    if record.state is MatrixState.FAILED:
        raise LinkError(record.reason)
    if not record.was_used:
        raise CommandError(_why_not(record))
    return CommandResult(f"{name} sent, applied at frame {record.applied_frame_seq}")


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
    cost = f"{1e9 * total_m(dither.request):.3g} nm RMS in all"
    cost = f"{cost}, budget {1e9 * now.dithers.policy.budget_m:.3g} nm"
    if dither.start_seq is None:
        return CommandResult(f"{dither.id} {SILENT}: {cost}", final=False)
    return CommandResult(f"{dither.id} plays from frame {dither.start_seq}: {cost}")


def _loop(_: cmd.SetLoop | cmd.Ramp, cause: str, now: TrackerState) -> CommandResult:
    found = now.loop.command
    if found is None or found.cause != cause:
        return CommandResult(f"{SILENT}: another change of the loop came after it")
    match found.state:
        case CommandState.ASKED:
            return CommandResult(f"{found.text}: {SILENT}", final=False)
        case CommandState.ACCEPTED:
            return CommandResult(f"the RTC has accepted: {found.text}")
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
            return CommandResult(f"{name} waits for the dither that plays to end", final=False)
        case MeasureState.ASKED:
            return CommandResult(f"{name} {SILENT}", final=False)
        case _ if record.start_seq is None:
            return CommandResult(f"{name} is {record.state}")
        case _:
            return CommandResult(f"{name} is {record.state}, from frame {record.start_seq}")


def _stopped(_: cmd.StopEverything, __: str, now: TrackerState) -> CommandResult:
    playing = None if now.loop.rtc is None else now.loop.rtc.dither_id
    text = f"{now.operator.stopped_because}; nothing is dithered, made or sent until it is released"
    if playing is None:
        return CommandResult(text)
    shows = f"the RTC's status still shows {playing}, it was asked to stop it"
    return CommandResult(f"{text}; {shows}", final=False)


def _no_dither(_: cmd.StopDither, __: str, now: TrackerState) -> CommandResult:
    playing = None if now.loop.rtc is None else now.loop.rtc.dither_id
    off = "no dither starts until one is ordered"
    if playing is None:
        return CommandResult(f"no dither plays; {off}")
    asked = f"the RTC was asked to stop {playing}, its status still shows it"
    return CommandResult(f"{asked}; {off}", final=False)


_TOLD_LATER: Final[dict[type, Callable[[Any, str, TrackerState], CommandResult]]] = {
    cmd.Approve: _sent,
    cmd.Publish: _report_republished,
    cmd.Rollback: _report_republished,
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
    match command:
        case cmd.SetMode():
            text = f"mode is {now.operator.mode}"
        case cmd.Resume():
            off = "; no dither starts until one is ordered" if now.dithers.stopped else ""
            text = f"released: mode is {now.operator.mode}{off}"
        case cmd.Refit():
            text = f"a reconstructor is being computed; mode is {now.operator.mode}"
        case cmd.Reject(id=name):
            text = f"{name} is discarded"
        case cmd.Acquire():
            text = f"an acquisition is under way: {now.operations.acquisition.text}"
        case cmd.AbortAcquisition():
            text = f"the acquisition has {now.operations.acquisition.text}"
        case cmd.GiveUp(id=name):
            record = now.measurement(name)
            text = f"{name} is {record.reason if record else 'given up'}"
        case cmd.SetPointing(elevation_deg=up, azimuth_deg=round_):
            text = f"the telescope points at elevation {up:g} deg, azimuth {round_:g} deg"
        case cmd.SetValue(name=name, value=value, for_s=for_s):
            text = f"{name} is {format_value(value)} for {for_s:g} s"
        case cmd.UnmuteAlarm(name=name):
            text = f"{name} is not muted any more"
        case cmd.AcknowledgeAlarm(name=name) | cmd.MuteAlarm(name=name):
            text = _alarm(now, name)
        case _:
            raise TypeError(f"found {type(command).__name__}; expected it in _TOLD_LATER")
    return CommandResult(text)


def _alarm(now: TrackerState, name: str) -> str:
    """Report an alarm that was acknowledged or muted."""
    record = next(
        (record for record in now.alarms.records if record.name == name), AlarmRecord(name=name)
    )
    said = []
    if record.acknowledged is not None:
        said.append("acknowledged; it stays until it is over")
    elif record.worst is None:
        said.append("over and done with")
    if record.muted is not None:
        left_s = ((record.muted.until_ns_utc or 0) - record.muted.t_ns_utc) / 1e9
        said.append(f"muted for {left_s:.0f} s, with {len(muted_records(now))} muted in all")
    return f"{name} is {', '.join(said)}"
