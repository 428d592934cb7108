"""Whether a dither is asked for, left alone, or stopped because it has done its work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.control.dither import forgetting_mean, measured_ratio
from service.telemetry.lockin import WindowEstimate
from service.telemetry.random_dither import RandomEstimate
from service.tracking.alarms import Act, forbidding, logged, with_alarm, without_alarm
from service.tracking.dither import ROUNDING, calm_ns_utc, own_sine, stopped, without_unwanted
from service.tracking.dither_plan import (
    NOISY_DITHER,
    OWN_DITHER,
    SHORTEST_PAUSE_S,
    Wish,
    budget_m,
    on_vibrations,
    plan_dither,
    total_m,
    wanted,
    why_unusable,
    window_lengths_s,
)
from service.tracking.events import AskDither, AskNoDither, Step
from service.tracking.loop import DitherView, RtcView
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.stages import DitherPhase, Precision
from service.tracking.state import Level, TrackerState

RESULT_WITHIN_S = 10.0
"""For the estimate of a window whose dither has ended."""

SOON_OVER_S = 2.0
"""A dither that ends by itself so soon is not worth a command."""

STOPPED_WITHIN_S = 5.0
"""An RTC still playing a dither so long after it was asked to stop does not stop dithers."""

MEMORY_S = 600.0
"""Of the mean cost that is shown."""


def choose_dither(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Dither as much and as often as the policy asks while the loop is closed, its matrix known.

    A dither that runs already, from before a restart of the service or in a replayed night, is as
    good as a new one and the RTC plays no second one beside it.
    """
    state = _accounted(state, rtc, policy, now_ns)
    state, stopping = without_unwanted(state, rtc, policy, now_ns)
    state, effects = _chosen(state, rtc, policy, now_ns)
    return state, (*stopping, *effects)


def _chosen(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    dither = state.dither
    if dither is not None and not own_sine(dither):
        return _shown(state, DitherPhase.OPERATOR, f"{dither.id} runs"), ()
    forbidden = _why_none(state, rtc, policy)
    if forbidden is not None:
        return _shown(state, DitherPhase.OFF, forbidden), ()
    wish, plan = wanted(state, rtc, policy, now_ns)
    later_ns = wish.next_ns_utc if wish.next_ns_utc > now_ns else None
    dithering = replace(state.dithering, plan=plan, next_ns_utc=later_ns)
    dithering = replace(dithering, avoided_hz=wish.choice.avoid_hz)
    state = _shown(replace(state, dithering=dithering), wish.phase, wish.reason)
    if dither is not None:
        return _running(state, dither, wish, now_ns)
    adopted = _adopted(state, rtc, policy, now_ns)
    if adopted is not None:
        return adopted, ()
    return _begun(state, rtc, policy, wish, now_ns)


def _begun(state: TrackerState, rtc: RtcView, policy: Policy, wish: Wish, now_ns: int) -> Step:
    """Ask for a dither if it is time, and nothing left behind is in its way."""
    if now_ns < calm_ns_utc(state):
        return _shown(state, DitherPhase.OFF, "the RTC has played the last one too strong"), ()
    if now_ns < state.retries.dither_ns_utc:
        return state, ()
    if rtc.dither_id is not None and rtc.dither_id.startswith((OWN_DITHER, NOISY_DITHER)):
        # left behind by this service: its window of another length, or to stop
        state = put_off(state, now_ns + 2 * SECOND_NS)
        return stopped(state, rtc.dither_id, now_ns), (AskNoDither(),)
    if now_ns < wish.next_ns_utc or _awaits_a_result(state, wish, now_ns):
        return state, ()
    return _ask(state, rtc, policy, wish, now_ns)


def learnt(
    before: TrackerState, after: TrackerState, estimate: WindowEstimate | RandomEstimate
) -> TrackerState:
    """Return the state after a window, with what it says of the precision of windows."""
    accepted = after.windows_accepted > before.windows_accepted
    if isinstance(estimate, RandomEstimate):
        return after
    if not accepted or estimate.dither_m <= 0.0 or after.rtc is None:
        return after
    magnitude, known = after.rtc.magnitude, after.dithering.precision
    ratio = measured_ratio(estimate.covariance, estimate.dither_m, estimate.window_s, magnitude)
    n_windows = 0 if known is None else known.n_windows
    mean = forgetting_mean(None if known is None else known.ratio, n_windows, ratio)
    precision = Precision(ratio=mean, n_windows=n_windows + 1)
    return replace(after, dithering=replace(after.dithering, precision=precision))


def put_off(state: TrackerState, until_ns_utc: int) -> TrackerState:
    """Return the state in which no dither is asked for by itself before then."""
    return replace(state, retries=state.retries.later(dither_ns_utc=until_ns_utc))


def _accounted(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> TrackerState:
    """Keep count of what the dither costs, and of who has looked at α last."""
    dithering, known, dither = state.dithering, state.registration, state.dither
    on = dither is not None and dither.start_seq is not None
    # what nobody has asked for costs as much
    playing = dither if on else rtc.dither
    power = 0.0 if playing is None else total_m(playing) ** 2
    since_ns = now_ns if dithering.seen_ns_utc is None else dithering.seen_ns_utc
    share = -np.expm1(-max(now_ns - since_ns, 0) / (MEMORY_S * SECOND_NS))
    passive_ns = dithering.passive_ns_utc
    if known is not None and known.window_ns_utc and known.arrived_ns_utc > known.window_ns_utc:
        passive_ns = known.arrived_ns_utc
    dithering = replace(
        dithering,
        budget_m=budget_m(rtc, policy),
        mean_square_m2=float(dithering.mean_square_m2 * (1.0 - share) + power * share),
        seen_ns_utc=now_ns,
        passive_ns_utc=passive_ns,
    )
    return replace(state, dithering=dithering)


def _shown(state: TrackerState, phase: DitherPhase, reason: str) -> TrackerState:
    dithering = replace(state.dithering, phase=phase, reason=reason)
    if phase in {DitherPhase.OFF, DitherPhase.OPERATOR}:
        dithering = replace(dithering, next_ns_utc=None)
    return replace(state, dithering=dithering)


def _why_none(state: TrackerState, rtc: RtcView, policy: Policy) -> str | None:
    still = state.dithering.unwanted_id
    left = "" if still is None else f"; the RTC still plays {still}"
    if state.dither_stopped:
        return f"stopped by the operator{left}"
    if not policy.dither_enabled and state.dither is None:
        return f"the settings forbid it{left}"
    if not rtc.in_loop:
        return rtc.why_open
    unnamed = rtc.cm_id is None or state.unfetched
    if state.in_use is None and not unnamed and state.dither is None and rtc.dither is None:
        return "the reconstructor in use is not known yet"
    alarm = forbidding(state, Act.MEASURE)
    return None if alarm is None else f"nothing would be measured under {alarm.name}"


def _running(state: TrackerState, dither: DitherView, wish: Wish, now_ns: int) -> Step:
    """Stop a dither that has done its work, or is too weak for what has come up meanwhile."""
    left_s = dither.duration_s - (now_ns - dither.asked_ns_utc) / SECOND_NS
    deaf = dither.id == state.dithering.stopped_id
    if dither.start_seq is None or left_s < SOON_OVER_S or deaf:
        return state, ()
    known = state.registration
    seen = known is not None and known.window_ns_utc > dither.asked_ns_utc
    pause_s = (wish.next_ns_utc - now_ns) / SECOND_NS
    done = seen and wish.phase is DitherPhase.SPARSE and pause_s >= SHORTEST_PAUSE_S
    weak = wish.phase is DitherPhase.ACQUIRE and 2.0 * total_m(dither) < wish.choice.total_m
    if not (done or weak):
        return state, ()
    text = f"{dither.id}: {wish.reason}" if done else f"{dither.id} is too weak: {wish.reason}"
    state = replace(stopped(state, dither.id, now_ns), dither=None)
    # the next one must not overtake the command to stop
    state = put_off(state, now_ns + SECOND_NS)
    return logged(state, "dither.stopped", text, now_ns), (AskNoDither(),)


def _adopted(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> TrackerState | None:
    """Take over a dither that runs, if it can be read; None: there is none."""
    running = rtc.dither
    if running is None or running.id == state.dither_lost:
        return None
    over = own_sine(running) and total_m(running) > ROUNDING * state.dithering.budget_m
    asked_to_stop = running.id == state.dithering.stopped_id
    # a recorded night stops nothing: what it goes on playing is read all the same
    heard_ns = state.dithering.stopped_ns_utc + round(STOPPED_WITHIN_S * SECOND_NS)
    if now_ns < heard_ns if asked_to_stop else over:
        return None
    for window_s in window_lengths_s(policy):
        dither = replace(running, asked_ns_utc=now_ns, window_s=window_s)
        if why_unusable(dither, rtc, policy) is None:
            text = f"{running.id} runs since frame {running.start_seq}"
            state = without_alarm(replace(state, dither=dither), "dither", now_ns)
            return logged(state, "dither.adopted", text, now_ns)
    return None


def _awaits_a_result(state: TrackerState, wish: Wish, now_ns: int) -> bool:
    """Return whether the window of the dither that ended last may still be on its way."""
    dithering = state.dithering
    if wish.phase is not DitherPhase.SPARSE or dithering.ended_ns_utc is None:
        return False
    late = now_ns - dithering.ended_ns_utc > RESULT_WITHIN_S * SECOND_NS
    return not late and state.windows_accepted < dithering.results_due


def _ask(state: TrackerState, rtc: RtcView, policy: Policy, wish: Wish, now_ns: int) -> Step:
    dither = plan_dither(rtc, policy, now_ns, choice=wish.choice)
    reason = why_unusable(dither, rtc, policy)
    if reason is not None:
        text = (
            f"no usable dither: {reason}; random signs need no lines, and α can be measured with "
            'them: POST /v1/dither with kind "binary"'
        )
        return with_alarm(put_off(state, now_ns + 60 * SECOND_NS), "dither", text, now_ns), ()
    shaken = on_vibrations(dither, wish.choice.avoid_hz)
    if shaken and dither.frequency_hz != state.dithering.lines_hz:
        text = f"lines at {shaken} Hz are on vibrations: there is no room, or the settings fix them"
        state = logged(state, "dither.on-vibrations", text, now_ns, Level.WARNING)
    dithering = replace(
        state.dithering,
        lines_hz=dither.frequency_hz,
        results_due=state.windows_accepted + wish.choice.n_windows,
        ended_ns_utc=None,
        next_ns_utc=None,
    )
    return replace(state, dither=dither, dithering=dithering), (AskDither(dither=dither),)
