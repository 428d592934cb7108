"""Routes of the state: as JSON, as health for orchestrators, as metrics for Prometheus."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from enum import StrEnum
from functools import partial
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from pydantic import BaseModel, Field

from service.link.statistics import LinkStatistics
from service.records.alarms import ARCHIVE_FAILED, WORKER_BEHIND, AlarmState, Responsible, Severity
from service.records.operations import DitherPhase
from service.records.products import MatrixState
from service.records.registration import Source, Validity
from service.records.state import Mode, TrackerState
from service.runtime.snapshot import Snapshot, WorkerLoad
from service.tracking.operations.running import CurrentOperation, ServiceState
from service.version import software_version
from service.web import views
from service.web.authentication import OPEN
from service.web.problems import INVALID, problem, problem_response
from service.web.views import Parameters, ServiceDep, answer, shows
from service.wire import Pattern

router = APIRouter(prefix="/v1", tags=["state"], responses={**INVALID})
health = APIRouter(tags=["health"])


class LimitParameters(Parameters):
    """Length of the returned list."""

    limit: int = Field(default=200, ge=1, le=100_000)
    """At most so many entries, the newest ones."""


@router.get("/state", responses={200: shows(views.STATE)})
async def state(service: ServiceDep) -> Response:
    """Return the whole state."""
    return answer(service.snapshot())


@router.get(
    "/alpha",
    responses={
        200: shows(views.ALPHA),
        404: problem_response("No window of telemetry has been accepted yet"),
    },
)
async def alpha(request: Request, service: ServiceDep) -> Response:
    """Return the registration now: estimate, 1 σ, covariance and age."""
    snapshot = service.snapshot()
    tracker = snapshot.tracker
    current = snapshot.alpha
    if current is None:
        detail = (
            f"no estimate yet: {tracker.windows.accepted} windows accepted, "
            f"{tracker.windows.refused} refused; {snapshot.ready_reason}"
        )
        return problem(request, HTTPStatus.NOT_FOUND, "no-estimate", detail)
    return answer(current)


@router.get("/alarms", responses={200: shows(views.ALARMS)})
async def alarms(service: ServiceDep) -> Response:
    """Return the alarms: lasting, ended unseen, muted."""
    return answer(service.snapshot(), views.ALARMS)


@router.get("/events", responses={200: shows(views.EVENTS)})
async def events(service: ServiceDep, parameters: Annotated[LimitParameters, Query()]) -> Response:
    """Return the log, oldest first, and the alarms."""
    tracker = service.snapshot().tracker
    return answer(replace(tracker, log=tracker.log[-parameters.limit :]), views.EVENTS)


# --- whether all is well


MAX_FRAME_AGE_S = 3.0
"""Age of the last frame beyond which telemetry counts as stopped, seconds."""


class HealthView(BaseModel):
    """The service answers and goes on."""

    status: str
    version: str
    uptime_s: float


class ReadyView(BaseModel):
    """The service does its work: telemetry is fresh, the archive writable, the worker keeps up."""

    ready: bool
    reason: str


@health.get(
    "/healthz",
    openapi_extra=OPEN,
    response_model=HealthView,
    responses={503: problem_response("A part of the service has stopped; the detail names it")},
)
async def healthz(request: Request, service: ServiceDep) -> HealthView | Response:
    """Say whether the service goes on: it takes telemetry in and ticks, with an RTC or without."""
    snapshot = service.snapshot()
    if snapshot.stalled:
        status = HTTPStatus.SERVICE_UNAVAILABLE
        return problem(request, status, "stalled", snapshot.stalled)
    return HealthView(status="ok", version=software_version(), uptime_s=snapshot.uptime_s)


@health.get(
    "/readyz",
    openapi_extra=OPEN,
    response_model=ReadyView,
    responses={503: problem_response("Telemetry, archive or worker: the detail says which, why")},
)
async def readyz(request: Request, service: ServiceDep) -> ReadyView | Response:
    """Say whether telemetry is fresh, the archive writable and the worker keeps up.

    It asks for more than ``ready`` of the state, which a service without an RTC is, too.
    """
    snapshot = service.snapshot()
    detail = "; ".join(f"{part}: {text}" for part, text in find_problems(snapshot).items() if text)
    if detail:
        return problem(request, HTTPStatus.SERVICE_UNAVAILABLE, "not-ready", detail)
    return ReadyView(ready=True, reason=snapshot.ready_reason)


def find_problems(snapshot: Snapshot) -> dict[str, str]:
    """Return what is the matter with telemetry, archive and worker; empty: nothing."""
    alarms = {alarm.name: alarm.text for alarm in snapshot.tracker.alarms.active}
    hindering = [wait for wait in snapshot.waiting_for if wait.blocks]
    age_s = snapshot.link.frame_age_s
    stopped = []
    if age_s is None:
        stopped = ["no frame has come from an RTC yet"]
    elif age_s > MAX_FRAME_AGE_S:
        stopped = [
            f"the last frame came {age_s:.0f} s ago, expected one within {MAX_FRAME_AGE_S:g} s"
        ]
    unusable = [wait.text for wait in hindering if wait.responsible is not Responsible.WORKER]
    lost = [wait.text for wait in hindering if wait.responsible is Responsible.WORKER]
    return {
        "telemetry": "; ".join([*stopped, *unusable]),
        "archive": alarms.get(ARCHIVE_FAILED, ""),
        "worker": "; ".join([*lost, *([alarms[WORKER_BEHIND]] if WORKER_BEHIND in alarms else [])]),
    }


@health.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "description": "Prometheus text format, or OpenMetrics where Accept asks for it",
            "content": {"text/plain": {"schema": {"type": "string"}}},
        }
    },
)
async def metrics(request: Request, service: ServiceDep) -> Response:
    """Return all metrics for Prometheus."""
    encode, content_type = choose_encoder(request.headers.get("accept", ""))
    # auto_describe would collect everything once more at registration.
    registry = CollectorRegistry(auto_describe=False)
    registry.register(SnapshotCollector(service.snapshot))
    ProcessCollector(registry=registry)
    return Response(encode(registry), headers={"Content-Type": content_type})


# --- the snapshot as Prometheus metrics

_ALPHA = (
    "shift_x_subapertures",
    "shift_y_subapertures",
    "rotation_radians",
    "magnification_ratio",
)
"""The four parameters in base units; the sensor's own for shifts."""

_LINK_COUNTERS = {
    "batches_received": "Telemetry batches taken in",
    "frames_received": "Frames that could be used",
    "frames_recovered": "Frames that came late but in time",
    "frames_duplicate": "Frames that came again",
    "frames_late": "Frames that came too late",
    "frames_nonfinite": "Frames dropped because a number in them was not finite",
    "frames_overwritten": "Frames not drained in time, or void by a new session",
    "statuses_received": "Status messages of the RTC",
    "acknowledgements_received": "Acknowledgements of reconstructors",
    "acknowledgements_unknown": "Acknowledgements for an id that was never offered",
    "events_dropped": "Events of the link not taken in time",
    "callback_errors": "Faults of the service while taking a message",
}


class SnapshotCollector(Collector):
    """Reads one snapshot for each scrape.

    Parameters
    ----------
    snapshot
        Returns what is known now.
    """

    def __init__(self, snapshot: Callable[[], Snapshot]) -> None:
        self._snapshot = snapshot

    # typing.override comes with Python 3.12
    def collect(self) -> Iterator[Metric]:  # type: ignore[explicit-override]
        """Yield every metric."""
        snapshot = self._snapshot()
        tracker = snapshot.tracker
        yield _gauge("build_info", "Version", {software_version(): 1}, "version")
        parts = {part: not text for part, text in find_problems(snapshot).items()}
        yield _gauge("ready", "1 for each part that does its work; all: /readyz", parts, "part")
        yield _gauge("uptime_seconds", "Since the service started", snapshot.uptime_s)
        refused = "Attempts to write that the disk has refused"
        yield _counter("archive_failures", refused, snapshot.archive_failures)
        waiting = "Lines of the audit trail that are not on the disk yet"
        yield _gauge("archive_waiting", waiting, snapshot.archive_waiting)
        yield from _of_worker_load(snapshot.worker_load)
        yield from _of_link(snapshot.link)
        since_ns = tracker.loop.reference_since_ns_utc
        unchanged = "Since the RTC changed its reference slopes; NaN: it has not"
        age_s = None if since_ns is None else (snapshot.now_ns - since_ns) / 1e9
        yield _gauge("reference_age_seconds", unchanged, age_s)
        used = snapshot.references.used
        ours = "1 while the RTC uses reference slopes of the service"
        yield _gauge("references_in_use", ours, used is not None)
        held = "RMS of the shape that they hold; NaN: none"
        yield _gauge("references_shape_meters", held, None if used is None else used.rms_m)
        scaled = "Mean gain that they were scaled with; NaN: none"
        yield _gauge("references_gain_ratio", scaled, None if used is None else used.gain)
        yield from _of_registration(snapshot)
        yield from _of_the_dither(tracker)
        yield from _of_reconstructors(tracker)
        yield from _of_measurement(snapshot)
        yield from _of_alarms(snapshot)
        waits = {wait.name: wait.blocks + 1 for wait in snapshot.waiting_for}
        expected = "1 for what is waited for, 2 where nothing can be done meanwhile"
        yield _gauge("waiting_for", expected, waits, "name")


def _of_alarms(snapshot: Snapshot) -> Iterator[Metric]:
    lasting, operating = snapshot.alarms, snapshot.operating
    yield _gauge("alarms", "Alarms that last", len(lasting))
    names = {alarm.record.name: 1 for alarm in lasting}
    yield _gauge("alarm", "1 for each alarm that lasts", names, "name")
    by_severity = Counter(str(alarm.severity) for alarm in lasting if alarm.record.muted is None)
    # Zero for severities without alarms, so that no series vanishes.
    shown = {str(severity): by_severity[severity] for severity in Severity}
    yield _gauge("alarms_shown", "Alarms that last and are not muted", shown, "severity")
    active = sum(alarm.record.alarm_state is AlarmState.ACTIVE for alarm in lasting)
    yield _gauge("alarms_unacknowledged", "Alarms that last and are not acknowledged", active)
    stale = "Alarms that ended without an acknowledgement"
    yield _gauge("alarms_stale", stale, len(snapshot.stale_alarms))
    yield _gauge("alarms_muted", "Alarms that are muted", len(snapshot.muted_alarms))
    states = _one_of(ServiceState, operating.service_state)
    yield _gauge("service_state", "1 for the state of the service", states, "state")
    doing = _one_of(CurrentOperation, operating.current_operation)
    yield _gauge("current_operation", "1 for what the service does", doing, "current_operation")


def _of_worker_load(load: WorkerLoad) -> Iterator[Metric]:
    text = "Processor time of the worker per second of telemetry, last minute"
    yield _gauge("worker_load_ratio", text, load.worker_per_s)
    yield _gauge("worker_job_load_ratio", f"{text}, by job", load.by_job, "job")
    text = "Processor time of the service itself per second, last minute"
    yield _gauge("service_load_ratio", text, load.service_per_s)
    busy = "Share of the last minute in which the worker had a job"
    yield _gauge("worker_busy_ratio", busy, load.busy_ratio)
    yield _gauge("window_seconds", "Mean length of the windows of the last minute", load.window_s)
    late = "Windows of the last minute that were joined to one the worker had no hand free for"
    yield _gauge("windows_late", late, load.windows_late)


def _of_link(link: LinkStatistics) -> Iterator[Metric]:
    for name, text in _LINK_COUNTERS.items():
        yield _counter(name, text, getattr(link, name))
    refused = "Frames not used, by reason"
    yield _counter("frames_refused", refused, link.frames_refused, "reason")
    malformed = "Messages that broke the contract"
    yield _counter("messages_malformed", malformed, link.messages_malformed, "kind")
    lost = "Frames missing in the sequence; falls again when they are recovered"
    # A gauge, because a counter of Prometheus must not fall.
    yield _gauge("frames_lost", lost, link.frames_lost)
    yield _gauge("rtc_alive", "1 while the RTC's liveliness token is there", link.rtc_alive)
    yield _gauge("frame_age_seconds", "Since the last frame arrived", link.frame_age_s)
    yield _gauge("telemetry_age_seconds", "Delay of the newest frame", link.telemetry_age_s)
    yield _gauge("latency_p50_seconds", "Median from put to callback", link.latency_p50_s)


def _of_registration(snapshot: Snapshot) -> Iterator[Metric]:
    tracker = snapshot.tracker
    windows = {
        "accepted": tracker.windows.accepted,
        "refused": tracker.windows.refused,
        "outlying": tracker.windows.outlying,
    }
    yield _counter("windows", "Windows of telemetry, by verdict", windows, "verdict")
    # the last look of each kind
    misfits = {str(entry.source): entry.misfit for entry in tracker.alpha.history}
    if tracker.alpha.passive is not None:
        misfits[str(Source.PASSIVE)] = tracker.alpha.passive.misfit
    explained = "Residual power over what noise explains, last of each kind: 1 is all explained"
    yield _gauge("misfit_ratio", explained, misfits, "source")
    alpha = snapshot.alpha
    if alpha is None:
        return
    registration = alpha.registration
    for name, text, four in (
        ("alpha", "Registration", registration.alpha.vector),
        ("alpha_sigma", "1 sigma, floor included", registration.shown_sigma),
        ("alpha_tracking_sigma", "1 sigma of changes", registration.tracking_sigma),
    ):
        for parameter, value in zip(_ALPHA, four.tolist(), strict=True):
            yield _gauge(f"{name}_{parameter}", text, value)
    yield _gauge("alpha_age_seconds", "Age of the estimate", alpha.age_s)
    worth = registration.validity.level
    text = "1 for the validity of the estimate"
    yield _gauge("alpha_validity", text, _one_of(Validity, worth), "validity")
    due = tracker.alpha.dither_due_since_ns_utc is not None
    yield _gauge("dither_due", "1 while a dithered window is wanted first", due)
    gain = "Mean optical gain of the dithered modes"
    yield _gauge("optical_gain_ratio", gain, registration.optical_gain)
    dithered = {str(one.mode): one for one in registration.optical_gains}
    gains, sigma = ({mode: one.gain for mode, one in dithered.items()}, "1 sigma of each")
    yield _gauge("mode_optical_gain_ratio", "Optical gain of each dithered mode", gains, "mode")
    sigmas = {mode: one.sigma for mode, one in dithered.items()}
    yield _gauge("mode_optical_gain_sigma_ratio", sigma, sigmas, "mode")


def _of_the_dither(tracker: TrackerState) -> Iterator[Metric]:
    dithering = tracker.dithers.policy
    mean = "Quadratic mean of the dither over ten minutes, OPD"
    yield _gauge("dither_mean_meters", mean, dithering.mean_cost_m)
    yield _gauge("dither_budget_meters", "Largest RMS of all modes together", dithering.budget_m)
    phases = _one_of(DitherPhase, dithering.phase)
    yield _gauge("dither_phase", "1 for how the service dithers", phases, "phase")


def _of_reconstructors(tracker: TrackerState) -> Iterator[Metric]:
    states = Counter(record.state for record in tracker.matrices.reconstructors)
    by_state = {str(state): states[state] for state in MatrixState}
    yield _gauge("reconstructors", "Reconstructors remembered", by_state, "state")
    yield _gauge(
        "mode", "1 for the mode of the service", _one_of(Mode, tracker.operator.mode), "mode"
    )
    if tracker.matrices.margin is None:
        return
    worst = tracker.matrices.margin.worst_pole_radius
    yield _gauge("worst_pole_radius", "Of the reconstructor in use, 1 is unstable", worst)
    yield _gauge(
        "pole_radius_bound", "Largest radius that is accepted", tracker.matrices.margin.bound
    )
    yield _gauge("stability_margin", "1 minus the worst pole radius", 1.0 - worst)


def _of_measurement(snapshot: Snapshot) -> Iterator[Metric]:
    current = snapshot.tracker.measuring
    patterns = _one_of(Pattern, None if current is None else current.pattern)
    text = "1 for the pattern of the interaction matrix being measured"
    yield _gauge("measuring", text, patterns, "pattern")
    if current is not None and current.asked_ns_utc is not None:
        age_s = (snapshot.now_ns - current.asked_ns_utc) / 1e9
        yield _gauge("measuring_seconds", "Time since the request", age_s)


def _one_of(kinds: type[StrEnum], current: StrEnum | None) -> dict[str, int]:
    """Return 1 for the kind that it is, 0 for all others."""
    return {str(kind): int(kind is current) for kind in kinds}


Numbers = float | None | Mapping[str, float]
"""Unknown values are NaN, as usual in Prometheus."""


def _metric(
    kind: type[GaugeMetricFamily | CounterMetricFamily],
    name: str,
    text: str,
    value: Numbers,
    label: str = "",
) -> Metric:
    """Return a metric with its number, or one for each value of its label."""
    family = kind(f"pyrcal_{name}", text, labels=[label] * bool(label))
    for key, number in value.items() if isinstance(value, Mapping) else [("", value)]:
        labels = [key] if isinstance(value, Mapping) else []
        family.add_metric(labels, math.nan if number is None else number)
    return family


_gauge = partial(_metric, GaugeMetricFamily)
_counter = partial(_metric, CounterMetricFamily)
