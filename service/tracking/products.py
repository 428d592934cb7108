"""Records of reconstructors and interaction matrices, with their states."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import ExpectedGain
from service.control.gains import ModeGain
from service.control.gate import GateVerdict
from service.model.misregistration import Misregistration, at_boundary
from service.wire import (
    ControlLaw,
    Manifest,
    MatrixLayout,
    Status,
)


class MatrixState(StrEnum):
    """States of a reconstructor on its way to the RTC."""

    REFUSED = "refused"
    """The stability gate refused it."""

    PROPOSED = "proposed"
    """Passed the gate; waits for an operator, half a minute at least."""

    DISCARDED = "discarded"
    """Rejected by an operator, or overtaken by another α or proposal."""

    PUBLISHED = "published"
    """Sent; no answer of the RTC yet."""

    STAGED = "staged"
    """Checked by the RTC, ready to swap."""

    APPLIED = "applied"
    """The RTC uses it."""

    SUPERSEDED = "superseded"
    """Replaced by another one."""

    REJECTED = "rejected"
    """Refused by the RTC, for its reason."""

    FAILED = "failed"
    """Not acknowledged in time, other numbers in the RTC, or taken back because the loop was worse;
    the reason says which."""


_ON_ITS_WAY = (MatrixState.PUBLISHED, MatrixState.STAGED)
_USED = (MatrixState.APPLIED, MatrixState.SUPERSEDED)
"""Tuples: looked at hundreds of times a second, for every record, and faster than sets."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged(ControlLaw):
    """Loop and α that a verdict of the gate is about.

    The gains are those of the modes that the reconstructor commands.
    """

    session: str
    """Session of the RTC."""

    alpha: Misregistration
    sigma: NDArray[np.float64]
    """``(4,)`` 1 σ, floor included, numeric units; without unstated places of pupil images, for
    which the reconstructor compensates."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReconstructorRecord:
    """All that is known of one reconstructor but its numbers."""

    id: str
    """Never reused."""

    state: MatrixState
    """State of the matrix."""

    n_modes: int
    """Modes it commands: the first ones of the basis."""

    created_ns_utc: int
    """Time of computation."""

    alpha: Misregistration | None = None
    """The registration it was computed for; None when the service did not make it."""

    sigma: NDArray[np.float64] | None = None
    """``(4,)`` 1 σ of that registration, floor included, numeric units."""

    parent: str | None = None
    """The reconstructor in use when it was computed, or the one a rollback copies."""

    sha256: str = ""
    """Checksum of the matrix as transmitted, 64 lower-case hexadecimal digits."""

    condition_number: float | None = None
    """Condition number of the interaction matrix that it inverts."""

    gate: GateVerdict | None = None
    """The stability gate's latest verdict; None: not judged yet."""

    judged: Judged | None = None
    """Conditions of that verdict, in this run of the service; None if they are unknown."""

    optical_gains: tuple[ModeGain, ...] = ()
    """Optical gains measured when it was made, for the table of loop gains. They are never
    multiplied into the matrix."""

    reason: str = ""
    """Why it is in this state: the RTC's or the operator's words."""

    published_ns_utc: int | None = None
    """Time at which it was sent; None if it was not."""

    applied_frame_seq: int | None = None
    """First frame whose slopes it multiplied; None: not applied, or before this service came."""

    config_id: str | None = None
    """The RTC's configuration that it is for; None: not known, or the RTC has one alone."""

    cause: str = field(default="", compare=False)
    """Id of the order or event that has made it, or sent it since."""

    @property
    def origin(self) -> str:
        """Maker of its numbers: the RTC, or the service."""
        if self.alpha is not None:
            return "the service's"
        return "the RTC's own" + ("" if self.parent is None else f", {self.parent} sent again")

    @property
    def on_its_way(self) -> bool:
        """Return True if it was sent and the RTC has not acknowledged or rejected it."""
        return self.state in _ON_ITS_WAY

    @property
    def was_used(self) -> bool:
        """Return True if it is in use, or was until another replaced it."""
        return self.state in _USED

    @classmethod
    def brought(cls, manifest: Manifest) -> ReconstructorRecord:
        """Return the record of a matrix that the RTC brought with it.

        Its manifest may name an α, which the service cannot verify.
        """
        return cls(
            id=manifest.id,
            state=MatrixState.APPLIED,
            n_modes=manifest.layout.shape[0],
            created_ns_utc=manifest.created_ns,
            sha256=manifest.layout.sha256,
            reason="brought by the RTC",
        )

    def manifest(self, layout: MatrixLayout, rtc: Status, system: str) -> Manifest:
        """Return the manifest it travels with."""
        return Manifest(
            id=self.id,
            layout=layout,
            alpha=None if self.alpha is None else self.alpha.to_boundary(),
            sigma=None if self.sigma is None else at_boundary(self.sigma),
            im_id=None,
            parent=self.parent,
            basis_id=rtc.basis_id,
            config_id=rtc.config_id,
            system=system,
            created_ns=self.created_ns_utc,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Assessment:
    """Loss of the reconstructor in use against a new one, at one registration."""

    id: str
    """Id of the reconstructor in use at that time."""

    alpha: Misregistration
    """The registration it was computed for."""

    expected: ExpectedGain
    t_ns_utc: int
    """Arrival time, by the service's clock."""


class ModeSet(StrEnum):
    """Modes by what they are, instead of by index."""

    CONTROLLED = "controlled"
    """Modes in the loop."""

    ALL = "all"
    """Modes of the basis."""
