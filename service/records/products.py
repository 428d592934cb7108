"""Records of reconstructors and interaction matrices, with their states."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service import wire
from service.model.misregistration import Misregistration, at_boundary
from service.records.registration import ModeGain


@dataclass(frozen=True, slots=True, kw_only=True)
class GateVerdict:
    """Verdict of the gate on a reconstructor, over the whole range of α."""

    accepted: bool
    """True only if every pole, everywhere within α ± 3σ, stays inside the bound."""

    worst_pole_radius: float
    """Largest closed-loop pole radius; 1 is the edge of stability. If the reconstructor is
    accepted, the true maximum is below the bound and at most 0.02 above this value."""

    aligned_pole_radius: float
    """Pole radius of a perfect reconstructor at these gains, the smallest that is possible."""

    bound: float
    """Largest radius that would have been accepted."""

    n_points: int
    """Number of registrations considered."""

    reason: str
    """Explanation for the operator; with what to do if the reconstructor was refused."""

    edge_motion_m: float | None = None
    """Largest RMS motion of an outer actuator for slope noise of 1, metres; None if unknown."""

    @property
    def unstable(self) -> bool:
        """True if some loop within α ± 3σ has a pole on or outside the unit circle."""
        return self.worst_pole_radius >= 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedGain:
    """Predicted loss of wavefront with the reconstructor in use, against a new one."""

    loss_m: float
    """Wavefront error minus that with a new reconstructor, metres RMS; infinite if only the new one
    is stable."""

    wavefront_m: float
    """Wavefront error with a new reconstructor, metres RMS."""

    pole_radius: float
    """Largest pole radius with the reconstructor in use, at α without its uncertainty."""

    fresh_pole_radius: float
    """Largest pole radius with a new reconstructor, at the same α."""


HEALTHY_RATIO = 1.3
"""A mode whose response differs from that of its neighbours by ``UNEVEN_RATIO`` or its inverse is
reported if it certainly exceeds this factor, which healthy modes do not exceed. It may still be
controlled."""


DOUBTFUL_RATIO = 1.45
"""From here on another window is asked."""


CERTAINTY_SIGMA = 3.0
"""A ratio is certainly beyond a limit if it exceeds it by this many σ."""


MAX_COMPARED_WINDOWS = 3
"""Number of windows that compare a mode before it is accepted without a certain result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeLimit:
    """More modes than these gate, RTC or operator would not have; they are tried again later."""

    n_modes: int
    """Number of modes that may be controlled at present."""

    since_ns_utc: int
    until_ns_utc: int
    """More are not tried before."""

    wait_s: float
    """From one to the other; doubled each time the limit is found again."""

    reason: str
    """Reason why more modes are not permitted, as the gate, the RTC or the operator gave it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeAnswer:
    """The last answer of a mode that contradicts the instrument file."""

    mode: int
    gain: float
    """Times the model."""

    like: int
    """Mode of the model that it answers as; its own: none certainly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeRatio:
    """Response of a mode relative to its neighbours, if it differs from that of healthy modes."""

    mode: int
    ratio: float
    """Response divided by the median response of its neighbours, averaged over all windows."""

    sigma: float
    """1 σ of that."""

    n_windows: int = 1

    def plus(self, other: ModeRatio) -> ModeRatio:
        """Return what two sets of windows say together."""
        # Weights by inverse variance; the variance of such a mean is σ² times the weight.
        weight = other.sigma**2 / (self.sigma**2 + other.sigma**2)
        return ModeRatio(
            mode=self.mode,
            ratio=weight * self.ratio + (1.0 - weight) * other.ratio,
            sigma=self.sigma * float(np.sqrt(weight)),
            n_windows=self.n_windows + other.n_windows,
        )

    @property
    def stands_out(self) -> bool:
        """Return True if the mode may be uneven and certainly differs from the others."""
        return self._beyond(DOUBTFUL_RATIO) and self._certainly_beyond(1.0)

    @property
    def certain(self) -> bool:
        """Return True if more than one window shows that the mode is uneven."""
        beyond = self._beyond(UNEVEN_RATIO) and self._certainly_beyond(HEALTHY_RATIO)
        return self.n_windows > 1 and beyond

    def _beyond(self, limit: float) -> bool:
        # Too weak by a factor counts as much as too strong by it.
        return self.ratio > limit or self.ratio < 1.0 / limit

    def _certainly_beyond(self, limit: float) -> bool:
        spare = CERTAINTY_SIGMA * self.sigma
        return self.ratio - spare > limit or self.ratio + spare < 1.0 / limit

    @property
    def undecided(self) -> bool:
        """Return True if another window must decide."""
        return self.stands_out and not self.certain and self.n_windows < MAX_COMPARED_WINDOWS


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeProof:
    """Modes whose response was verified against the model, independently of any matrix."""

    proven: frozenset[int] = frozenset()
    """Seen in a dithered window: the sign, and the size within a factor of its neighbours'."""

    contrary: frozenset[int] = frozenset()
    """Seen in two windows to answer with another sign or size, or not at all."""

    suspected: frozenset[int] = frozenset()
    """Seen so in one window: the next one decides."""

    strange: frozenset[int] = frozenset()
    """Modes of the RTC's own matrix that could not be recognised in it."""

    answers: tuple[ModeAnswer, ...] = ()
    """Modes with a wrong or suspect response, in order."""

    uneven: frozenset[int] = frozenset()
    """Modes with a response certainly far above or below that of their neighbours, in at least two
    windows."""

    doubtful: tuple[ModeRatio, ...] = ()
    """Modes that may be uneven, in order. They are not verified before further windows decide."""

    compared: frozenset[int] = frozenset()
    """Modes that were dithered next to enough others for a comparison."""

    own_uneven: str = ""
    """Modes that are uneven in the RTC's own matrix, in words; empty if there are none."""

    shown: frozenset[int] = frozenset()
    """Modes that the present dither verifies; empty if its result is known."""

    shown_ns_utc: int = 0
    """Time of that request."""

    n_tries: int = 0
    """Number of consecutive requests without a result for any of their modes."""

    session: str = ""
    """Session of the RTC in which the service before this one has seen it; empty: this one has."""

    own_weights: tuple[float, ...] = ()
    """Weight of each mode of the basis for the measurement of α, by how well the model explains
    the RTC's own matrix; empty if all count alike."""

    own_model_error: tuple[float, float, float, float] | None = None
    """1 σ by which the model leads a window of α astray, numeric units, by the scatter between the
    modes of the RTC's own matrix; None if it explains them well, or none was read."""

    own_misfit_ratio: float | None = None
    """Median share of its modes' response that the model does not explain, in norm; None if no
    matrix was read."""

    own_response_ratio: float | None = None
    """Median over its modes of the response in the RTC's own matrix divided by the model's; None if
    no matrix was read."""

    @property
    def n_proven(self) -> int:
        """Modes that a dither has shown to answer as they should."""
        return len(self.proven)

    @property
    def contrary_modes(self) -> tuple[int, ...]:
        """Return the modes that a dither has found wrong; none of them is newly controlled."""
        return tuple(sorted(self.contrary))


UNEVEN_RATIO = 1.6
"""A mode that answers so many times as its neighbours do, or one over that, is named: those of
healthy telescopes are within 1.12, but for the last of a basis that has all of a mirror's."""


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
class Judged(wire.ControlLaw):
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

    reference_id: str | None = None
    """Reference slopes that the RTC used when it was computed; None if they are not known."""

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
    def brought(cls, manifest: wire.Manifest) -> ReconstructorRecord:
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

    def manifest(self, layout: wire.MatrixLayout, rtc: wire.Status, system: str) -> wire.Manifest:
        """Return the manifest it travels with."""
        return wire.Manifest(
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


class Frame(StrEnum):
    """Frames in which a shape is given."""

    MIRROR = "mirror"
    """Fixed on the mirror: it turns and moves on the sensor with the registration."""

    INSTRUMENT = "instrument"
    """Fixed on the pupil as the sensor and the science camera see it."""


class ShapeKind(StrEnum):
    """Kinds of numbers that describe a shape."""

    MODES = "modes"
    """Coefficients of the modes of the basis from mode 0 on, RMS of OPD."""

    ZERNIKE = "zernike"
    """Coefficients of Zernike polynomials from Noll index 1 on, RMS of OPD."""

    MAP = "map"
    """OPD on a square grid over the pupil, row by row."""

    SLOPES = "slopes"
    """Slopes that were measured at optical gain 1, in the RTC's own order."""

    @property
    def frame(self) -> Frame:
        """The frame in which numbers of this kind are given."""
        return Frame.MIRROR if self is ShapeKind.MODES else Frame.INSTRUMENT


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """A shape that the loop is to hold, for example against non-common-path aberrations."""

    id: str
    kind: ShapeKind
    frame: Frame
    values: tuple[float, ...]
    """Metres of OPD; slopes are dimensionless."""

    source: str
    """File or measurement that it came from; empty if not known."""

    by: str
    """Name of the person who loaded it; empty if not known."""

    loaded_ns_utc: int
    """Time of loading, by the service's clock."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferencesRecord:
    """Everything known of one set of reference slopes except its numbers."""

    id: str
    """The RTC's ``reference_id`` while it uses them; never reused."""

    state: MatrixState
    """State on the way to the RTC, as of a reconstructor."""

    created_ns_utc: int
    """Time of computation."""

    shape: str | None = None
    """Id of the shape that they hold; None for the RTC's own references."""

    coefficients_m: tuple[float, ...] = ()
    """Coefficients of the modes from mode 0 on that the mirror is to hold, metres RMS of OPD."""

    alpha: Misregistration | None = None
    """Registration that they were computed for; None for the RTC's own."""

    gain: float | None = None
    """Mean gain that they were scaled with, weighted by the power of the shape in each mode."""

    offset_rms: float = 0.0
    """RMS of the offset over all slopes."""

    unexplained_ratio: float = 0.0
    """Share of the shape that no controlled mode explains, in norm."""

    sha256: str = ""
    """Checksum of the offset as it is sent, 64 lower-case hexadecimal digits; empty if zeros."""

    parent: str | None = None
    """References whose numbers these are, when they were sent again; None if computed."""

    reason: str = ""
    """Reason for the state, in the RTC's, the service's or an operator's words."""

    by: str = ""
    """Person who ordered to send them; empty if the service did it by itself."""

    published_ns_utc: int | None = None
    """Time at which they were sent; None if they were not."""

    applied_ns_utc: int | None = None
    """Time at which the RTC was first seen to use them; None if it was not."""

    held_ratio: float | None = None
    """Share of the shape that the mirror holds, by the mean of the commands; None if not measured.
    """

    held_sigma: float | None = None
    """1 σ of it."""

    cause: str = field(default="", compare=False)
    """Id of the order or event that made or sent them."""

    @property
    def rms_m(self) -> float:
        """RMS of the shape, metres OPD."""
        return float(np.sqrt(np.sum(np.square(self.coefficients_m))))

    @property
    def on_its_way(self) -> bool:
        """Return True if they were sent and the RTC does not use or refuse them yet."""
        return self.state in _ON_ITS_WAY


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
