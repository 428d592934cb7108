"""The state: ten frozen records, replaced as a whole."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from service.control.gate import GateVerdict
from service.model.misregistration import Misregistration
from service.tracking.alarms import Alarm, AlarmRecord
from service.tracking.dither_request import Dither, DitherPolicyState
from service.tracking.mode_limits import ModeLimit, ModeProof
from service.tracking.operation_records import (
    Acquisition,
    LoopCommand,
    MeasurementRecord,
    Probation,
)
from service.tracking.products import Assessment, MatrixState, ReconstructorRecord
from service.tracking.registration import (
    HistoryEntry,
    LawState,
    Offload,
    PassiveState,
    Registration,
    TimedEstimate,
    VoidInterval,
)
from service.wire import Pointing, Status


class Level(StrEnum):
    """Log levels."""

    DEBUG = "debug"
    """Of every quiet minute: in no audit trail."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True, kw_only=True)
class LogEntry:
    """One thing that happened."""

    t_ns_utc: int
    level: Level
    name: str
    """Machine-readable, like ``reconstructor.applied``."""

    text: str

    times: int = 1
    """How often: a line that repeats within a minute is told once, and again with this count."""

    last_ns_utc: int = 0
    """The last time, where it was more than once."""

    ranges: tuple[tuple[str, str], ...] = ()
    """Of a line that was counted: the smallest and the largest of each number in its text."""

    cause: str = ""
    """Id of the order or event that has led to it: what else that led to has the same; empty: of
    before the service began."""

    @property
    def line(self) -> tuple[int, str, str]:
        """Key that makes repeated lines the same."""
        return self.t_ns_utc, self.name, self.text


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservatoryValue:
    """A value that the observatory reports, for operators' own rules."""

    name: str
    value: bool | float | str
    until_ns_utc: int
    """It counts before this."""

    by: str
    """Who told it; empty: nobody said."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """Something that was asked for and came to nothing."""

    cause: str
    """Id of the order or event that has asked for it."""

    text: str
    """Why."""


class Mode(StrEnum):
    """Modes: how much the service may do by itself."""

    AUTO = "auto"
    """Measure, compute and publish what passes the gate."""

    PROPOSE = "propose"
    """Measure and compute; an operator approves each publication."""

    HOLD = "hold"
    """Measure only: nothing is computed or published without an order."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OperatorState:
    """Operators' orders in force."""

    mode: Mode = Mode.PROPOSE

    settings_mode: Mode | None = None
    """What the settings say while an operator has ordered another; None: ``mode`` is theirs."""

    stopped_because: str = ""
    """Who has stopped everything, and why; empty: nobody, or it was released."""

    failures: tuple[Failure, ...] = ()
    """What came to nothing, oldest first, bounded: whoever gave the order looks for its cause."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlphaState:
    """α, and the telemetry it comes from."""

    registration: Registration | None = None
    """None until the first accepted window."""

    history: tuple[HistoryEntry, ...] = ()
    """Oldest first, bounded."""

    own_matrix_alpha: Misregistration | None = None
    """Registration that best explains the RTC's own matrix: fits begin there while α is unknown.
    None if no matrix of the RTC's own was read."""

    far_windows: tuple[TimedEstimate, ...] = ()
    """Last windows that were too far from where their fit began, and agree with one another."""

    passive: PassiveState | None = None

    passive_unavailable_reason: str = ""
    """Why ordinary telemetry says nothing of α now; empty: it does, or was not looked at yet."""

    void_intervals: tuple[VoidInterval, ...] = ()
    """Which telemetry is void, for what and why: in the order in which that was found, bounded."""

    dither_due_since_ns_utc: int | None = None
    """Since when a dithered window is wanted before anything else is believed; None: it is not."""

    dither_due_reason: str = ""
    """Why: what makes α doubtful."""

    pointing: Pointing | None = None
    """Of the telescope, from the RTC's status or the observatory; None: nobody has told."""

    pointings: tuple[tuple[int, Pointing], ...] = ()
    """Where it looked, and from when on by the RTC's clock: oldest first, bounded."""

    offload: Offload | None = None
    """The last one asked for; None: none was, or α is corrected by the matrix alone."""

    law: LawState = field(default_factory=LawState)
    """Where the law of pointing has the mirror."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowCounts:
    """Counts of windows by outcome."""

    accepted: int = 0

    refused: int = 0

    run: int = 0
    """How many of the last windows could be used one after the other; below 0: were refused."""

    refused_because: str = ""
    """Why the last of those was; empty: none was yet."""

    outlying: int = 0
    """Believable in themselves, but so far from all others that they were not believed."""

    refusal: LogEntry | None = None
    """The last one that was refused, and why, as the log has it; None: none was."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixStates:
    """Reconstructors, and what is known of the one the RTC multiplies with."""

    reconstructors: tuple[ReconstructorRecord, ...] = ()
    """Oldest first, bounded; the one in use is always among them once known."""

    in_use: str | None = None
    """Id of the matrix the RTC multiplies with; None: unknown."""

    verified_ids: frozenset[str] = frozenset()
    """Ids of matrices whose numbers the RTC has shown or acknowledged in this session."""

    mismatched_id: str | None = None
    """Id under which the RTC holds other numbers than were sent; None: it holds what it should."""

    hindrance: str = ""
    """What keeps a reconstructor that is wanted from being made, and what to change; empty if
    nothing does, or none is wanted."""

    applied_asked_ns_utc: int = 0
    """When the RTC was last asked for the matrix it uses."""

    read_back_error: str = ""
    """Why it could not be had; empty: it could, or was not asked for."""

    margin: GateVerdict | None = None
    """The gate's verdict on the matrix in use at the current α ± 3σ; None: not known yet."""

    assessment: Assessment | None = None
    """What the matrix in use loses against a new one; None: not known yet."""

    making_since_ns_utc: int | None = None
    """When the reconstructor now being computed was asked for; None: none is."""

    judged_ns_utc: int | None = None
    """When ``margin`` was last asked for."""

    no_making_before_ns_utc: int = 0
    """Before when no reconstructor is computed again."""

    mode_proof: ModeProof = field(default_factory=ModeProof)
    """Which modes have shown how they answer."""

    mode_limit: ModeLimit | None = None
    """How many modes the gate lets be controlled; None: as many as are wanted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Operations:
    """Operations with the loop or the mirror to themselves: each under way, or the last one."""

    acquisition: Acquisition = field(default_factory=Acquisition)
    """Finding α from nothing: under way, or how the last one ended."""

    probation: Probation | None = None
    """Of the matrix applied last; None: none has been, in this run of the service."""

    measurements: tuple[MeasurementRecord, ...] = ()
    """Of interaction matrices, oldest first, bounded."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherState:
    """The dither, and what it has taught."""

    dither: Dither | None = None
    """Requested or running; None: none, and a new one may be asked for."""

    stopped: bool = False
    """An operator stopped it: the service does not start another by itself."""

    lost: str | None = None
    """The last dither that did not reach the mirror: not adopted though a status shows it."""

    losses: int = 0
    """Dithers lost since the last window was accepted."""

    policy: DitherPolicyState = field(default_factory=DitherPolicyState)
    """What the dither policy has learnt, and its account of why it dithers or does not."""

    no_dither_before_ns_utc: int = 0
    """Before when none is asked for again: what cannot be had holds up nothing else."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopState:
    """The RTC and its loop."""

    rtc: Status | None = None
    """None until the first status, and again when the RTC has vanished."""

    basis_id: str | None = None
    """Pinned or adopted; frames of another basis are refused."""

    config_id: str | None = None
    """Pinned or adopted; frames of another configuration are refused."""

    vibrations_hz: tuple[float, ...] = ()
    """Vibration lines in the slopes, lowest first."""

    holds: bool = False
    """Whether telemetry says that the loop leaves little of what it follows."""

    command: LoopCommand | None = None
    """The last change of the loop that was asked of the RTC; None: none was."""

    close_since_ns_utc: int | None = None
    """Since when the loop should close again after a measurement that was given up; None: no."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlarmStates:
    """Alarms that last, and what is kept of those before."""

    active: tuple[Alarm, ...] = ()
    """Those that last."""

    records: tuple[AlarmRecord, ...] = ()
    """What is kept of alarms that last, went unseen or are muted."""

    observatory_values: tuple[ObservatoryValue, ...] = ()
    """Values that operators' own rules ask for, as they were told last."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackerState:
    """Everything the service knows; ``service.tracker.step`` makes the next one."""

    system: str
    """The ``{system}`` of the wire."""

    operator: OperatorState = field(default_factory=OperatorState)
    alpha: AlphaState = field(default_factory=AlphaState)
    windows: WindowCounts = field(default_factory=WindowCounts)
    matrices: MatrixStates = field(default_factory=MatrixStates)
    operations: Operations = field(default_factory=Operations)
    dithers: DitherState = field(default_factory=DitherState)
    loop: LoopState = field(default_factory=LoopState)
    alarms: AlarmStates = field(default_factory=AlarmStates)

    log: tuple[LogEntry, ...] = ()
    """Oldest first, bounded."""

    def reconstructor(self, matrix_id: str) -> ReconstructorRecord | None:
        """Return the record of this id, or None."""
        return next((r for r in reversed(self.matrices.reconstructors) if r.id == matrix_id), None)

    def failure(self, cause: str) -> str:
        """Return why what this order or event has asked for came to nothing; empty: it did not."""
        failures = reversed(self.operator.failures)
        return next((failure.text for failure in failures if failure.cause == cause), "")

    def alarm(self, name: str) -> Alarm | None:
        """Return the alarm of this name that lasts, or None."""
        return next((alarm for alarm in self.alarms.active if alarm.name == name), None)

    @property
    def on_probation(self) -> bool:
        """Whether nothing is sent unasked: a matrix is on probation, or being rolled back."""
        return self.operations.probation is not None and self.operations.probation.under_way

    @property
    def previous(self) -> str | None:
        """Id of the reconstructor that was in use before: what a rollback goes back to."""
        used = (
            r.id
            for r in reversed(self.matrices.reconstructors)
            if r.state is MatrixState.SUPERSEDED and r.config_id in {None, self.loop.config_id}
        )
        return next(used, None)

    def measurement(self, measurement_id: str) -> MeasurementRecord | None:
        """Return the record of this measured matrix, or None."""
        return next(
            (r for r in reversed(self.operations.measurements) if r.id == measurement_id), None
        )

    @property
    def by_rtc(self) -> tuple[MeasurementRecord, ...]:
        """Interaction matrices the RTC has measured or measures, oldest first."""
        return tuple(r for r in self.operations.measurements if r.pattern is not None)

    @property
    def noisy(self) -> tuple[MeasurementRecord, ...]:
        """Noisy interaction matrices, by random signs on sky, oldest first."""
        return tuple(r for r in self.operations.measurements if r.pattern is None)

    @property
    def measuring(self) -> MeasurementRecord | None:
        """The measurement by the RTC that is under way, or None."""
        return self._under_way(noisy=False)

    @property
    def noisy_measurement(self) -> MeasurementRecord | None:
        """The noisy interaction matrix under way, or None."""
        return self._under_way(noisy=True)

    def _under_way(self, *, noisy: bool) -> MeasurementRecord | None:
        going_on = (r for r in reversed(self.operations.measurements) if r.under_way)
        return next((r for r in going_on if (r.pattern is None) is noisy), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """Orders that outlive a restart of the service."""

    mode: Mode | None = None
    """None: that of the settings holds."""

    settings_mode: Mode | None = None
    """What the settings said then; where they say something else now, they have the last word."""

    dither_stopped: bool = False
    stopped: str = ""
    """Who has stopped everything, and why; empty: nobody."""

    seen: tuple[AlarmRecord, ...] = ()
    """What operators have seen of alarms, and what nobody has seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Saved:
    """State that a service leaves to the next, besides its products."""

    system: str
    """The ``{system}`` of the wire."""

    saved_ns_utc: int
    """When, by the service's clock."""

    session: str | None
    """The RTC's; None: none was there."""

    in_use: str | None
    """Id of the matrix the RTC multiplied with; None: unknown."""

    pointing: Pointing | None
    """Of the telescope; None: nobody had told."""

    registration: Registration | None
    """Without the window that may be waiting for another: that one will not come. None: an
    acquisition has forgotten it, and found no other yet."""

    acquisition: Acquisition | None = None
    """One under way, or over without an α; None: neither."""

    orders: Orders | None = None
    """None: nothing was ordered that the settings do not say."""

    offload: Offload | None = None
    """The last demand to move the mirror's image, with all before it; None: there was none."""

    void_intervals: tuple[VoidInterval, ...] = ()
    """Which telemetry is void, for what and why."""

    mode_proof: ModeProof | None = None
    """Which modes have shown how they answer, in ``session``; None: none has."""

    @property
    def tells_of_alpha(self) -> bool:
        """Whether it says what α was, or why it is not known."""
        return self.registration is not None or self.acquisition is not None
