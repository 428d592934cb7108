"""Choose the modes to dither."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from service.control.dither import N_MODES_ABOVE_LOOP, select_informative_modes
from service.control.loop import compute_amplification
from service.tracking.policy import Policy
from service.wire import DitherRequest, Status

N_LINES = 4
"""Modes that are dithered at once."""

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Dither lines over the frame rate: wind biases those below 0.2; no sum of two meets a third."""

LINE_RANGE = (0.2, 0.35)
"""Range of the lines as a fraction of the frame rate, for avoiding vibrations."""

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


def check_free_modes(request: DitherRequest, rtc: Status, policy: Policy) -> str:
    """Return why a dither of the service should move to modes that are still free, or "".

    More modes may be controlled now than when it was requested.
    """
    inside = controlled(request.modes, rtc)
    if not inside:
        return ""
    fixed = _without_choice(rtc, policy)
    if fixed is not None and len(controlled(fixed, rtc)) >= len(inside):
        return ""
    named = ", ".join(str(mode) for mode in inside)
    return f"the loop controls modes {named} now: others are free"


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
