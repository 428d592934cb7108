"""Decide which dither is wanted now: strength, windows, pauses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.control import dither
from service.control.dither import DitherRequirement, compute_schedule, look_up_precision
from service.estimation.loop import explain_open_loop
from service.estimation.windows import DITHER_SETTLING_S
from service.records.alarms import Interlock
from service.records.operations import Dither, DitherPhase, DitherPlan, DitherPurpose, Schedule
from service.records.registration import Registration
from service.records.state import TrackerState
from service.tracking import mode_proof
from service.tracking.dither_request import (
    DEFAULT_DURATION_S,
    DITHER_MARGIN_S,
    LOW_MODE,
    N_LINES,
    DitherParameters,
    choose_modes,
    clear_lines,
    controlled,
    expected_amplification,
    has_free_modes,
    infer_purpose,
    is_automatic_sine,
    step_of,
    total_m,
)
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext
from service.wire import Status

MIN_WINDOWS_FOR_PAUSE = 3
"""Windows that must agree before the dither uses less than the whole budget, or pauses."""

MAX_DITHER_DURATION_S = 30.0
"""Longest dither requested at once, so that a dither ends soon after a crashed service."""

MIN_DITHER_PAUSE_S = 3.0
"""Shortest pause between dithers: a shorter one saves less than the next dither's settling takes.
"""

MAX_PASSIVE_AGE_S = 25.0
"""Largest age of a passive estimate that still counts as monitoring: a little more than two of its
intervals."""

FAINT_MAGNITUDE = 11.5
FAINT_WINDOW_S = 5.0
"""On a faint star a shorter window biases the rotation (0.08 deg at magnitude 12.5 in 1 s)."""

WINDOW_LENGTH_RATIOS = (1.0, 2.5, 5.0, 10.0)
"""Lengths of windows, in units of the shortest."""

WINDOWS_PER_DITHER = (1, 2, 3, 5, 8, 12)
"""Windows in one sitting."""

MAX_UNBIASED_SIGMA = np.array([0.03, 0.03, np.deg2rad(0.04), 0.003])
"""1 σ of one window above which its fit may be biased by noise by more than a loop of FLAO
notices, numeric units."""

AMPLITUDE_HYSTERESIS_RATIO = 1.25
"""Ratio of the best amplitude to the present one within which the present one is kept."""

MIN_DETECTED_JUMP = np.array([0.1, 0.1, np.deg2rad(0.1), np.inf])
"""Smallest jump that two windows must detect at once, numeric units: a tenth of a subaperture, a
tenth of a degree."""

JUMP_DETECTION_SIGMA = 6.0
"""Two windows confirm a jump larger than this number of σ of one window, even if it occurred within
the first one."""

WEAK_LINES_POWER_SHARE, MAX_WEAK_LINE_POWER_SHARE = 0.25, 0.02
"""Share of the first dither's power for all weak lines together, and for each at most: less than a
tenth of a strong line's, because α would be lost if the weak line's mode responded unlike the
model."""

WEAK_LINE_CLEARANCE_HZ = 4.0
"""Smallest distance between a weak line and a strong one, Hz; larger if windows are short."""

N_WEAK_LINE_WINDOWS = 2
"""Duration of a dither with weak lines, windows: enough to identify a mode and to make a matrix."""

AMPLITUDE_ROUNDING_RATIO = 1.001
"""Ratio of the played to the requested RMS that rounding explains."""

MAX_RESULT_DELAY_S = 10.0
"""Longest wait for the estimate of a window whose dither has ended."""

_MIN_DRIFT_RATE = 1e-9
"""Smallest random walk after one second, numeric units; nothing on a telescope is more stable."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WantedDither:
    """The dither that is wanted."""

    phase: DitherPhase
    reason: str
    parameters: DitherParameters
    next_ns_utc: int
    """Time of its start; now or earlier to start at once."""


def choose_next(context: StepContext, rtc: Status) -> tuple[WantedDither, DitherPlan]:
    """Return the dither that is wanted in this state, and the plan behind it."""
    state, policy, kappa = context.state, context.policy, precision(context.state, rtc)
    requirement = _requirement(context, rtc, kappa)
    window_s = requirement.window_s
    sittings = tuple(n * window_s for n in WINDOWS_PER_DITHER)
    sparse = replace(requirement, window_s=dither.choose_burst_s(kappa, requirement, sittings))
    phase, reason, next_ns = _next_window(context, sparse)
    requirement = sparse if phase is DitherPhase.SPARSE else requirement
    found = compute_schedule(kappa, requirement)
    plan = _plan(state, found, requirement, window_s, phase)
    shown: tuple[int, ...] = ()
    no_matrix = state.matrices.in_use is None or mode_proof.unknown_loop(state, rtc)
    # If the RTC offers no matrix, all modes must be shown before a matrix controls any of them
    # (docs/decisions/0032-rtc-checked-by-its-telemetry.md).
    early = state.alpha.dither_due_since_ns_utc is None and no_matrix
    if phase in {DitherPhase.FOLLOW, DitherPhase.SPARSE} or early:
        shown = mode_proof.modes_to_show(context, rtc, window_s)
    if shown:
        return _to_show(context, rtc, shown, window_s), plan
    fixed = policy.dither_amplitude_m is not None
    total_m = requirement.budget_m if fixed else plan.total_m
    longest_s = MAX_DITHER_DURATION_S - DITHER_SETTLING_S - DITHER_MARGIN_S
    lasting_s = requirement.window_s if phase is DitherPhase.SPARSE else longest_s
    choice = _parameters(context, total_m, window_s, max(requirement.window_s, lasting_s))
    # An acquisition watches its matrices itself (``mode_proof.check_proven``).
    if phase is DitherPhase.ACQUIRE and not context.acquisition.under_way:
        choice = _with_others(context, rtc, choice)
        if choice.modes:
            reason = f"{reason}; further modes are dithered weakly to be verified"
    return WantedDither(phase=phase, reason=reason, parameters=choice, next_ns_utc=next_ns), plan


def _to_show(
    context: StepContext, rtc: Status, modes: tuple[int, ...], window_s: float
) -> WantedDither:
    """Return the dither that shows how modes answer, before a matrix controls them."""
    lines = mode_proof.lines_clear(context, rtc, window_s)
    spread = np.linspace(0, len(lines) - 1, len(modes)).round().astype(int)
    choice = replace(
        _parameters(context, quiet_budget_m(rtc, context.policy, modes), window_s, window_s),
        modes=modes,
        lines_hz=tuple(lines[k] for k in spread),
    )
    reason = f"modes up to {max(modes)} are shown before they are controlled"
    return WantedDither(
        phase=DitherPhase.PROVE, reason=reason, parameters=choice, next_ns_utc=context.now_ns
    )


def _with_others(context: StepContext, rtc: Status, choice: DitherParameters) -> DitherParameters:
    """Return the first dither with weak lines that show other modes: they cost no time.

    The modes that determine α keep most of the power, and there are no weak lines if the star is so
    faint that one window does not reach the required precision. The dither lasts for the two
    windows that are required before a matrix is made, or for one if all modes are to be shown
    first, and ends by itself.
    """
    registration, policy = context.registration, context.policy
    begun = registration is not None and registration.n_windows > 0
    window_sigma = precision(context.state, rtc) / (choice.total_m * np.sqrt(choice.window_s))
    if begun or policy.dither_frequencies_hz or np.any(window_sigma > policy.dither_sigma):
        return choice
    telling = choose_modes(rtc, policy, choice.shunned)[: rtc.max_dither_modes]
    if not telling:  # the RTC plays none, or none can be believed: the dither itself says so
        return choice
    strong = clear_lines(rtc, len(telling), choice)
    apart_hz = max(
        WEAK_LINE_CLEARANCE_HZ, mode_proof.MIN_LINE_SPACING_STEPS * step_of(rtc, choice.window_s)
    )
    free = [
        line
        for line in mode_proof.lines_clear(context, rtc, choice.window_s)
        if min(abs(line - other) for other in strong) >= apart_hz
    ]
    others = mode_proof.find_weak_line_modes(context, rtc, telling)
    others = others[: min(len(free), rtc.max_dither_modes - len(telling))]
    if not others:
        return choice
    # As far apart as the free lines allow.
    spread = np.linspace(0, len(free) - 1, len(others)).round().astype(int)
    share = min(WEAK_LINES_POWER_SHARE / len(others), MAX_WEAK_LINE_POWER_SHARE)
    lines = {mode: (free[k], share) for mode, k in zip(others, spread.tolist(), strict=True)}
    # Shares are of power: together they make 1, and the total amplitude stays that of the choice.
    rest = (1.0 - share * len(others)) / len(telling)
    lines |= {mode: (line, rest) for mode, line in zip(telling, strong, strict=True)}
    return replace(
        choice,
        modes=tuple(sorted(lines)),
        lines_hz=tuple(lines[mode][0] for mode in sorted(lines)),
        shares=tuple(lines[mode][1] for mode in sorted(lines)),
        n_windows=1 if mode_proof.unknown_loop(context.state, rtc) else N_WEAK_LINE_WINDOWS,
    )


def operator_parameters(context: StepContext, rtc: Status) -> DitherParameters:
    """Return what an operator's dither is like where the operator does not say."""
    policy, plan = context.policy, context.dither_policy.plan
    window_s = policy.window_s if plan is None else plan.window_s
    lasting_s = DEFAULT_DURATION_S - DITHER_SETTLING_S - DITHER_MARGIN_S
    return _parameters(context, quiet_budget_m(rtc, policy), window_s, lasting_s)


def _parameters(
    context: StepContext, total_m: float, window_s: float, lasting_s: float
) -> DitherParameters:
    return DitherParameters(
        total_m=total_m,
        window_s=window_s,
        # The tolerance keeps rounding from losing a window of an exact multiple.
        n_windows=max(int(lasting_s / window_s + 1e-6), 1),
        avoid_hz=(*context.policy.dither_avoid_hz, *context.loop.vibrations_hz),
        last_hz=context.dither_policy.lines_hz,
        shunned=mode_proof.shunned_modes(context.state),
        low_mode=mode_proof.answers_well(context.state, LOW_MODE),
    )


def _plan(
    state: TrackerState,
    found: Schedule,
    requirement: DitherRequirement,
    window_s: float,
    phase: DitherPhase,
) -> DitherPlan:
    """Return the schedule as it is carried out."""
    total_m, interval_s = _steady_amplitude(state, found, requirement), found.interval_s
    # Until α is measured the dither uses the whole budget.
    if phase is DitherPhase.ACQUIRE:
        total_m = requirement.budget_m
    if phase is not DitherPhase.SPARSE:
        interval_s = window_s
    on_s = min(requirement.window_s + DITHER_SETTLING_S, interval_s)
    return DitherPlan(
        total_m=total_m,
        window_s=window_s,
        interval_s=interval_s,
        sigma=found.sigma,
        sufficient=found.sufficient,
        # An RMS over time: it goes with the root of the share of the time with dither.
        mean_cost_m=total_m * float(np.sqrt(on_s / interval_s)),
    )


def precision(state: TrackerState, rtc: Status) -> NDArray[np.float64]:
    """Return κ ``(4,)`` of ``σ = κ / (A sqrt(T))`` as far as it has been learnt."""
    table, learnt = look_up_precision(rtc.magnitude), state.dithers.policy.precision
    return table if learnt is None else table * learnt.ratio


def budget_m(rtc: Status, policy: Policy) -> float:
    """Return the largest RMS of all lines together that policy, settings and RTC allow, metres."""
    n = min(len(policy.dither_modes or range(N_LINES)), rtc.max_dither_modes)
    # Both limits are of one mode; the total of n equal modes is the root of n times larger.
    largest = min(rtc.max_dither_m, policy.dither_amplitude_m or np.inf)
    return float(min(policy.dither_budget_m, largest * np.sqrt(max(n, 1))))


def quiet_budget_m(rtc: Status, policy: Policy, chosen: tuple[int, ...] = ()) -> float:
    """Return the largest RMS to request, metres: the loop amplifies a dither of its own modes.

    Without ``chosen`` modes it is for those that are dithered to follow α.
    """
    # The budget limits what is on the mirror, the request what is added to the commands.
    quiet_m = policy.dither_budget_m / expected_amplification(rtc, policy, chosen)
    return float(min(budget_m(rtc, policy), quiet_m))


def check_dithered_modes(
    dither: Dither, rtc: Status, policy: Policy, shunned: frozenset[int]
) -> str:
    """Return why another dither should replace the one that runs, or "".

    It was requested when fewer modes were controlled, or before the measured response of one of its
    modes disagreed with the model.
    """
    if dither.purpose is DitherPurpose.PROVE:
        return ""
    odd = shunned.intersection(dither.request.modes)
    if odd and not odd.intersection(choose_modes(rtc, policy, shunned)):
        return (
            f"mode {min(odd)} has not answered as the instrument file says: others are used for α"
        )
    # The low mode, which comes last, is one of the loop's on purpose.
    inside = controlled(dither.request.modes[:N_LINES], rtc)
    if not inside:
        return ""
    if has_free_modes(rtc, policy, n_inside=len(inside)):
        named = ", ".join(str(mode) for mode in inside)
        return f"the loop controls modes {named} now: others are free"
    if total_m(dither.request) <= AMPLITUDE_HYSTERESIS_RATIO * quiet_budget_m(rtc, policy):
        return ""
    return "the loop controls its modes now and amplifies it: a weaker one is requested"


def window_lengths_s(policy: Policy) -> tuple[float, ...]:
    """Return how long a window may be, shortest first."""
    lengths = [policy.window_s * step for step in WINDOW_LENGTH_RATIOS]
    return tuple(s for s in lengths if s <= policy.longest_window_s) or (policy.window_s,)


def _requirement(
    context: StepContext, rtc: Status, kappa: NDArray[np.float64]
) -> DitherRequirement:
    policy = context.policy
    requirement = DitherRequirement(
        sigma=policy.dither_sigma,
        # Both the schedule and the pauses divide by the drift.
        drift_rate=np.sqrt(np.maximum(_walk_rate(context), _MIN_DRIFT_RATE**2)),
        budget_m=quiet_budget_m(rtc, policy),
        window_s=policy.window_s,
        window_sigma=MIN_DETECTED_JUMP / JUMP_DETECTION_SIGMA,
        longest_s=policy.longest_pause_s,
    )
    lengths = window_lengths_s(policy)
    # See ``FAINT_WINDOW_S``: a shorter window biases the rotation on a faint star.
    if rtc.magnitude is not None and rtc.magnitude >= FAINT_MAGNITUDE:
        lengths = tuple(s for s in lengths if s >= FAINT_WINDOW_S) or lengths[-1:]
    usable = MAX_UNBIASED_SIGMA * policy.tolerance
    window_s = dither.choose_window_s(kappa, requirement, usable, lengths)
    return replace(requirement, window_s=window_s)


def _walk_rate(context: StepContext) -> NDArray[np.float64]:
    """Return ``(4,)`` variance that α gains in a second: the drift, or the flexure of a slew."""
    registration, base = context.registration, context.policy.drift_rate**2
    if registration is None:
        return base
    # Over less than a second, growth divided by age would be noise, or a division by zero.
    age_s = (context.now_ns - registration.arrived_ns_utc) / SECOND_NS
    # During a slew flexure adds more than the drift of the settings.
    return np.maximum(base, registration.grown / age_s) if age_s >= 1.0 else base


def _next_window(
    context: StepContext, requirement: DitherRequirement
) -> tuple[DitherPhase, str, int]:
    """Return how to dither, why, and when the next window is due."""
    state, policy, now_ns = context.state, context.policy, context.now_ns
    registration = context.registration
    if registration is None:
        return DitherPhase.ACQUIRE, "α is not known", now_ns
    if state.alpha.dither_due_since_ns_utc is not None:
        return DitherPhase.ACQUIRE, state.alpha.dither_due_reason or "α is in doubt", now_ns
    if registration.n_windows < MIN_WINDOWS_FOR_PAUSE:
        text = f"{registration.n_windows} of {MIN_WINDOWS_FOR_PAUSE} windows agree"
        return DitherPhase.ACQUIRE, text, now_ns
    # This is the default: a jump in a pause of 20 s remained undetected for 19 s
    # (docs/decisions/0021-dither-policy.md).
    if policy.longest_pause_s == 0.0:
        return DitherPhase.FOLLOW, "the settings allow no pause", now_ns
    window_ns = registration.window_ns_utc or registration.arrived_ns_utc
    longest_ns = window_ns + round(policy.longest_pause_s * SECOND_NS)
    passive_ns = state.dithers.policy.passive_ns_utc
    if passive_ns is not None and now_ns - passive_ns < MAX_PASSIVE_AGE_S * SECOND_NS:
        return _pace_with_passive(registration, requirement, longest_ns, now_ns)
    return _pace_without_passive(registration, requirement, longest_ns)


def _pace_with_passive(
    registration: Registration, requirement: DitherRequirement, longest_ns: int, now_ns: int
) -> tuple[DitherPhase, str, int]:
    """Pace by what the filter makes of dithered windows and ordinary telemetry together."""
    enough = bool(np.all(np.diag(registration.covariance) <= requirement.sigma**2))
    if enough:
        return DitherPhase.SPARSE, "ordinary telemetry keeps σ between windows", longest_ns
    if registration.arrived_ns_utc > registration.window_ns_utc:
        return DitherPhase.SPARSE, "ordinary telemetry alone keeps σ no longer", now_ns
    return DitherPhase.FOLLOW, "one window does not bring σ to its target", now_ns


def _pace_without_passive(
    registration: Registration, requirement: DitherRequirement, longest_ns: int
) -> tuple[DitherPhase, str, int]:
    """Pace by how far α may have walked since the last window."""
    # α walks randomly, so that its variance grows linearly with time. The parameter with the least
    # room decides.
    room = requirement.sigma**2 - np.diag(registration.covariance)
    on_s = DITHER_SETTLING_S + requirement.window_s + DITHER_MARGIN_S
    pause_s = float(np.min(room / requirement.drift_rate**2)) - on_s
    if pause_s < MIN_DITHER_PAUSE_S:
        text = "α walks too fast for a pause, or no window brings σ to its target"
        return DitherPhase.FOLLOW, text, registration.arrived_ns_utc
    # Bounded, because a slow drift allows any pause; the longest one is applied below.
    due_ns = registration.arrived_ns_utc + round(min(pause_s, 1e6) * SECOND_NS)
    text = "α cannot have walked far since the last window"
    return DitherPhase.SPARSE, text, min(due_ns, longest_ns)


def _steady_amplitude(
    state: TrackerState, found: Schedule, requirement: DitherRequirement
) -> float:
    """Return the amplitude, left as it is while the best one is near."""
    before = state.dithers.policy.plan
    settled = state.dithers.policy.phase in {DitherPhase.FOLLOW, DitherPhase.SPARSE}
    # A lower budget takes effect at once.
    if before is None or not settled or before.total_m > requirement.budget_m:
        return found.total_m
    ratio = found.total_m / before.total_m
    near = 1.0 / AMPLITUDE_HYSTERESIS_RATIO <= ratio <= AMPLITUDE_HYSTERESIS_RATIO
    return before.total_m if near else found.total_m


def check_dither_allowed(context: StepContext, rtc: Status) -> str | None:
    """Return why the service asks for no dither of its own, or None."""
    state = context.state
    still = state.dithers.policy.unwanted_id
    left = "" if still is None else f"; the RTC still plays {still}"
    if state.dithers.stopped:
        return f"stopped by the operator{left}"
    if not context.policy.dither_enabled and state.dithers.dither is None:
        return f"the settings forbid it{left}"
    if not rtc.in_loop:
        return explain_open_loop(rtc)
    unnamed = rtc.cm_id is None or state.matrices.read_back_error
    if (
        state.matrices.in_use is None
        and not unnamed
        and state.dithers.dither is None
        and rtc.dither is None
    ):
        return "the reconstructor in use is not known yet"
    alarm = context.blocking_alarm(Interlock.MEASURE)
    return None if alarm is None else f"nothing would be measured under {alarm.name}"


def awaits_result(context: StepContext, wanted_dither: WantedDither) -> bool:
    """Return whether the window of the dither that ended last may still be on its way."""
    dithering = context.dither_policy
    if wanted_dither.phase is DitherPhase.PROVE:
        return mode_proof.awaits_result(context, wanted_dither.parameters.window_s)
    if wanted_dither.phase is not DitherPhase.SPARSE or dithering.ended_ns_utc is None:
        return False
    late = context.now_ns - dithering.ended_ns_utc > MAX_RESULT_DELAY_S * SECOND_NS
    return not late and context.windows.accepted < dithering.results_due


def check_dither_strength(context: StepContext, rtc: Status) -> str | None:
    """Return why a running dither exceeds its limits, or None.

    An operator's own dither may exceed the budget, but not its own request.
    """
    if rtc.dither is None:
        return None
    running, dithering = rtc.dither.request, context.dither_policy
    found_m, most_m = total_m(running), budget_m(rtc, context.policy)
    purpose = infer_purpose(running.id, context.dither)
    over = is_automatic_sine(running, purpose) and found_m > AMPLITUDE_ROUNDING_RATIO * most_m
    if not over and running.id != dithering.loud_id:
        return None
    if running.id == dithering.loud_id and dithering.loud_text:
        return dithering.loud_text
    return (
        f"the RTC plays a dither of {1e9 * found_m:.3g} nm RMS in all, more than the budget of "
        f"{1e9 * most_m:.3g} nm"
    )


def check_dither_wanted(context: StepContext, rtc: Status) -> str | None:
    """Return why the dither that the RTC plays must go though it is not too strong, or None."""
    followed, running = context.dither, rtc.dither_id
    purpose = None if running is None else infer_purpose(running, followed)
    if purpose is None or purpose is DitherPurpose.FOREIGN:
        return None
    if context.operator.stopped_because:
        return "everything is stopped"
    if context.dithers.stopped and (followed is None or followed.id != running):
        return "an operator has stopped the dither"
    if not context.policy.dither_enabled and followed is None and purpose.automatic:
        return "the settings forbid a dither"
    return None
