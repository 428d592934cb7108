"""The dither policy over REST: why it dithers or does not, what that costs and buys."""

from __future__ import annotations

from service.routes.views import FourView, Number, View
from service.state import DitherPhase


class DitherPlanView(View):
    """The dither that is wanted in the present state."""

    total_m: Number
    """RMS of all modes together on the mirror, metres OPD."""

    window_s: Number
    """Telemetry in one estimate."""

    interval_s: Number
    """From one sitting to the next, at most; ``window_s``: no pause."""

    sigma: FourView
    """1 σ to be expected just before each sitting from dithered windows alone, no model error."""

    sufficient: bool
    """Whether that is what the settings ask for; otherwise it is the best within the budget."""

    mean_cost_m: Number
    """Quadratic mean over time, pauses included, metres OPD."""


class DitheringView(View):
    """The dither policy: its state, its reasons and its cost."""

    phase: DitherPhase
    """"off", "acquire", "follow" (no pause), "sparse" or "operator"."""

    reason: str
    """Why it is on or off."""

    budget_m: Number
    """Largest RMS of all modes together that settings and RTC allow, metres OPD."""

    mean_cost_m: Number
    """Quadratic mean of what has been on the mirror, over ten minutes, metres OPD."""

    plan: DitherPlanView | None
    """Null: none could be made yet."""

    next_ns_utc: int | None
    """When the next sitting is due; null: now, or never."""

    n_windows_learnt: int
    """Windows that the precision of this star's and these modes' windows was learnt from."""

    avoided_hz: tuple[Number, ...]
    """Vibrations the lines keep clear of, of the settings and heard in the slopes."""
