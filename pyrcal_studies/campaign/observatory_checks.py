"""Whether the matrices a night has published were what the service took them for: stable ones.

Told by the telescope alone: the wavefront after the swap, and the poles of the loop that the matrix
closes around the telescope's own response, which no part of the service has seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.campaign.observatory_dome import Moment
from service.control.gate import GateVerdict
from service.control.loop import pole_radius
from service.model.misregistration import Misregistration
from sim_rtc.computer.telemetry import LoopSettings
from sim_rtc.telescope.diffractive import DiffractiveOptics
from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.telescope.plant import Optics

WATCHED_S = 20.0
"""After a swap: an unstable loop needs a fraction of it, an edge may slip after seconds."""

LEAST_S = 0.5
"""Less than this of a matrix in use tells nothing."""

GROWTH = 2.0
"""A wavefront error that ends so much above the one before, and above the night's best, has grown:
seeing that gets worse by a half in this time makes 1.4."""

STROKE_M = 1e-8
"""Of the push and pull that find a telescope's response, metres RMS: a pyramid is linear there."""


class Outcome(StrEnum):
    """What a matrix did to the loop."""

    HELD = "held"
    DIVERGED = "diverged"
    UNTESTED = "untested"
    """It was not applied, or not for long enough to tell."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Swap:
    """A matrix as it came into use."""

    id: str
    n_modes: int
    time_s: float
    alpha: Misregistration
    """Where the mirror truly lay."""

    made_for: Misregistration | None
    """The registration it was computed for; None: not by the service."""

    gate: GateVerdict | None
    """The service's own verdict before it was sent; None: not judged."""

    radius: float | None
    """Largest pole radius around the telescope's true response to a flat wavefront: without the
    optical gain, which lowers the loop gain; 1 is the edge. None: it was not looked at."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Publication:
    """A swap, and what came of it."""

    swap: Swap
    before_nm: float
    """RMS wavefront error during the second before the swap."""

    after_nm: float
    """The same during the last second of the watch; NaN: there is none."""

    n_clipped: int
    """Commands that met a limit of the mirror during the watch, beyond those before it."""

    outcome: Outcome


def published(swap: Swap, moments: Sequence[Moment], until_s: float) -> Publication:
    """Judge one swap by the moments around it; the watch ends at ``until_s`` at the latest.

    That is the next swap, the next jump of the mirror or the end of the night: what comes after is
    not the matrix's doing.
    """
    end_s = min(swap.time_s + WATCHED_S, until_s)
    before = [m for m in moments if swap.time_s - 1.0 < m.time_s <= swap.time_s]
    after = [m for m in moments if swap.time_s < m.time_s <= end_s]
    late = [m for m in after if m.time_s > end_s - 1.0]
    before_nm, after_nm = _rms_nm(before), _rms_nm(late)
    n_clipped = sum(m.n_clipped for m in after) if not any(m.n_clipped for m in before) else 0
    quiet_nm = min((m.wavefront_nm for m in moments if m.time_s > 1.0), default=np.nan)
    grown = after_nm > GROWTH * max(before_nm, quiet_nm)
    outcome = Outcome.HELD
    if grown or n_clipped or (swap.radius or 0.0) >= 1.0:
        outcome = Outcome.DIVERGED
    elif end_s - swap.time_s < LEAST_S:
        outcome = Outcome.UNTESTED
    return Publication(
        swap=swap,
        before_nm=before_nm,
        after_nm=after_nm,
        n_clipped=n_clipped,
        outcome=outcome,
    )


def true_radius(
    reconstructor: NDArray[np.float32], optics: Optics, settings: LoopSettings
) -> float:
    """Return the largest pole radius of the loop of these optics, its gains and this matrix."""
    n_modes = len(reconstructor)
    coupling = reconstructor @ true_response(optics, n_modes)
    gains = np.array(settings.gains[:n_modes], np.float32)
    eigenvalues = np.linalg.eigvals(gains[:, None] * coupling)
    radii = pole_radius(eigenvalues, leak=settings.leak, delay_frames=settings.delay_frames)
    return float(radii.max())


def true_response(optics: Optics, n_modes: int) -> NDArray[np.float32]:
    """Return the true interaction matrix ``(n_slopes, n_modes)``: known, or pushed and pulled."""
    if isinstance(optics, LinearOptics):
        return optics.slopes_per_command[:, :n_modes]
    if not isinstance(optics, DiffractiveOptics):
        raise TypeError(f"poles: found {type(optics).__name__}; expected a simulated telescope")
    rng = np.random.default_rng(0)
    columns = []
    for mode in range(n_modes):
        stroke = np.float32(STROKE_M) * optics.opd_per_command[:, mode]
        push, pull = (optics.slopes(sign * stroke, None, rng) for sign in (1.0, -1.0))
        columns.append((push - pull) / np.float32(2.0 * STROKE_M))
    return np.column_stack(columns)


def _rms_nm(moments: Sequence[Moment]) -> float:
    if not moments:
        return float("nan")
    return float(np.sqrt(np.mean([m.wavefront_nm**2 for m in moments])))
