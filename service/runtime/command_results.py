"""What an order has led to, in one sentence, from the state after it."""

from __future__ import annotations

from dataclasses import dataclass

from service.errors import CommandError, LinkError
from service.tracking import commands as cmd
from service.tracking.alarm_records import as_text, muted
from service.tracking.alarms import NO_DITHER, AlarmRecord
from service.tracking.commands import Command
from service.tracking.dither_request import total_m
from service.tracking.loop import CommandState
from service.tracking.products import MatrixState, MeasureState, ReconstructorRecord
from service.tracking.sending import why_unsendable
from service.tracking.state import TrackerState
from service.tracking.step_context import new_lines

SILENT = "sent, the RTC has not answered yet"

_ON_ITS_WAY = {
    MatrixState.PROPOSED: "is being judged again before it is sent",
    MatrixState.PUBLISHED: SILENT,
    MatrixState.STAGED: "sent, the RTC holds it and has not applied it yet",
}


@dataclass(frozen=True, slots=True)
class CommandResult:
    """What there is to tell."""

    text: str
    final: bool = True
    """Whether waiting for the RTC, or for a verdict, could not tell more."""


@dataclass(frozen=True, slots=True)
class CarriedOut:
    """An order that was carried out, as far as the service can by itself."""

    command: Command
    before: TrackerState
    """What was known before it."""

    then: TrackerState
    """Right after it, before anything was heard of it."""

    def result(self, now: TrackerState) -> CommandResult:  # noqa: C901 - one line for each command
        """Return what has come of it by now.

        Raises
        ------
        CommandError
            If RTC or gate have refused it.
        LinkError
            If the RTC did not answer in its time.
        """
        match self.command:
            case cmd.SetMode():
                return CommandResult(f"mode is {now.operator.mode}")
            case cmd.StopEverything():
                return _stopped(now)
            case cmd.Resume():
                off = "; no dither is started until one is asked for"
                return CommandResult(
                    f"released: mode is {now.operator.mode}{off if now.dithers.stopped else ''}"
                )
            case cmd.SetPointing():
                return _pointing(now)
            case cmd.SetValue(name=name, value=value, for_s=for_s):
                return CommandResult(f"{name} is {as_text(value)} for {for_s:g} s")
            case cmd.Acquire():
                return CommandResult(
                    f"an acquisition is under way: {now.operations.acquisition.text}"
                )
            case cmd.AbortAcquisition():
                return CommandResult(f"the acquisition has {now.operations.acquisition.text}")
            case cmd.StartDither():
                return self._dither(now)
            case cmd.StopDither():
                return _no_dither(now)
            case cmd.SetLoop() | cmd.Ramp():
                return self._loop(now)
            case cmd.Measure(id=name) | cmd.MeasureNoisy(id=name):
                return _measurement(now, name)
            case cmd.GiveUp(id=name):
                record = now.measurement(name)
                why = "" if record is None else record.reason.removeprefix("given up ")
                return CommandResult(f"{name} is given up {why}")
            case cmd.AcknowledgeAlarm(name=name) | cmd.MuteAlarm(name=name):
                return _alarm(now, name)
            case cmd.UnmuteAlarm(name=name):
                return CommandResult(f"{name} is not muted any more")
            case _:
                return self._of_matrices(now)

    def _of_matrices(self, now: TrackerState) -> CommandResult:
        match self.command:
            case cmd.Refit():
                return CommandResult(
                    f"a reconstructor is being computed; mode is {now.operator.mode}"
                )
            case cmd.Approve(id=name):
                return self._sent(now, name)
            case cmd.Reject(id=name):
                return CommandResult(f"{name} is discarded")
            case cmd.Publish(id=name):
                return self._republished(now, name)
            case _:
                return self._republished(now, self.before.previous or "")

    def _republished(self, now: TrackerState, source: str) -> CommandResult:
        """Tell of a reconstructor that goes out again, under an id of its own."""
        known = {record.id for record in self.before.matrices.reconstructors}
        made = [r for r in now.matrices.reconstructors if r.parent == source and r.id not in known]
        if made:
            if made[-1].state is MatrixState.REFUSED and isinstance(self.command, cmd.Rollback):
                text = f"{_why_not(made[-1])}; ordered with anyway, it goes out all the same"
                raise CommandError(text)
            answer = self._sent(now, made[-1].id)
            return CommandResult(
                f"{answer.text}; it is {source} again; mode is {now.operator.mode}", answer.final
            )
        failed = [line for line in new_lines(self.then, now) if line.name == "job.failed"]
        if now.matrices.making_since_ns_utc is None and failed:
            raise CommandError(failed[-1].text)
        return CommandResult(f"{source} is being judged before it is sent again", final=False)

    def _sent(self, now: TrackerState, name: str) -> CommandResult:
        """Tell how far a reconstructor is on its way to the RTC."""
        record = now.reconstructor(name)
        if record is None:
            raise CommandError(f"{name} is not known any more")
        for line in new_lines(self.then, now):
            if line.name == "reconstructor.not-sent" and line.text.startswith(name):
                raise CommandError(line.text)
        held = why_unsendable(now, record) if record.state is MatrixState.PROPOSED else None
        if held is not None:
            return CommandResult(f"{name} is proposed and not sent: {held}")
        words = _ON_ITS_WAY.get(record.state)
        if words is not None:
            return CommandResult(f"{name} {words}", final=False)
        if record.state is MatrixState.FAILED:
            raise LinkError(record.reason)
        if not record.was_used:
            raise CommandError(_why_not(record))
        return CommandResult(f"{name} sent, applied at frame {record.applied_frame_seq}")

    def _dither(self, now: TrackerState) -> CommandResult:
        asked = self.then.dithers.dither
        name = "" if asked is None else asked.id
        dither = now.dithers.dither
        if dither is None or dither.id != name:
            told = now.alarm(NO_DITHER)
            gone = f"{name} is not followed any more: see the events"
            raise CommandError(gone if told is None else told.text)
        cost = f"{1e9 * total_m(dither.request):.3g} nm RMS in all"
        cost = f"{cost}, budget {1e9 * now.dithers.policy.budget_m:.3g} nm"
        if dither.start_seq is None:
            return CommandResult(f"{name} {SILENT}: {cost}", final=False)
        return CommandResult(f"{name} plays from frame {dither.start_seq}: {cost}")

    def _loop(self, now: TrackerState) -> CommandResult:
        asked, found = self.then.loop.command, now.loop.command
        if asked is None or found is None or asked.id != found.id:
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


def _pointing(now: TrackerState) -> CommandResult:
    where = now.alpha.pointing
    if where is None:
        return CommandResult("the pointing is not known")
    return CommandResult(
        f"the telescope looks at elevation {where.elevation_deg:g} deg, azimuth "
        f"{where.azimuth_deg:g} deg"
    )


def _stopped(now: TrackerState) -> CommandResult:
    playing = None if now.loop.rtc is None else now.loop.rtc.dither_id
    text = f"{now.operator.stopped_because}; nothing is dithered, made or sent until it is released"
    if playing is None:
        return CommandResult(text)
    return CommandResult(
        f"{text}; the RTC's status still shows {playing}, it was told to stop it", False
    )


def _no_dither(now: TrackerState) -> CommandResult:
    playing = None if now.loop.rtc is None else now.loop.rtc.dither_id
    off = "no dither is started until one is asked for"
    if playing is None:
        return CommandResult(f"no dither plays; {off}")
    return CommandResult(
        f"the RTC was told to stop {playing}, its status still shows it; {off}", False
    )


def _alarm(now: TrackerState, name: str) -> CommandResult:
    """Tell what is kept of an alarm that was acknowledged or muted."""
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
        said.append(f"muted for {left_s:.0f} s, with {len(muted(now))} muted in all")
    return CommandResult(f"{name} is {', '.join(said)}")


def _measurement(now: TrackerState, name: str) -> CommandResult:
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


def _why_not(record: ReconstructorRecord) -> str:
    who = {MatrixState.REJECTED: "the RTC", MatrixState.REFUSED: "the gate"}.get(record.state)
    if who is None:
        return f"{record.id} is {record.state}: {record.reason}"
    gate = record.gate
    reason = record.reason if gate is None or gate.accepted else gate.reason
    return f"{who} refused {record.id}: {reason}"
