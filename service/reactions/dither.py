"""The dither's life: accepted, playing, ended, lost on its way to the mirror."""

from __future__ import annotations

from dataclasses import replace

from service import events as ev
from service.reactions.dither_choice import total_m
from service.reactions.dither_unwanted import ROUNDING
from service.reactions.journal import logged, with_alarm, without_alarm
from service.reactions.policy import SECOND_NS
from service.state import DitherView, Level, RtcView, TrackerState

SILENT_S = 1.0
"""Of frames without the dither, before it is missed."""

PATIENCE_S = 1.5
"""Of frames without it, before another is asked for; doubled each time, for one that is late."""

LONGEST_PATIENCE_S = 60.0

_ON_ITS_WAY_S = 2.0
"""For a status made before the dither began, where it does not tell its own frame."""

_SAME_LINE_HZ = 2.5

DITHER_LOST = "dither-lost"


def on_dither(state: TrackerState, event: ev.DitherAnswered, now_ns: int) -> TrackerState:
    """Note when the dither starts, or why it does not."""
    if state.dither is None or state.dither.id != event.id:
        return state
    if event.accepted:
        state = replace(
            state, dither=replace(state.dither, start_seq=event.start_seq, asked_ns_utc=now_ns)
        )
        text = f"{event.id} starts at frame {event.start_seq}"
        return logged(without_alarm(state, "dither", now_ns), "dither.started", text, now_ns)
    retries = state.retries.later(dither_ns_utc=now_ns + 10 * SECOND_NS)
    state = replace(state, dither=None, retries=retries)
    return with_alarm(state, "dither", f"the RTC refused the dither: {event.reason}", now_ns)


def on_vibrations(state: TrackerState, event: ev.Vibrations, now_ns: int) -> TrackerState:
    """Note where the slopes vibrate; the next dither keeps clear of it."""
    before, lines = state.vibrations_hz, event.lines_hz
    state = replace(state, vibrations_hz=lines)
    # a line between two bins of the spectrum shows now in one, now in the other
    near = (any(abs(line - known) < _SAME_LINE_HZ for known in before) for line in lines)
    if all(near):
        return state
    text = f"vibrations at {', '.join(f'{line:.0f}' for line in lines)} Hz"
    return logged(state, "vibrations", text, now_ns)


def follow_status(state: TrackerState, rtc: RtcView, now_ns: int) -> TrackerState:
    """Compare the dither that should run with the one the RTC's status shows."""
    dither = state.dither
    if dither is None or dither.start_seq is None:
        return state
    if rtc.dither_id == dither.id:
        return _corrected(state, dither, rtc.dither, now_ns)
    elapsed_s = (now_ns - dither.asked_ns_utc) / SECOND_NS
    if rtc.seq < dither.start_seq if rtc.seq >= 0 else elapsed_s <= _ON_ITS_WAY_S:
        return state
    played_s = (rtc.seq - dither.start_seq) / rtc.frame_rate_hz if rtc.seq >= 0 else elapsed_s
    told_to_stop = dither.id == state.dithering.stopped_id
    # a status a second old may be the first to show the end
    if told_to_stop or played_s >= dither.duration_s - SILENT_S:
        dithering = replace(state.dithering, ended_ns_utc=now_ns)
        state = replace(state, dither=None, dithering=dithering)
        state = without_alarm(state, DITHER_LOST, now_ns)
        return logged(state, "dither.ended", f"{dither.id} has ended", now_ns)
    text = f"the RTC's status shows no {dither.id} although it was accepted: it is asked for again"
    wait_s = 0.0 if state.dither_losses == 0 else _patience_s(state)
    retries = state.retries.later(dither_ns_utc=now_ns + round(wait_s * SECOND_NS))
    state = replace(state, retries=retries)
    return _lost(state, dither, text, now_ns)


def on_silence(state: TrackerState, event: ev.DitherSilent, now_ns: int) -> TrackerState:
    """Miss a dither that the frames do not show, whatever the status says; then ask anew.

    The frames have the last word. One the RTC only applies late comes in time for a longer
    patience.
    """
    dither = state.dither
    if dither is None or dither.id != event.id:
        return state
    text = (
        f"the RTC accepted {dither.id}, and for {event.silent_s:.1f} s its frames have held none "
        "of it: α is not measured"
    )
    if event.silent_s < _patience_s(state):
        return with_alarm(state, DITHER_LOST, text, now_ns)
    return _lost(state, dither, text, now_ns)


def _corrected(
    state: TrackerState, asked: DitherView, running: DitherView | None, now_ns: int
) -> TrackerState:
    """Take the RTC's word on what it plays, where that is not what was asked for.

    It is true, and not for that tolerated: one too strong is stopped.
    """
    if running is None:
        return state
    running = replace(running, asked_ns_utc=asked.asked_ns_utc, window_s=asked.window_s)
    if running == asked:
        return state
    if total_m(running) > ROUNDING * max(total_m(asked), state.dithering.budget_m):
        state = replace(state, dithering=replace(state.dithering, loud_id=running.id, loud_text=""))
    text = (
        f"{asked.id}: the RTC plays modes {running.modes}, {running.frequency_hz} Hz, "
        f"{running.amplitude_m} m from frame {running.start_seq}; asked for were modes "
        f"{asked.modes}, {asked.frequency_hz} Hz, {asked.amplitude_m} m from {asked.start_seq}"
    )
    return logged(replace(state, dither=running), "dither.other", text, now_ns, Level.WARNING)


def _lost(state: TrackerState, dither: DitherView, text: str, now_ns: int) -> TrackerState:
    state = with_alarm(state, DITHER_LOST, text, now_ns)
    state = logged(state, "dither.lost", text, now_ns, Level.WARNING)
    return replace(state, dither=None, dither_lost=dither.id, dither_losses=state.dither_losses + 1)


def _patience_s(state: TrackerState) -> float:
    return min(PATIENCE_S * 2.0**state.dither_losses, LONGEST_PATIENCE_S)


def found_again(state: TrackerState, now_ns: int) -> TrackerState:
    """Return the state after a window that held the dither, or when none is wanted any more."""
    state = replace(state, dither_lost=None, dither_losses=0)
    return without_alarm(state, DITHER_LOST, now_ns)
