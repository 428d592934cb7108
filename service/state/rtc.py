"""The RTC and its dither, as its own status shows them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherView:
    """A sinusoidal dither, asked for or running."""

    id: str
    modes: tuple[int, ...]
    amplitude_m: tuple[float, ...]
    """RMS of each mode, metres OPD."""

    frequency_hz: tuple[float, ...]
    duration_s: float
    start_seq: int | None
    """First frame that contains it; None until the RTC has accepted."""

    asked_ns_utc: int
    """When it was asked for, then when it was accepted or adopted; 0: none of these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcView:
    """The RTC as its last status message shows it."""

    session: str
    loop: str
    """"open", "closed" or "partial"."""

    frame_rate_hz: float
    delay_frames: float
    leak: float
    gains: tuple[float, ...]
    """One per mode of the basis; 0 where uncontrolled."""

    n_controlled: int
    n_modes: int
    n_slopes: int
    cm_id: str | None
    basis_id: str
    config_id: str
    magnitude: float | None
    max_dither_m: float
    max_dither_modes: int
    dither_id: str | None
    """The dither now running; None: none."""

    t_ns_utc: int
    """The RTC's own timestamp of this status."""

    seq: int = -1
    """Last frame processed when it was made; -1: not known."""

    dither: DitherView | None = None
    """What is running, where it is a sine that has been announced to the frame; else None."""
