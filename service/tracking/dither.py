"""Start, follow and stop the dither.

A dither that is already running, from before a restart of the service or in a replayed night, is
used like a new one. The RTC plays only one at a time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.control.dither import compute_precision_ratio, update_mean_ratio
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import RandomEstimate
from service.records.messages import Message, compose
from service.records.operations import Dither, DitherPhase, DitherPurpose, Precision
from service.records.state import Level, TrackerState
from service.tracking import dither_plan, dither_request, mode_proof
from service.tracking.dither_plan import WantedDither
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, present
from service.wire import DitherRequest, DitherStatus, DitherStop, Reply, Status

MAX_MEASURED_AMPLITUDE_RATIO = 1.1
"""Tolerated ratio of the amplitude measured in a second of frames to the permitted one."""

FAILED_DITHER_PAUSE_S = 60.0
"""Pause after a dither that was too strong or had no response, before another is tried."""

STOP_REQUEST_INTERVAL_S = 2.0

MISSING_DITHER_ALARM_S = 1.0
"""Duration of frames without the dither after which it is reported missing."""

FIRST_DITHER_RETRY_S = 1.5
"""Duration of frames without the dither after which another is requested; doubled each time, for an
RTC that begins late."""

MAX_DITHER_RETRY_S = 60.0

MIN_STOPPED_REMAINDER_S = 2.0
"""A dither that ends by itself within this time is not stopped by a command."""

STOP_TIMEOUT_S = 5.0
"""An RTC still playing a dither so long after it was asked to stop does not stop dithers."""

COST_AVERAGING_TIME_S = 600.0
"""Averaging time of the cost that is displayed."""

_STATUS_DELAY_S = 2.0
"""Time for a status made before the dither began to arrive, if it has no frame number."""


def choose_dither(context: StepContext) -> None:
    """Dither as much and as often as the policy asks while the loop is closed, its matrix known."""
    rtc, dither = present(context.rtc), context.dither
    _update_cost(context, rtc)
    if dither is not None and not dither_request.is_automatic_sine(dither.request, dither.purpose):
        _set_phase(context, DitherPhase.OPERATOR, f"{dither.id} runs")
        return
    forbidden = dither_plan.check_dither_allowed(context, rtc)
    if forbidden is not None:
        _set_phase(context, DitherPhase.OFF, forbidden)
        return
    mode_proof.give_up_unseen(context, rtc)
    wanted, plan = dither_plan.choose_next(context, rtc)
    context.dither_policy = replace(
        context.dither_policy,
        plan=plan,
        next_ns_utc=wanted.next_ns_utc if wanted.next_ns_utc > context.now_ns else None,
        avoided_hz=wanted.parameters.avoid_hz,
    )
    _set_phase(context, wanted.phase, wanted.reason)
    if dither is not None:
        _end_when_done(context, rtc, dither, wanted)
    # After a restart of the service its dither may still run: it is followed, not restarted.
    elif not _adopt(context, rtc):
        _begin(context, rtc, wanted)


def request_dither(context: StepContext, dither: Dither) -> None:
    """Ask for a dither and follow it."""
    context.dither = replace(dither, cause=context.cause)
    context.ask(ev.Ask(request=dither.request))


def request_stop(context: StepContext) -> None:
    """Ask the RTC to play no dither; two reasons at once are one request."""
    stop = ev.Ask(request=DitherStop(id=f"stop-{context.now_ns}"))
    # Two reasons in one step would otherwise send two commands.
    if stop not in context.effects:
        context.ask(stop)


def forget_dither(context: StepContext) -> None:
    """Follow no dither any more."""
    context.dither = None


def stop_running_dither(context: StepContext) -> None:
    """Stop the dither that runs, if one does; follow and adopt it no more."""
    dither, rtc = context.dither, context.rtc
    running = dither.id if dither is not None else rtc and rtc.dither_id
    if running:
        _note_stop(context, running)
        context.dither = None
        request_stop(context)


def allow_dither(context: StepContext, *, allowed: bool = True) -> None:
    """Let the service dither by itself, or not any more."""
    context.dithers = replace(context.dithers, stopped=not allowed)


def on_stop(context: StepContext, _: cmd.StopDither) -> None:
    """Stop the dither until it is ordered again."""
    forget_dither(context)
    allow_dither(context, allowed=False)
    note_found(context)
    stop_unfollowed(context)
    context.log("dither.stopped", "by the operator")


def stop_unfollowed(context: StepContext) -> None:
    """Ask the RTC to end a dither that is not needed and not followed."""
    context.dither_policy = replace(context.dither_policy, stop_asked_ns_utc=context.now_ns)
    request_stop(context)


def on_answer(context: StepContext, request: DitherRequest, reply: Reply) -> None:
    """Note when the dither starts, or why it does not."""
    if context.dither is None or context.dither.id != request.id:
        return
    if reply.accepted:
        context.dither = replace(
            context.dither, start_seq=reply.start_seq, asked_ns_utc=context.now_ns
        )
        text = f"{request.id} starts at frame {reply.start_seq}"
        context.log("dither.started", text, _level(context.dither))
        return
    context.put_off(dither_s=10.0)
    context.dither = None
    refused = compose("dither.refused", reply.reason)
    context.raise_alarm(alarms.NO_DITHER, refused)
    context.fail(str(refused))


def on_failure(context: StepContext, _: DitherRequest, __: str) -> None:
    """Forget a dither whose request did not reach the RTC, and request none for 5 s."""
    context.put_off(dither_s=5.0)
    context.dither = None


def on_stop_answer(context: StepContext, _: DitherStop, reply: Reply) -> None:
    """Put on record that the RTC goes on; it is asked again for as long as it must be."""
    if not reply.accepted:
        context.warn("job.failed", compose("dither.not-stopped", reply.reason))


def follow_status(context: StepContext, rtc: Status) -> None:
    """Compare the dither that should run with the one the RTC's status shows."""
    dither = context.dither
    if dither is None or dither.start_seq is None:
        return
    if rtc.dither is not None and rtc.dither_id == dither.id:
        _take_over_played(context, dither, rtc.dither)
        return
    elapsed_s = (context.now_ns - dither.asked_ns_utc) / SECOND_NS
    # Without a frame number in the status only the elapsed time shows whether the dither has begun.
    if rtc.seq is None:
        begun, played_s = elapsed_s > _STATUS_DELAY_S, elapsed_s
    else:
        begun = rtc.seq >= dither.start_seq
        played_s = (rtc.seq - dither.start_seq) / rtc.frame_rate_hz
    if not begun:
        return
    asked_to_stop = dither.id == context.dither_policy.stopped_id
    # a status a second old may be the first to show the end
    if asked_to_stop or played_s >= dither.request.duration_s - MISSING_DITHER_ALARM_S:
        context.dither_policy = replace(context.dither_policy, ended_ns_utc=context.now_ns)
        context.dither = None
        context.clear_alarm(alarms.DITHER_LOST)
        context.log("dither.ended", f"{dither.id} has ended", _level(dither))
        return
    # The first loss is retried at once; an RTC that begins late needs more time.
    if context.dithers.losses:
        context.put_off(dither_s=_patience_s(context.state))
    _note_lost(context, dither, compose("dither.not-shown", id=dither.id))


def on_silence(context: StepContext, event: ev.DitherSilent) -> None:
    """Report a dither missing in the frames; request it again.

    The frames decide, whatever the status says. An RTC that begins late is given a longer time
    after each attempt.
    """
    dither = context.dither
    if dither is None or dither.id != event.id:
        return
    text = compose("dither.not-in-frames", id=dither.id, silent_s=event.silent_s)
    if event.silent_s < _patience_s(context.state):
        context.raise_alarm(alarms.DITHER_LOST, text)
    else:
        _note_lost(context, dither, text)


def note_found(context: StepContext) -> None:
    """Miss it no more: a window held the dither, or none is wanted any more."""
    context.dithers = replace(context.dithers, lost=None, losses=0)
    context.clear_alarm(alarms.DITHER_LOST)


def learn_precision(context: StepContext, event: ev.WindowFitted) -> None:
    """Take over from an accepted window what it says of the precision of windows."""
    estimate, rtc, before = event.estimate, context.rtc, context.dither_policy.precision
    accepted = context.windows.accepted > context.before.windows.accepted
    if isinstance(estimate, RandomEstimate) or not accepted or rtc is None:
        return
    if len(estimate.modes) > dither_request.N_LINES + 1:
        return  # not the modes that tell most of α
    if estimate.dither_m > 0.0:
        ratio = compute_precision_ratio(
            estimate.covariance, estimate.dither_m, estimate.window_s, rtc.magnitude
        )
        n_windows = 0 if before is None else before.n_windows
        mean = update_mean_ratio(None if before is None else before.ratio, n_windows, ratio)
        precision = Precision(ratio=mean, n_windows=n_windows + 1)
        context.dither_policy = replace(context.dither_policy, precision=precision)


def on_measured(context: StepContext, event: ev.DitherMeasured) -> None:
    """Report a dither that differs from the request; stop one that is too strong.

    The commands in the frames are what the mirror does, whatever the RTC's status says.
    """
    rtc, dither = context.rtc, context.dither
    if not event.text:
        context.dither_policy = replace(context.dither_policy, loud_text="", mismatched_id=None)
        return
    if rtc is None or dither is None or dither.id != event.id:
        return
    context.dither_policy = replace(
        context.dither_policy, mismatched_id=event.id, mismatched_m=event.found_m
    )
    most_m = dither_plan.budget_m(rtc, context.policy)
    # An operator may have allowed more than the budget.
    if event.found_m <= MAX_MEASURED_AMPLITUDE_RATIO * max(event.asked_m, most_m):
        context.raise_alarm(alarms.NOT_AS_ASKED, f"{event.text}; check the RTC's dither")
        return
    loud = f"{event.text}; the budget is {1e9 * most_m:.3g} nm"
    _note_unwanted(context, event.id)
    context.dither_policy = replace(context.dither_policy, loud_id=event.id, loud_text=loud)
    _raise_over_budget(context, event.id, loud)
    stop_unfollowed(context)


def stop_unanswered(context: StepContext, text: str) -> None:
    """End a dither that the slopes do not answer, and try another in a while."""
    if context.dither is not None:
        ended = (
            f"{context.dither.id} was ended, and another is tried after "
            f"{FAILED_DITHER_PAUSE_S:.0f} s"
        )
        context.raise_alarm(alarms.MIRROR_SILENT, f"the mirror does not answer: {text}; {ended}")
        context.put_off(dither_s=FAILED_DITHER_PAUSE_S)
        stop_running_dither(context)


def stop_unwanted(context: StepContext) -> None:
    """Ask the RTC, again and again, to stop what it should not play."""
    rtc = present(context.rtc)
    running, loud = rtc.dither_id, dither_plan.check_dither_strength(context, rtc)
    why = loud or dither_plan.check_dither_wanted(context, rtc)
    if running is None or why is None:
        forget_unwanted(context)
        return
    if context.dither_policy.unwanted_id != running:
        _note_unwanted(context, running)
        if loud is not None:
            _raise_over_budget(context, running, loud)
    if (
        context.now_ns - context.dither_policy.stop_asked_ns_utc
        >= STOP_REQUEST_INTERVAL_S * SECOND_NS
    ):
        stop_unfollowed(context)


def forget_unwanted(context: StepContext) -> None:
    """Note that no unwanted dither plays."""
    if context.dither_policy.unwanted_id is not None:
        context.dither_policy = replace(context.dither_policy, unwanted_id=None)


def _begin(context: StepContext, rtc: Status, wanted: WantedDither) -> None:
    """Ask for a dither if it is time, and nothing left behind is in its way."""
    loud_ns = context.dither_policy.loud_ns_utc
    if loud_ns and context.now_ns < loud_ns + round(FAILED_DITHER_PAUSE_S * SECOND_NS):
        _set_phase(context, DitherPhase.OFF, "the RTC has played the last one too strong")
        return
    if context.now_ns < context.dithers.no_dither_before_ns_utc:
        return
    left = None if rtc.dither_id is None else dither_request.infer_purpose(rtc.dither_id, None)
    if left is not None and (left.automatic or left is DitherPurpose.NOISY):
        # left behind by this service: its window of another length, or to stop
        context.put_off(dither_s=2.0)
        stop_running_dither(context)
    elif context.now_ns >= wanted.next_ns_utc and not dither_plan.awaits_result(context, wanted):
        _ask(context, rtc, wanted)


def _ask(context: StepContext, rtc: Status, wanted: WantedDither) -> None:
    dither = dither_request.plan_dither(
        rtc, context.policy, context.now_ns, choice=wanted.parameters
    )
    reason = dither_request.check_dither_usable(dither, rtc, context.policy)
    if reason is not None:
        text = (
            f"no usable dither: {reason}; a dither of random signs needs no lines, and α can be "
            "measured with one"
        )
        context.put_off(dither_s=60.0)
        context.raise_alarm(alarms.NO_DITHER, text)
        return
    shaken = dither_request.on_vibrations(dither, wanted.parameters.avoid_hz)
    if shaken and dither.frequency_hz != context.dither_policy.lines_hz:
        text = f"lines at {shaken} Hz are on vibrations: there is no room, or the settings fix them"
        context.warn("dither.on-vibrations", text)
    if wanted.phase is DitherPhase.PROVE:
        mode_proof.note_shown(context, wanted.parameters.modes)
    context.dither_policy = replace(
        context.dither_policy,
        lines_hz=wanted.parameters.last_hz if wanted.parameters.modes else dither.frequency_hz,
        # The count that accepted windows reach once all of this dither have arrived.
        results_due=context.windows.accepted + wanted.parameters.n_windows,
        ended_ns_utc=None,
        next_ns_utc=None,
    )
    request_dither(context, dither)


def _end_when_done(context: StepContext, rtc: Status, dither: Dither, wanted: WantedDither) -> None:
    """Stop a dither that has done its work, or is no longer the one to ask for."""
    # The service's clock: what is left only decides whether a command to stop is worth sending.
    left_s = dither.request.duration_s - (context.now_ns - dither.asked_ns_utc) / SECOND_NS
    was_stopped = dither.id == context.dither_policy.stopped_id
    if dither.start_seq is None or left_s < MIN_STOPPED_REMAINDER_S or was_stopped:
        return
    registration = context.registration
    seen = registration is not None and registration.window_ns_utc > dither.asked_ns_utc
    pause_s = (wanted.next_ns_utc - context.now_ns) / SECOND_NS
    # Stopped only where the pause is worth a start and its settling.
    done = seen and wanted.phase is DitherPhase.SPARSE and pause_s >= dither_plan.MIN_DITHER_PAUSE_S
    weak = (
        wanted.phase is DitherPhase.ACQUIRE
        # Only a dither with less than half of the wanted amplitude is worth a restart.
        and 2.0 * dither_request.total_m(dither.request) < wanted.parameters.total_m
    )
    moved = dither_plan.check_dithered_modes(dither, rtc, context.policy, wanted.parameters.shunned)
    # weak lines are worth another dither where what is known was restored, and is to be confirmed
    confirms = registration is not None and bool(wanted.parameters.modes)
    proves = dither.purpose is DitherPurpose.PROVE
    if (confirms or wanted.phase is DitherPhase.PROVE) and not proves:
        moved = wanted.reason
    if done or weak or moved:
        # the next one must not overtake the command to stop
        context.put_off(dither_s=1.0)
        weakness = "" if done or moved else " is too weak"
        text = f"{dither.id}{weakness}: {moved or wanted.reason}"
        context.log("dither.stopped", text, Level.INFO if moved or weakness else Level.DEBUG)
        stop_running_dither(context)


def _adopt(context: StepContext, rtc: Status) -> bool:
    """Take over a dither that runs, if it can be read; return whether there is one."""
    if rtc.dither is None or rtc.dither_id == context.dithers.lost:
        return False
    running, begun_seq, dithering = rtc.dither.request, rtc.dither.start_seq, context.dither_policy
    purpose = dither_request.infer_purpose(running.id, None)
    over = (
        dither_request.is_automatic_sine(running, purpose)
        and dither_request.total_m(running)
        > dither_plan.AMPLITUDE_ROUNDING_RATIO * dithering.budget_m
    )
    asked_to_stop = running.id == dithering.stopped_id
    # a recorded night stops nothing: what it goes on playing is read all the same
    deadline_ns = dithering.stopped_ns_utc + round(STOP_TIMEOUT_S * SECOND_NS)
    if context.now_ns < deadline_ns if asked_to_stop else over:
        return False
    for window_s in dither_plan.window_lengths_s(context.policy):
        dither = Dither(
            request=running,
            purpose=purpose,
            start_seq=begun_seq,
            asked_ns_utc=context.now_ns,
            window_s=window_s,
        )
        if dither_request.check_dither_usable(dither, rtc, context.policy) is None:
            context.dither = dither
            context.log("dither.adopted", f"{running.id} runs since frame {begun_seq}")
            return True
    return False


def _level(dither: Dither) -> Level:
    """Return the log level of a dither: the service's own come and go all night."""
    return Level.DEBUG if dither.purpose.automatic else Level.INFO


def _update_cost(context: StepContext, rtc: Status) -> None:
    """Keep count of what the dither costs, and of who has looked at α last."""
    dithering, registration, dither = context.dither_policy, context.registration, context.dither
    followed = dither is not None and dither.start_seq is not None
    # what nobody has asked for costs as much
    playing = dither if followed else rtc.dither
    power = 0.0 if playing is None else dither_request.total_m(playing.request) ** 2
    since_ns = context.now_ns if dithering.seen_ns_utc is None else dithering.seen_ns_utc
    # 1 - exp(-t/T), accurate for short steps. A clock that was set back adds nothing.
    share = -np.expm1(-max(context.now_ns - since_ns, 0) / (COST_AVERAGING_TIME_S * SECOND_NS))
    passive_ns = dithering.passive_ns_utc
    windows_ns = 0 if registration is None else registration.window_ns_utc
    if registration is not None and windows_ns and registration.arrived_ns_utc > windows_ns:
        passive_ns = registration.arrived_ns_utc
    context.dither_policy = replace(
        dithering,
        budget_m=dither_plan.budget_m(rtc, context.policy),
        mean_square_m2=float(dithering.mean_square_m2 * (1.0 - share) + power * share),
        seen_ns_utc=context.now_ns,
        passive_ns_utc=passive_ns,
    )


def _set_phase(context: StepContext, phase: DitherPhase, reason: str) -> None:
    none_follows = phase in {DitherPhase.OFF, DitherPhase.OPERATOR}
    # A phase in which the service starts no dither must not announce one.
    next_ns = None if none_follows else context.dither_policy.next_ns_utc
    context.dither_policy = replace(
        context.dither_policy, phase=phase, reason=reason, next_ns_utc=next_ns
    )


def _take_over_played(context: StepContext, asked: Dither, shown: DitherStatus) -> None:
    """Follow the dither that the RTC reports if it differs from the request.

    The report is used, but the dither is not tolerated for that: one that is too strong is stopped.
    """
    running = replace(asked, request=shown.request, start_seq=shown.start_seq)
    if running == asked:
        return
    plays, wanted = running.request, asked.request
    if dither_request.total_m(plays) > dither_plan.AMPLITUDE_ROUNDING_RATIO * max(
        dither_request.total_m(wanted), context.dither_policy.budget_m
    ):
        context.dither_policy = replace(context.dither_policy, loud_id=running.id, loud_text="")
    text = (
        f"{asked.id}: the RTC plays modes {plays.modes}, {running.frequency_hz} Hz, "
        f"{plays.amplitude_m} m from frame {running.start_seq}; requested were modes "
        f"{wanted.modes}, {asked.frequency_hz} Hz, {wanted.amplitude_m} m from {asked.start_seq}"
    )
    context.dither = running
    context.warn("dither.other", text)


def _note_lost(context: StepContext, dither: Dither, text: Message) -> None:
    context.raise_alarm(alarms.DITHER_LOST, text)
    context.warn("dither.lost", text)
    context.dither = None
    context.dithers = replace(context.dithers, lost=dither.id, losses=context.dithers.losses + 1)


def _patience_s(state: TrackerState) -> float:
    return min(FIRST_DITHER_RETRY_S * 2.0**state.dithers.losses, MAX_DITHER_RETRY_S)


def _note_stop(context: StepContext, dither_id: str) -> None:
    """Note that the RTC is asked to stop a dither, and since when."""
    if context.dither_policy.stopped_id != dither_id:
        context.dither_policy = replace(
            context.dither_policy,
            stopped_id=dither_id,
            ended_ns_utc=None,
            stopped_ns_utc=context.now_ns,
        )


def _note_unwanted(context: StepContext, running: str) -> None:
    """Note that a dither must go, and follow it no more."""
    _note_stop(context, running)
    if context.dither is not None and context.dither.id == running:
        context.dither = None
    context.dither_policy = replace(context.dither_policy, unwanted_id=running)


def _raise_over_budget(context: StepContext, running: str, loud: str) -> None:
    text = (
        f"{loud}: the RTC was ordered to stop {running}, and another is tried after "
        f"{FAILED_DITHER_PAUSE_S:.0f} s; check the dither of the RTC, or stop the dither"
    )
    context.dither_policy = replace(context.dither_policy, loud_ns_utc=context.now_ns)
    context.raise_alarm(alarms.OVER_BUDGET, text)
