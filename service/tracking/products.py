"""What is made and measured: reconstructors, interaction matrices, and where each of them is."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import ExpectedGain
from service.control.gains import ModeGain
from service.control.gate import GateVerdict
from service.estimation.comparison import ProbationFinding
from service.model.misregistration import Misregistration, at_boundary
from service.wire import (
    ControlLaw,
    Manifest,
    MatrixLayout,
    MatrixStrokes,
    MeasuredManifest,
    Pattern,
    Status,
)


class MatrixState(StrEnum):
    """Where a reconstructor is on its way to the RTC."""

    REFUSED = "refused"
    """The stability gate refused it: it is never offered."""

    PROPOSED = "proposed"
    """It passed the gate and waits for an operator: for half a minute at least, unless the
    mirror has moved too far for it."""

    DISCARDED = "discarded"
    """An operator rejected it, or what it was made for has passed: another α, another proposal."""

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
    """No acknowledgement came in time, the RTC holds other numbers, or the loop was worse with it
    and the service went back; the reason says which."""


_ON_ITS_WAY = (MatrixState.PUBLISHED, MatrixState.STAGED)
_USED = (MatrixState.APPLIED, MatrixState.SUPERSEDED)
"""Tuples: looked at hundreds of times a second, for every record, and faster than sets."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged(ControlLaw):
    """What a verdict of the gate is of: of another loop, or of another α, it says nothing.

    The gains are those of the modes that the reconstructor commands.
    """

    session: str
    """Of the RTC."""

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

    cause: str = field(default="", compare=False)
    """Id of the order or event that has made it, or sent it since."""

    @property
    def is_rtcs(self) -> bool:
        """Whether its numbers are the RTC's own, brought by it or sent again."""
        return self.alpha is None

    @property
    def origin(self) -> str:
        """Who made its numbers: the RTC, or the service."""
        if not self.is_rtcs:
            return "the service's"
        return "the RTC's own" + ("" if self.parent is None else f", {self.parent} sent again")

    @property
    def on_its_way(self) -> bool:
        """Whether it was sent, and the RTC has not said what became of it."""
        return self.state in _ON_ITS_WAY

    @property
    def was_used(self) -> bool:
        """Whether it is in use, or was until another took its place."""
        return self.state in _USED

    @classmethod
    def brought(cls, manifest: Manifest) -> ReconstructorRecord:
        """Return what is known of a matrix the RTC brought with it.

        Its manifest may name an α, but nobody here can vouch for it.
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
    """What the reconstructor in use loses against a new one, at one registration."""

    id: str
    """Of the reconstructor in use then."""

    alpha: Misregistration
    """The registration it was computed for."""

    expected: ExpectedGain
    t_ns_utc: int
    """When it came, by the service's clock."""


class ProbationState(StrEnum):
    """How far the probation of a matrix is that has been applied."""

    RUNNING = "running"
    """Telemetry is being compared with that of the matrix before."""

    OVERDUE = "overdue"
    """Telemetry is late: the verdict counts when it comes, and nothing waits for it."""

    PASSED = "passed"
    """The loop is as good as before, or better."""

    ROLLING_BACK = "rolling-back"
    """It is worse: the matrix before is on its way back."""

    WATCHED = "watched"
    """It was worse; the matrix before is in use again, and the loop is looked at with it."""

    ROLLED_BACK = "rolled-back"
    """It was worse; the matrix before is in use again."""

    KEPT = "kept"
    """It is worse, and the service could not go back; the text says why."""

    OPENING = "opening"
    """The loop was lost with it, and going back was no help or no way: it is asked to open."""

    OPENED = "opened"
    """The loop opened when it was asked to."""

    NOT_JUDGED = "not-judged"
    """There was nothing to compare with; the text says why."""


_ON_PROBATION = (ProbationState.RUNNING, ProbationState.ROLLING_BACK, ProbationState.WATCHED)
"""As above."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Probation:
    """The matrix applied last, on probation: against the one before."""

    id: str
    """Of the one on probation."""

    before: str
    """Of the one that was in use before."""

    reference: str
    """Of the one whose telemetry it is compared with: the one before, or the last that was not
    found worse."""

    state: ProbationState
    text: str
    """What is found or done, or why nothing is."""

    since_ns_utc: int
    until_ns_utc: int
    """The verdict comes by then, where telemetry does."""

    loop: Status | None = None
    """As it was with the matrix before; None: it was not known."""

    finding: ProbationFinding | None = None
    """The numbers that were compared; None: not yet, or there are none."""

    worse: str = ""
    """What it did to the loop, where it made that worse; empty: it did not."""

    rollback: str | None = None
    """Id under which the matrix before was sent again; None: it was not."""

    opens: bool = False
    """Whether the loop may be asked to open where it is lost and going back does not help."""

    @property
    def judges(self) -> str | None:
        """Id of the matrix on which a verdict is waited for; None: on none."""
        if self.state is ProbationState.WATCHED:
            return self.rollback
        waits = self.state in {ProbationState.RUNNING, ProbationState.OVERDUE}
        return self.id if waits else None

    def awaits(self, before: str, after: str) -> bool:
        """Return whether a verdict on these two is waited for."""
        return (before, after) == (self.reference, self.judges)

    @property
    def under_way(self) -> bool:
        """Whether nothing else is to be sent meanwhile."""
        return self.state in _ON_PROBATION


class MeasureState(StrEnum):
    """Where a measurement of an interaction matrix is, by the RTC alone or by random signs."""

    WAITING = "waiting"
    """The service's own dither has to end first."""

    ASKED = "asked"
    """The RTC has not answered yet."""

    RUNNING = "running"
    """The RTC measures, or the random signs play and are summed."""

    FINISHING = "finishing"
    """The random signs are over; the matrix is being fitted and archived."""

    REFUSED = "refused"
    """The RTC would not; the reason is the RTC's."""

    FAILED = "failed"
    """There is no matrix; the reason says why."""

    STORED = "stored"
    """The matrix is in the archive."""

    GIVEN_UP = "given-up"
    """An operator waits for it no longer; the RTC may go on, what it sends is ignored."""


_MEASURING = (
    MeasureState.RUNNING,
    MeasureState.WAITING,
    MeasureState.ASKED,
    MeasureState.FINISHING,
)
"""As above."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyFinding:
    """What came of random signs on all modes: a noisy interaction matrix."""

    n_slopes: int
    n_frames: int
    """Frames that entered it."""

    n_missing: int
    """Frames of its windows that never came."""

    snr: float
    """RMS signal of an element over its noise: about 1 on a bright star, less on a faint one."""

    alpha: Misregistration | None
    """The registration fitted to it; None: none could be."""

    covariance: NDArray[np.float64] | None
    """``(4, 4)`` of that, numeric units, from the data alone; None as above."""

    optical_gain: float | None
    """Mean gain of the modes against the model; None as above."""

    misfit: float | None
    """Residual power over what noise explains; None as above."""

    cm_id: str | None
    """The reconstructor in use at its end."""

    session: str
    created_ns_utc: int
    """End of its last frame, the RTC's clock."""

    sha256: str
    """Of the matrix as C-ordered little-endian float32."""

    @property
    def sigma(self) -> NDArray[np.float64] | None:
        """``(4,)`` 1 σ of the registration, numeric units, from the data alone; None as above."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementRecord(MatrixStrokes):
    """All that is known of one measured interaction matrix but its numbers.

    Nothing of it can become a reconstructor: it is a measurement to fit a model to.
    """

    state: MeasureState
    pattern: Pattern | None
    """None: random signs on all modes at once, loop closed, summed by the service itself."""

    n_average: int | None = None
    """Repetitions averaged; None: the pattern has none."""

    window_s: float | None = None
    """Of the windows that random signs are summed from."""

    seed: int | None = None
    """Of random signs, whose dither has the id of the matrix."""

    asked_ns_utc: int | None = None
    """When the service asked for it; None: it did not."""

    start_seq: int | None = None
    """First frame that contained a stroke; None: not known."""

    closed_before: bool = False
    """Whether the loop was closed when it was asked for."""

    overdue_since_ns_utc: int | None = None
    """Since when everything looks as if it were over, but no matrix has come."""

    reason: str = ""
    """Why there is no matrix, or what is missing."""

    created_ns_utc: int | None = None
    """When it was measured, by the RTC's clock; None: it was not, or not yet."""

    n_slopes: int | None = None
    double_pass: bool | None = None
    """Whether the light saw the mirror twice: the matrix is then twice as large."""

    session: str | None = None
    """The RTC's session."""

    basis_id: str | None = None
    config_id: str | None = None
    sha256: str = ""
    """Of the matrix as it travels, 64 lower-case hex digits."""

    finding: NoisyFinding | None = None
    """What came of random signs; None: not finished, or another pattern."""

    cause: str = field(default="", compare=False)
    """Id of the order that has asked for it."""

    @classmethod
    def sent(cls, manifest: MeasuredManifest) -> MeasurementRecord:
        """Return what is known of a matrix the RTC sends, or of why there is none."""
        there = manifest.reason is None
        return cls(
            id=manifest.id,
            state=MeasureState.STORED if there else MeasureState.FAILED,
            pattern=manifest.pattern,
            modes=manifest.modes,
            amplitude_m=manifest.amplitude_m,
            n_average=None if manifest.pattern is Pattern.SINE else manifest.n_average,
            reason=manifest.reason or "",
            created_ns_utc=manifest.created_ns,
            n_slopes=manifest.layout.shape[0],
            double_pass=manifest.double_pass,
            session=manifest.session,
            basis_id=manifest.basis_id,
            config_id=manifest.config_id,
            sha256=manifest.layout.sha256,
        )

    @property
    def opens_loop(self) -> bool:
        """Whether the loop is open while it is measured."""
        return self.pattern not in {None, Pattern.SINE}

    @property
    def n_modes(self) -> int:
        """Columns."""
        return len(self.modes)

    @property
    def total_m(self) -> float:
        """RMS of all modes together, metres OPD."""
        return float(np.sqrt(np.sum(np.square(self.amplitude_m))))

    @property
    def each_m(self) -> float:
        """RMS of each mode, metres OPD, where all have the same."""
        return float(self.total_m / np.sqrt(max(len(self.amplitude_m), 1)))

    @property
    def under_way(self) -> bool:
        """Whether the service waits for the matrix, or works on it."""
        return self.state in _MEASURING


class ModeSet(StrEnum):
    """Modes by what they are, instead of by index."""

    CONTROLLED = "controlled"
    """Those in the loop."""

    ALL = "all"
    """Those of the basis."""
