"""Asking the RTC for something: the command out, its answer back as an event."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from service.errors import CommandError, LinkError
from service.runtime import translate
from service.runtime.ports import RtcPort
from service.tracking import events as ev
from service.tracking.events import Effect, Event
from service.tracking.loop import CommandState
from service.tracking.products import MeasureState
from service.tracking.state import TrackerState
from service.wire import (
    DitherKind,
    DitherRequest,
    DitherStop,
    Loop,
    LoopRequest,
    RampRequest,
)

Question = ev.AskDither | ev.AskNoDither | ev.AskMeasurement | ev.AskLoop | ev.AskRamp


async def ask(bridge: RtcPort, question: Question, clock_ns: Callable[[], int]) -> Event | None:
    """Send a command and return what the RTC said to it; None: nothing to report.

    Raises
    ------
    LinkError
        If the RTC does not answer.
    CommandError
        If it does not stop a dither.
    """
    match question:
        case ev.AskDither():
            return await _dither(bridge, question)
        case ev.AskNoDither():
            await _no_dither(bridge, f"stop-{clock_ns()}")
            return None
        case ev.AskMeasurement(record=record):
            reply = await bridge.command(translate.measure_request(record))
            state = MeasureState.RUNNING if reply.accepted else MeasureState.REFUSED
            return ev.MatrixMeasured(
                record=replace(record, state=state, reason=reply.reason, start_seq=reply.start_seq)
            )
        case ev.AskLoop():
            return await _loop(bridge, question)
        case ev.AskRamp():
            return await _ramp(bridge, question)


def why_not(effects: tuple[Effect, ...], state: TrackerState) -> Exception | None:
    """Return what whoever gave a command should know of the RTC's answer to it, or None."""
    for effect in effects:
        match effect:
            case ev.AskMeasurement(record=asked):
                record = state.measurement(asked.id)
                if record is not None and record.state is MeasureState.REFUSED:
                    return CommandError(f"the RTC refused: {record.reason}")
                if record is not None and record.state is MeasureState.FAILED:
                    return LinkError(record.reason)
            case ev.AskLoop(id=command) | ev.AskRamp(id=command):
                last = state.loop_command
                if last is not None and last.id == command:
                    return _refusal(last.state, last.reason)
            case _:
                pass
    return None


def _refusal(outcome: CommandState, reason: str) -> Exception | None:
    match outcome:
        case CommandState.REFUSED:
            return CommandError(f"the RTC refused: {reason}")
        case CommandState.FAILED:
            return LinkError(reason)
        case _:
            return None


async def _dither(bridge: RtcPort, question: ev.AskDither) -> Event:
    dither = question.dither
    reply = await bridge.command(
        DitherRequest(
            id=dither.id,
            kind=DitherKind(dither.kind.value),
            modes=dither.modes,
            amplitude_m=dither.amplitude_m,
            frequency_hz=dither.frequency_hz or None,
            duration_s=dither.duration_s,
            seed=dither.seed,
        )
    )
    return ev.DitherAnswered(
        id=dither.id, accepted=reply.accepted, reason=reply.reason, start_seq=reply.start_seq
    )


async def _no_dither(bridge: RtcPort, command: str) -> None:
    reply = await bridge.command(DitherStop(id=command))
    if not reply.accepted:
        raise CommandError(f"the RTC did not stop the dither: {reply.reason}")


async def _loop(bridge: RtcPort, question: ev.AskLoop) -> Event:
    wish = {None: None, True: Loop.CLOSED, False: Loop.OPEN}[question.closed]
    reply = await bridge.command(
        LoopRequest(
            id=question.id,
            loop=wish,
            gains=question.gains,
            leak=question.leak,
            n_controlled=question.n_controlled,
        )
    )
    return ev.LoopAnswered(id=question.id, accepted=reply.accepted, reason=reply.reason)


async def _ramp(bridge: RtcPort, question: ev.AskRamp) -> Event:
    reply = await bridge.command(
        RampRequest(
            id=question.id,
            groups=question.groups,
            gains=question.gains,
            frames_per_gain=question.frames_per_gain,
        )
    )
    return ev.LoopAnswered(id=question.id, accepted=reply.accepted, reason=reply.reason)
