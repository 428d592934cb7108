"""What the service does by itself next: dither, judge, compute, from what it knows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.lockin import LockInPlan
from service.events import AskDither, AskNoDither, Effect, FetchMatrix, JudgeMatrix, MakeMatrix
from service.model.misregistration import BOUNDARY_SCALE
from service.reactions.journal import WRONG_RTC, logged, with_alarm, without_alarm
from service.state import (
    DitherView,
    MatrixState,
    Mode,
    ReconstructorRecord,
    RtcView,
    TrackerState,
)

SECOND_NS = 1_000_000_000

MIN_WINDOWS = 2
"""Windows that must agree before anything is made from them."""

JUDGE_INTERVAL_S = 10.0
"""Least time between two looks at the margin of the matrix in use."""

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Dither lines over the frame rate: wind biases those below 0.2; no sum of two meets a third."""

SETTLING_S = 0.3
"""Of the loop, after a dither has begun, before the first window."""

_N_LINES = 4
_OWN_DITHER = "dither-"
_SENT = (MatrixState.PUBLISHED, MatrixState.STAGED)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Policy:
    """The settings of the tracker."""

    dither_enabled: bool = True
    dither_amplitude_m: float = 5e-9
    """RMS of each dithered mode, metres OPD."""

    dither_modes: tuple[int, ...] | None = None
    """None: four modes the loop will not control."""

    dither_frequencies_hz: tuple[float, ...] | None = None
    """None: ``LINE_FRACTIONS`` of the frame rate."""

    dither_duration_s: float = 120.0
    """Of one request; it is repeated, so that a dead service leaves no dither behind."""

    window_s: float = 2.0
    drift_rate: NDArray[np.float64]
    """``(4,)`` random walk σ after one second, numeric units."""

    floor: NDArray[np.float64]
    """``(4,)`` 1 σ model error, numeric units."""

    n_modes_target: int = 500
    """Modes to control once the registration is known."""

    update_threshold: NDArray[np.float64]
    """``(4,)`` change of α that makes a new reconstructor worthwhile, numeric units."""

    minimum_interval_s: float = 5.0
    """Least time between two reconstructors."""

    refused_interval_s: float = 30.0
    """The same after one was refused, rejected or not acknowledged."""


def decide(
    state: TrackerState, policy: Policy, now_ns: int
) -> tuple[TrackerState, tuple[Effect, ...]]:
    """Return what is to be done now, and the state that remembers having asked for it."""
    if state.rtc is None or any(a.name in _PARALYSING for a in state.alarms):
        return state, ()
    effects: list[Effect] = []
    for choose in (_fetch, _dither, _judge, _update):
        state, wanted = choose(state, state.rtc, policy, now_ns)
        effects += wanted
    return state, tuple(effects)


_PARALYSING = (*WRONG_RTC, "loop-diverging", "edge-slip")
_Choice = tuple[TrackerState, tuple[Effect, ...]]


def _fetch(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> _Choice:
    """Ask for the matrix in use when nobody here has it."""
    if rtc.cm_id is None or state.reconstructor(rtc.cm_id) is not None:
        return state, ()
    if now_ns < state.retry_ns_utc:
        return state, ()
    return replace(state, retry_ns_utc=now_ns + 3 * SECOND_NS), (FetchMatrix(id=rtc.cm_id),)


def _dither(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> _Choice:
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


def _judge(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> _Choice:
    """Look at the margin of the matrix in use once α is known, and now and then."""
    if state.registration is None or state.in_use is None:
        return state, ()
    if state.registration.n_windows < MIN_WINDOWS or state.making_since_ns_utc is not None:
        return state, ()
    waited = state.judged_ns_utc is None or (
        now_ns - state.judged_ns_utc > JUDGE_INTERVAL_S * SECOND_NS
    )
    if not waited:
        return state, ()
    return replace(state, judged_ns_utc=now_ns), (JudgeMatrix(id=state.in_use),)


def _update(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> _Choice:
    """Compute a reconstructor when the one in use no longer fits α, or could command more modes."""
    registration = state.registration
    if state.mode is Mode.HOLD or registration is None or registration.n_windows < MIN_WINDOWS:
        return state, ()
    if rtc.loop != "closed" or state.making_since_ns_utc is not None:
        return state, ()
    if _busy(state, policy) or now_ns < max(_next_attempt_ns(state, policy), state.retry_ns_utc):
        return state, ()
    in_use = state.reconstructor(state.in_use) if state.in_use else None
    if in_use is None:
        return state, ()
    target = min(policy.n_modes_target, rtc.n_modes)
    if moved(state, in_use, policy):
        effect = MakeMatrix(n_modes=rtc.n_controlled, why=_why_moved(state, in_use))
    elif rtc.n_controlled < target:
        effect = MakeMatrix(n_modes=target, why=f"{rtc.n_controlled} of {target} modes controlled")
    else:
        return state, ()
    return replace(state, making_since_ns_utc=now_ns), (effect,)


def moved(state: TrackerState, record: ReconstructorRecord, policy: Policy) -> bool:
    """Return whether α has moved from what this reconstructor was made for, beyond noise."""
    if state.registration is None:
        return False
    if record.alpha is None or record.sigma is None:
        return True
    distance = np.abs(state.registration.alpha.vector - record.alpha.vector)
    noise = np.sqrt(np.diag(state.registration.covariance))
    return bool(np.any(distance > np.maximum(policy.update_threshold, 3.0 * noise)))


def _why_moved(state: TrackerState, record: ReconstructorRecord) -> str:
    if record.alpha is None or state.registration is None:
        return f"{record.id} was not made for a known registration"
    step = (state.registration.alpha.vector - record.alpha.vector) * BOUNDARY_SCALE
    return (
        f"moved by {step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f} "
        f"since {record.id}"
    )


def _busy(state: TrackerState, policy: Policy) -> bool:
    """Return whether a reconstructor is on its way, or one that fits α awaits an operator.

    In auto nobody is going to decide on a proposal left from another mode or an absent RTC.
    """
    return any(
        r.state in _SENT
        or (
            r.state is MatrixState.PROPOSED
            and state.mode is not Mode.AUTO
            and not moved(state, r, policy)
        )
        for r in state.reconstructors
    )


def _next_attempt_ns(state: TrackerState, policy: Policy) -> int:
    """Return before when no reconstructor is computed by itself."""
    own = [r for r in state.reconstructors if r.parent is not None]
    if not own:
        return 0
    last = own[-1]
    failed = (MatrixState.REFUSED, MatrixState.REJECTED, MatrixState.FAILED, MatrixState.DISCARDED)
    wait_s = policy.refused_interval_s if last.state in failed else policy.minimum_interval_s
    return last.created_ns_utc + int(wait_s * SECOND_NS)
