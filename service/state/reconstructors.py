"""Reconstructors: where each is on its way to the RTC, and all that is known of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.control.gate import GateVerdict
from service.model.misregistration import Misregistration
from service.state.registration import ModeGain


class MatrixState(StrEnum):
    """Where a reconstructor is on its way to the RTC."""

    REFUSED = "refused"
    """The stability gate refused it: it is never offered."""

    PROPOSED = "proposed"
    """It passed the gate and waits for an operator."""

    DISCARDED = "discarded"
    """An operator rejected it."""

    PUBLISHED = "published"
    """Sent; the RTC has not answered yet."""

    STAGED = "staged"
    """The RTC holds it, checked, ready to swap."""

    APPLIED = "applied"
    """It multiplies the slopes now."""

    SUPERSEDED = "superseded"
    """It was applied, and another one has been since."""

    REJECTED = "rejected"
    """The RTC refused it; the reason is the RTC's."""

    FAILED = "failed"
    """No acknowledgement came in time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """What a verdict of the gate is of: of another loop, or of another α, it says nothing."""

    session: str
    """Of the RTC."""

    gains: tuple[float, ...]
    """Of the modes that the reconstructor commands."""

    leak: float
    delay_frames: float
    alpha: Misregistration
    sigma: NDArray[np.float64]
    """``(4,)`` 1 σ, floor included, numeric units."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReconstructorRecord:
    """All that is known of one reconstructor but its numbers."""

    id: str
    """Never reused."""

    state: MatrixState
    """Where it is on its way."""

    n_modes: int
    """Modes it commands: the first ones of the basis."""

    created_ns_utc: int
    """When it was computed."""

    alpha: Misregistration | None = None
    """The registration it was computed for; None when the service did not make it."""

    sigma: NDArray[np.float64] | None = None
    """``(4,)`` 1 σ of that registration, floor included, numeric units."""

    parent: str | None = None
    """The reconstructor in use when it was computed, or the one a rollback copies."""

    sha256: str = ""
    """Of the matrix as it travels, 64 lower-case hex digits."""

    condition_number: float | None = None
    """Of the interaction matrix it inverts."""

    gate: GateVerdict | None = None
    """The stability gate's latest verdict; None: not judged yet."""

    judged: Judged | None = None
    """What that verdict is of, in this run of the service; None: nobody knows any more."""

    optical_gains: tuple[ModeGain, ...] = ()
    """Measured when it was made, for the table of loop gains beside it; never folded in."""

    reason: str = ""
    """Why it is in this state: the RTC's or the operator's words."""

    published_ns_utc: int | None = None
    """When it was sent; None: never."""

    applied_frame_seq: int | None = None
    """First frame whose slopes it multiplied; None: not applied, or before this service came."""
