"""The RTC over REST: its loop, what it plays and measures, what was asked of it."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator

from service.routes.views import Number, View
from service.state import CommandState, DitherKind, MeasurePattern, MeasureState, NoisyState


class GainGroupView(View):
    """Neighbouring modes with the same loop gain."""

    first: int
    """0-based basis index of the first mode."""

    last: int
    """Of the last one; it belongs to the group."""

    gain: Number


def _by_group(gains: tuple[float, ...]) -> list[dict[str, float]]:
    groups: list[dict[str, float]] = []
    for mode, gain in enumerate(gains):
        if groups and groups[-1]["gain"] == gain:
            groups[-1]["last"] = mode
        else:
            groups.append({"first": mode, "last": mode, "gain": gain})
    return groups


class RtcView(View):
    """The RTC as its last status message shows it."""

    session: str
    loop: str
    """"open", "closed" or "partial"."""

    frame_rate_hz: Number
    delay_frames: Number
    leak: Number
    """Per frame."""

    gains: Annotated[tuple[GainGroupView, ...], BeforeValidator(_by_group)]
    """Of all modes of the basis, 0 where uncontrolled."""

    n_controlled: int
    n_modes: int
    n_slopes: int
    cm_id: str | None
    """The reconstructor it says it uses."""

    basis_id: str
    config_id: str
    magnitude: Number
    """Of the star; null: not known."""

    max_dither_m: Number
    """Largest dither it accepts, metres OPD RMS."""

    max_dither_modes: int
    t_ns_utc: int
    """The RTC's own timestamp."""


class DitherView(View):
    """The dither now requested of the RTC."""

    id: str
    modes: tuple[int, ...]
    """0-based basis indices."""

    amplitude_m: tuple[Number, ...]
    """RMS of each mode, metres OPD."""

    kind: DitherKind
    """"sine" or "binary"."""

    frequency_hz: tuple[Number, ...]
    """One for each mode of a sine; empty: a binary dither has none."""

    seed: int | None
    """Of a binary dither's signs."""

    duration_s: Number
    start_seq: int | None
    """First frame that contains it; null until the RTC has accepted."""


class MeasuringView(View):
    """The interaction matrix being measured."""

    id: str
    """Of the matrix to come: ``/v1/measurements/{id}`` says more."""

    state: MeasureState
    """"asked" or "running"."""

    pattern: MeasurePattern
    modes: tuple[int, ...]
    """0-based basis indices."""

    asked_ns_utc: int | None
    """Since when."""

    opens_loop: bool
    """Whether the loop is open meanwhile."""


class GatheringView(View):
    """The noisy interaction matrix under way."""

    id: str
    """Of the matrix to come, and of its dither: ``/v1/noisy-matrix/{id}`` says more."""

    state: NoisyState
    """"waiting", "asked", "running" or "finishing"."""

    total_m: float
    """RMS of all its modes together, metres OPD."""

    duration_s: float
    """Of telemetry."""

    asked_ns_utc: int
    """Since when."""


class LoopCommandView(View):
    """The last change of the loop, or gain ramp, asked of the RTC."""

    id: str
    text: str
    """What was asked for."""

    state: CommandState
    """"asked", "accepted", "refused" or "failed"."""

    reason: str
    """Why it was refused, or has failed."""

    asked_ns_utc: int
    lasts_s: float
    """How long the RTC is busy with it, at its nominal rate; 0: it changes at once."""
