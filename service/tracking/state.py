"""Everything the service knows: one frozen record, replaced as a whole, read by REST, metrics."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.control.gate import GateVerdict
from service.model.misregistration import Misregistration
from service.tracking.alarms import Alarm, AlarmRecord
from service.tracking.dither_request import Dither, DitherPolicyState
from service.tracking.loop import LoopCommand
from service.tracking.mode_limits import ModeLimit, ModeProof
from service.tracking.products import (
    Assessment,
    MatrixState,
    MeasurementRecord,
    Probation,
    ReconstructorRecord,
)
from service.tracking.registration import HistoryEntry, Offload, PassiveState, Registration
from service.wire import Pointing, Status


class Level(StrEnum):
    """How loudly an event speaks."""

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

    @property
    def line(self) -> tuple[int, str, str]:
        """What makes it this line and no other, however often it has happened."""
        return self.t_ns_utc, self.name, self.text


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservatoryValue:
    """A value that the observatory tells, for operators' own rules."""

    name: str
    value: bool | float | str
    until_ns_utc: int
    """It counts before this."""

    by: str
    """Who told it; empty: nobody said."""


class Mode(StrEnum):
    """How much the service may do by itself."""

    AUTO = "auto"
    """Estimate, compute and publish whatever passes the gate."""

    PROPOSE = "propose"
    """Estimate and compute; an operator approves each publication."""

    HOLD = "hold"
    """Estimate only: nothing is computed or published unless asked for."""


class AcquisitionStage(StrEnum):
    """How far an acquisition has come."""

    IDLE = "idle"
    """None has been asked for, or needed."""

    OPENING = "opening"
    """The RTC has been asked to open the loop."""

    COARSE = "coarse"
    """Smooth modes are dithered with the loop open, to find α from afar."""

    CONFIRMING = "confirming"
    """Other modes are dithered, which must say the same."""

    PARTIAL = "partial"
    """A reconstructor for a part of the modes is made, judged and sent; then the loop closes."""

    WIDENING = "widening"
    """The loop is closed: α sharpens, and more modes are controlled."""

    TRACKING = "tracking"
    """Done: α is known and the loop closed on it."""

    FAILED = "failed"
    """Given up; the text says why, and what to do."""

    ABORTED = "aborted"
    """An operator ended it."""

    INTERRUPTED = "interrupted"
    """The service ended, or the RTC vanished, in the middle of it; the text says what is done."""


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
    """Whether it was closed and no alarm said that it did not hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interruption:
    """What an acquisition was at when it was cut off: the service ended, or the RTC vanished."""

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
    """What it does, or how it ended and what to do."""

    started_ns_utc: int = 0
    since_ns_utc: int = 0
    """Since when it is in this stage."""

    commanded: bool = False
    """An operator asked for it: that allows its publications in every mode."""

    attempt: int = 0
    """How often the loop has been opened for it."""

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

    command: str | None = None
    """Id of the change of the loop that was asked for in this stage; None: none was."""

    matrix: str | None = None
    """Id of the reconstructor sent for it last; None: none was in this attempt."""

    applied: str | None = None
    """Id of the last one that was applied with the loop closed."""

    sent: bool = False
    """Whether anything was sent: the RTC's own matrix is then no longer in use."""

    windows: int = 0
    """Windows that had been accepted when the reconstructor in use was applied, or it was over."""

    held_off: bool = False
    """An operator ended it: none begins by itself until windows agree in a closed loop, an operator
    sets the mode, or asks for one."""

    interruption: Interruption | None = None
    """How it was left by the service before this one, or at a gap in the link; None: it was not."""

    @property
    def uses_wide_capture(self) -> bool:
        """Whether windows are of the open loop, from which α is found."""
        return self.stage in {AcquisitionStage.COARSE, AcquisitionStage.CONFIRMING}

    @property
    def under_way(self) -> bool:
        """Whether it is neither over nor idle."""
        return self.stage in UNDER_WAY


@dataclass(frozen=True, kw_only=True, eq=False)  # without slots: see Turn
class TrackerState:
    """Everything the service knows; ``service.tracker.step`` makes the next one."""

    system: str
    """The ``{system}`` of the wire."""

    mode: Mode = Mode.PROPOSE
    settings_mode: Mode | None = None
    """What the settings say while an operator has ordered another; None: ``mode`` is theirs."""

    registration: Registration | None = None
    """None until the first accepted window."""

    history: tuple[HistoryEntry, ...] = ()
    """Oldest first, bounded."""

    reconstructors: tuple[ReconstructorRecord, ...] = ()
    """Oldest first, bounded; the one in use is always among them once known."""

    measurements: tuple[MeasurementRecord, ...] = ()
    """Of interaction matrices, oldest first, bounded."""

    in_use: str | None = None
    """Id of the matrix the RTC multiplies with; None: unknown."""

    verified_ids: frozenset[str] = frozenset()
    """Ids of matrices whose numbers the RTC has shown or acknowledged in this session."""

    mismatched_id: str | None = None
    """Id under which the RTC holds other numbers than were sent; None: it holds what it should."""

    applied_asked_ns_utc: int = 0
    """When the RTC was last asked for the matrix it uses."""

    read_back_error: str = ""
    """Why it could not be had; empty: it could, or was not asked for."""

    margin: GateVerdict | None = None
    """The gate's verdict on the matrix in use at the current α ± 3σ; None: not known yet."""

    assessment: Assessment | None = None
    """What the matrix in use loses against a new one; None: not known yet."""

    probation: Probation | None = None
    """Of the matrix applied last; None: none has been, in this run of the service."""

    mode_proof: ModeProof = field(default_factory=ModeProof)
    """Which modes have shown how they answer."""

    mode_limit: ModeLimit | None = None
    """How many modes the gate lets be controlled; None: as many as are wanted."""

    rtc: Status | None = None
    """None until the first status, and again when the RTC has vanished."""

    basis_id: str | None = None
    """Pinned or adopted; frames of another basis are refused."""

    config_id: str | None = None
    """Pinned or adopted; frames of another configuration are refused."""

    dither: Dither | None = None
    """Requested or running; None: none, and a new one may be asked for."""

    dither_stopped: bool = False
    """An operator stopped it: the service does not start another by itself."""

    dither_lost: str | None = None
    """The last dither that did not reach the mirror: not adopted though a status shows it."""

    dither_losses: int = 0
    """Dithers lost since the last window was accepted."""

    dither_policy: DitherPolicyState = field(default_factory=DitherPolicyState)
    """What the dither policy has learnt, and its account of why it dithers or does not."""

    vibrations_hz: tuple[float, ...] = ()
    """Vibration lines in the slopes, lowest first."""

    loop_holds: bool = False
    """Whether telemetry says that the loop leaves little of what it follows."""

    acquisition: Acquisition = field(default_factory=Acquisition)
    """Finding α from nothing: under way, or how the last one ended."""

    loop_command: LoopCommand | None = None
    """The last change of the loop that was asked of the RTC; None: none was."""

    close_since_ns_utc: int | None = None
    """Since when the loop should close again after a measurement that was given up; None: no."""

    making_since_ns_utc: int | None = None
    """When the reconstructor now being computed was asked for; None: none is."""

    judged_ns_utc: int | None = None
    """When ``margin`` was last asked for."""

    no_dither_before_ns_utc: int = 0
    """Before when none is asked for again: what cannot be had holds up nothing else."""

    no_making_before_ns_utc: int = 0
    """Before when no reconstructor is computed again."""

    dither_due_since_ns_utc: int | None = None
    """Since when a dithered window is wanted before anything else is believed; None: it is not."""

    dither_due_reason: str = ""
    """Why: what makes α doubtful."""

    pointing: Pointing | None = None
    """Of the telescope, from the RTC's status or the observatory; None: nobody has told."""

    pointings: tuple[tuple[int, Pointing], ...] = ()
    """Where it looked, and from when on by the RTC's clock: oldest first, bounded."""

    void_before_ns_utc: int = 0
    """Telemetry that began before this time of the RTC's clock measures nothing."""

    void_because: str = ""
    """What was the matter with it."""

    offload: Offload | None = None
    """The last one asked for; None: none was, or α is corrected by the matrix alone."""

    passive: PassiveState | None = None
    passive_unavailable_reason: str = ""
    """Why ordinary telemetry says nothing of α now; empty: it does, or was not looked at yet."""

    stopped_because: str = ""
    """Who has stopped everything, and why; empty: nobody, or it was released."""

    observatory_values: tuple[ObservatoryValue, ...] = ()
    """Values that operators' own rules ask for, as they were told last."""

    alarms: tuple[Alarm, ...] = ()
    """Those that last."""

    alarm_records: tuple[AlarmRecord, ...] = ()
    """What is kept of alarms that last, went unseen or are muted."""

    log: tuple[LogEntry, ...] = ()
    """Oldest first, bounded."""

    windows_accepted: int = 0
    windows_refused: int = 0
    window_run: int = 0
    """How many of the last windows could be used one after the other; below 0: were refused."""
    windows_outlying: int = 0
    """Believable in themselves, but so far from all others that they were not believed."""

    def reconstructor(self, matrix_id: str) -> ReconstructorRecord | None:
        """Return the record of this id, or None."""
        return next((r for r in reversed(self.reconstructors) if r.id == matrix_id), None)

    def alarm(self, name: str) -> Alarm | None:
        """Return the alarm of this name that lasts, or None."""
        return next((alarm for alarm in self.alarms if alarm.name == name), None)

    @property
    def on_probation(self) -> bool:
        """Whether nothing is sent unasked: a matrix is on probation, or being rolled back."""
        return self.probation is not None and self.probation.under_way

    @property
    def previous(self) -> str | None:
        """Id of the reconstructor that was in use before: what a rollback goes back to."""
        used = (r.id for r in reversed(self.reconstructors) if r.state is MatrixState.SUPERSEDED)
        return next(used, None)

    def measurement(self, measurement_id: str) -> MeasurementRecord | None:
        """Return the record of this measured matrix, or None."""
        return next((r for r in reversed(self.measurements) if r.id == measurement_id), None)

    @property
    def by_rtc(self) -> tuple[MeasurementRecord, ...]:
        """Interaction matrices the RTC has measured or measures, oldest first."""
        return tuple(r for r in self.measurements if r.pattern is not None)

    @property
    def noisy(self) -> tuple[MeasurementRecord, ...]:
        """Noisy interaction matrices, by random signs on sky, oldest first."""
        return tuple(r for r in self.measurements if r.pattern is None)

    @property
    def measuring(self) -> MeasurementRecord | None:
        """The measurement by the RTC that is under way, or None."""
        return self._under_way(noisy=False)

    @property
    def noisy_measurement(self) -> MeasurementRecord | None:
        """The noisy interaction matrix under way, or None."""
        return self._under_way(noisy=True)

    def _under_way(self, *, noisy: bool) -> MeasurementRecord | None:
        going_on = (r for r in reversed(self.measurements) if r.under_way)
        return next((r for r in going_on if (r.pattern is None) is noisy), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What an operator has ordered that a restart of the service does not undo."""

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
    """What a service leaves to the one after it, besides its products."""

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

    @property
    def tells_of_alpha(self) -> bool:
        """Whether it says what α was, or why it is not known."""
        return self.registration is not None or self.acquisition is not None
