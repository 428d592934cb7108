"""A dither's life: accepted, playing, ended, lost on its way to the mirror, or not wanted."""

from __future__ import annotations

from dataclasses import replace

from service.tracking import events as ev
from service.tracking.activity import GONE_WITHIN_S
from service.tracking.alarms import logged, with_alarm, without_alarm
from service.tracking.dither_plan import OUR_DITHERS, OWN_DITHER, budget_m, total_m
from service.tracking.events import AskNoDither, Step
from service.tracking.loop import DitherKind, DitherView, RtcView
from service.tracking.measuring import cut_off
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.state import Level, TrackerState

NOT_STOPPED = "dither-not-stopped"
"""Alarm while a dither goes on that was asked to stop."""

OVER_BUDGET = "dither-over-budget"
"""Alarm from when the RTC plays a dither stronger than it may until it plays one as it may."""

NOT_AS_ASKED = "dither-not-as-asked"
"""Alarm while the frames hold another dither than the one that was asked for."""

MEASURED = 1.1
"""What a second of frames may hold more than is allowed, before it is too strong."""

ROUNDING = 1.001
"""What a dither may be stronger by than what was asked for."""

CALM_S = 60.0
"""After one that was too strong, before another is tried."""

TELL_EVERY_S = 2.0


def own_sine(dither: DitherView) -> bool:
    """Return whether a dither is one that the service has chosen by itself."""
    return dither.id.startswith(OWN_DITHER) and dither.kind is DitherKind.SINE


def without_unwanted(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Ask the RTC, again and again, to stop what it should not play."""
    running, loud = rtc.dither_id, _too_strong(state, rtc, policy)
    why = loud or _why_unwanted(state, rtc, policy)
    if running is None or why is None:
        return _forgiven(gone(state, now_ns), rtc, policy, now_ns), ()
    if state.dithering.unwanted_id != running:
        state = _met(state, running, now_ns)
        state = state if loud is None else _alarmed(state, running, loud, now_ns)
    if now_ns - state.dithering.unwanted_since_ns_utc >= GONE_WITHIN_S * SECOND_NS:
        text = (
            f"{why}, and the RTC goes on playing {running}: it is asked every {TELL_EVERY_S:.0f} s "
            "to stop it; stop it at the RTC"
        )
        state = with_alarm(state, NOT_STOPPED, text, now_ns)
    if now_ns - state.dithering.told_ns_utc < TELL_EVERY_S * SECOND_NS:
        return state, ()
    return told_to_stop(state, now_ns), (AskNoDither(),)


def on_measured(state: TrackerState, event: ev.DitherMeasured, policy: Policy, now_ns: int) -> Step:
    """Name a dither that the frames show to be otherwise than asked; stop one that is too strong.

    What the commands hold is what the mirror does, whatever the RTC's status says.
    """
    rtc, dither = state.rtc, state.dither
    if not event.text:
        state = replace(state, dithering=replace(state.dithering, loud_text="", amiss_id=None))
        return without_alarm(without_alarm(state, NOT_AS_ASKED, now_ns), OVER_BUDGET, now_ns), ()
    if rtc is None or dither is None or dither.id != event.id:
        return state, ()
    dithering = replace(state.dithering, amiss_id=event.id, amiss_m=event.found_m)
    state = replace(state, dithering=dithering)
    most_m = budget_m(rtc, policy)
    if event.found_m <= MEASURED * max(event.asked_m, most_m):
        text = f"{event.text}; look at the RTC's dither"
        return with_alarm(state, NOT_AS_ASKED, text, now_ns), ()
    loud = f"{event.text}; the budget is {1e9 * most_m:.3g} nm"
    state = cut_off(state, f"its dither was too strong: {event.text}", now_ns)
    state = _met(state, event.id, now_ns)
    dithering = replace(state.dithering, loud_id=event.id, loud_text=loud)
    state = _alarmed(replace(state, dithering=dithering), event.id, loud, now_ns)
    return told_to_stop(state, now_ns), (AskNoDither(),)


def stopped(state: TrackerState, dither_id: str, now_ns: int) -> TrackerState:
    """Note that the RTC is asked to stop a dither, and since when."""
    if state.dithering.stopped_id == dither_id:
        return state
    dithering = replace(state.dithering, stopped_id=dither_id, ended_ns_utc=None)
    return replace(state, dithering=replace(dithering, stopped_ns_utc=now_ns))


def told_to_stop(state: TrackerState, now_ns: int) -> TrackerState:
    """Return the state in which the RTC has just been told to play no dither."""
    return replace(state, dithering=replace(state.dithering, told_ns_utc=now_ns))


def gone(state: TrackerState, now_ns: int) -> TrackerState:
    """Return the state in which no unwanted dither plays, or nobody knows of one."""
    if state.dithering.unwanted_id is None:
        return state
    state = replace(state, dithering=replace(state.dithering, unwanted_id=None))
    return without_alarm(state, NOT_STOPPED, now_ns)


def calm_ns_utc(state: TrackerState) -> int:
    """Return until when no dither is tried because the last one was too strong; 0: none was."""
    loud_ns = state.dithering.loud_ns_utc
    return loud_ns and loud_ns + round(CALM_S * SECOND_NS)


def _met(state: TrackerState, running: str, now_ns: int) -> TrackerState:
    """Return the state that knows of a dither that must go, and follows it no more."""
    state = stopped(state, running, now_ns)
    if state.dither is not None and state.dither.id == running:
        state = replace(state, dither=None)
    dithering = replace(state.dithering, unwanted_id=running, unwanted_since_ns_utc=now_ns)
    return replace(state, dithering=dithering)


def _alarmed(state: TrackerState, running: str, loud: str, now_ns: int) -> TrackerState:
    text = (
        f"{loud}: it was told to stop {running}, and another is tried after {CALM_S:.0f} s; look "
        "at the RTC's dither, or stop the dither to do without"
    )
    state = replace(state, dithering=replace(state.dithering, loud_ns_utc=now_ns))
    return with_alarm(state, OVER_BUDGET, text, now_ns)


def _forgiven(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> TrackerState:
    """End the alarm of a dither too strong once one is played as it may, or none is wanted."""
    by_frames = bool(state.dithering.loud_text)
    fine = (
        not by_frames
        and state.dither is not None
        and rtc.dither is not None
        and rtc.dither.id == state.dither.id
    )
    given_up = state.dither_stopped or not policy.dither_enabled
    if given_up:
        state = without_alarm(state, NOT_AS_ASKED, now_ns)
    return without_alarm(state, OVER_BUDGET, now_ns) if fine or given_up else state


def _too_strong(state: TrackerState, rtc: RtcView, policy: Policy) -> str | None:
    """Return why a dither that is played costs more than it may, or None.

    An operator's own may cost more than the budget, but not more than was asked for.
    """
    running = rtc.dither
    if running is None:
        return None
    found_m, most_m = total_m(running), budget_m(rtc, policy)
    over = own_sine(running) and found_m > ROUNDING * most_m
    if not over and running.id != state.dithering.loud_id:
        return None
    if running.id == state.dithering.loud_id and state.dithering.loud_text:
        return state.dithering.loud_text
    return (
        f"the RTC plays a dither of {1e9 * found_m:.3g} nm RMS in all, more than the budget of "
        f"{1e9 * most_m:.3g} nm"
    )


def _why_unwanted(state: TrackerState, rtc: RtcView, policy: Policy) -> str | None:
    running = rtc.dither_id
    if running is None or not running.startswith(OUR_DITHERS):
        return None
    wanted = state.dither is not None and state.dither.id == running
    if state.dither_stopped and not wanted:
        return "the operator wants no dither"
    if not policy.dither_enabled and state.dither is None and running.startswith(OWN_DITHER):
        return "the settings forbid a dither"
    return None


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
