"""Records of operations."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration
from service.wire import DitherRequest, MatrixStrokes, MeasuredManifest, Pattern, Status

Array = NDArray[np.float64]


class Verdict(StrEnum):
    """Outcome of a comparison."""

    AS_GOOD = "as-good"
    WORSE = "worse"
    UNKNOWN = "unknown"
    """It could not be made; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbationFinding:
    """Telemetry with one matrix against telemetry with the one before."""

    verdict: Verdict
    before: str
    """Id of the matrix before."""

    after: str
    """Id of the one that is judged."""

    text: str
    """The numbers in words, or why there are none."""

    after_s: float = 0.0
    """Telemetry with it, seconds."""

    mode: int = -1
    """The one that has grown most against all others; -1: none was compared."""

    mode_ratio: float = 0.0
    """RMS of its steps over that before, less what all modes have in common."""

    limit: float = 0.0
    """Limit of that ratio; a larger ratio is worse."""

    common_ratio: float = 0.0
    """RMS of the steps over those before: the median of all modes."""

    slopes_ratio: float = 0.0
    """RMS of all slopes over that before."""

    lost: bool = False
    """True if the loop has stopped correcting: the wavefront would be no worse without it."""

    residual_ratio: float | None = None
    """RMS of the residual as both matrices measure it, divided by that before the swap, with seeing
    taken out. If the numbers of the new matrix are unknown, as the previous matrix measures it;
    None if neither is known."""

    residual_limit: float | None = None
    """Limit of that ratio; a larger ratio is worse. None if the ratio is None."""

    ring_ratio: float | None = None
    """RMS of the outer ring against the mirror inside, over that before; None: too few modes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Schedule:
    """Dither with one burst every ``interval_s``."""

    total_m: float
    """RMS of all lines together, metres OPD."""

    interval_s: float
    """Interval between the starts of two bursts, seconds; without pauses it is ``window_s``."""

    sigma: Array
    """``(4,)`` 1 σ of α just before each burst, which is its maximum, numeric units."""

    sufficient: bool
    """True if the required σ is met; else the whole budget is used and σ is close to the best."""


class DitherPurpose(StrEnum):
    """Purposes of a dither; the value is how the id of a requested one begins."""

    FOLLOW = "dither"
    """Follow α."""

    PROVE = "dither-prove"
    """Show how modes respond before they are controlled."""

    OPERATOR = "operator"
    """Ordered by an operator."""

    NOISY = "noisy"
    """Measure a noisy interaction matrix."""

    ACQUIRE = "acquire"
    """Find α in an acquisition."""

    FOREIGN = "foreign"
    """Unknown: another program requested it."""

    @property
    def automatic(self) -> bool:
        """True if the service chooses such a dither by itself in closed loop."""
        return self in {DitherPurpose.FOLLOW, DitherPurpose.PROVE}


@dataclass(frozen=True, slots=True, kw_only=True)
class Dither:
    """A dither that the service follows, requested or running."""

    request: DitherRequest
    """Request that the RTC plays."""

    purpose: DitherPurpose
    """Purpose of the dither; of an adopted one, as far as its id shows it."""

    start_seq: int | None = None
    """First frame that contains it; None until the RTC has accepted."""

    asked_ns_utc: int
    """Time of the request, later of its acceptance or adoption."""

    window_s: float | None = None
    """Telemetry in one estimate, seconds, if planned with the dither; otherwise None."""

    cause: str = field(default="", compare=False)
    """Id of the order or event that led to the request; empty if the dither was adopted."""

    @property
    def id(self) -> str:
        """Id of the request."""
        return self.request.id

    @property
    def frequency_hz(self) -> tuple[float, ...]:
        """Frequency of each mode of a sine dither; empty for a binary dither."""
        return self.request.frequency_hz or ()


class DitherPhase(StrEnum):
    """Phases of the dither policy."""

    OFF = "off"
    """None is wanted, or none can be had."""

    ACQUIRE = "acquire"
    """α is not known, or something asks to see it again: the whole budget, without pause."""

    PROVE = "prove"
    """Modes that are to be controlled are shown to the sensor first, the whole budget on them."""

    FOLLOW = "follow"
    """Without pause, for the flexure leaves no time for one; as weak as that allows."""

    SPARSE = "sparse"
    """A sitting of a few windows now and then, off in between."""

    OPERATOR = "operator"
    """An operator's own, or one somebody else started."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Precision:
    """Precision of windows, learnt from accepted ones and kept from star to star."""

    ratio: NDArray[np.float64]
    """``(4,)`` measured κ of ``σ = κ / (A sqrt(T))`` over that of the table for the magnitude."""

    n_windows: int
    """Windows it was learnt from."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherPlan(Schedule):
    """The dither that is wanted in the present state."""

    mean_cost_m: float
    """Quadratic mean of the dither over time, pauses included, metres OPD."""

    window_s: float
    """Telemetry in one estimate, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherPolicyState:
    """Memory of the dither policy, and its report to the operator."""

    phase: DitherPhase = DitherPhase.OFF
    reason: str = "nothing has been decided yet"
    """Reason for the present phase."""

    budget_m: float = 0.0
    """Largest RMS of all lines together that settings and RTC allow, metres OPD."""

    plan: DitherPlan | None = None
    """Present schedule; None if none has been computed yet."""

    next_ns_utc: int | None = None
    """Start of the next dither; None if one runs now or none is planned."""

    precision: Precision | None = None
    """Precision of windows; None if no window has been accepted yet."""

    avoided_hz: tuple[float, ...] = ()
    """Vibrations that the lines avoid, Hz."""

    lines_hz: tuple[float, ...] = ()
    """Lines of the last requested dither, Hz; they are kept if possible."""

    passive_ns_utc: int | None = None
    """Time at which the estimate was last renewed without a dithered window."""

    results_due: int = 0
    """Total of accepted windows at which the last dither has delivered its results."""

    ended_ns_utc: int | None = None
    """Time at which the service's last dither ended by itself; None if one runs, or it was stopped.
    """

    stopped_id: str | None = None
    """Id of the last dither that the service stopped without an order."""

    stopped_ns_utc: int = 0
    """Time of the first request to stop it."""

    unwanted_id: str | None = None
    """Id of a dither that the RTC plays and should not; None if there is none."""

    stop_asked_ns_utc: int = 0
    """Time of the last request to stop an unwanted dither."""

    loud_id: str | None = None
    """Id of the last dither that the RTC played stronger than requested and than the budget."""

    loud_ns_utc: int = 0
    """Time of the last request to stop a dither that was too strong; 0 if there was none."""

    loud_text: str = ""
    """Measured excess of that dither; empty if its status showed it."""

    mismatched_id: str | None = None
    """Id of the last dither that differed from its request in the frames."""

    mismatched_m: float = 0.0
    """RMS of all its lines together, metres OPD."""

    mean_square_m2: float = 0.0
    """Mean square of the dither on the mirror, over ten minutes, metres OPD squared."""

    seen_ns_utc: int | None = None
    """End of the interval of that mean."""

    @property
    def mean_cost_m(self) -> float:
        """Quadratic mean of the dither on the mirror, over ten minutes, metres OPD."""
        return float(np.sqrt(self.mean_square_m2))

    @property
    def n_windows_learnt(self) -> int:
        """Windows from which the precision was learnt."""
        return 0 if self.precision is None else self.precision.n_windows


class AcquisitionStage(StrEnum):
    """Stage of an acquisition."""

    IDLE = "idle"
    """None yet."""

    OPENING = "opening"
    """The RTC was requested to open the loop."""

    COARSE = "coarse"
    """Smooth modes are dithered with the loop open, to estimate α."""

    CONFIRMING = "confirming"
    """Other modes are dithered, to confirm α."""

    PARTIAL = "partial"
    """A reconstructor of a part of the modes is made, judged and sent; then the loop closes."""

    WIDENING = "widening"
    """The loop is closed; σ decreases, and more modes are controlled."""

    TRACKING = "tracking"
    """Done: α is known and the loop closed."""

    FAILED = "failed"
    """Given up; the text says why."""

    ABORTED = "aborted"
    """An operator ended it."""

    INTERRUPTED = "interrupted"
    """The service ended or the RTC vanished; the text says what follows."""


UNDER_WAY = frozenset(
    {
        AcquisitionStage.OPENING,
        AcquisitionStage.COARSE,
        AcquisitionStage.CONFIRMING,
        AcquisitionStage.PARTIAL,
        AcquisitionStage.WIDENING,
    }
)
"""Stages in which the loop is the acquisition's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFound:
    """The loop before anything was done to it."""

    closed: bool
    gains: tuple[float, ...]
    """One per mode of the basis, as it will be closed again."""

    n_controlled: int
    """Modes to come back to."""

    leak: float
    """Per frame."""

    held: bool
    """True if the loop was closed and no alarm reported that it failed to hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interruption:
    """State of an acquisition that was interrupted by a restart or a vanished RTC."""

    doing: str
    """Stage, and the text of it."""

    session: str | None
    """The RTC's; None: none was there. An open loop in the same session is the one it left."""

    cause: str = "the service ended"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Acquisition:
    """One acquisition, under way or over."""

    stage: AcquisitionStage = AcquisitionStage.IDLE
    text: str = "none was needed"
    """Current step of the acquisition, or its end and the remedy."""

    started_ns_utc: int = 0
    since_ns_utc: int = 0
    """Time at which the present stage began."""

    commanded: bool = False
    """True if an operator ordered it, which permits its publications in every mode."""

    attempt: int = 0
    """Number of times the loop has been opened for it."""

    misses: int = 0
    """Windows in a row, of this stage or before a start, that led nowhere."""

    found: LoopFound | None = None
    """None: idle."""

    alpha: Misregistration | None = None
    """Found with the loop open; None: not yet."""

    covariance: NDArray[np.float64] | None = None
    """``(4, 4)`` of it, the open loop's model error included, numeric units."""

    n_modes: int = 0
    """Modes of the reconstructor that is made, sent or in use."""

    max_modes: int | None = None
    """More than so many were refused by the gate, or have slipped; None: not yet."""

    lost_with: str | None = None
    """Id of the service's own matrix in use when the loop was lost, which is why ``max_modes`` is
    half of its modes. None if the loop held, or ran on the RTC's own matrix."""

    command: str | None = None
    """Id of the change of the loop that was requested in this stage; None if there was none."""

    matrix: str | None = None
    """Id of the reconstructor sent for it last; None: none was in this attempt."""

    applied: str | None = None
    """Id of the last one that was applied with the loop closed."""

    sent: bool = False
    """True if a matrix was sent, so that the RTC's own matrix is no longer in use."""

    windows: int = 0
    """Windows that had been accepted when the reconstructor in use was applied, or it was over."""

    held_off: bool = False
    """An operator ended it: none begins by itself until windows agree in a closed loop, an operator
    sets the mode, or asks for one."""

    interruption: Interruption | None = None
    """State in which the previous service, or a gap in the link, left it; None if it was not
    interrupted."""

    cause: str = ""
    """Id of the order or event that has begun it; empty: the service before this one did."""

    @property
    def n_modes_before(self) -> int:
        """Number of modes controlled before the acquisition, to which it returns."""
        return self.n_modes if self.found is None else self.found.n_controlled

    @property
    def uses_wide_capture(self) -> bool:
        """Return True if windows are open-loop windows, from which a distant α can be found."""
        return self.stage in {AcquisitionStage.COARSE, AcquisitionStage.CONFIRMING}

    @property
    def under_way(self) -> bool:
        """Return True if the acquisition is neither finished nor idle."""
        return self.stage in UNDER_WAY


class ProbationState(StrEnum):
    """Stage of the probation of an applied matrix."""

    RUNNING = "running"
    """Telemetry is compared with that of the previous matrix."""

    OVERDUE = "overdue"
    """Telemetry is late; nothing waits for the verdict."""

    PASSED = "passed"
    """The loop is as good as before, or better."""

    ROLLING_BACK = "rolling-back"
    """The loop is worse: the previous matrix is being sent."""

    WATCHED = "watched"
    """The previous matrix is in use again, and the loop is checked."""

    ROLLED_BACK = "rolled-back"
    """The previous matrix is in use again."""

    KEPT = "kept"
    """The loop is worse, and the service could not go back; the text says why."""

    OPENING = "opening"
    """The loop was lost, and going back did not help: the RTC is requested to open it."""

    OPENED = "opened"
    """The RTC has opened the loop."""

    ACQUIRING = "acquiring"
    """The loop was lost, and going back did not help: the registration is acquired again."""

    NOT_CONFIRMED = "not-confirmed"
    """The loop was no better with the matrix before: the swap was not the cause."""

    NOT_JUDGED = "not-judged"
    """No comparison was possible; the text says why."""


_ON_PROBATION = (ProbationState.RUNNING, ProbationState.ROLLING_BACK, ProbationState.WATCHED)
"""Tuples: looked at hundreds of times a second, and faster than sets."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Probation:
    """The matrix applied last, on probation: against the one before."""

    id: str
    """Id of the matrix on probation."""

    before: str
    """Id of the matrix that was in use before."""

    reference: str
    """Id of the matrix whose telemetry is the reference: the previous one, or the last that was not
    judged worse."""

    state: ProbationState
    text: str
    """What is found or done, or why nothing is."""

    since_ns_utc: int
    until_ns_utc: int
    """The verdict comes by then, where telemetry does."""

    loop: Status | None = None
    """Status of the loop with the previous matrix; None if unknown."""

    finding: ProbationFinding | None = None
    """The numbers that were compared; None: not yet, or there are none."""

    worse: str = ""
    """Way in which the matrix made the loop worse; empty if it did not."""

    rollback: str | None = None
    """Id under which the matrix before was sent again; None: it was not."""

    opens: bool = False
    """True if opening the loop is permitted when the loop is lost and a rollback does not help."""

    resumes: bool = False
    """True if the service goes on in mode auto if the rollback does not help."""

    resumed_ns_utc: int | None = None
    """Time at which the service last went on in this way; None if it did not."""

    @property
    def judges(self) -> str | None:
        """Id of the matrix on which a verdict is waited for; None: on none."""
        if self.state is ProbationState.WATCHED:
            return self.rollback
        awaited = self.state in {ProbationState.RUNNING, ProbationState.OVERDUE}
        return self.id if awaited else None

    def awaits(self, before: str, after: str) -> bool:
        """Return whether a verdict on these two is waited for."""
        return (before, after) == (self.reference, self.judges)

    @property
    def under_way(self) -> bool:
        """Return True if nothing else may be sent meanwhile."""
        return self.state in _ON_PROBATION


class MeasureState(StrEnum):
    """Stage of a measurement of an interaction matrix, by the RTC or by random signs."""

    WAITING = "waiting"
    """The service's own dither must end first."""

    ASKED = "asked"
    """No answer of the RTC yet."""

    RUNNING = "running"
    """The RTC measures, or the random dither runs."""

    FINISHING = "finishing"
    """The matrix is being fitted and archived."""

    REFUSED = "refused"
    """Refused by the RTC, for its reason."""

    FAILED = "failed"
    """No matrix; the reason says why."""

    STORED = "stored"
    """The matrix is in the archive."""

    GIVEN_UP = "given-up"
    """An operator ended the wait; a matrix of the RTC is ignored."""


_MEASURING = (
    MeasureState.RUNNING,
    MeasureState.WAITING,
    MeasureState.ASKED,
    MeasureState.FINISHING,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyFinding:
    """Result of a measurement with random signs on all modes: a noisy interaction matrix."""

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
    """Checksum of the matrix as C-ordered little-endian float32."""

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
    """Duration of the windows that random signs are summed over, seconds; None for other patterns.
    """

    seed: int | None = None
    """Seed of the random signs, whose dither has the id of the matrix; None for other patterns."""

    asked_ns_utc: int | None = None
    """Time at which the service requested it; None if the service did not."""

    start_seq: int | None = None
    """First frame that contained a stroke; None: not known."""

    closed_before: bool = False
    """True if the loop was closed when it was requested."""

    overdue_since_ns_utc: int | None = None
    """Time since which the measurement appears finished although no matrix has arrived; None if it
    does not."""

    reason: str = ""
    """Why there is no matrix, or what is missing."""

    created_ns_utc: int | None = None
    """Time of measurement, by the RTC's clock; None if it is not finished."""

    n_slopes: int | None = None
    double_pass: bool | None = None
    """True if the light met the mirror twice, which doubles the matrix; None if unknown."""

    session: str | None = None
    """The RTC's session."""

    basis_id: str | None = None
    config_id: str | None = None
    sha256: str = ""
    """Checksum of the matrix as transmitted, 64 lower-case hexadecimal digits."""

    finding: NoisyFinding | None = None
    """Result of random signs; None if not finished, or for another pattern."""

    cause: str = field(default="", compare=False)
    """Id of the order that requested it."""

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
        """Return True if the loop is open during the measurement."""
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
        """Return True while the service waits for the matrix or processes it."""
        return self.state in _MEASURING


class CommandState(StrEnum):
    """State of a command to the RTC."""

    ASKED = "asked"
    """No answer of the RTC yet."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    """Refused by the RTC, for its reason."""

    FAILED = "failed"
    """No answer: whether it was carried out is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopCommand:
    """A change of the loop, or a gain ramp, asked of the RTC."""

    id: str
    text: str
    """Description of the command."""

    state: CommandState
    asked_ns_utc: int
    lasts_s: float = 0.0
    """Time for which the RTC is busy with it at its nominal rate, seconds; 0 if it acts at once."""

    until_ns_utc: int = 0
    """Until when it is, once it has accepted; 0: not known."""

    reason: str = ""
    """Why it was refused, or has failed."""

    cause: str = field(default="", compare=False)
    """Id of the order or event that requested it."""


class RefitState(StrEnum):
    """States of a refit."""

    RUNNING = "running"
    """The reconstructor is being computed and judged."""

    MADE = "made"
    """There is a reconstructor; its own state says what becomes of it."""

    REFUSED = "refused"
    """There is one, and the gate refuses it."""

    FAILED = "failed"
    """There is none, for a reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefitJob:
    """An order to compute a reconstructor for the registration of now."""

    id: str
    state: RefitState
    n_modes: int
    """Number of modes requested."""

    asked_ns_utc: int
    reconstructor: str | None = None
    """Id of the one that was made; None: there is none, or not yet."""

    reason: str = ""
    """Result in words."""
