"""The dither: asked for when it is due, adopted, playing, ended, lost, unwanted or too strong.

A dither that runs already, from before a restart of the service or in a replayed night, is as good
as a new one, and the RTC plays no second one beside it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.control.dither import forgetting_mean, measured_ratio
from service.estimation.lockin import WindowEstimate
from service.estimation.random_dither import RandomEstimate
from service.tracking import alarms, dither_plan, mode_proof
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.activity import GONE_WITHIN_S
from service.tracking.dither_modes import N_LINES
from service.tracking.dither_plan import Wish
from service.tracking.dither_request import (
    NOISY_DITHER,
    OWN_DITHER,
    Dither,
    DitherPhase,
    Precision,
    on_vibrations,
    own_sine,
    plan_dither,
    proves,
    total_m,
    why_unusable,
)
from service.tracking.policy import SECOND_NS
from service.tracking.state import Level
from service.tracking.turn import Turn
from service.wire import DitherRequest, DitherStatus, DitherStop, Reply, Status

MEASURED = 1.1
"""What a second of frames may hold more than is allowed, before it is too strong."""

CALM_S = 60.0
"""After one that was too strong, or that nothing answered, before another is tried."""

TELL_EVERY_S = 2.0

SILENT_S = 1.0
"""Of frames without the dither, before it is missed."""

PATIENCE_S = 1.5
"""Of frames without it, before another is asked for; doubled each time, for one that is late."""

LONGEST_PATIENCE_S = 60.0

SOON_OVER_S = 2.0
"""A dither that ends by itself so soon is not worth a command."""

STOPPED_WITHIN_S = 5.0
"""An RTC still playing a dither so long after it was asked to stop does not stop dithers."""

MEMORY_S = 600.0
"""Of the mean cost that is shown."""

_ON_ITS_WAY_S = 2.0
"""For a status made before the dither began, where it does not tell its own frame."""


def choose_dither(turn: Turn, rtc: Status) -> None:
    """Dither as much and as often as the policy asks while the loop is closed, its matrix known."""
    _account(turn, rtc)
    stop_unwanted(turn, rtc)
    dither = turn.dither
    if dither is not None and not own_sine(dither.request):
        _show(turn, DitherPhase.OPERATOR, f"{dither.id} runs")
        return
    forbidden = dither_plan.why_none(turn, rtc)
    if forbidden is not None:
        _show(turn, DitherPhase.OFF, forbidden)
        return
    mode_proof.give_up(turn, rtc)
    wish, plan = dither_plan.wanted(turn, rtc)
    turn.dithering = replace(
        turn.dithering,
        plan=plan,
        next_ns_utc=wish.next_ns_utc if wish.next_ns_utc > turn.now_ns else None,
        avoided_hz=wish.choice.avoid_hz,
    )
    _show(turn, wish.phase, wish.reason)
    if dither is not None:
        _end_when_done(turn, rtc, dither, wish)
    elif not _adopt(turn, rtc):
        _begin(turn, rtc, wish)


def ask_for(turn: Turn, dither: Dither) -> None:
    """Ask for a dither and follow it."""
    turn.dither = dither
    turn.ask(ev.Ask(request=dither.request))


def ask_to_stop(turn: Turn) -> None:
    """Ask the RTC to play no dither; two reasons at once are one request."""
    stop = ev.Ask(request=DitherStop(id=f"stop-{turn.now_ns}"))
    if stop not in turn.effects:
        turn.ask(stop)


def drop(turn: Turn) -> None:
    """Follow no dither any more."""
    turn.dither = None


def make_way(turn: Turn) -> None:
    """Stop the dither that runs, if one does; follow and adopt it no more."""
    running = turn.dither.id if turn.dither is not None else turn.rtc and turn.rtc.dither_id
    if running:
        _note_stop(turn, running)
        turn.dither = None
        ask_to_stop(turn)


def allow(turn: Turn, *, allowed: bool = True) -> None:
    """Let the service dither by itself, or not any more."""
    turn.state = replace(turn.state, dither_stopped=not allowed)


def stop_by_operator(turn: Turn, _: cmd.StopDither) -> None:
    """Stop the dither, and start none until told to."""
    drop(turn)
    allow(turn, allowed=False)
    found_again(turn)
    tell_to_stop(turn)
    turn.log("dither.stopped", "by the operator")


def tell_to_stop(turn: Turn) -> None:
    """Ask the RTC to end a dither that nobody wants, which is not followed."""
    turn.dithering = replace(turn.dithering, told_ns_utc=turn.now_ns)
    ask_to_stop(turn)


def on_answer(turn: Turn, request: DitherRequest, reply: Reply) -> None:
    """Note when the dither starts, or why it does not."""
    if turn.dither is None or turn.dither.id != request.id:
        return
    if reply.accepted:
        turn.dither = replace(turn.dither, start_seq=reply.start_seq, asked_ns_utc=turn.now_ns)
        turn.calm(alarms.NO_DITHER)
        text = f"{request.id} starts at frame {reply.start_seq}"
        turn.log("dither.started", text, _level(request))
        return
    turn.put_off(dither_s=10.0)
    turn.dither = None
    turn.alarm(alarms.NO_DITHER, f"the RTC refused the dither: {reply.reason}")


def on_stop_answer(turn: Turn, reply: Reply) -> None:
    """Put on record that the RTC goes on; it is asked again for as long as it must be."""
    if not reply.accepted:
        turn.warn("job.failed", f"the RTC did not stop the dither: {reply.reason}")


def follow_status(turn: Turn, rtc: Status) -> None:
    """Compare the dither that should run with the one the RTC's status shows."""
    dither = turn.dither
    if dither is None or dither.start_seq is None:
        return
    if rtc.dither is not None and rtc.dither_id == dither.id:
        _correct(turn, dither, rtc.dither)
        return
    elapsed_s = (turn.now_ns - dither.asked_ns_utc) / SECOND_NS
    if rtc.seq is None:
        begun, played_s = elapsed_s > _ON_ITS_WAY_S, elapsed_s
    else:
        begun = rtc.seq >= dither.start_seq
        played_s = (rtc.seq - dither.start_seq) / rtc.frame_rate_hz
    if not begun:
        return
    asked_to_stop = dither.id == turn.dithering.stopped_id
    # a status a second old may be the first to show the end
    if asked_to_stop or played_s >= dither.request.duration_s - SILENT_S:
        turn.dithering = replace(turn.dithering, ended_ns_utc=turn.now_ns)
        turn.dither = None
        turn.calm(alarms.DITHER_LOST)
        turn.log("dither.ended", f"{dither.id} has ended", _level(dither.request))
        return
    if turn.state.dither_losses:
        turn.put_off(dither_s=_patience_s(turn))
    text = f"the RTC's status shows no {dither.id} although it was accepted: it is asked for again"
    _lose(turn, dither, text)


def on_silence(turn: Turn, event: ev.DitherSilent) -> None:
    """Miss a dither that the frames do not show, whatever the status says; then ask anew.

    The frames have the last word. One the RTC only applies late comes in time for a longer
    patience.
    """
    dither = turn.dither
    if dither is None or dither.id != event.id:
        return
    text = (
        f"the RTC accepted {dither.id}, and for {event.silent_s:.1f} s its frames have held none "
        "of it: α is not measured"
    )
    if event.silent_s < _patience_s(turn):
        turn.alarm(alarms.DITHER_LOST, text)
    else:
        _lose(turn, dither, text)


def found_again(turn: Turn) -> None:
    """Miss it no more: a window held the dither, or none is wanted any more."""
    turn.state = replace(turn.state, dither_lost=None, dither_losses=0)
    turn.calm(alarms.DITHER_LOST)


def learn(turn: Turn, estimate: WindowEstimate | RandomEstimate) -> None:
    """Take over from an accepted window what it says of the precision of windows."""
    rtc, known = turn.rtc, turn.dithering.precision
    accepted = turn.state.windows_accepted > turn.before.windows_accepted
    if isinstance(estimate, RandomEstimate) or not accepted or rtc is None:
        return
    if len(estimate.modes) > N_LINES:
        return  # not the modes that tell most of α
    if estimate.dither_m > 0.0:
        ratio = measured_ratio(
            estimate.covariance, estimate.dither_m, estimate.window_s, rtc.magnitude
        )
        n_windows = 0 if known is None else known.n_windows
        mean = forgetting_mean(None if known is None else known.ratio, n_windows, ratio)
        precision = Precision(ratio=mean, n_windows=n_windows + 1)
        turn.dithering = replace(turn.dithering, precision=precision)


def why_too_strong(turn: Turn, event: ev.DitherMeasured) -> str | None:
    """Name a dither that the frames show to be otherwise than asked; return why it must go.

    What the commands hold is what the mirror does, whatever the RTC's status says.
    """
    rtc, dither = turn.rtc, turn.dither
    if not event.text:
        turn.dithering = replace(turn.dithering, loud_text="", amiss_id=None)
        turn.calm(alarms.NOT_AS_ASKED)
        turn.calm(alarms.OVER_BUDGET)
        return None
    if rtc is None or dither is None or dither.id != event.id:
        return None
    turn.dithering = replace(turn.dithering, amiss_id=event.id, amiss_m=event.found_m)
    most_m = dither_plan.budget_m(rtc, turn.policy)
    if event.found_m > MEASURED * max(event.asked_m, most_m):
        return f"{event.text}; the budget is {1e9 * most_m:.3g} nm"
    turn.alarm(alarms.NOT_AS_ASKED, f"{event.text}; look at the RTC's dither")
    return None


def stop_too_strong(turn: Turn, dither_id: str, loud: str) -> None:
    """Stop a dither that the frames show to be too strong."""
    _meet_unwanted(turn, dither_id)
    turn.dithering = replace(turn.dithering, loud_id=dither_id, loud_text=loud)
    _blame(turn, dither_id, loud)
    tell_to_stop(turn)


def stop_unanswered(turn: Turn, text: str) -> None:
    """End a dither that the slopes do not answer, and try another in a while."""
    if turn.dither is not None:
        ended = f"{turn.dither.id} was ended, and another is tried after {CALM_S:.0f} s"
        turn.alarm(alarms.MIRROR_SILENT, f"the mirror does not answer: {text}; {ended}")
        turn.put_off(dither_s=CALM_S)
        make_way(turn)


def stop_unwanted(turn: Turn, rtc: Status) -> None:
    """Ask the RTC, again and again, to stop what it should not play."""
    running, loud = rtc.dither_id, dither_plan.too_strong(turn, rtc)
    why = loud or dither_plan.why_unwanted(turn, rtc)
    if running is None or why is None:
        forget_unwanted(turn)
        _forgive(turn, rtc)
        return
    if turn.dithering.unwanted_id != running:
        _meet_unwanted(turn, running)
        if loud is not None:
            _blame(turn, running, loud)
    if turn.now_ns - turn.dithering.stopped_ns_utc >= GONE_WITHIN_S * SECOND_NS:
        text = (
            f"{why}, and the RTC goes on playing {running}: it is asked every {TELL_EVERY_S:.0f} s "
            "to stop it; stop it at the RTC"
        )
        turn.alarm(alarms.NOT_STOPPED, text)
    if turn.now_ns - turn.dithering.told_ns_utc >= TELL_EVERY_S * SECOND_NS:
        tell_to_stop(turn)


def forget_unwanted(turn: Turn) -> None:
    """Note that no unwanted dither plays, or nobody knows of one."""
    if turn.dithering.unwanted_id is not None:
        turn.dithering = replace(turn.dithering, unwanted_id=None)
        turn.calm(alarms.NOT_STOPPED)


def _begin(turn: Turn, rtc: Status, wish: Wish) -> None:
    """Ask for a dither if it is time, and nothing left behind is in its way."""
    loud_ns = turn.dithering.loud_ns_utc
    if loud_ns and turn.now_ns < loud_ns + round(CALM_S * SECOND_NS):
        _show(turn, DitherPhase.OFF, "the RTC has played the last one too strong")
        return
    if turn.now_ns < turn.state.no_dither_before_ns_utc:
        return
    if rtc.dither_id is not None and rtc.dither_id.startswith((OWN_DITHER, NOISY_DITHER)):
        # left behind by this service: its window of another length, or to stop
        turn.put_off(dither_s=2.0)
        make_way(turn)
    elif turn.now_ns >= wish.next_ns_utc and not dither_plan.awaits_a_result(turn, wish):
        _ask(turn, rtc, wish)


def _ask(turn: Turn, rtc: Status, wish: Wish) -> None:
    dither = plan_dither(rtc, turn.policy, turn.now_ns, choice=wish.choice)
    reason = why_unusable(dither, rtc, turn.policy)
    if reason is not None:
        text = (
            f"no usable dither: {reason}; a dither of random signs needs no lines, and α can be "
            "measured with one"
        )
        turn.put_off(dither_s=60.0)
        turn.alarm(alarms.NO_DITHER, text)
        return
    shaken = on_vibrations(dither, wish.choice.avoid_hz)
    if shaken and dither.frequency_hz != turn.dithering.lines_hz:
        text = f"lines at {shaken} Hz are on vibrations: there is no room, or the settings fix them"
        turn.warn("dither.on-vibrations", text)
    if wish.phase is DitherPhase.PROVE:
        mode_proof.begin(turn, wish.choice.modes)
    turn.dithering = replace(
        turn.dithering,
        lines_hz=wish.choice.last_hz if wish.choice.modes else dither.frequency_hz,
        results_due=turn.state.windows_accepted + wish.choice.n_windows,
        ended_ns_utc=None,
        next_ns_utc=None,
    )
    ask_for(turn, dither)


def _end_when_done(turn: Turn, rtc: Status, dither: Dither, wish: Wish) -> None:
    """Stop a dither that has done its work, or is no longer the one to ask for."""
    left_s = dither.request.duration_s - (turn.now_ns - dither.asked_ns_utc) / SECOND_NS
    deaf = dither.id == turn.dithering.stopped_id
    if dither.start_seq is None or left_s < SOON_OVER_S or deaf:
        return
    seen = turn.known is not None and turn.known.window_ns_utc > dither.asked_ns_utc
    pause_s = (wish.next_ns_utc - turn.now_ns) / SECOND_NS
    done = seen and wish.phase is DitherPhase.SPARSE and pause_s >= dither_plan.SHORTEST_PAUSE_S
    weak = wish.phase is DitherPhase.ACQUIRE and 2.0 * total_m(dither.request) < wish.choice.total_m
    moved = dither_plan.why_moved(dither, rtc, turn.policy, wish.choice.shunned)
    if wish.phase is DitherPhase.PROVE and not proves(dither.request):
        moved = wish.reason
    if done or weak or moved:
        # the next one must not overtake the command to stop
        turn.put_off(dither_s=1.0)
        weakness = "" if done or moved else " is too weak"
        text = f"{dither.id}{weakness}: {moved or wish.reason}"
        turn.log("dither.stopped", text, Level.INFO if moved or weakness else Level.DEBUG)
        make_way(turn)


def _adopt(turn: Turn, rtc: Status) -> bool:
    """Take over a dither that runs, if it can be read; return whether there is one."""
    if rtc.dither is None or rtc.dither_id == turn.state.dither_lost:
        return False
    running, begun_seq, dithering = rtc.dither.request, rtc.dither.start_seq, turn.dithering
    over = own_sine(running) and total_m(running) > dither_plan.ROUNDING * dithering.budget_m
    asked_to_stop = running.id == dithering.stopped_id
    # a recorded night stops nothing: what it goes on playing is read all the same
    heard_ns = dithering.stopped_ns_utc + round(STOPPED_WITHIN_S * SECOND_NS)
    if turn.now_ns < heard_ns if asked_to_stop else over:
        return False
    for window_s in dither_plan.window_lengths_s(turn.policy):
        dither = Dither(
            request=running, start_seq=begun_seq, asked_ns_utc=turn.now_ns, window_s=window_s
        )
        if why_unusable(dither, rtc, turn.policy) is None:
            turn.dither = dither
            turn.calm(alarms.NO_DITHER)
            turn.log("dither.adopted", f"{running.id} runs since frame {begun_seq}")
            return True
    return False


def _level(request: DitherRequest) -> Level:
    """Return how loudly a dither is told of: the service's own come and go all night."""
    return Level.DEBUG if request.id.startswith(OWN_DITHER) else Level.INFO


def _account(turn: Turn, rtc: Status) -> None:
    """Keep count of what the dither costs, and of who has looked at α last."""
    dithering, known, dither = turn.dithering, turn.known, turn.dither
    followed = dither is not None and dither.start_seq is not None
    # what nobody has asked for costs as much
    playing = dither if followed else rtc.dither
    power = 0.0 if playing is None else total_m(playing.request) ** 2
    since_ns = turn.now_ns if dithering.seen_ns_utc is None else dithering.seen_ns_utc
    share = -np.expm1(-max(turn.now_ns - since_ns, 0) / (MEMORY_S * SECOND_NS))
    passive_ns = dithering.passive_ns_utc
    if known is not None and known.window_ns_utc and known.arrived_ns_utc > known.window_ns_utc:
        passive_ns = known.arrived_ns_utc
    turn.dithering = replace(
        dithering,
        budget_m=dither_plan.budget_m(rtc, turn.policy),
        mean_square_m2=float(dithering.mean_square_m2 * (1.0 - share) + power * share),
        seen_ns_utc=turn.now_ns,
        passive_ns_utc=passive_ns,
    )


def _show(turn: Turn, phase: DitherPhase, reason: str) -> None:
    none_follows = phase in {DitherPhase.OFF, DitherPhase.OPERATOR}
    next_ns = None if none_follows else turn.dithering.next_ns_utc
    turn.dithering = replace(turn.dithering, phase=phase, reason=reason, next_ns_utc=next_ns)


def _correct(turn: Turn, asked: Dither, shown: DitherStatus) -> None:
    """Take the RTC's word on what it plays, where that is not what was asked for.

    It is true, and not for that tolerated: one too strong is stopped.
    """
    running = replace(asked, request=shown.request, start_seq=shown.start_seq)
    if running == asked:
        return
    plays, meant = running.request, asked.request
    if total_m(plays) > dither_plan.ROUNDING * max(total_m(meant), turn.dithering.budget_m):
        turn.dithering = replace(turn.dithering, loud_id=running.id, loud_text="")
    text = (
        f"{asked.id}: the RTC plays modes {plays.modes}, {running.frequency_hz} Hz, "
        f"{plays.amplitude_m} m from frame {running.start_seq}; asked for were modes "
        f"{meant.modes}, {asked.frequency_hz} Hz, {meant.amplitude_m} m from {asked.start_seq}"
    )
    turn.dither = running
    turn.warn("dither.other", text)


def _lose(turn: Turn, dither: Dither, text: str) -> None:
    turn.alarm(alarms.DITHER_LOST, text)
    turn.warn("dither.lost", text)
    turn.dither = None
    losses = turn.state.dither_losses + 1
    turn.state = replace(turn.state, dither_lost=dither.id, dither_losses=losses)


def _patience_s(turn: Turn) -> float:
    return min(PATIENCE_S * 2.0**turn.state.dither_losses, LONGEST_PATIENCE_S)


def _note_stop(turn: Turn, dither_id: str) -> None:
    """Note that the RTC is asked to stop a dither, and since when."""
    if turn.dithering.stopped_id != dither_id:
        turn.dithering = replace(
            turn.dithering, stopped_id=dither_id, ended_ns_utc=None, stopped_ns_utc=turn.now_ns
        )


def _meet_unwanted(turn: Turn, running: str) -> None:
    """Note that a dither must go, and follow it no more."""
    _note_stop(turn, running)
    if turn.dither is not None and turn.dither.id == running:
        turn.dither = None
    turn.dithering = replace(turn.dithering, unwanted_id=running)


def _blame(turn: Turn, running: str, loud: str) -> None:
    text = (
        f"{loud}: it was told to stop {running}, and another is tried after {CALM_S:.0f} s; look "
        "at the RTC's dither, or stop the dither to do without"
    )
    turn.dithering = replace(turn.dithering, loud_ns_utc=turn.now_ns)
    turn.alarm(alarms.OVER_BUDGET, text)


def _forgive(turn: Turn, rtc: Status) -> None:
    """End the alarm of a dither too strong once one is played as it may, or none is wanted."""
    own = turn.dither
    by_frames = bool(turn.dithering.loud_text)
    fine = not by_frames and own is not None and rtc.dither_id == own.id
    given_up = turn.state.dither_stopped or not turn.policy.dither_enabled
    if given_up:
        turn.calm(alarms.NOT_AS_ASKED)
    if fine or given_up:
        turn.calm(alarms.OVER_BUDGET)
