"""Which dither is asked for: modes, lines clear of vibrations, amplitude within every limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.control.dither_modes import SPAN, most_telling
from service.control.dithering import clear_of
from service.errors import ModelError
from service.reactions.policy import Policy
from service.state import DitherKind, DitherView, RtcView
from service.telemetry.lockin import SIDE_OFFSETS_HZ, LockInPlan
from service.telemetry.played import Asked

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


def why_unusable(dither: DitherView, rtc: RtcView, policy: Policy) -> str | None:
    """Return why the lines of a dither cannot be told apart in its windows, or None."""
    if dither.kind is not DitherKind.SINE:
        return f"{dither.id} is {dither.kind}, not a sine"
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
    choice: Choice | None = None,
    modes: tuple[int, ...] | None = None,
    amplitude_m: float | None = None,
    frequency_hz: tuple[float, ...] | None = None,
    duration_s: float | None = None,
) -> DitherView:
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
    return DitherView(
        id=f"{ASKED_DITHER if asked else OWN_DITHER}{now_ns}",
        modes=chosen,
        amplitude_m=(float(min(amplitude, rtc.max_dither_m)),) * len(chosen),
        frequency_hz=tuple(round(f / step_hz) * step_hz for f in lines),
        duration_s=duration_s or lasting_s,
        start_seq=None,
        asked_ns_utc=now_ns,
        window_s=choice.window_s,
    )


def total_m(dither: DitherView) -> float:
    """Return the RMS of all lines of a dither together, metres OPD."""
    return float(np.sqrt(np.sum(np.square(dither.amplitude_m))))


def lock_in_plan(dither: DitherView, rtc: RtcView, window_s: float) -> LockInPlan:
    """Return how a dither is demodulated, from where the loop has settled.

    Its own window counts; ``window_s`` is for a dither that was planned without one.

    Raises
    ------
    ModelError
        If its lines cannot be told apart in a window.
    """
    return LockInPlan(
        modes=dither.modes,
        frequencies_hz=dither.frequency_hz,
        amplitude_m=dither.amplitude_m,
        frame_rate_hz=rtc.frame_rate_hz,
        n_frames=round((dither.window_s or window_s) * rtc.frame_rate_hz),
        first_seq=(dither.start_seq or 0) + round(SETTLING_S * rtc.frame_rate_hz),
    )


def asked_of(dither: DitherView, rtc: RtcView) -> Asked:
    """Return a dither as the frames should hold it."""
    first_seq = dither.start_seq or 0
    return Asked(
        modes=dither.modes,
        amplitude_m=dither.amplitude_m,
        frequency_hz=dither.frequency_hz,
        frame_rate_hz=rtc.frame_rate_hz,
        first_seq=first_seq,
        stop_seq=first_seq + round(dither.duration_s * rtc.frame_rate_hz),
        own=tuple(mode not in rtc.in_loop for mode in dither.modes),
    )


def clear_lines(rtc: RtcView, n_lines: int, choice: Choice) -> tuple[float, ...]:
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


def on_vibrations(dither: DitherView, avoid_hz: tuple[float, ...]) -> tuple[float, ...]:
    """Return the lines of a dither that are not clear of vibrations."""
    near = CLEARANCES_HZ[-1] - 1e-6
    return tuple(f for f in dither.frequency_hz if any(abs(f - v) < near for v in avoid_hz))


def n_lines(rtc: RtcView, policy: Policy) -> int:
    """Return how many modes the service dithers by itself."""
    return min(len(policy.dither_modes or range(_N_LINES)), rtc.max_dither_modes)


def _step_hz(rtc: RtcView, window_s: float) -> float:
    """Return the frequency of one period in a window."""
    return rtc.frame_rate_hz / max(round(window_s * rtc.frame_rate_hz), 1)


def _uncontrolled_modes(rtc: RtcView, policy: Policy) -> tuple[int, ...]:
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
