"""Which dither the service asks for by itself."""

from __future__ import annotations

from dataclasses import replace

from service.errors import ModelError
from service.estimation.lockin import LockInPlan
from service.events import AskDither, AskNoDither
from service.reactions.journal import logged, with_alarm, without_alarm
from service.reactions.matrices import Step
from service.reactions.policy import SECOND_NS, Policy
from service.state import DitherView, RtcView, TrackerState

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Dither lines over the frame rate: wind biases those below 0.2; no sum of two meets a third."""

SETTLING_S = 0.3
"""Of the loop, after a dither has begun, before the first window."""

_N_LINES = 4
_OWN_DITHER = "dither-"


def choose_dither(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Keep a dither running while the loop is closed and its matrix known.

    One that runs already, from before a restart of the service or in a replayed night, is as good
    as a new one and the RTC plays no second one beside it.
    """
    wanted = policy.dither_enabled and not state.dither_stopped and state.dither is None
    if rtc.loop != "closed" or not wanted:
        return state, ()
    usable = rtc.dither is not None and rtc.dither.id != state.dither_lost
    if usable and rtc.dither is not None and why_unusable(rtc.dither, rtc, policy) is None:
        state = replace(state, dither=replace(rtc.dither, asked_ns_utc=now_ns))
        text = f"{rtc.dither.id} runs since frame {rtc.dither.start_seq}"
        state = without_alarm(state, "dither", now_ns)
        return logged(state, "dither.adopted", text, now_ns), ()
    if state.in_use is None or now_ns < state.retry_ns_utc:
        return state, ()
    if rtc.dither_id is not None and rtc.dither_id.startswith(_OWN_DITHER):
        # left behind by this service when its window had another length
        return replace(state, retry_ns_utc=now_ns + 2 * SECOND_NS), (AskNoDither(),)
    dither = plan_dither(rtc, policy, now_ns)
    reason = why_unusable(dither, rtc, policy)
    if reason is not None:
        state = replace(state, retry_ns_utc=now_ns + 60 * SECOND_NS)
        return with_alarm(state, "dither", f"no usable dither: {reason}", now_ns), ()
    return replace(state, dither=dither), (AskDither(dither=dither),)


def why_unusable(dither: DitherView, rtc: RtcView, policy: Policy) -> str | None:
    """Return why the lines of a dither cannot be told apart in this policy's windows, or None."""
    try:
        lock_in_plan(dither, rtc, policy.window_s)
    except ModelError as error:
        return str(error)
    return None


def plan_dither(
    rtc: RtcView,
    policy: Policy,
    now_ns: int,
    *,
    modes: tuple[int, ...] | None = None,
    amplitude_m: float | None = None,
    frequency_hz: tuple[float, ...] | None = None,
    duration_s: float | None = None,
) -> DitherView:
    """Return the dither to ask for: what is not given is the policy's own choice.

    The lines are rounded to whole periods in a window. The modes are ones the loop does not and
    will not control: nothing there amplifies the dither or the noise.
    """
    chosen = modes or policy.dither_modes or _uncontrolled_modes(rtc, policy)
    chosen = chosen[: rtc.max_dither_modes]
    lines = frequency_hz or policy.dither_frequencies_hz
    if lines is None:
        lines = tuple(f * rtc.frame_rate_hz for f in LINE_FRACTIONS[: len(chosen)])
    amplitude = min(amplitude_m or policy.dither_amplitude_m, rtc.max_dither_m)
    return DitherView(
        id=f"{_OWN_DITHER}{now_ns}",
        modes=chosen,
        amplitude_m=(amplitude,) * len(chosen),
        frequency_hz=tuple(round(f * policy.window_s) / policy.window_s for f in lines),
        duration_s=duration_s or policy.dither_duration_s,
        start_seq=None,
        asked_ns_utc=now_ns,
    )


def lock_in_plan(dither: DitherView, rtc: RtcView, window_s: float) -> LockInPlan:
    """Return how a dither is demodulated, from where the loop has settled.

    Raises
    ------
    ModelError
        If its lines cannot be told apart in a window of ``window_s``.
    """
    return LockInPlan(
        modes=dither.modes,
        frequencies_hz=dither.frequency_hz,
        amplitude_m=dither.amplitude_m,
        frame_rate_hz=rtc.frame_rate_hz,
        n_frames=round(window_s * rtc.frame_rate_hz),
        first_seq=(dither.start_seq or 0) + round(SETTLING_S * rtc.frame_rate_hz),
    )


def _uncontrolled_modes(rtc: RtcView, policy: Policy) -> tuple[int, ...]:
    """Return four modes spread just above the controlled ones, or the highest four there are."""
    first = max(rtc.n_controlled, min(policy.n_modes_target, rtc.n_modes))
    spare = rtc.n_modes - first
    if spare < _N_LINES:
        return tuple(range(max(rtc.n_modes - _N_LINES, 0), rtc.n_modes))
    step = max(1, min(20, spare // (_N_LINES + 1)))
    return tuple(first + step // 2 + step * line for line in range(_N_LINES))
