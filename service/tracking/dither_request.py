"""A dither as planned, requested and adopted: its modes, amplitudes and lines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from service.control.dither import N_MODES_ABOVE_LOOP, place_lines, select_informative_modes
from service.control.loop import compute_amplification
from service.errors import CommandError, ModelError
from service.estimation.demodulation import SIDE_OFFSETS_HZ
from service.estimation.lockin import LockInPlan
from service.estimation.random_dither import FRAMES_PER_MODE, RandomPlan
from service.estimation.windows import DITHER_SETTLING_S, ExpectedDither
from service.records.operations import Dither, DitherPurpose
from service.records.products import ModeSet
from service.tracking.policy import Policy
from service.wire import DitherKind, DitherRequest, Status

N_LINES = 4
"""Modes that are dithered at once."""

LOW_MODE = 11
"""Mode of the loop that is dithered besides: without one the optical gains of all low modes were
inferred from the high ones, and up to 21 % wrong."""

LOW_MODE_SHARE = 0.06
"""Its share of the dither's power: a quarter of the power of each other mode. Its gain is then
known to 1 % after 5 s at magnitude 8, and α to 3 % less than without it."""

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Dither lines over the frame rate: wind biases those below 0.2; no sum of two meets a third."""

LINE_RANGE = (0.2, 0.35)
"""Range of the lines as a fraction of the frame rate, for avoiding vibrations."""

LOW_LINE_FRACTION, LOW_LINE_LIMIT = 0.389, 0.43
"""The line of ``LOW_MODE`` and its upper limit, as fractions of the frame rate."""

_OPTICAL_GAINS = (0.25, 0.5, 0.75, 1.0)
"""Optical gains that a loop on sky may have; unknown when a dither is planned."""

PROVING_LINE_RANGE = (0.15, 0.45)
"""The same of the many lines that show how modes answer: what wind does to a slow one is little of
its size."""

_MANY_LINES = np.linspace(*PROVING_LINE_RANGE, 100)


def choose_modes(
    rtc: Status, policy: Policy, shunned: frozenset[int] = frozenset()
) -> tuple[int, ...]:
    """Return the modes to dither: those in the settings, or the best for α.

    These are four above the controlled modes. If fewer are left they are four of the highest
    ``N_MODES_ABOVE_LOOP``, in the loop or not: the last modes of a basis contain little information
    on a rotation, and their response deviates most from the model. Until the model is available
    they are spread evenly, or the last four. ``shunned`` modes, whose response disagrees with the
    model, are used only if there are no others.
    """
    fixed = _without_choice(rtc, policy, shunned)
    if fixed is not None:
        return fixed
    first = _first_free(rtc, policy)
    if policy.mode_information is not None:
        return _most_informative(
            policy, first, min(first + N_MODES_ABOVE_LOOP, rtc.n_modes), shunned
        )
    step = max(1, min(20, (rtc.n_modes - first) // (N_LINES + 1)))
    return tuple(first + step // 2 + step * line for line in range(N_LINES))


def controlled(modes: tuple[int, ...], rtc: Status) -> tuple[int, ...]:
    """Return which of these modes the loop moves by itself."""
    if rtc.loop == "open":
        return ()
    return tuple(mode for mode in modes if mode < rtc.n_controlled and rtc.gains[mode])


def expected_amplification(rtc: Status, policy: Policy, chosen: tuple[int, ...] = ()) -> float:
    """Return the ratio of a dither's amplitude on the mirror to the request; 1 for free modes.

    The loop responds to a dither of its own modes. At 0.2 to 0.35 of the frame rate with a delay of
    two frames it amplifies the dither. The ratio is for all lines together, in any seeing. Without
    ``chosen`` modes it is for the four that follow α.
    """
    dithered = chosen or _without_choice(rtc, policy) or ()
    modes = controlled(dithered, rtc)
    if not modes:
        return 1.0
    gains = np.outer([rtc.gains[mode] for mode in modes], _OPTICAL_GAINS).ravel()
    lines = _MANY_LINES if chosen else np.array(LINE_FRACTIONS)
    found = compute_amplification(
        gains[:, None], lines, leak=rtc.leak, delay_frames=max(rtc.delay_frames, 1.0)
    )
    # The mean is over the lines, of power; the largest is over the optical gains, because the
    # seeing is not known. A loop that attenuates the dither must not raise the request.
    return max(float(np.sqrt(np.mean(found**2, axis=-1)).max()), 1.0)


def has_free_modes(rtc: Status, policy: Policy, *, n_inside: int) -> bool:
    """Return whether the service has other modes to dither, fewer of which the loop controls."""
    fixed = _without_choice(rtc, policy)
    return fixed is None or len(controlled(fixed, rtc)) < n_inside


def _without_choice(
    rtc: Status, policy: Policy, shunned: frozenset[int] = frozenset()
) -> tuple[int, ...] | None:
    """Return the modes to dither where there is no choice; None: there is."""
    if policy.dither_modes:
        return policy.dither_modes[: rtc.max_dither_modes]
    # Enough free modes are left to choose among.
    if rtc.n_modes - _first_free(rtc, policy) >= N_LINES:
        return None
    if policy.mode_information is None:
        return tuple(range(max(rtc.n_modes - N_LINES, 0), rtc.n_modes))
    highest = max(rtc.n_modes - N_MODES_ABOVE_LOOP, 0)
    return _most_informative(policy, highest, rtc.n_modes, shunned)[: rtc.max_dither_modes]


@lru_cache(maxsize=4)  # of one policy; asked for with every status
def _most_informative(
    policy: Policy, first: int, stop: int, shunned: frozenset[int]
) -> tuple[int, ...]:
    """Return the modes with most information on α."""
    if policy.mode_information is None:
        return ()
    among = [mode for mode in range(first, stop) if mode not in shunned]
    return select_informative_modes(policy.mode_information, among, N_LINES, policy.dither_sigma)


def _first_free(rtc: Status, policy: Policy) -> int:
    """Return the first mode that the loop neither controls nor is going to."""
    return max(rtc.n_controlled, policy.wanted_modes(rtc))


VIBRATION_CLEARANCES_HZ = (21.0, 8.0)
"""Distances between a line and a vibration that are tried in turn: beyond the side bins that
measure noise, then beyond the vibration's own width."""

DITHER_MARGIN_S = 0.3
"""Dither after the last window, in case it begins late because frames were lost."""

PROVING_DITHER_MARGIN_S = 0.9
"""Dither after the last window if there is only one: frames may be delayed by half a second, and a
status that shows the end of the dither before they are processed would cost the window."""

MAX_STOP_DELAY_S = 3.0
"""Time for a stop to be acknowledged, and for the next status to show it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherParameters:
    """Parameters of a dither that do not come from settings or an operator."""

    total_m: float
    """RMS of all lines together, metres OPD."""

    window_s: float
    """Telemetry in one estimate, seconds."""

    n_windows: int
    """Windows that it must last for."""

    avoid_hz: tuple[float, ...] = ()
    """Vibrations, Hz."""

    last_hz: tuple[float, ...] = ()
    """Lines of the last dither, kept if possible."""

    modes: tuple[int, ...] = ()
    """Modes whose response is to be measured; empty for those that determine α best."""

    lines_hz: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    """Share of the power of each mode; empty for equal shares."""

    shunned: frozenset[int] = frozenset()
    """Modes that are not to be dithered to follow α."""

    low_mode: bool = False
    """True if ``LOW_MODE`` may be dithered besides: it answers as the model says."""


def check_dither_usable(dither: Dither, rtc: Status, policy: Policy) -> str | None:
    """Return why the lines of a dither cannot be separated in its windows, or None."""
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
    choice: DitherParameters,
    modes: tuple[int, ...] | None = None,
    amplitude_m: float | None = None,
    frequency_hz: tuple[float, ...] | None = None,
    duration_s: float | None = None,
) -> Dither:
    """Return the dither to ask for; the policy chooses what is not given.

    Lines have whole periods in a window. The loop leaves the modes alone, if there are such.
    """
    asked = any(wish is not None for wish in (modes, amplitude_m, frequency_hz, duration_s))
    proving = choice.modes and not asked
    chosen = modes or choice.modes or choose_modes(rtc, policy, choice.shunned)
    chosen = chosen[: rtc.max_dither_modes]
    lines = choice.lines_hz if proving else frequency_hz or policy.dither_frequencies_hz
    lines = clear_lines(rtc, len(chosen), choice) if lines is None else lines
    sizes = [amplitude_m or choice.total_m / np.sqrt(max(len(chosen), 1))] * len(chosen)
    if proving and choice.shares:
        sizes = [choice.total_m * np.sqrt(share) for share in choice.shares]
    low = None if asked or choice.modes else low_line(rtc, policy, choice, chosen, lines)
    if low is not None:
        chosen, lines = (*chosen, LOW_MODE), (*lines, low)
        rest = np.sqrt(1.0 - LOW_MODE_SHARE)
        sizes = [*(size * rest for size in sizes), choice.total_m * np.sqrt(LOW_MODE_SHARE)]
    spare_s = PROVING_DITHER_MARGIN_S if proving else DITHER_MARGIN_S
    lasting_s = DITHER_SETTLING_S + choice.n_windows * choice.window_s + spare_s
    step_hz = step_of(rtc, choice.window_s)
    purpose = DitherPurpose.PROVE if proving else DitherPurpose.FOLLOW
    purpose = DitherPurpose.OPERATOR if asked else purpose
    request = DitherRequest(
        id=name_dither(purpose, now_ns),
        kind=DitherKind.SINE,
        modes=chosen,
        amplitude_m=tuple(float(min(size, rtc.max_dither_m)) for size in sizes),
        frequency_hz=tuple(round(f / step_hz) * step_hz for f in lines),
        duration_s=duration_s or lasting_s,
    )
    return Dither(request=request, purpose=purpose, asked_ns_utc=now_ns, window_s=choice.window_s)


def name_dither(purpose: DitherPurpose, now_ns: int) -> str:
    """Return the id of a dither requested now; an engineer at the RTC reads its purpose there."""
    return f"{purpose}-{now_ns}"


def infer_purpose(shown_id: str, followed: Dither | None) -> DitherPurpose:
    """Return the purpose of the dither that the RTC's status shows."""
    if followed is not None and followed.id == shown_id:
        return followed.purpose
    # Nobody follows it. An earlier run may have requested it, or a service on another machine that
    # this one has taken over from, whose archive it cannot read: the status has nothing but the id.
    # This is the only place where an id is parsed.
    begins, _, time = shown_id.rpartition("-")
    known = begins in {*DitherPurpose} and time[:1].isdigit()
    return DitherPurpose(begins) if known else DitherPurpose.FOREIGN


def is_automatic_sine(request: DitherRequest, purpose: DitherPurpose) -> bool:
    """Return whether a dither is one that the service has chosen by itself."""
    return purpose.automatic and request.kind is DitherKind.SINE


def total_m(request: DitherRequest) -> float:
    """Return the RMS of all lines of a dither together, metres OPD."""
    return float(np.sqrt(np.sum(np.square(request.amplitude_m))))


def lock_in_plan(dither: Dither, rtc: Status, window_s: float) -> LockInPlan:
    """Return the demodulation plan of a dither, beginning when the loop has settled.

    The dither's own window length is used; ``window_s`` is the default for a dither without one.

    Raises
    ------
    ModelError
        If its lines cannot be separated in a window.
    """
    return LockInPlan(
        modes=dither.request.modes,
        frequencies_hz=dither.frequency_hz,
        amplitude_m=dither.request.amplitude_m,
        frame_rate_hz=rtc.frame_rate_hz,
        n_frames=round((dither.window_s or window_s) * rtc.frame_rate_hz),
        first_seq=(dither.start_seq or 0) + round(DITHER_SETTLING_S * rtc.frame_rate_hz),
    )


def expected_dither(
    dither: Dither, rtc: Status, products: NDArray[np.float32] | None = None
) -> ExpectedDither:
    """Return the expected dither in the frames.

    ``products`` is that of ``Description``; None if the slopes' response is unknown.
    """
    # There is no start before the RTC has accepted the dither.
    first_seq, request = dither.start_seq or 0, dither.request
    modes = list(request.modes)
    response: tuple[float, ...] = ()
    if products is not None and max(modes) < len(products):
        response = tuple(products[modes, modes].tolist())
    return ExpectedDither(
        id=dither.id,
        modes=request.modes,
        amplitude_m=request.amplitude_m,
        frequency_hz=dither.frequency_hz,
        frame_rate_hz=rtc.frame_rate_hz,
        first_seq=first_seq,
        stop_seq=first_seq + round(request.duration_s * rtc.frame_rate_hz),
        own=tuple(mode not in rtc.in_loop for mode in request.modes),
        response=response,
    )


def clear_lines(rtc: Status, n_lines: int, choice: DitherParameters) -> tuple[float, ...]:
    """Return lines in the band that wind affects little, as far from vibrations as possible.

    The lines of the last dither are kept unless one is on a vibration or outside the band that the
    present frame rate allows.
    """
    last = choice.last_hz[:n_lines]
    rate, step = rtc.frame_rate_hz, step_of(rtc, choice.window_s)
    # The side bins of a line must stay between 0 and the Nyquist frequency after the line was
    # rounded to a whole period.
    edge = float(SIDE_OFFSETS_HZ.max()) + step
    near = [abs(line - vibration) for line in last for vibration in choice.avoid_hz]
    usable = all(edge <= line <= rate / 2 - edge for line in last)
    if len(last) == n_lines and usable and min(near, default=np.inf) >= VIBRATION_CLEARANCES_HZ[-1]:
        return last
    fractions = LINE_FRACTIONS[:n_lines]
    if n_lines > N_LINES:
        fractions = tuple(np.linspace(*LINE_RANGE, n_lines).tolist())
    wanted = tuple(fraction * rate for fraction in fractions)
    band = (max(LINE_RANGE[0] * rate, edge), min(LINE_RANGE[1] * rate, rate / 2 - edge))
    for clearance_hz in (*VIBRATION_CLEARANCES_HZ, 4.0 * step):
        found = place_lines(
            wanted, choice.avoid_hz, clearance_hz=clearance_hz, step_hz=step, range_hz=band
        )
        if found is not None:
            return found
    return wanted


def low_line(
    rtc: Status,
    policy: Policy,
    choice: DitherParameters,
    chosen: tuple[int, ...],
    lines: tuple[float, ...],
) -> float | None:
    """Return the line on which ``LOW_MODE`` is dithered besides the ``chosen`` modes on ``lines``.

    None if it must not be, if the settings fix modes, amplitude or lines, if the RTC plays no more
    modes, if the loop does not control it, if the chosen modes are hardly higher, or if no line is
    clear of the others and of vibrations.
    """
    fixed = policy.dither_modes or policy.dither_frequencies_hz or policy.dither_amplitude_m
    near = min(chosen, default=0) < 4 * LOW_MODE or len(chosen) >= rtc.max_dither_modes
    if fixed or near or not (choice.low_mode and controlled((LOW_MODE,), rtc)):
        return None
    rate, step = rtc.frame_rate_hz, step_of(rtc, choice.window_s)
    edge = float(SIDE_OFFSETS_HZ.max()) + step
    found = place_lines(
        (*lines, LOW_LINE_FRACTION * rate),
        choice.avoid_hz,
        clearance_hz=VIBRATION_CLEARANCES_HZ[0],
        step_hz=step,
        range_hz=(LINE_RANGE[0] * rate, min(LOW_LINE_LIMIT * rate, rate / 2 - edge)),
    )
    return found[-1] if found is not None and found[:-1] == lines else None


def on_vibrations(dither: Dither, avoid_hz: tuple[float, ...]) -> tuple[float, ...]:
    """Return the lines of a dither that are not clear of vibrations."""
    # A line that was placed at exactly the clearance is clear.
    near = VIBRATION_CLEARANCES_HZ[-1] - 1e-6
    return tuple(f for f in dither.frequency_hz if any(abs(f - v) < near for v in avoid_hz))


def step_of(rtc: Status, window_s: float) -> float:
    """Return the frequency of one period in a window."""
    return rtc.frame_rate_hz / max(round(window_s * rtc.frame_rate_hz), 1)


DEFAULT_DURATION_S = 120.0
"""Duration of a dither that an operator requests without stating one."""

DEFAULT_RANDOM_RMS_M = 5e-9
"""Default RMS of all modes together, metres OPD, within the budget."""

RANDOM_WINDOW_MARGIN_RATIO = 2.0
"""Ratio of the windows' length to the shortest possible for so many modes."""


def plan_random(
    rtc: Status,
    policy: Policy,
    now_ns: int,
    *,
    purpose: DitherPurpose,
    dither_id: str,
    modes: tuple[int, ...] | ModeSet,
    total_m: float,
    duration_s: float,
) -> Dither:
    """Return random signs to ask for; their windows, all alike, fill their whole length.

    Parameters
    ----------
    rtc, policy, now_ns
        The RTC, the settings and the time.
    purpose, dither_id
        Purpose of the dither, and the id of the request.
    modes
        0-based basis indices, or which they are.
    total_m
        RMS of all modes together, metres OPD.
    duration_s
        Of telemetry, settling not included.

    Raises
    ------
    CommandError
        If the RTC would not play it, or no window fits into it.
    """
    modes = _modes(modes, rtc)
    # Powers of modes add, so that the RMS of each is the total over the root of their number.
    amplitude_m = float(total_m / np.sqrt(len(modes)))
    if amplitude_m > rtc.max_dither_m:
        raise CommandError(
            f"found {1e9 * amplitude_m:.3g} nm on each of {len(modes)} modes, the RTC "
            f"takes at most {1e9 * rtc.max_dither_m:.3g} nm"
        )
    least_s = max(
        policy.window_s,
        RANDOM_WINDOW_MARGIN_RATIO * FRAMES_PER_MODE * len(modes) / rtc.frame_rate_hz,
    )
    # The tolerance keeps rounding from losing a window of a duration that is an exact multiple.
    n_windows = int(duration_s / least_s * (1.0 + 1e-9))
    if n_windows < 1:
        raise CommandError(
            f"found {duration_s:g} s; {len(modes)} modes need windows of {least_s:.3g} s"
        )
    request = DitherRequest(
        id=dither_id,
        kind=DitherKind.BINARY,
        modes=modes,
        amplitude_m=(amplitude_m,) * len(modes),
        seed=now_ns % (1 << 31),
        duration_s=DITHER_SETTLING_S + duration_s + DITHER_MARGIN_S,
    )
    return Dither(
        request=request, purpose=purpose, asked_ns_utc=now_ns, window_s=duration_s / n_windows
    )


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
        # Rounded down, so that all windows fit into the dither; the tolerance is for rounding
        # errors.
        n_frames=int((dither.window_s or window_s) * rtc.frame_rate_hz * (1.0 + 1e-12)),
        first_seq=(dither.start_seq or 0) + round(DITHER_SETTLING_S * rtc.frame_rate_hz),
    )


def check_modes(modes: tuple[int, ...], rtc: Status) -> None:
    """Refuse modes that the RTC's basis does not have, or none.

    Raises
    ------
    CommandError
        If so.
    """
    if not modes or max(modes) >= rtc.n_modes:
        found = max(modes, default=None)
        raise CommandError(f"found mode {found}; expected 0 to {rtc.n_modes - 1}")


def cost_of(total_m: float, policy: Policy, *, over_budget: bool) -> str:
    """Return in words what a dither costs, of the budget; beyond it only if that is meant.

    Raises
    ------
    CommandError
        If it is not.
    """
    cost = f"{1e9 * total_m:.3g} nm RMS in all, budget {1e9 * policy.dither_budget_m:.3g} nm"
    # Rounding must not put a dither of exactly the budget over it.
    if total_m <= policy.dither_budget_m * (1.0 + 1e-9):
        return cost
    if not over_budget:
        raise CommandError(f"{cost}; say over_budget if that is meant")
    return f"{cost}: over budget, as asked"


def _modes(asked: tuple[int, ...] | ModeSet, rtc: Status) -> tuple[int, ...]:
    if isinstance(asked, ModeSet):
        modes = tuple(range(rtc.n_modes if asked is ModeSet.ALL else rtc.n_controlled))
    else:
        modes = asked
    check_modes(modes, rtc)
    if len(modes) > rtc.max_dither_modes:
        raise CommandError(
            f"found {len(modes)} modes; the RTC dithers at most {rtc.max_dither_modes}"
        )
    return modes
