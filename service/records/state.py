"""The state: twelve frozen records, replaced as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from service.model.misregistration import Misregistration
from service.records import products
from service.records.alarms import Alarm, AlarmRecord
from service.records.messages import Message, Range
from service.records.operations import (
    Acquisition,
    Dither,
    DitherPolicyState,
    LoopCommand,
    MeasurementRecord,
    Probation,
    RefitJob,
)
from service.records.registration import (
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
    """Once a minute while nothing happens; not in the audit trail."""

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

    message: Message

    times: int = 1
    """Number of occurrences. A line that repeats within a minute is logged once, and again with
    this count."""

    last_ns_utc: int = 0
    """The last time, where it was more than once."""

    ranges: Mapping[str, Range] = field(default_factory=dict)
    """Range of each number in the message of a counted line; empty if it was not counted."""

    cause: str = ""
    """Id of the order or event that has led to it: what else that led to has the same; empty: of
    before the service began."""

    @property
    def text(self) -> str:
        """Sentence of the message."""
        return str(self.message)

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
    """Name of the person who reported it; empty if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """An order or request that had no result."""

    cause: str
    """Id of the order or event that caused it."""

    text: str
    """Why."""


class Mode(StrEnum):
    """Modes: how much the service may do by itself."""

    AUTO = "auto"
    """Measure, compute, and publish what passes the gate."""

    PROPOSE = "propose"
    """Measure and compute; an operator approves each publication."""

    HOLD = "hold"
    """Measure; compute and publish by order only."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OperatorState:
    """Operators' orders in force."""

    mode: Mode = Mode.PROPOSE

    settings_mode: Mode | None = None
    """Mode in the settings while an operator has ordered another; None if ``mode`` is that of the
    settings."""

    stopped_because: str = ""
    """Operator who has stopped everything, and the reason; empty if nothing is stopped."""

    failures: tuple[Failure, ...] = ()
    """Failures, oldest first, bounded in number. The source of an order finds its own by the cause.
    """


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
    """Void intervals of telemetry with purpose and reason, in the order in which they were found,
    bounded in number."""

    dither_due_since_ns_utc: int | None = None
    """Time since which a dithered window is needed before any other measurement is accepted; None
    if none is needed."""

    dither_due_reason: str = ""
    """Why: what makes α doubtful."""

    pointing: Pointing | None = None
    """Pointing of the telescope, from the RTC's status or the observatory; None if not reported."""

    pointings: tuple[tuple[int, Pointing], ...] = ()
    """Previous pointings with their start by the RTC's clock, oldest first, bounded in number."""

    offload: Offload | None = None
    """Last offload requested; None if there was none or α is corrected by the matrix alone."""

    law: LawState = field(default_factory=LawState)
    """State of the pointing law."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowCounts:
    """Counts of windows by outcome."""

    accepted: int = 0

    refused: int = 0

    run: int = 0
    """Number of consecutive windows accepted; negative if they were rejected."""

    refused_because: Message | None = None
    """Reason of the last rejection; None if there was none."""

    outlying: int = 0
    """Windows that were plausible by themselves but rejected as outliers."""

    refusal: LogEntry | None = None
    """The last one that was refused, and why, as the log has it; None: none was."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixStates:
    """Reconstructors, and what is known of the one the RTC multiplies with."""

    reconstructors: tuple[products.ReconstructorRecord, ...] = ()
    """Oldest first, bounded; the one in use is always among them once known."""

    in_use: str | None = None
    """Id of the matrix the RTC multiplies with; None: unknown."""

    verified_ids: frozenset[str] = frozenset()
    """Ids of matrices whose numbers the RTC has shown or acknowledged in this session."""

    mismatched_id: str | None = None
    """Id under which the RTC holds other numbers than were sent; None: it holds what it should."""

    unconfirmed_id: str | None = None
    """Id of the matrix that the RTC has acknowledged as applied and no status has named since."""

    misapplied: str = ""
    """Difference between the matrix that the RTC names and the one it applies; empty if there is
    none, or an operator has set the mode since."""

    misapplied_id: str | None = None
    """Id under which it multiplies with other numbers; None if it has not swapped at all."""

    hindrance: str = ""
    """Reason why a required reconstructor cannot be computed, and what to change; empty if there is
    none."""

    applied_asked_ns_utc: int = 0
    """Time of the last request to the RTC for the matrix that it uses."""

    read_back_error: str = ""
    """Reason why that matrix could not be read; empty if it could."""

    margin: products.GateVerdict | None = None
    """The gate's verdict on the matrix in use at the current α ± 3σ; None: not known yet."""

    assessment: products.Assessment | None = None
    """Loss of the matrix in use compared with a new one; None if not computed yet."""

    making_since_ns_utc: int | None = None
    """Time at which the reconstructor now being computed was requested; None if none is computed.
    """

    judged_ns_utc: int | None = None
    """Time at which ``margin`` was last requested."""

    no_making_before_ns_utc: int = 0
    """Time before which no further reconstructor is computed."""

    mode_proof: products.ModeProof = field(default_factory=products.ModeProof)
    """Modes whose response has been verified."""

    mode_limit: products.ModeLimit | None = None
    """Number of modes that the gate permits; None if it permits all that are requested."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferenceStates:
    """The shape that the loop is to hold, and the reference slopes for it."""

    shape: products.Shape | None = None
    """Shape to hold; None for the RTC's own references."""

    former: tuple[products.Shape | None, str] = (None, "")
    """Shape before the present one, and why its references were paused: it returns if the present
    one is refused."""

    records: tuple[products.ReferencesRecord, ...] = ()
    """References of the service, oldest first, bounded; those in use are always among them."""

    used_id: str | None = None
    """Id of the references that the RTC uses; None if it uses none of the service."""

    verified_id: str | None = None
    """Id of those whose numbers the RTC has shown; None if it has shown none."""

    asked_ns_utc: int = 0
    """Time of the last request to show them."""

    computing_since_ns_utc: int | None = None
    """Time at which those now being computed were requested; None if none are computed."""

    not_before_ns_utc: int = 0
    """Time before which no others are computed."""

    paused: str = ""
    """Reason why none are made or sent unless ordered; empty if there is none."""

    unsupported: str = ""
    """Reason why the RTC cannot be sent references; empty if it can, or was not asked."""

    difference: str = ""
    """Difference between what was sent and what the RTC applies; empty if there is none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Operations:
    """Operations with the loop or the mirror to themselves: each under way, or the last one."""

    acquisition: Acquisition = field(default_factory=Acquisition)
    """Finding α from nothing: under way, or how the last one ended."""

    probation: Probation | None = None
    """Probation of the matrix applied last; None if none was applied since the service started."""

    measurements: tuple[MeasurementRecord, ...] = ()
    """Measurements of interaction matrices, oldest first, bounded in number."""

    refits: tuple[RefitJob, ...] = ()
    """Reconstructors that operators have ordered, oldest first, bounded in number."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherState:
    """The dither, and what it has taught."""

    dither: Dither | None = None
    """Dither that is requested or running; None if there is none."""

    stopped: bool = False
    """An operator stopped it: the service does not start another by itself."""

    lost: str | None = None
    """The last dither that did not reach the mirror: not adopted though a status shows it."""

    losses: int = 0
    """Dithers lost since the last window was accepted."""

    policy: DitherPolicyState = field(default_factory=DitherPolicyState)
    """Statistics of the dither policy, and its reason for the present dither or its absence."""

    no_dither_before_ns_utc: int = 0
    """Time before which no further dither is requested, so that a refused dither does not block
    other work."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopState:
    """The RTC and its loop."""

    rtc: Status | None = None
    """None until the first status, and again when the RTC has vanished."""

    basis_id: str | None = None
    """Pinned or adopted; frames of another basis are refused."""

    config_id: str | None = None
    """Pinned or adopted; an RTC that names its reference slopes by it has another in its status."""

    renamed_ns_utc: int | None = None
    """Time by the RTC's clock at which it had another ``config_id``, until its matrix and a window
    have shown that the sensor is the same; None if that is known."""

    commanded_modes: int | None = None
    """Number of modes that the RTC has accepted to control and no status has shown yet; None if
    there is none."""

    reference_id: str | None = None
    """Name of the reference slopes: the RTC's ``reference_id``, or its ``config_id`` if it sends
    none; None before the first status."""

    reference_since_ns_utc: int | None = None
    """Time since which the RTC uses them; None if it has not changed them since the service began.
    """

    vibrations_hz: tuple[float, ...] = ()
    """Vibration lines in the slopes, lowest first."""

    holds: bool = False
    """True if the telemetry shows that the loop suppresses what it follows."""

    command: LoopCommand | None = None
    """The last change of the loop that was asked of the RTC; None: none was."""

    close_since_ns_utc: int | None = None
    """Time since which the loop should be closed again after an aborted measurement; None if it
    need not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelState:
    """State on which the optical model depends, besides instrument file and settings.

    Every job of the worker is done with it, so that any worker gives the same results. Large arrays
    are represented by keys of their contents: ``service.runtime.workers`` keeps them.
    """

    sensor_mode: str | None = None
    """Mode of the sensor that the rest belongs to; None: the first, or there is only one."""

    slopes: tuple[str, tuple[tuple[str, int], ...]] | None = None
    """Order of the slopes found in the RTC's own matrix, and the fields of its orientation by name.
    None if the instrument file has them, or none were found."""

    own_matrix_read: bool = False
    """True if the RTC's own matrix was compared with the model in this mode of the sensor."""

    response: tuple[float, ...] | None = None
    """Response of each mode to a command over the nominal one; None if nominal."""

    own_residual: str | None = None
    """Key of the part of the RTC's own matrix that the model does not explain; None if none was
    computed."""

    dither_session: str | None = None
    """Session of the RTC that the dithered responses are of; None if there are none."""

    dithered: tuple[tuple[int, str], ...] = ()
    """Modes whose response to a dither was measured, each with the key of its residual."""

    strength: float = 1.0
    """Variance of the loop's residual over that expected at the instrument's r0."""

    linearised_at: Misregistration | None = None
    """Registration of the last linearisation; None if there is none at this working point."""

    @property
    def keys(self) -> frozenset[str]:
        """Keys of the arrays that it consists of."""
        keys = {key for _, key in self.dithered}
        return frozenset(keys if self.own_residual is None else keys | {self.own_residual})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlarmStates:
    """Alarms that last, and what is kept of those before."""

    active: tuple[Alarm, ...] = ()
    """Alarms that are active."""

    records: tuple[AlarmRecord, ...] = ()
    """Records of alarms that are active, unacknowledged or muted."""

    observatory_values: tuple[ObservatoryValue, ...] = ()
    """Last reported values for the operators' own alarm rules."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackerState:
    """Everything the service knows; ``service.tracker.step`` makes the next one."""

    system: str
    """The ``{system}`` of the wire."""

    operator: OperatorState = field(default_factory=OperatorState)
    alpha: AlphaState = field(default_factory=AlphaState)
    windows: WindowCounts = field(default_factory=WindowCounts)
    matrices: MatrixStates = field(default_factory=MatrixStates)
    references: ReferenceStates = field(default_factory=ReferenceStates)
    operations: Operations = field(default_factory=Operations)
    dithers: DitherState = field(default_factory=DitherState)
    loop: LoopState = field(default_factory=LoopState)
    model: ModelState = field(default_factory=ModelState)
    alarms: AlarmStates = field(default_factory=AlarmStates)

    log: tuple[LogEntry, ...] = ()
    """Oldest first, bounded."""

    def reconstructor(self, matrix_id: str | None) -> products.ReconstructorRecord | None:
        """Return the record of this id, or None."""
        return next((r for r in reversed(self.matrices.reconstructors) if r.id == matrix_id), None)

    def references_of(self, reference_id: str | None) -> products.ReferencesRecord | None:
        """Return the record of these reference slopes, or None."""
        return next((r for r in reversed(self.references.records) if r.id == reference_id), None)

    @property
    def used(self) -> products.ReconstructorRecord | None:
        """Record of the matrix that the RTC multiplies with; None if unknown."""
        return self.reconstructor(self.matrices.in_use)

    @property
    def sent(self) -> products.ReconstructorRecord | None:
        """Record of a matrix that is on its way to the RTC; None if there is none."""
        return next((r for r in self.matrices.reconstructors if r.on_its_way), None)

    def failure(self, cause: str) -> str:
        """Return the reason why an order or event had no result; empty if it had one."""
        failures = reversed(self.operator.failures)
        return next((failure.text for failure in failures if failure.cause == cause), "")

    def alarm(self, name: str) -> Alarm | None:
        """Return the alarm of this name that lasts, or None."""
        return next((alarm for alarm in self.alarms.active if alarm.name == name), None)

    @property
    def on_probation(self) -> bool:
        """Return True if a matrix is on probation or being rolled back.

        Nothing is sent without an order meanwhile.
        """
        return self.operations.probation is not None and self.operations.probation.under_way

    @property
    def previous(self) -> str | None:
        """Id of the reconstructor that was in use before: what a rollback goes back to."""
        used = (
            r.id
            for r in reversed(self.matrices.reconstructors)
            if r.state is products.MatrixState.SUPERSEDED
            and r.config_id in {None, self.loop.config_id}
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
        return next((r for r in reversed(self.by_rtc) if r.under_way), None)

    @property
    def noisy_measurement(self) -> MeasurementRecord | None:
        """The noisy interaction matrix under way, or None."""
        return next((r for r in reversed(self.noisy) if r.under_way), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """Orders that outlive a restart of the service."""

    mode: Mode | None = None
    """None: that of the settings holds."""

    settings_mode: Mode | None = None
    """Mode of the settings at that time. If the settings have changed since, the new ones apply."""

    dither_stopped: bool = False
    stopped: str = ""
    """Operator who has stopped everything, and the reason; empty if nothing was stopped."""

    seen: tuple[AlarmRecord, ...] = ()
    """Alarms with and without an operator's acknowledgement."""

    shape: products.Shape | None = None
    """Shape that the loop is to hold; None if none was loaded."""

    references_paused: str = ""
    """Reason why no references are made for it; empty if there is none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Saved:
    """State that a service leaves to the next, besides its products."""

    system: str
    """The ``{system}`` of the wire."""

    saved_ns_utc: int
    """Time of saving, by the service's clock."""

    session: str | None
    """The RTC's; None: none was there."""

    in_use: str | None
    """Id of the matrix the RTC multiplied with; None: unknown."""

    pointing: Pointing | None
    """Pointing of the telescope; None if not reported."""

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
    """Void intervals of telemetry with purpose and reason."""

    mode_proof: products.ModeProof | None = None
    """Modes whose response was verified in ``session``; None if there are none."""

    @property
    def tells_of_alpha(self) -> bool:
        """Return True if it contains α, or the reason why α is unknown."""
        return self.registration is not None or self.acquisition is not None
