"""How the service is doing: for orchestrators and Prometheus."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus

import numpy as np
from fastapi import APIRouter, Request, Response
from numpy.typing import NDArray
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from pydantic import BaseModel

from service import __version__
from service.link.statistics import LinkStatistics
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.routes.problems import problem, problem_response
from service.routes.views import ServiceDep
from service.snapshot import Pace, Snapshot
from service.tracking.products import MatrixState
from service.tracking.registration import Source, Validity
from service.tracking.stages import DitherPhase
from service.tracking.state import Mode, TrackerState
from service.wire import Pattern

router = APIRouter(tags=["how it is doing"])


class HealthView(BaseModel):
    """The process runs and answers."""

    status: str
    version: str
    uptime_s: float


class ReadyView(BaseModel):
    """The service can do its work."""

    ready: bool
    reason: str


@router.get("/healthz")
async def healthz(service: ServiceDep) -> HealthView:
    """Answer as long as the process lives."""
    snapshot = service.snapshot()
    return HealthView(status="ok", version=__version__, uptime_s=snapshot.uptime_s)


@router.get(
    "/readyz",
    response_model=ReadyView,
    responses={503: problem_response("The service cannot do its work yet; the detail says why")},
)
async def readyz(request: Request, service: ServiceDep) -> ReadyView | Response:
    """Say whether the service can do its work, and what it waits for."""
    snapshot = service.snapshot()
    if not snapshot.ready:
        detail = snapshot.ready_reason
        return problem(request, HTTPStatus.SERVICE_UNAVAILABLE, "not-ready", detail)
    return ReadyView(ready=True, reason=snapshot.ready_reason)


@router.get(
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
    """Return everything that can be counted or measured, for Prometheus."""
    encode, content_type = choose_encoder(request.headers.get("accept", ""))
    registry = CollectorRegistry(auto_describe=False)
    registry.register(SnapshotCollector(service.snapshot))
    return Response(encode(registry), headers={"Content-Type": content_type})


# --- the snapshot as Prometheus metrics

_LINK_COUNTERS = {
    "batches_received": "Telemetry batches taken in",
    "frames_received": "Frames that could be used",
    "frames_recovered": "Frames that came late and still found their place",
    "frames_duplicate": "Frames that came again",
    "frames_late": "Frames that came when their place had been passed",
    "frames_nonfinite": "Frames dropped because a number in them was not finite",
    "frames_overwritten": "Frames nobody drained in time, or that a new session made void",
    "statuses_received": "Status messages of the RTC",
    "acknowledgements_received": "Acknowledgements of reconstructors",
    "acknowledgements_unknown": "Acknowledgements for an id that was never offered",
    "events_dropped": "Events of the link that nobody took in time",
    "callback_errors": "Faults of the service while it took a message in",
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
        yield _labelled_gauge("build_info", "Version", "version", {__version__: 1})
        yield _gauge("ready", "1 when the service can do its work", snapshot.ready)
        yield _gauge("uptime_seconds", "Since the service started", snapshot.uptime_s)
        refused = "Attempts to write that the disk has refused"
        yield CounterMetricFamily(
            "pyrcal_archive_failures", refused, value=snapshot.archive_failures
        )
        waiting = "Lines of the audit trail that are not on the disk yet"
        yield _gauge("archive_waiting", waiting, snapshot.archive_waiting)
        yield from _of_pace(snapshot.pace)
        yield from _of_link(snapshot.link)
        yield from _of_registration(snapshot)
        yield from _of_the_dither(snapshot.tracker)
        yield from _of_reconstructors(snapshot.tracker)
        yield from _of_measurement(snapshot)
        alarms = {alarm.name: 1 for alarm in snapshot.tracker.alarms}
        yield _gauge("alarms", "Alarms that last", len(alarms))
        waits = {wait.name: wait.hinders + 1 for wait in snapshot.waiting_for}
        expected = "1 for what is waited for, 2 where nothing can be done meanwhile"
        yield _labelled_gauge("waiting_for", expected, "name", waits)
        yield _labelled_gauge("alarm", "1 for each alarm that lasts", "name", alarms)


def _of_pace(pace: Pace) -> Iterator[Metric]:
    text = "Processor time of the worker per second of telemetry, last minute"
    yield _gauge("worker_load_ratio", text, pace.worker_per_s)
    yield _labelled_gauge("worker_job_load_ratio", f"{text}, by job", "job", pace.by_job)
    text = "Processor time of the service itself per second, last minute"
    yield _gauge("service_load_ratio", text, pace.service_per_s)
    busy = "Share of the last minute in which the worker had a job"
    yield _gauge("worker_busy_ratio", busy, pace.busy_ratio)
    yield _gauge("window_seconds", "Mean length of the windows of the last minute", pace.window_s)
    late = "Windows of the last minute that were joined to one the worker had no hand free for"
    yield _gauge("windows_late", late, pace.windows_late)


def _of_link(link: LinkStatistics) -> Iterator[Metric]:
    for name, text in _LINK_COUNTERS.items():
        yield CounterMetricFamily(f"pyrcal_{name}", text, value=getattr(link, name))
    yield _labelled_counter(
        "frames_refused", "Frames not used, by reason", "reason", link.frames_refused
    )
    yield _labelled_counter(
        "messages_malformed",
        "Messages that broke the contract",
        "kind",
        link.messages_malformed,
    )
    lost = "Frames missing in the sequence; falls again when they are recovered"
    yield _gauge("frames_lost", lost, link.frames_lost)
    yield _gauge("rtc_alive", "1 while the RTC's liveliness token is there", link.rtc_alive)
    yield _gauge("frame_age_seconds", "Since the last frame arrived", link.frame_age_s)
    yield _gauge("latency_p50_seconds", "Median from put to callback", link.latency_p50_s)


def _of_registration(snapshot: Snapshot) -> Iterator[Metric]:
    tracker = snapshot.tracker
    windows = {
        "accepted": tracker.windows_accepted,
        "refused": tracker.windows_refused,
        "outlying": tracker.windows_outlying,
    }
    yield _labelled_counter("windows", "Windows of telemetry, by verdict", "verdict", windows)
    explained = "Residual power over what noise explains, last of each kind: 1 is all explained"
    yield _labelled_gauge("misfit_ratio", explained, "source", _misfits(tracker))
    alpha = snapshot.alpha
    if alpha is None:
        return
    registration = alpha.known
    yield from _four("alpha", "Registration", registration.alpha.vector)
    yield from _four("alpha_sigma", "1 sigma, floor included", registration.sigma)
    yield _gauge("alpha_age_seconds", "Age of the estimate", alpha.age_s)
    valid = {str(kind): kind is registration.standing.validity for kind in Validity}
    yield _labelled_gauge("alpha_validity", "1 for what the estimate is worth", "validity", valid)
    due = tracker.dither_due_since_ns_utc is not None
    yield _gauge("dither_due", "1 while a dithered window is wanted before all else", due)
    gain = "Mean optical gain of the dithered modes"
    yield _gauge("optical_gain_ratio", gain, registration.optical_gain)


def _misfits(tracker: TrackerState) -> dict[str, float]:
    """Return the last goodness of fit of each way of looking at telemetry."""
    newest_first = tuple(reversed(tracker.history))
    found = {}
    for source in Source:
        last = next((entry for entry in newest_first if entry.source is source), None)
        if last is not None:
            found[str(source)] = last.misfit
    if tracker.watchdog is not None:
        found[str(Source.PASSIVE)] = tracker.watchdog.misfit
    return found


def _of_the_dither(tracker: TrackerState) -> Iterator[Metric]:
    dithering = tracker.dithering
    mean = "Quadratic mean of the dither over ten minutes, metres OPD"
    yield _gauge("dither_mean_metres", mean, dithering.mean_cost_m)
    yield _gauge("dither_budget_metres", "Largest RMS of all modes together", dithering.budget_m)
    phases = {str(phase): phase is dithering.phase for phase in DitherPhase}
    yield _labelled_gauge("dither_phase", "1 for how the service dithers", "phase", phases)


def _of_reconstructors(tracker: TrackerState) -> Iterator[Metric]:
    states = Counter(record.state for record in tracker.reconstructors)
    by_state = {str(state): states[state] for state in MatrixState}
    yield _labelled_gauge("reconstructors", "Reconstructors remembered", "state", by_state)
    modes = {str(mode): mode is tracker.mode for mode in Mode}
    yield _labelled_gauge("mode", "1 for the mode of the service", "mode", modes)
    if tracker.margin is None:
        return
    worst = tracker.margin.worst_pole_radius
    yield _gauge("worst_pole_radius", "Of the reconstructor in use, 1 is unstable", worst)
    yield _gauge("pole_radius_bound", "Largest radius that is accepted", tracker.margin.bound)
    yield _gauge("stability_margin", "1 minus the worst pole radius", 1.0 - worst)


def _of_measurement(snapshot: Snapshot) -> Iterator[Metric]:
    current = snapshot.tracker.measuring
    patterns = {
        str(pattern): current is not None and current.pattern is pattern for pattern in Pattern
    }
    text = "1 for the pattern of the interaction matrix being measured"
    yield _labelled_gauge("measuring", text, "pattern", patterns)
    if current is not None and current.asked_ns_utc is not None:
        age_s = (snapshot.now_ns - current.asked_ns_utc) / 1e9
        yield _gauge("measuring_seconds", "Since it was asked for", age_s)


def _four(prefix: str, text: str, vector: NDArray[np.float64]) -> Iterator[Metric]:
    for name, value in zip(PARAMETERS, vector * BOUNDARY_SCALE, strict=True):
        yield _gauge(f"{prefix}_{name}", f"{text}: {name}", float(value))


def _gauge(name: str, text: str, value: float | None) -> Metric:
    """Return a gauge; what is not known is NaN, as Prometheus has it."""
    return GaugeMetricFamily(f"pyrcal_{name}", text, value=math.nan if value is None else value)


def _labelled_gauge(name: str, text: str, label: str, values: Mapping[str, float]) -> Metric:
    family = GaugeMetricFamily(f"pyrcal_{name}", text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def _labelled_counter(name: str, text: str, label: str, values: Mapping[str, int]) -> Metric:
    family = CounterMetricFamily(f"pyrcal_{name}", text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family
