"""What the service knows: one frozen record, replaced as a whole, read by REST and metrics."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.control.gate import GateVerdict
from service.model.misregistration import Misregistration


class Mode(StrEnum):
    """How much the service may do by itself."""

    AUTO = "auto"
    """Estimate, compute and publish whatever passes the gate."""

    PROPOSE = "propose"
    """Estimate and compute; an operator approves each publication."""

    HOLD = "hold"
    """Estimate only: nothing is computed or published unless asked for."""


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


class MeasurePattern(StrEnum):
    """How the RTC measures an interaction matrix."""

    PUSH_PULL_MODAL = "push-pull-modal"
    """One mode after the other, loop open."""

    PUSH_PULL_ZONAL = "push-pull-zonal"
    """One actuator after the other, loop open."""

    HADAMARD = "hadamard"
    """All modes at once with the signs of a Hadamard matrix, loop open."""

    SINE = "sine"
    """All modes at once, each at its own frequency, loop closed."""


class MeasureState(StrEnum):
    """Where a measurement of an interaction matrix is."""

    ASKED = "asked"
    """The RTC has not answered yet."""

    RUNNING = "running"
    """The RTC measures."""

    REFUSED = "refused"
    """The RTC would not; the reason is the RTC's."""

    FAILED = "failed"
    """There is no matrix; the reason says why."""

    STORED = "stored"
    """The matrix is in the archive."""


class Level(StrEnum):
    """How loudly an event speaks."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The current estimate of α and how sure the service is of it."""

    alpha: Misregistration
    """The estimate."""

    covariance: NDArray[np.float64]
    """``(4, 4)``, numeric units (subapertures, radians, ratio), model-error floor not included."""

    floor: NDArray[np.float64]
    """``(4,)`` 1 σ of the model error that no integration removes, numeric units."""

    t_ns_utc: int
    """End of the last window that entered the estimate."""

    arrived_ns_utc: int
    """The same by the service's clock: age is judged by arrival, never by comparing clocks."""

    n_windows: int
    """Windows that entered the estimate."""

    optical_gain: float | None = None
    """Mean modulus of the measured complex gain of the dithered modes; None: not measured."""

    @property
    def total_covariance(self) -> NDArray[np.float64]:
        """``(4, 4)`` covariance with the model-error floor added."""
        return self.covariance + np.diag(self.floor**2)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """``(4,)`` 1 σ including the floor, numeric units (rotation in radians)."""
        return np.sqrt(np.diag(self.total_covariance))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HistoryEntry:
    """One window's own estimate and the filtered one after it."""

    t_ns_utc: int
    """End of the window."""

    measured: Misregistration
    """What this window alone says."""

    measured_sigma: NDArray[np.float64]
    """``(4,)`` its 1 σ from the data, numeric units."""

    filtered: Misregistration
    """The Kalman estimate after it."""

    filtered_sigma: NDArray[np.float64]
    """``(4,)`` 1 σ of the filtered estimate, floor included, numeric units."""

    innovation: float
    """Normalised innovation squared (4 degrees of freedom); 0 for the first window."""


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

    reason: str = ""
    """Why it is in this state: the RTC's or the operator's words."""

    published_ns_utc: int | None = None
    """When it was sent; None: never."""

    applied_frame_seq: int | None = None
    """First frame whose slopes it multiplied; None: not applied, or before this service came."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementRecord:
    """All that is known of one measured interaction matrix but its numbers."""

    id: str
    """Never reused."""

    state: MeasureState
    pattern: MeasurePattern
    modes: tuple[int, ...]
    """0-based basis indices, one for each column."""

    amplitude_m: tuple[float, ...]
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None
    """Repetitions averaged; None: the pattern has none."""

    frequency_hz: tuple[float, ...] | None = None
    """Of each mode; None: not a sine, or asked for by somebody else."""

    duration_s: float | None = None
    """Of a sine; None as above."""

    asked_ns_utc: int | None = None
    """When the service asked for it; None: it did not."""

    start_seq: int | None = None
    """First frame that contained a stroke; None: not known."""

    overdue_since_ns_utc: int | None = None
    """Since when everything looks as if it were over, but no matrix has come."""

    reason: str = ""
    """Why there is no matrix."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherView:
    """A sinusoidal dither, asked for or running."""

    id: str
    modes: tuple[int, ...]
    amplitude_m: tuple[float, ...]
    """RMS of each mode, metres OPD."""

    frequency_hz: tuple[float, ...]
    duration_s: float
    start_seq: int | None
    """First frame that contains it; None until the RTC has accepted."""

    asked_ns_utc: int
    """When it was asked for, then when it was accepted or adopted; 0: none of these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcView:
    """The RTC as its last status message shows it."""

    session: str
    loop: str
    """"open", "closed" or "partial"."""

    frame_rate_hz: float
    delay_frames: float
    leak: float
    gains: tuple[float, ...]
    """One per mode of the basis; 0 where uncontrolled."""

    n_controlled: int
    n_modes: int
    n_slopes: int
    cm_id: str | None
    basis_id: str
    config_id: str
    magnitude: float | None
    max_dither_m: float
    max_dither_modes: int
    dither_id: str | None
    """The dither now running; None: none."""

    t_ns_utc: int
    """The RTC's own timestamp of this status."""

    seq: int = -1
    """Last frame processed when it was made; -1: not known."""

    dither: DitherView | None = None
    """What is running, where it is a sine that has been announced to the frame; else None."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watchdog:
    """The passive estimate, from ordinary telemetry, beside the dithered one."""

    alpha: Misregistration
    sigma: NDArray[np.float64]
    """``(4,)`` numeric units; shifts carry the wind bias and are never below 0.1 subaperture."""

    t_ns_utc: int
    consistent: bool
    """False when it disagrees with the current α by more than its own uncertainty allows."""

    text: str
    """What the operator should know."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """Something that must be seen, for as long as it lasts."""

    name: str
    since_ns_utc: int
    text: str
    """What was found, and what to do."""

    seen_ns_utc: int = 0
    """When it was last found to be so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogEntry:
    """One thing that happened."""

    t_ns_utc: int
    level: Level
    name: str
    """Machine-readable, like ``reconstructor.applied``."""

    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackerState:
    """Everything the service knows; ``service.tracker.step`` makes the next one."""

    system: str
    """The ``{system}`` of the wire."""

    mode: Mode = Mode.PROPOSE
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

    margin: GateVerdict | None = None
    """The gate's verdict on the matrix in use at the current α ± 3σ; None: not known yet."""

    rtc: RtcView | None = None
    """None until the first status, and again when the RTC has vanished."""

    basis_id: str | None = None
    """Pinned or adopted; frames of another basis are refused."""

    config_id: str | None = None
    """Pinned or adopted; frames of another configuration are refused."""

    dither: DitherView | None = None
    """Requested or running; None: none, and a new one may be asked for."""

    dither_stopped: bool = False
    """An operator stopped it: the service does not start another by itself."""

    making_since_ns_utc: int | None = None
    """When the reconstructor now being computed was asked for; None: none is."""

    judged_ns_utc: int | None = None
    """When ``margin`` was last asked for."""

    retry_ns_utc: int = 0
    """Nothing is asked of the RTC or computed by itself before this time."""

    watchdog: Watchdog | None = None
    alarms: tuple[Alarm, ...] = ()
    log: tuple[LogEntry, ...] = ()
    """Oldest first, bounded."""

    windows_accepted: int = 0
    windows_refused: int = 0

    def reconstructor(self, matrix_id: str) -> ReconstructorRecord | None:
        """Return the record of this id, or None."""
        return next((r for r in reversed(self.reconstructors) if r.id == matrix_id), None)

    def measurement(self, measurement_id: str) -> MeasurementRecord | None:
        """Return the record of this measured matrix, or None."""
        return next((r for r in reversed(self.measurements) if r.id == measurement_id), None)

    @property
    def measuring(self) -> MeasurementRecord | None:
        """The measurement under way, or None."""
        under_way = {MeasureState.ASKED, MeasureState.RUNNING}
        return next((r for r in reversed(self.measurements) if r.state in under_way), None)
