"""Which dither is wanted and when: modes, lines clear of vibrations, amplitude, windows, pauses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.control import dither
from service.control.dither import (
    SPAN,
    Demand,
    Schedule,
    clear_of,
    most_telling,
    schedule,
    tabulated,
)
from service.errors import CommandError, ModelError
from service.telemetry.lockin import SIDE_OFFSETS_HZ, LockInPlan
from service.telemetry.played import Asked
from service.telemetry.random_dither import FRAMES_PER_MODE, RandomPlan
from service.tracking.loop import Dither
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.products import ModeSet
from service.tracking.registration import Registration
from service.tracking.stages import DitherPhase, DitherPlan
from service.tracking.state import TrackerState
from service.wire import DitherKind, DitherRequest, Status

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Dither lines over the frame rate: wind biases those below 0.2; no sum of two meets a third."""

LINE_RANGE = (0.2, 0.35)
"""Of the frame rate, where lines may go to keep clear of vibrations."""

CLEARANCES_HZ = (21.0, 8.0)
"""Between a line and a vibration: beyond the side bins that measure the noise, or at least beyond
a vibration's own width."""

SETTLING_S = 0.3
"""Of the loop, after a dither has begun, before the first window."""

SPARE_S = 0.3
"""Of dither behind the last window, for one that begins late because frames were lost."""

OWN_DITHER = "dither-"
ASKED_DITHER = "operator-"
NOISY_DITHER = "noisy-"
ACQUIRING_DITHER = "acquire-"
"""How the id of a dither begins that the service has chosen, an operator, one that measures a
noisy interaction matrix, and one that finds α from nothing."""

OUR_DITHERS = (OWN_DITHER, ASKED_DITHER, NOISY_DITHER, ACQUIRING_DITHER)

_N_LINES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What a dither is to be like, besides what settings or an operator fix."""

    total_m: float
    """RMS of all lines together, metres OPD."""

    window_s: float
    """Telemetry in one estimate."""

    n_windows: int
    """Windows it must last for."""

    avoid_hz: tuple[float, ...] = ()
    """Vibrations."""

    last_hz: tuple[float, ...] = ()
    """Lines it need not leave without reason."""


def why_unusable(dither: Dither, rtc: Status, policy: Policy) -> str | None:
    """Return why the lines of a dither cannot be told apart in its windows, or None."""
    kind = dither.request.kind
    if kind is not DitherKind.SINE:
        return f"{dither.id} is {kind}, not a sine"
    try:
        lock_in_plan(dither, rtc, policy.window_s)
    except ModelError as error:
        return str(error)
    return None


def plan_dither(
    rtc: Status,
    policy: Policy,
    now_ns: int,
    *,
    choice: Choice | None = None,
    modes: tuple[int, ...] | None = None,
    amplitude_m: float | None = None,
    frequency_hz: tuple[float, ...] | None = None,
    duration_s: float | None = None,
) -> Dither:
    """Return the dither to ask for: what is not given is the policy's own choice.

    The lines are rounded to whole periods in a window. The modes are ones the loop does not and
    will not control: nothing there amplifies the dither or the noise. Without a ``choice`` it is
    the whole budget for as long as the policy allows.
    """
    asked = any(wish is not None for wish in (modes, amplitude_m, frequency_hz, duration_s))
    n_windows = int((policy.dither_duration_s - SETTLING_S - SPARE_S) / policy.window_s)
    choice = choice or Choice(
        total_m=policy.dither_budget_m, window_s=policy.window_s, n_windows=max(n_windows, 1)
    )
    chosen = (modes or policy.dither_modes or _uncontrolled_modes(rtc, policy))[
        : rtc.max_dither_modes
    ]
    lines = frequency_hz or policy.dither_frequencies_hz
    if lines is None:
        lines = clear_lines(rtc, len(chosen), choice)
    amplitude = amplitude_m or choice.total_m / np.sqrt(max(len(chosen), 1))
    lasting_s = SETTLING_S + choice.n_windows * choice.window_s + SPARE_S
    step_hz = _step_hz(rtc, choice.window_s)
    request = DitherRequest(
        id=f"{ASKED_DITHER if asked else OWN_DITHER}{now_ns}",
        kind=DitherKind.SINE,
        modes=chosen,
        amplitude_m=(float(min(amplitude, rtc.max_dither_m)),) * len(chosen),
        frequency_hz=tuple(round(f / step_hz) * step_hz for f in lines),
        duration_s=duration_s or lasting_s,
    )
    return Dither(request=request, asked_ns_utc=now_ns, window_s=choice.window_s)


def total_m(request: DitherRequest) -> float:
    """Return the RMS of all lines of a dither together, metres OPD."""
    return float(np.sqrt(np.sum(np.square(request.amplitude_m))))


def lock_in_plan(dither: Dither, rtc: Status, window_s: float) -> LockInPlan:
    """Return how a dither is demodulated, from where the loop has settled.

    Its own window counts; ``window_s`` is for a dither that was planned without one.

    Raises
    ------
    ModelError
        If its lines cannot be told apart in a window.
    """
    return LockInPlan(
        modes=dither.request.modes,
        frequencies_hz=dither.frequency_hz,
        amplitude_m=dither.request.amplitude_m,
        frame_rate_hz=rtc.frame_rate_hz,
        n_frames=round((dither.window_s or window_s) * rtc.frame_rate_hz),
        first_seq=(dither.start_seq or 0) + round(SETTLING_S * rtc.frame_rate_hz),
    )


def asked_of(dither: Dither, rtc: Status) -> Asked:
    """Return a dither as the frames should hold it."""
    first_seq, request = dither.start_seq or 0, dither.request
    return Asked(
        modes=request.modes,
        amplitude_m=request.amplitude_m,
        frequency_hz=dither.frequency_hz,
        frame_rate_hz=rtc.frame_rate_hz,
        first_seq=first_seq,
        stop_seq=first_seq + round(request.duration_s * rtc.frame_rate_hz),
        own=tuple(mode not in rtc.in_loop for mode in request.modes),
    )


def clear_lines(rtc: Status, n_lines: int, choice: Choice) -> tuple[float, ...]:
    """Return lines in the band that wind leaves alone, as clear of vibrations as these allow.

    Those of the last dither stay while none of them is on a vibration.
    """
    last = choice.last_hz
    near = [abs(line - vibration) for line in last for vibration in choice.avoid_hz]
    if len(last) == n_lines and min(near, default=np.inf) >= CLEARANCES_HZ[-1]:
        return last
    rate, step = rtc.frame_rate_hz, _step_hz(rtc, choice.window_s)
    fractions = LINE_FRACTIONS[:n_lines]
    if n_lines > _N_LINES:
        fractions = tuple(np.linspace(*LINE_RANGE, n_lines).tolist())
    wanted = tuple(fraction * rate for fraction in fractions)
    edge = float(SIDE_OFFSETS_HZ.max()) + step
    band = (max(LINE_RANGE[0] * rate, edge), min(LINE_RANGE[1] * rate, rate / 2 - edge))
    for clearance_hz in (*CLEARANCES_HZ, 4.0 * step):
        found = clear_of(
            wanted, choice.avoid_hz, clearance_hz=clearance_hz, step_hz=step, range_hz=band
        )
        if found is not None:
            return found
    return wanted


def on_vibrations(dither: Dither, avoid_hz: tuple[float, ...]) -> tuple[float, ...]:
    """Return the lines of a dither that are not clear of vibrations."""
    near = CLEARANCES_HZ[-1] - 1e-6
    return tuple(f for f in dither.frequency_hz if any(abs(f - v) < near for v in avoid_hz))


def n_lines(rtc: Status, policy: Policy) -> int:
    """Return how many modes the service dithers by itself."""
    return min(len(policy.dither_modes or range(_N_LINES)), rtc.max_dither_modes)


def _step_hz(rtc: Status, window_s: float) -> float:
    """Return the frequency of one period in a window."""
    return rtc.frame_rate_hz / max(round(window_s * rtc.frame_rate_hz), 1)


def _uncontrolled_modes(rtc: Status, policy: Policy) -> tuple[int, ...]:
    """Return the four most telling modes above the controlled ones, or the highest four there are.

    Until the model is known they are spread evenly.
    """
    first = max(rtc.n_controlled, min(policy.n_modes_target, rtc.n_modes))
    spare = rtc.n_modes - first
    if spare < _N_LINES:
        return tuple(range(max(rtc.n_modes - _N_LINES, 0), rtc.n_modes))
    if policy.mode_information is not None:
        above = range(first, min(first + SPAN, rtc.n_modes))
        return most_telling(policy.mode_information, above, _N_LINES, policy.dither_sigma)
    step = max(1, min(20, spare // (_N_LINES + 1)))
    return tuple(first + step // 2 + step * line for line in range(_N_LINES))


RANDOM_TOTAL_M = 5e-9
"""RMS of all modes together where none is asked for, within the budget."""

COMFORTABLE = 2.0
"""Windows are longer by this than they have to be for so many modes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomChoice:
    """What a random dither is to be like."""

    id: str
    modes: tuple[int, ...] | ModeSet
    total_m: float
    """RMS of all modes together, metres OPD."""

    duration_s: float
    """Of telemetry, settling not included."""


def plan_random(asked: RandomChoice, rtc: Status, policy: Policy, now_ns: int) -> Dither:
    """Return the dither to ask for; its windows, all alike, fill its whole length.

    Raises
    ------
    CommandError
        If the RTC would not play it, or no window fits into it.
    """
    modes = _modes(asked.modes, rtc)
    amplitude_m = float(asked.total_m / np.sqrt(len(modes)))
    if amplitude_m > rtc.max_dither_m:
        raise CommandError(
            f"dither: found {1e9 * amplitude_m:.3g} nm on each of {len(modes)} modes, the RTC "
            f"takes at most {1e9 * rtc.max_dither_m:.3g} nm"
        )
    least_s = max(policy.window_s, COMFORTABLE * FRAMES_PER_MODE * len(modes) / rtc.frame_rate_hz)
    n_windows = int(asked.duration_s / least_s * (1.0 + 1e-9))
    if n_windows < 1:
        raise CommandError(
            f"dither: found {asked.duration_s:g} s; {len(modes)} modes need windows of "
            f"{least_s:.3g} s"
        )
    request = DitherRequest(
        id=asked.id,
        kind=DitherKind.BINARY,
        modes=modes,
        amplitude_m=(amplitude_m,) * len(modes),
        seed=now_ns % (1 << 31),
        duration_s=SETTLING_S + asked.duration_s + SPARE_S,
    )
    return Dither(request=request, asked_ns_utc=now_ns, window_s=asked.duration_s / n_windows)


def random_plan(dither: Dither, rtc: Status, window_s: float) -> RandomPlan:
    """Return how a random dither is correlated, from where the loop has settled.

    Raises
    ------
    ModelError
        If its windows are too short for its modes.
    """
    return RandomPlan(
        modes=dither.request.modes,
        amplitude_m=dither.request.amplitude_m,
        n_frames=int((dither.window_s or window_s) * rtc.frame_rate_hz * (1.0 + 1e-12)),
        first_seq=(dither.start_seq or 0) + round(SETTLING_S * rtc.frame_rate_hz),
    )


def _modes(asked: tuple[int, ...] | ModeSet, rtc: Status) -> tuple[int, ...]:
    if isinstance(asked, ModeSet):
        modes = tuple(range(rtc.n_modes if asked is ModeSet.ALL else rtc.n_controlled))
    else:
        modes = asked
    if not modes or max(modes) >= rtc.n_modes:
        raise CommandError(
            f"dither: found mode {max(modes, default=None)}; expected 0 to {rtc.n_modes - 1}"
        )
    if len(modes) > rtc.max_dither_modes:
        raise CommandError(
            f"dither: found {len(modes)} modes; the RTC dithers at most {rtc.max_dither_modes}"
        )
    return modes


MIN_WINDOWS = 3
"""Windows that must agree before the dither is less than the whole budget, or pauses."""

LASTING_S = 30.0
"""Of a request without pause: no longer does a dead service leave a dither behind."""

SHORTEST_PAUSE_S = 3.0
"""A shorter one is not worth the settling of the next dither."""

WATCHED_WITHIN_S = 25.0
"""A passive estimate younger than this is watching: two of its looks, and some."""

FAINT_MAGNITUDE = 11.5
FAINT_WINDOW_S = 5.0
"""On a faint star a shorter window biases the rotation (0.08 deg at magnitude 12.5 in 1 s)."""

WINDOW_LADDER = (1.0, 2.5, 5.0, 10.0)
"""Lengths of windows, in units of the shortest."""

SITTING_LADDER = (1, 2, 3, 5, 8, 12)
"""Windows in one sitting."""

USABLE = np.array([0.03, 0.03, np.deg2rad(0.04), 0.003])
"""1 σ of one window above which its fit may be biased by noise, numeric units."""

CHANGE = 1.25
"""The amplitude stays while the best one is within this factor of it."""

JUMP = np.array([0.1, 0.1, np.deg2rad(0.1), np.inf])
"""What two windows must tell when it happens at once (numeric units): a tenth of a subaperture, a
tenth of a degree."""

STANDS_OUT = 6.0
"""A jump of so many σ of one window is told by two, wherever in the first it falls."""

_SLOWEST = 1e-9
"""Random walk after a second, numeric units: nothing on a telescope stands stiller."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """The dither that is wanted."""

    phase: DitherPhase
    reason: str
    choice: Choice
    next_ns_utc: int
    """When; now or earlier: at once."""


def wanted(
    state: TrackerState, rtc: Status, policy: Policy, now_ns: int
) -> tuple[Wish, DitherPlan]:
    """Return the dither that is wanted in this state, and the plan behind it."""
    kappa = precision(state, rtc)
    demand = _demand(kappa, state, rtc, policy, now_ns)
    window_s = demand.window_s
    sittings = tuple(n * window_s for n in SITTING_LADDER)
    sparse = replace(demand, window_s=dither.burst_s(kappa, demand, sittings))
    phase, reason, next_ns = _paced(state, sparse, policy, now_ns)
    demand = sparse if phase is DitherPhase.SPARSE else demand
    found = schedule(kappa, demand)
    plan = _plan(state, found, demand, window_s, phase)
    fixed = policy.dither_amplitude_m is not None
    choice = Choice(
        total_m=demand.budget_m if fixed else plan.total_m,
        window_s=window_s,
        n_windows=max(int(max(demand.window_s, _lasting_s(phase)) / window_s + 1e-6), 1),
        avoid_hz=(*policy.dither_avoid_hz, *state.vibrations_hz),
        last_hz=state.dithering.lines_hz,
    )
    return Wish(phase=phase, reason=reason, choice=choice, next_ns_utc=next_ns), plan


def by_hand(state: TrackerState, rtc: Status, policy: Policy) -> Choice:
    """Return what an operator's dither is like where the operator does not say."""
    plan = state.dithering.plan
    window_s = policy.window_s if plan is None else plan.window_s
    lasting_s = policy.dither_duration_s - SETTLING_S - SPARE_S
    return Choice(
        total_m=budget_m(rtc, policy),
        window_s=window_s,
        n_windows=max(int(lasting_s / window_s + 1e-6), 1),
        avoid_hz=(*policy.dither_avoid_hz, *state.vibrations_hz),
        last_hz=state.dithering.lines_hz,
    )


def _plan(
    state: TrackerState, found: Schedule, demand: Demand, window_s: float, phase: DitherPhase
) -> DitherPlan:
    """Return the schedule as it is carried out."""
    total_m, interval_s = _steady(state, found, demand), found.interval_s
    if phase is DitherPhase.ACQUIRE:
        total_m = demand.budget_m
    if phase is not DitherPhase.SPARSE:
        interval_s = window_s
    on_s = min(demand.window_s + demand.settling_s, interval_s)
    return DitherPlan(
        total_m=total_m,
        window_s=window_s,
        interval_s=interval_s,
        sigma=found.sigma,
        sufficient=found.sufficient,
        mean_cost_m=total_m * float(np.sqrt(on_s / interval_s)),
    )


def precision(state: TrackerState, rtc: Status) -> NDArray[np.float64]:
    """Return κ ``(4,)`` of ``σ = κ / (A sqrt(T))`` as far as it has been learnt."""
    table, known = tabulated(rtc.magnitude), state.dithering.precision
    return table if known is None else table * known.ratio


def budget_m(rtc: Status, policy: Policy) -> float:
    """Return the largest RMS of all lines together that policy, settings and RTC allow, metres."""
    n = n_lines(rtc, policy)
    largest = min(rtc.max_dither_m, policy.dither_amplitude_m or np.inf)
    return float(min(policy.dither_budget_m, largest * np.sqrt(max(n, 1))))


def window_lengths_s(policy: Policy) -> tuple[float, ...]:
    """Return how long a window may be, shortest first."""
    lengths = [policy.window_s * step for step in WINDOW_LADDER]
    return tuple(s for s in lengths if s <= policy.longest_window_s) or (policy.window_s,)


def _demand(
    kappa: NDArray[np.float64], state: TrackerState, rtc: Status, policy: Policy, now_ns: int
) -> Demand:
    demand = Demand(
        sigma=policy.dither_sigma,
        drift_rate=np.sqrt(np.maximum(_walk_rate(state, policy, now_ns), _SLOWEST**2)),
        budget_m=budget_m(rtc, policy),
        window_s=policy.window_s,
        settling_s=SETTLING_S,
        window_sigma=JUMP / STANDS_OUT,
        longest_s=policy.longest_pause_s,
    )
    lengths = window_lengths_s(policy)
    if rtc.magnitude is not None and rtc.magnitude >= FAINT_MAGNITUDE:
        lengths = tuple(s for s in lengths if s >= FAINT_WINDOW_S) or lengths[-1:]
    return replace(demand, window_s=dither.window_s(kappa, demand, USABLE, lengths))


def _lasting_s(phase: DitherPhase) -> float:
    """Return how long a request is to be read at least, seconds."""
    return 0.0 if phase is DitherPhase.SPARSE else LASTING_S - SETTLING_S - SPARE_S


def _walk_rate(state: TrackerState, policy: Policy, now_ns: int) -> NDArray[np.float64]:
    """Return ``(4,)`` variance that α gains in a second: the drift, or the flexure of a slew."""
    known, base = state.registration, policy.drift_rate**2
    if known is None:
        return base
    age_s = (now_ns - known.arrived_ns_utc) / SECOND_NS
    return np.maximum(base, known.grown / age_s) if age_s >= 1.0 else base


def _paced(
    state: TrackerState, demand: Demand, policy: Policy, now_ns: int
) -> tuple[DitherPhase, str, int]:
    """Return how to dither, why, and when the next window is due."""
    known = state.registration
    if known is None:
        return DitherPhase.ACQUIRE, "α is not known", now_ns
    if state.dither_due_since_ns_utc is not None:
        return DitherPhase.ACQUIRE, state.dither_due_reason or "α is in doubt", now_ns
    if known.n_windows < MIN_WINDOWS:
        text = f"{known.n_windows} of {MIN_WINDOWS} windows agree"
        return DitherPhase.ACQUIRE, text, now_ns
    if policy.longest_pause_s == 0.0:
        return DitherPhase.FOLLOW, "the settings allow no pause", now_ns
    window_ns = known.window_ns_utc or known.arrived_ns_utc
    longest_ns = window_ns + round(policy.longest_pause_s * SECOND_NS)
    passive_ns = state.dithering.passive_ns_utc
    if passive_ns is not None and now_ns - passive_ns < WATCHED_WITHIN_S * SECOND_NS:
        return _watched(known, demand, longest_ns, now_ns)
    return _unwatched(known, demand, longest_ns)


def _watched(
    known: Registration, demand: Demand, longest_ns: int, now_ns: int
) -> tuple[DitherPhase, str, int]:
    """Pace by what the filter makes of dithered windows and ordinary telemetry together."""
    enough = bool(np.all(np.diag(known.covariance) <= demand.sigma**2))
    if enough:
        return DitherPhase.SPARSE, "ordinary telemetry keeps σ between windows", longest_ns
    if known.arrived_ns_utc > known.window_ns_utc:
        return DitherPhase.SPARSE, "ordinary telemetry alone keeps σ no longer", now_ns
    return DitherPhase.FOLLOW, "a window alone does not bring σ to what is asked", now_ns


def _unwatched(
    known: Registration, demand: Demand, longest_ns: int
) -> tuple[DitherPhase, str, int]:
    """Pace by how far α may have walked since the last window."""
    room = demand.sigma**2 - np.diag(known.covariance)
    on_s = demand.settling_s + demand.window_s + SPARE_S
    pause_s = float(np.min(room / demand.drift_rate**2)) - on_s
    if pause_s < SHORTEST_PAUSE_S:
        text = "α walks too fast for a pause, or no window brings σ to what is asked"
        return DitherPhase.FOLLOW, text, known.arrived_ns_utc
    due_ns = known.arrived_ns_utc + round(min(pause_s, 1e6) * SECOND_NS)
    return (
        DitherPhase.SPARSE,
        "α cannot have walked far since the last window",
        min(due_ns, longest_ns),
    )


def _steady(state: TrackerState, found: Schedule, demand: Demand) -> float:
    """Return the amplitude, left as it is while the best one is near."""
    before = state.dithering.plan
    settled = state.dithering.phase in {DitherPhase.FOLLOW, DitherPhase.SPARSE}
    if before is None or not settled or before.total_m > demand.budget_m:
        return found.total_m
    ratio = found.total_m / before.total_m
    return before.total_m if 1.0 / CHANGE <= ratio <= CHANGE else found.total_m
