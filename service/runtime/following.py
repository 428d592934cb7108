"""What the supervisor makes of streams and state between two events: no clock, no task, no link.

Apart from the tasks, so that a simulated night runs the very same service.
"""

from __future__ import annotations

from dataclasses import replace

from service import events as ev
from service.errors import ModelError
from service.events import Event
from service.reactions.alarms import Act, forbidding
from service.reactions.dither import SILENT_S
from service.reactions.policy import Policy
from service.runtime.streams import Streams, shape_mismatch, troubles, with_dither, with_rtc
from service.state import Level, TrackerState


def followed(
    streams: Streams, state: TrackerState, policy: Policy
) -> tuple[Streams, ev.Noted | None]:
    """Keep the streaming estimators in step with the RTC and the dither.

    Returns the streams, and what to put on record when the dither cannot be read.
    """
    if forbidding(state, Act.ASK) is not None:
        return with_rtc(streams, None), None
    streams = with_rtc(streams, state.rtc)
    dither = state.dither
    try:
        return with_dither(streams, dither, policy.window_s), None
    except ModelError as error:
        unusable = None if dither is None else replace(dither, asked_ns_utc=0)
        note = ev.Noted(name="dither.unusable", text=str(error), level=Level.WARNING)
        return replace(streams, lock_in=None, random=None, dither=unusable), note


def news(was_silent_s: float, streams: Streams, state: TrackerState) -> list[Event]:
    """Return what blocks of telemetry have brought besides windows.

    A dither that should be in the frames is missed twice a second; ``was_silent_s`` is for how
    long it had been before these blocks.
    """
    found: list[Event] = []
    silent_s, dither = streams.dither_silent_s, streams.dither
    due = silent_s >= SILENT_S and int(2 * silent_s) > int(2 * was_silent_s)
    if dither is not None and due:
        found.append(ev.DitherSilent(id=dither.id, silent_s=silent_s))
    lines = () if streams.hearing is None else streams.hearing.lines_hz
    if streams.hearing is not None and lines != state.vibrations_hz:
        found.append(ev.Vibrations(lines_hz=lines))
    for name, trouble, over in troubles(streams):
        known = any(alarm.name == name for alarm in state.alarms)
        if (trouble is not None) is not known:
            text, t_ns = trouble or over, streams.heard_ns_utc
            found.append(ev.Trouble(name=name, text=text, over=known, t_ns_utc=t_ns))
    return found


def shape_news(streams: Streams, state: TrackerState) -> Event | None:
    """Return whether it has changed that the RTC's telemetry fits the instrument file, or None."""
    if state.rtc is None:
        return None
    reason = shape_mismatch(streams.description, state.rtc)
    known = any(alarm.name == "instrument-mismatch" for alarm in state.alarms)
    if (reason is not None) is known:
        return None
    text = reason or "the RTC's telemetry fits the instrument file again"
    return ev.Trouble(name="instrument-mismatch", text=text, over=known)
