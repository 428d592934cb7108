"""Random dithers: how one is asked for, and how it is read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.errors import CommandError
from service.reactions.dither_choice import SETTLING_S, SPARE_S
from service.reactions.policy import Policy
from service.state import DitherKind, DitherView, ModeSet, RtcView
from service.telemetry.randomdither import FRAMES_PER_MODE, RandomPlan

RANDOM_TOTAL_M = 5e-9
"""RMS of all modes together where none is asked for, within the budget."""

COMFORTABLE = 2.0
"""Windows are longer by this than they have to be for so many modes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What a random dither is to be like."""

    id: str
    modes: tuple[int, ...] | ModeSet
    total_m: float
    """RMS of all modes together, metres OPD."""

    duration_s: float
    """Of telemetry, settling not included."""


def plan_random(asked: Asked, rtc: RtcView, policy: Policy, now_ns: int) -> DitherView:
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
    return DitherView(
        id=asked.id,
        kind=DitherKind.BINARY,
        modes=modes,
        amplitude_m=(amplitude_m,) * len(modes),
        frequency_hz=(),
        seed=now_ns % (1 << 31),
        duration_s=SETTLING_S + asked.duration_s + SPARE_S,
        start_seq=None,
        asked_ns_utc=now_ns,
        window_s=asked.duration_s / n_windows,
    )


def random_plan(dither: DitherView, rtc: RtcView, window_s: float) -> RandomPlan:
    """Return how a random dither is correlated, from where the loop has settled.

    Raises
    ------
    ModelError
        If its windows are too short for its modes.
    """
    return RandomPlan(
        modes=dither.modes,
        amplitude_m=dither.amplitude_m,
        n_frames=int((dither.window_s or window_s) * rtc.frame_rate_hz * (1.0 + 1e-12)),
        first_seq=(dither.start_seq or 0) + round(SETTLING_S * rtc.frame_rate_hz),
    )


def _modes(asked: tuple[int, ...] | ModeSet, rtc: RtcView) -> tuple[int, ...]:
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
