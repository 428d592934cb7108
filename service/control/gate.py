"""The stability gate: what keeps a bad matrix off the telescope."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class GateVerdict:
    """Whether a reconstructor would hold the loop, over the whole range α may be in."""

    accepted: bool
    """True only if every pole, everywhere within α ± 3σ, stays inside the bound."""

    worst_pole_radius: float
    """Largest closed-loop pole radius found; 1 is the edge of stability."""

    aligned_pole_radius: float
    """The same for a perfect reconstructor at these gains: nothing can do better."""

    bound: float
    """Largest radius that would have been accepted."""

    n_points: int
    """Registrations tried."""

    reason: str
    """What the operator should know, and do when it was refused."""
