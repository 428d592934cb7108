"""What can happen to the service, what an operator can ask, and what is to be done about it."""

from __future__ import annotations

from dataclasses import dataclass

from service.control.gate import GateVerdict
from service.estimation.instrumental import WindowEstimate
from service.estimation.lockin import WindowRefused
from service.estimation.passive import PassiveEstimate
from service.state import (
    DitherView,
    Level,
    MatrixState,
    MeasurementRecord,
    MeasurePattern,
    Mode,
    ReconstructorRecord,
    RtcView,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SetMode:
    """An operator chooses how much the service may do by itself."""

    mode: Mode


@dataclass(frozen=True, slots=True, kw_only=True)
class Refit:
    """Compute a reconstructor for the current α now; it still passes the gate and the mode."""

    n_modes: int | None = None
    """Modes to control; None: as many as now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StartDither:
    """Start a sinusoidal dither; None: the service's own choice."""

    modes: tuple[int, ...] | None = None
    """0-based basis indices."""

    amplitude_m: float | None = None
    """RMS of each mode, metres OPD."""

    frequency_hz: tuple[float, ...] | None = None
    """One for each mode."""

    duration_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StopDither:
    """Stop the dither and do not start another until told to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Approve:
    """Publish a proposed reconstructor."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reject:
    """Discard a proposed reconstructor."""

    id: str
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Publish:
    """Send a known reconstructor again, under a new id, after it has passed the gate anew."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollback:
    """Go back to the reconstructor that was in use before the present one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """Have the RTC measure an interaction matrix; None: the service's own choice."""

    id: str
    """Of the matrix to come; never used before."""

    pattern: MeasurePattern
    modes: tuple[int, ...] | None = None
    """0-based basis indices."""

    amplitude_m: float | None = None
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None = None
    """Repetitions; None for a sine."""

    frequency_hz: tuple[float, ...] | None = None
    """One for each mode of a sine."""

    duration_s: float | None = None
    """Of a sine."""


Command = (
    SetMode | Refit | StartDither | StopDither | Approve | Reject | Publish | Rollback | Measure
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Time has passed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusSeen:
    """The RTC said how it is."""

    rtc: RtcView


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionStarted:
    """The RTC started anew: its windows, commands and staged matrices are void."""

    session: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcVanished:
    """The RTC's liveliness token went away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trouble:
    """A condition that must be seen while it lasts."""

    name: str
    text: str
    over: bool = False
    """The condition has ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Noted:
    """Something happened that changes nothing but should be on record."""

    name: str
    text: str
    level: Level = Level.INFO


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowFitted:
    """The worker estimated α from one window."""

    estimate: WindowEstimate


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowLost:
    """A window gave no estimate."""

    refused: WindowRefused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watched:
    """The watchdog estimated α from ordinary telemetry."""

    estimate: PassiveEstimate
    t_ns_utc: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixMade:
    """A reconstructor has been computed, or copied, and judged."""

    record: ReconstructorRecord
    wanted: bool
    """An operator asked for this very matrix: no further approval is needed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixFetched:
    """The matrix the RTC uses, which the service did not make, is known now."""

    record: ReconstructorRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class MarginJudged:
    """The gate's verdict on the matrix in use, at the current α."""

    id: str
    verdict: GateVerdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledged:
    """The RTC answered to a reconstructor."""

    id: str
    session: str | None = None
    """Of the RTC that answers; None: not known."""

    state: MatrixState
    reason: str
    frame_seq: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherAnswered:
    """The RTC accepted or refused a dither."""

    id: str
    accepted: bool
    reason: str
    start_seq: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixMeasured:
    """A measured interaction matrix is one step further: begun, refused, failed or stored."""

    record: MeasurementRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class JobFailed:
    """Something that was to be done could not be."""

    effect: Effect
    text: str


Event = (
    Command
    | Tick
    | StatusSeen
    | SessionStarted
    | RtcVanished
    | Trouble
    | Noted
    | WindowFitted
    | WindowLost
    | Watched
    | MatrixMade
    | MatrixFetched
    | MarginJudged
    | Acknowledged
    | DitherAnswered
    | MatrixMeasured
    | JobFailed
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MakeMatrix:
    """Compute a reconstructor for the current α and judge it."""

    n_modes: int
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CopyMatrix:
    """Judge an earlier reconstructor at the current α and offer it under a new id."""

    source: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeMatrix:
    """Judge the matrix in use at the current α."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SendMatrix:
    """Publish a reconstructor; first tell the RTC how many modes it commands."""

    id: str
    n_modes: int
    gains: tuple[float, ...] | None
    """``(n_modes of the basis,)`` gains to go with it; None: those in force."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchMatrix:
    """Ask the RTC for the matrix it uses."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AskDither:
    """Ask the RTC for a dither."""

    dither: DitherView


@dataclass(frozen=True, slots=True, kw_only=True)
class AskNoDither:
    """Ask the RTC to stop its dither."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskMeasurement:
    """Ask the RTC to measure an interaction matrix."""

    record: MeasurementRecord


Effect = (
    MakeMatrix
    | CopyMatrix
    | JudgeMatrix
    | SendMatrix
    | FetchMatrix
    | AskDither
    | AskNoDither
    | AskMeasurement
)
