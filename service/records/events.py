"""Events, effects, and their ids."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import UTC, datetime

from service.model.misregistration import Misregistration
from service.records import estimates, products
from service.records.commands import Command
from service.records.messages import Message
from service.records.operations import MeasurementRecord, ProbationFinding
from service.records.state import Level, ModelState, TrackerState
from service.wire import Acknowledgement, ReferencesInUse, Reply, Status
from service.wire import Command as Request


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Caused:
    """An effect with the id of its cause."""

    cause: str = field(default="", compare=False)
    """Id of the command or event that has led to it; ``StepContext.ask`` says so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MakeMatrix(Caused):
    """Compute a reconstructor for the current α and judge it."""

    n_modes: int
    why: str
    gains: tuple[float, ...] | None = None
    """``(n_modes of the basis,)`` gains it is to run with; None: those in force."""

    fewer: tuple[int, ...] = ()
    """Tried instead, largest first, where the gate refuses ``n_modes``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RepublishMatrix(Caused):
    """Judge an earlier reconstructor at the current α and offer it under a new id."""

    source: str
    why: str
    judged: bool = True
    """True to have the gate check the matrix; False if it was not requested and the gate's earlier
    verdict holds."""

    anyway: bool = False
    """True if an operator has approved it despite a rejection by the gate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeMatrix(Caused):
    """Judge the matrix in use at the current α."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeProposal(Caused):
    """Judge a reconstructor that is to be sent, at the current α and with these gains."""

    id: str
    gains: tuple[float, ...]
    """Gains of the modes it commands."""

    wanted: bool = True
    """True if it was requested to be sent; False if the service sends it on its own initiative."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SendMatrix(Caused):
    """Publish a reconstructor, after the number of modes it commands."""

    id: str
    n_modes: int
    gains: tuple[float, ...] | None
    """``(n_modes of the basis,)`` gains to go with it; None: those in force."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchMatrix(Caused):
    """Ask the RTC for the matrix it uses."""

    id: str | None
    """Id of the dither in its status; None if the status has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchReferences(Caused):
    """Ask the RTC for the offset of its reference slopes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ask(Caused):
    """Ask something of the RTC."""

    request: Request
    judged: bool = False
    """Only if the gate lets the matrix in use run with the gains of the request."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MakeReferences(Caused):
    """Compute reference slopes for the shape, at the current α and optical gains."""

    id: str
    """Id of the references."""

    worst_seeing_arcsec: float
    """Seeing in which the loop must survive with them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SendReferences(Caused):
    """Have the RTC subtract these references."""

    id: str
    ramp_s: float
    """Duration of the ramp to them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishNoisy(Caused):
    """Fit and archive what has been summed of a noisy interaction matrix."""

    record: MeasurementRecord


MatrixEffect = MakeMatrix | RepublishMatrix | JudgeMatrix | JudgeProposal | SendMatrix | FetchMatrix
ReferencesEffect = FetchReferences | MakeReferences | SendReferences
Effect = MatrixEffect | ReferencesEffect | Ask | FinishNoisy


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Time has passed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionStarted:
    """The RTC began a new session: its windows, commands and staged matrices are void."""

    session: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcVanished:
    """The RTC's liveliness token went away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServicesMet:
    """Other services of this system came or went."""

    drives: bool
    """True if this service drives the RTC, False if it is on standby."""

    others: tuple[str, ...]
    """The other services in words, the first one first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionChanged:
    """A condition that must be seen while it lasts."""

    name: str
    text: str | Message
    over: bool = False
    """The condition has ended."""

    t_ns_utc: int = 0
    """End of the telemetry concerned, by the RTC's clock; 0 if it was not telemetry."""

    @classmethod
    def detect(
        cls, state: TrackerState, name: str, text: str | None, over: str, t_ns_utc: int = 0
    ) -> list[ConditionChanged]:
        """Return the trouble that has come or gone, if it has; no text: there is none now."""
        raised = state.alarm(name) is not None
        if bool(text) is raised:
            return []
        return [cls(name=name, text=text or over, over=raised, t_ns_utc=t_ns_utc)]


@dataclass(frozen=True, slots=True, kw_only=True)
class LogEvent:
    """Something happened that changes nothing but should be on record."""

    name: str
    text: str | Message
    level: Level = Level.INFO


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherUnusable:
    """The dither that plays cannot be read from the frames; an acquisition ends with it."""

    text: str
    """Why."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowFitted:
    """The worker estimated α from one window."""

    estimate: estimates.LockInEstimate | estimates.RandomEstimate
    began_ns_utc: int = 0
    """Start of the window, by the RTC's clock; 0 if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WideCaptureFitted:
    """The worker found α from afar, in a window with the loop open."""

    found: estimates.WideCaptureEstimate
    began_ns_utc: int = 0
    """Start of the window, by the RTC's clock; 0 if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowLost:
    """A window gave no estimate."""

    refused: estimates.WindowRefused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveFitted:
    """The watchdog estimated α from ordinary telemetry."""

    estimate: estimates.PassiveEstimate
    t_ns_utc: int
    """End of the telemetry it is of."""

    began_ns_utc: int = 0
    """Start of the telemetry, by the RTC's clock; 0 if unknown."""

    loop: tuple[float, ...] = ()
    """``estimation.loop.loop_numbers`` of the loop it is of; empty: not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PassiveUnavailable:
    """The watchdog cannot estimate α from ordinary telemetry as it is."""

    text: str
    """Why, and what it would need."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixMade:
    """A reconstructor has been computed, or copied, and judged."""

    record: products.ReconstructorRecord
    wanted: bool
    """True if an operator ordered this very matrix, so that it needs no approval."""

    anyway: bool = False
    """Not the gate's either: it has been in use, and its reason says what the gate says."""

    asked_modes: int | None = None
    """Number of modes requested; None if no number was requested."""

    why_fewer: str = ""
    """Reason for a smaller number of modes, as the gate gave it; empty if there is none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixFetched:
    """The matrix the RTC uses, which the service did not make, is known now."""

    record: products.ReconstructorRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencesFetched:
    """The RTC has reported the offset of its reference slopes."""

    in_use: ReferencesInUse


@dataclass(frozen=True, slots=True, kw_only=True)
class ModesRecognised:
    """The model has recognised the modes of the matrix in use."""

    id: str
    strange: tuple[int, ...]
    """Modes that it controls and that could not be recognised: they prove nothing."""

    text: str
    """Remark for the operator."""

    response: float | None = None
    """Median response of its modes divided by the model's; None if no mode was recognised."""

    uneven: str = ""
    """Modes whose response differs strongly from that of their neighbours; empty if there are none.
    """

    alpha: Misregistration | None = None
    """Registration that best explains the RTC's own matrix; None if the matrix does not determine
    it."""

    weights: tuple[float, ...] = ()
    """Weight of each mode of the basis for the measurement of α, by how well the model explains
    it; empty if all modes count alike."""

    model_error: tuple[float, float, float, float] | None = None
    """1 σ by which the model leads a window astray, numeric units, from the scatter between the
    modes of the RTC's own matrix; None if it explains them well, or is not known."""

    misfit: float | None = None
    """Median share of the RTC's own matrix that the model leaves unexplained, per mode, in norm;
    None if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MarginJudged:
    """The gate's verdict on the matrix in use, at the current α."""

    id: str
    verdict: products.GateVerdict
    alpha: Misregistration | None = None
    """Registration at which it was judged; None if unknown."""

    expected: products.ExpectedGain | None = None
    """Gain expected from a new matrix; None if not computed."""

    judged: products.Judged | None = None
    """Conditions of the verdict; None if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProposalJudged:
    """The gate's verdict on a reconstructor that is to be sent."""

    id: str
    verdict: products.GateVerdict
    judged: products.Judged
    wanted: bool = True
    """Value of ``wanted`` in the request for the verdict."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """The RTC answered what was asked of it."""

    request: Request
    reply: Reply


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherSilent:
    """A dither should be on the mirror, and the frames hold none of it."""

    id: str
    silent_s: float
    """Duration without a dither, by the frames' own time, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherMeasured:
    """The dither in the frames differs from the request, or no longer does."""

    id: str
    found_m: float
    """RMS of all modes together, metres OPD."""

    asked_m: float
    text: str
    """Difference from the request in words; empty if there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Telemetry with the matrix in use has been compared with that of the one before."""

    finding: ProbationFinding


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixMisapplied:
    """The commands show that the RTC multiplies with other numbers than those of this matrix."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferencesMade:
    """Reference slopes were computed, and their size was checked."""

    record: products.ReferencesRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeHeld:
    """The mean of the commands has shown how much of a shape the mirror holds."""

    id: str
    """Id of the references in use."""

    ratio: float
    """1 if they are applied as they were sent."""

    sigma: float
    """1 σ of it, by the turbulence."""

    other: str = ""
    """The wrong way to apply them that agrees best with the commands."""

    log_odds: float = 0.0
    """Natural logarithm of the likelihood of that way over that of references as sent."""

    began_ns_utc: int = 0
    """Beginning of the telemetry that it compares, the RTC's clock; 0 if that is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopHeld:
    """Telemetry says that the loop holds well, or that it does so no longer."""

    holds: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Vibrations:
    """The vibration lines in the slopes are others than before."""

    lines_hz: tuple[float, ...]
    """Lowest first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModesCommanded:
    """The RTC has accepted to control another number of modes with the next matrix."""

    n_modes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelChanged:
    """A job has changed the optical model: it has measured something or linearised elsewhere."""

    model: ModelState


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixMeasured:
    """A measured interaction matrix is one step further: begun, refused, failed or stored."""

    record: MeasurementRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class JobFailed:
    """Something that was to be done could not be."""

    effect: Effect
    text: str


ServiceEvent = Tick | ConditionChanged | LogEvent | JobFailed
RtcEvent = Status | SessionStarted | RtcVanished | ServicesMet | Acknowledgement | Answered
WindowEvent = WindowFitted | WideCaptureFitted | WindowLost | PassiveFitted | PassiveUnavailable
DitherEvent = DitherSilent | DitherUnusable | DitherMeasured
LoopEvent = Compared | LoopHeld | MatrixMisapplied | Vibrations | ModelChanged | ModesCommanded
TelemetryEvent = WindowEvent | DitherEvent | LoopEvent
JudgedEvent = ModesRecognised | MarginJudged | ProposalJudged
MatrixEvent = MatrixMade | MatrixFetched | MatrixMeasured | JudgedEvent
ReferencesEvent = ReferencesMade | ReferencesFetched | ShapeHeld
Event = Command | ServiceEvent | RtcEvent | TelemetryEvent | MatrixEvent | ReferencesEvent


def new_id(name: str, now_ns: int) -> str:
    """Return an id that nothing else of this name has: it says when that was, UTC."""
    return f"{name}-{datetime.fromtimestamp(now_ns / 1e9, UTC):%Y%m%dT%H%M%S.%f}"


def kebab(kind: type) -> str:
    """Return the name of a kind of command or event in kebab case, as used in ids: ``set-mode``."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", kind.__name__).lower()
