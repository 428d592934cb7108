"""Whether the gate's verdict on a reconstructor still says anything of the loop there is now."""

from __future__ import annotations

import numpy as np

from service.state import Judged, Registration, TrackerState
from service.state.rtc import SAME_DELAY, SAME_LEAK, same_gains

MIN_WINDOWS = 2
"""Windows that must agree before anything is made from them."""

REACH = np.array([0.05, 0.05, np.deg2rad(0.05), 0.005])
"""Half of what 594 modes tolerate without loss (Heritier et al. 2018): a verdict is as good so far
beyond α ± 3σ (numeric units)."""


def settled(known: Registration) -> bool:
    """Return whether α may be believed: windows agree, and none of them hints at a jump."""
    return known.n_windows >= MIN_WINDOWS and known.candidate is None and known.usable


def why_stale(state: TrackerState, judged: Judged | None, gains: tuple[float, ...]) -> str | None:
    """Return why a verdict says nothing of a loop with these gains now; None: it does.

    It was taken over α ± 3σ as they were then, which must hold all of α ± 3σ as they are now, but
    for a small ``REACH``: σ grows between two windows, and another verdict takes as long.
    """
    known = state.registration
    if known is None or judged is None:
        return None if known is None else why_of_another_loop(state, judged, gains)
    moved = np.abs(known.alpha.vector - judged.alpha.vector)
    if np.any(moved + 3.0 * known.sigma > 3.0 * judged.sigma + REACH):
        return "α ± 3σ reaches further than it was judged for"
    return why_of_another_loop(state, judged, gains)


def why_worthless(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return the same where it need not be sent: while α is in doubt no verdict is of where it is.

    A reconstructor that somebody wants back is sent all the same.
    """
    known = state.registration
    if known is not None and known.doubt:
        return known.doubt
    return why_stale(state, judged, gains)


def why_of_another_loop(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return what is different in the loop since a verdict; None: nothing, or no RTC is there.

    An open loop does not tell the gains it will close with.
    """
    rtc = state.rtc
    if rtc is None:
        return None
    if judged is None:
        return "nobody knows of which loop its verdict is"
    if judged.session != rtc.session:
        return "the RTC has begun a new session"
    if abs(judged.leak - rtc.leak) > SAME_LEAK:
        return f"the leak was {judged.leak:g}, it is {rtc.leak:g}"
    if abs(judged.delay_frames - rtc.delay_frames) > SAME_DELAY:
        return f"the delay was {judged.delay_frames:g} frames, it is {rtc.delay_frames:g}"
    same = rtc.loop == "open" or same_gains(gains, judged.gains)
    return None if same else "the gains have changed"
