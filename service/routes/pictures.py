"""What of each of the service's records leaves over REST."""

from __future__ import annotations

from dataclasses import dataclass

from service.control.expected_gain import ExpectedGain
from service.control.gate import GateVerdict
from service.files.uploads import FitJob
from service.link.statistics import LinkStatistics
from service.routes.service import Alpha, Pace, Rtc, Snapshot
from service.routes.views import view
from service.telemetry.estimate import Determines
from service.tracking.events import GainGroup
from service.tracking.loop import DitherView, LoopCommand, Pointing
from service.tracking.products import (
    Assessment,
    MeasurementRecord,
    ModeLimit,
    NoisyFinding,
    NoisyRecord,
    ReconstructorRecord,
)
from service.tracking.registration import HistoryEntry, ModeGain, Source, Watchdog
from service.tracking.stages import Acquisition, Dithering, DitherPlan
from service.tracking.state import Alarm, LogEntry, TrackerState, Waiting


@dataclass(frozen=True, slots=True, kw_only=True)
class GainTableShown:
    """Optical gains, and the factors of the loop gains that undo them, mode by mode."""

    reconstructor: str | None
    """The one it goes with; None: the present gains, with whichever is in use."""

    measured: tuple[ModeGain, ...]
    """Empty: the table is only what is expected at 1 arcsec of seeing."""

    optical_gain: list[float]
    """Of each mode: how much of the model's response the sensor shows."""

    relative_sigma: list[float]
    """1 σ of each as a share of it; it grows away from the measured modes."""

    factor: list[float]
    """By which to multiply one loop gain for all modes: mean 1, 0.5 to 2."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimator:
    """One way of looking at telemetry; ``source`` in the history of α names it."""

    source: Source
    """"lock-in", "random" or "passive"."""

    determines: Determines


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimators:
    """All ways of looking at telemetry."""

    estimators: tuple[Estimator, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitJobs:
    """The fits the service remembers until it ends."""

    fits: tuple[FitJob, ...]
    """Oldest first."""


view("PointingView", Pointing)
view("ModeGainView", ModeGain, "mode gain gain_sigma=sigma gain_scatter=scatter t_ns_utc")
view("VerdictView", GateVerdict)
view("ExpectedGainView", ExpectedGain)
view("AssessmentView", Assessment)
view("ModeLimitView", ModeLimit, "n_modes since_ns_utc until_ns_utc reason")
ALPHA = view(
    "AlphaView",
    Alpha,
    "known.alpha known.sigma known.floor covariance parameters known.t_ns_utc age_s window_age_s "
    "known.n_windows known.standing.validity validity_reason=known.standing.reason "
    "valid_until_ns_utc=known.standing.until_ns_utc known.restored_ns_utc known.jumped_ns_utc "
    "suspected known.optical_gain known.optical_gains passive_bias passive_bias_sigma "
    "known.pointing",
)
view("HistoryEntryView", HistoryEntry)
HISTORY = view("HistoryView", TrackerState, "entries=history", "The last estimates.")
view("WatchdogView", Watchdog)

view("GainGroupView", GainGroup)
view(
    "RtcView",
    Rtc,
    "known.session known.loop known.frame_rate_hz known.delay_frames known.leak gains "
    "known.n_controlled known.n_modes known.n_slopes known.cm_id known.basis_id known.config_id "
    "known.magnitude known.max_dither_m known.max_dither_modes known.t_ns_utc",
)
view("LoopCommandView", LoopCommand, "id text state reason asked_ns_utc lasts_s")
view(
    "DitherView",
    DitherView,
    "id modes amplitude_m kind frequency_hz seed duration_s start_seq",
)
view("DitherPlanView", DitherPlan)
view(
    "DitheringView",
    Dithering,
    "phase reason budget_m mean_cost_m plan next_ns_utc n_windows_learnt avoided_hz",
)
view(
    "AcquisitionView",
    Acquisition,
    "stage text under_way started_ns_utc since_ns_utc held_off commanded n_attempts=attempt alpha "
    "n_modes",
)

RECONSTRUCTOR = view(
    "ReconstructorView",
    ReconstructorRecord,
    "id state n_modes created_ns_utc alpha sigma parent sha256 condition_number gate reason "
    "published_ns_utc applied_frame_seq",
)
RECONSTRUCTORS = view(
    "ReconstructorsView",
    TrackerState,
    "in_use reconstructors",
    "The reconstructors the service remembers.",
)
GAINS = view("GainTableView", GainTableShown)

MEASUREMENT = view(
    "MeasurementView",
    MeasurementRecord,
    "id state reason pattern modes amplitude_m n_average frequency_hz duration_s asked_ns_utc "
    "start_seq created_ns_utc n_slopes double_pass session basis_id config_id sha256",
)
MEASUREMENTS = view(
    "MeasurementsView", TrackerState, "measurements", "Measured interaction matrices."
)
MEASURING = view(
    "MeasuringView",
    MeasurementRecord,
    "id state pattern modes asked_ns_utc opens_loop",
    "The interaction matrix being measured: ``/v1/measurements/{id}`` says more.",
)
view(
    "NoisyFindingView",
    NoisyFinding,
    "n_slopes n_frames n_missing snr alpha sigma optical_gain misfit cm_id session created_ns_utc "
    "sha256",
)
NOISY = view(
    "NoisyView",
    NoisyRecord,
    "id state reason n_modes modes total_m amplitude_m duration_s window_s seed asked_ns_utc "
    "basis_id config_id finding",
)
NOISY_MATRICES = view(
    "NoisyListView", TrackerState, "noisy_matrices=noisy", "Noisy interaction matrices."
)
GATHERING = view(
    "GatheringView",
    NoisyRecord,
    "id state total_m duration_s asked_ns_utc",
    "The noisy interaction matrix under way: ``/v1/noisy-matrix/{id}`` says more.",
)

view("EstimatorView", Estimator, "source determines.parameters determines.missing determines.text")
ESTIMATORS = view("EstimatorsView", Estimators)
FIT_JOB = view("FitJobView", FitJob, "id state asked_ns_utc n_bytes sha256 reason")
FIT_JOBS = view("FitJobsView", FitJobs)

view("AlarmView", Alarm, "name since_ns_utc text")
view("LogEntryView", LogEntry, "t_ns_utc level name text n_times=times")
EVENTS = view("EventsView", TrackerState, "alarms log", "What happened, and what is wrong now.")
view("WaitingView", Waiting)
view("PaceView", Pace)
view(
    "LinkView",
    LinkStatistics,
    "rtc_alive session frame_age_s latency_p50_s frames_received frames_lost frames_recovered "
    "frames_duplicate frames_late frames_nonfinite frames_overwritten frames_refused "
    "messages_malformed",
)
STATE = view(
    "StateView",
    Snapshot,
    "tracker.system tracker.mode ready ready_reason now_ns uptime_s registration=alpha "
    "tracker.in_use tracker.margin tracker.assessment tracker.mode_limit rtc tracker.pointing "
    "tracker.basis_id tracker.config_id tracker.dither tracker.dithering tracker.vibrations_hz "
    "tracker.measuring tracker.gathering tracker.acquisition tracker.loop_command "
    "tracker.dither_due_since_ns_utc tracker.dither_due_reason tracker.watchdog tracker.unwatched "
    "waiting_for tracker.alarms tracker.windows_accepted tracker.windows_refused "
    "tracker.windows_outlying pace link",
    "What the service knows, at one glance.",
    measuring=MEASURING,
    gathering=GATHERING,
)
