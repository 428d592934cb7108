"""What leaves over REST: every number carries its unit in its name; what is not finite is null."""

from __future__ import annotations

from pydantic import Field

from service.routes.acquisition_views import AcquisitionView
from service.routes.dither_views import DitheringView
from service.routes.registration_views import AlphaView, PointingView, WatchdogView
from service.routes.rtc_views import (
    DitherView,
    GatheringView,
    LoopCommandView,
    MeasuringView,
    RtcView,
)
from service.routes.service import Snapshot
from service.routes.views import FourView, Number, View
from service.state import Level, MatrixState, Mode, Party


class VerdictView(View):
    """The stability gate's verdict, over everything α may be."""

    accepted: bool
    """Whether every pole stays within the bound."""

    worst_pole_radius: Number
    """Largest closed-loop pole radius; 1 is the edge of stability, null: not finite."""

    aligned_pole_radius: Number
    """The same for a perfect reconstructor at these gains."""

    bound: Number
    """Largest radius that is accepted."""

    n_points: int
    """Registrations tried."""

    reason: str
    """What to know, and to do when it was refused."""

    edge_motion_m: float | None = None
    """RMS motion of the outermost actuators for slope noise of 1, metres; null: not known."""


class ReconstructorView(View):
    """One reconstructor."""

    id: str
    """Never reused."""

    state: MatrixState
    """Where it is on its way to the RTC."""

    n_modes: int
    """Modes it commands."""

    created_ns_utc: int
    """When it was computed."""

    alpha: FourView | None
    """The registration it was computed for; null: not made by this service."""

    sigma: FourView | None
    """1 σ of that registration."""

    parent: str | None
    """The one in use when it was computed, or the one a rollback copies."""

    sha256: str
    """Of the matrix as it travels (``format=raw``)."""

    condition_number: Number
    """Of the interaction matrix it inverts."""

    gate: VerdictView | None
    """The stability gate's verdict."""

    reason: str
    """Why it is in this state."""

    published_ns_utc: int | None
    """When it was sent."""

    applied_frame_seq: int | None
    """First frame whose slopes it multiplied."""


class ReconstructorsView(View):
    """The reconstructors the service remembers."""

    in_use: str | None
    """Id of the one the RTC multiplies with; null: unknown."""

    reconstructors: tuple[ReconstructorView, ...]
    """Oldest first."""


class AlarmView(View):
    """Something that must be seen, for as long as it lasts."""

    name: str
    since_ns_utc: int
    text: str
    """What was found, and what to do."""


class LogEntryView(View):
    """One thing that happened."""

    t_ns_utc: int
    level: Level
    name: str
    """Machine-readable, like ``reconstructor.applied``."""

    text: str
    n_times: int = Field(validation_alias="times")
    """How often so far: a line that repeats is told once a minute, with a count."""


class EventsView(View):
    """What happened, and what is wrong now."""

    alarms: tuple[AlarmView, ...]
    log: tuple[LogEntryView, ...]
    """Oldest first."""


class WaitingView(View):
    """Something the service waits for."""

    name: str
    """Machine-readable."""

    party: Party
    """Who can end it: "rtc", "operator", "worker" (the service's own) or "service" (another)."""

    text: str
    """What is missing, and what to do."""

    hinders: bool
    """Whether the service can do nothing of its work meanwhile: then it is not ready."""


class LinkView(View):
    """What has passed on the link since the service started."""

    rtc_alive: bool
    session: str | None
    frame_age_s: Number
    """Since the last frame arrived, seconds; null: none has."""

    latency_p50_s: Number
    """Median from put to callback, seconds; null: not known."""

    frames_received: int
    frames_lost: int
    frames_recovered: int
    frames_duplicate: int
    frames_late: int
    frames_nonfinite: int
    frames_overwritten: int
    frames_refused: dict[str, int]
    """By reason."""

    messages_malformed: dict[str, int]
    """By kind."""


class ExpectedGainView(View):
    """What a new reconstructor would win over the one in use, by the linear model of the loop."""

    loss_m: Number
    """Wavefront error that a new one would save, metres RMS; null: infinite."""

    wavefront_m: Number
    """Wavefront error with a new one, metres RMS."""

    pole_radius: Number
    """Of the one in use, at the estimate itself."""

    fresh_pole_radius: Number
    """Of a new one there."""


class AssessmentView(View):
    """What the reconstructor in use loses, and where."""

    id: str
    alpha: FourView
    """The registration it was computed for."""

    expected: ExpectedGainView
    t_ns_utc: int
    """When."""


class ModeLimitView(View):
    """More modes than these would not pass the gate."""

    n_modes: int
    since_ns_utc: int
    until_ns_utc: int
    """More are not tried before."""

    reason: str
    """What the gate said of more."""


class PaceView(View):
    """What the work of the last minute cost."""

    worker_per_s: Number
    """Processor time of the worker for each second of telemetry; null: there was none."""

    by_job: dict[str, float]
    """The same by kind of job, what costs most first."""

    service_per_s: Number
    """Processor time of the service itself for each second of the clock."""

    busy_ratio: Number
    """Share of the time in which the worker had a job."""

    window_s: Number
    """Mean length of the windows fitted, seconds; null: none was."""

    windows_late: int
    """Windows that came while another still waited for the worker, and were joined to it."""


class StateView(View):
    """What the service knows, at one glance."""

    system: str
    """The system it works for."""

    mode: Mode
    """How much the service may do by itself."""

    ready: bool
    ready_reason: str
    """What it waits for."""

    now_ns: int
    """The service's clock, nanoseconds since the Unix epoch."""

    uptime_s: float
    registration: AlphaView | None
    """Null until the first accepted window."""

    in_use: str | None
    """Id of the reconstructor the RTC multiplies with; null: unknown."""

    margin: VerdictView | None
    """The gate's verdict on the reconstructor in use, at the current estimate; null: not known."""

    assessment: AssessmentView | None
    """What it loses against a new one; null: not known."""

    mode_limit: ModeLimitView | None
    """How many modes the gate lets be controlled; null: as many as are wanted."""

    rtc: RtcView | None
    """Null: no RTC has been heard, or it has vanished."""

    pointing: PointingView | None
    """Of the telescope; null: nobody has told."""

    basis_id: str | None
    config_id: str | None
    dither: DitherView | None
    dithering: DitheringView
    """Why the service dithers or does not, and what that costs."""

    vibrations_hz: tuple[Number, ...]
    """Vibration lines heard in the slopes, lowest first."""

    measuring: MeasuringView | None
    """Null: none is."""

    gathering: GatheringView | None
    """The noisy interaction matrix under way; null: none is."""

    acquisition: AcquisitionView
    loop_command: LoopCommandView | None
    """Null: none was asked for."""

    dither_due_since_ns_utc: int | None
    """Since when a dithered window is wanted before anything else is believed; null: it is not."""

    dither_due_reason: str
    """Why."""

    watchdog: WatchdogView | None
    """The last look at ordinary telemetry; null: there was none."""

    unwatched: str
    """Why ordinary telemetry says nothing of α now, and what it would need; empty: it does, or was
    not looked at yet."""

    waiting_for: tuple[WaitingView, ...]
    """Whom the service waits for and what they should do, what hinders most first."""

    alarms: tuple[AlarmView, ...]
    windows_accepted: int
    windows_refused: int
    windows_outlying: int
    """Believable in themselves, but too far from all others to be believed."""

    pace: PaceView
    link: LinkView

    @classmethod
    def of(cls, snapshot: Snapshot) -> StateView:
        """Return the view of a snapshot."""
        tracker = snapshot.tracker
        same = {
            name: getattr(tracker, name)
            for name in cls.model_fields
            if name != "registration" and hasattr(tracker, name)
        }
        registration = tracker.registration
        return cls.model_validate(
            same
            | {
                "ready": snapshot.ready,
                "ready_reason": snapshot.ready_reason,
                "waiting_for": snapshot.waiting_for,
                "now_ns": snapshot.now_ns,
                "uptime_s": (snapshot.now_ns - snapshot.started_ns) / 1e9,
                "registration": registration and AlphaView.of(registration, snapshot),
                "link": snapshot.link,
                "pace": snapshot.pace,
            }
        )
