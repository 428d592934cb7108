"""What tests of several modules share of unit.test_api."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass, field, replace

import numpy as np

from service.archive import Archive
from service.errors import UnknownIdError
from service.link.statistics import LinkStatistics
from service.model.misregistration import Misregistration
from service.records.alarms import Alarm
from service.records.commands import Refit
from service.records.messages import as_message
from service.records.operations import (
    Dither,
    DitherPhase,
    DitherPlan,
    DitherPolicyState,
    DitherPurpose,
    RefitJob,
    RefitState,
)
from service.records.products import GateVerdict, MatrixState, ReconstructorRecord
from service.records.registration import HistoryEntry, PassiveState, Registration
from service.records.state import Level, LogEntry, Mode
from service.runtime.snapshot import Snapshot
from service.wire import DitherKind, DitherRequest, DitherStatus, Loop, Status
from tests.support.situations import POLICY
from tests.support.states import changed, tracker_state

SECOND = 1_000_000_000


ALPHA = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=np.deg2rad(0.3), magnification=1.005
)


SIGMA = np.array([0.01, 0.02, np.deg2rad(0.03), 0.0004])


VERDICT = GateVerdict(
    accepted=True,
    worst_pole_radius=0.8,
    aligned_pole_radius=0.7,
    bound=0.95,
    n_points=9,
    reason="stable",
)


MATRIX = np.arange(12, dtype=np.float32).reshape(3, 4)


LINK = LinkStatistics(
    rtc_alive=True,
    session="s-1",
    basis_id="kl",
    config_id="b1",
    batches_received=300,
    frames_received=3000,
    frames_lost=2,
    frames_recovered=1,
    frames_duplicate=4,
    frames_late=6,
    frames_nonfinite=5,
    frames_overwritten=7,
    frames_refused={"basis": 8},
    messages_malformed={"status": 9},
    statuses_received=30,
    acknowledgements_received=3,
    acknowledgements_unknown=1,
    events_dropped=0,
    callback_errors=0,
    frame_age_s=0.01,
    latency_p50_s=None,
)


def entry(k):
    return HistoryEntry(
        t_ns_utc=k * SECOND,
        measured=ALPHA,
        measured_sigma=2 * SIGMA,
        filtered=ALPHA,
        filtered_sigma=SIGMA,
        innovation=3.5,
        misfit=1.2,
    )


REQUEST = DitherRequest(
    id="d-1",
    kind=DitherKind.SINE,
    modes=(501, 450),
    amplitude_m=(5e-9, 5e-9),
    frequency_hz=(210.0, 250.0),
    duration_s=60.0,
)


STATE = tracker_state(
    system="flao-lbt",
    mode=Mode.PROPOSE,
    registration=Registration(
        alpha=ALPHA,
        covariance=np.diag(SIGMA**2),
        floor=np.array([0.003, 0.003, np.deg2rad(0.005), 0.0003]),
        t_ns_utc=80 * SECOND,
        arrived_ns_utc=90 * SECOND,
        n_windows=4,
        optical_gain=0.6,
    ),
    history=tuple(entry(k) for k in range(5)),
    reconstructors=(
        ReconstructorRecord(id="rtc-0", state=MatrixState.APPLIED, n_modes=400, created_ns_utc=1),
        ReconstructorRecord(
            id="cm-1",
            state=MatrixState.PROPOSED,
            n_modes=400,
            created_ns_utc=2,
            alpha=ALPHA,
            sigma=SIGMA,
            parent="rtc-0",
            sha256=hashlib.sha256(MATRIX.tobytes()).hexdigest(),
            condition_number=8.4,
            gate=VERDICT,
            reason="waits",
        ),
    ),
    in_use="rtc-0",
    margin=VERDICT,
    rtc=Status(
        session="s-1",
        seq=None,
        loop=Loop.CLOSED,
        frame_rate_hz=1000.0,
        delay_frames=2.0,
        leak=1.0,
        gains=(0.4, 0.4),
        n_controlled=400,
        n_modes=594,
        n_slopes=1384,
        cm_id="rtc-0",
        basis_id="kl",
        config_id="b1",
        magnitude=None,
        max_dither_m=1e-7,
        max_dither_modes=4,
        dither=DitherStatus(request=REQUEST, start_seq=17),
        t_ns=99 * SECOND,
    ),
    basis_id="kl",
    config_id="b1",
    policy=DitherPolicyState(
        phase=DitherPhase.SPARSE,
        reason="ordinary telemetry keeps σ between windows",
        budget_m=8e-9,
        plan=DitherPlan(
            total_m=5e-9,
            window_s=2.0,
            interval_s=60.0,
            sigma=SIGMA,
            sufficient=True,
            mean_cost_m=1e-9,
        ),
        mean_square_m2=9e-18,
    ),
    vibrations_hz=(61.0,),
    dither=Dither(request=REQUEST, purpose=DitherPurpose.FOLLOW, start_seq=17, asked_ns_utc=5),
    passive=PassiveState(
        alpha=ALPHA,
        sigma=10 * SIGMA,
        misfit=float("nan"),
        t_ns_utc=80 * SECOND,
        consistent=True,
        text="agrees",
    ),
    active=(
        Alarm(
            name="rtc.silent",
            since_ns_utc=70 * SECOND,
            message=as_message("x", "no status: look at it"),
        ),
    ),
    log=tuple(
        LogEntry(
            t_ns_utc=k,
            level=Level.INFO,
            name="window.accepted",
            message=as_message("x", f"window {k}"),
        )
        for k in range(4)
    ),
    accepted=4,
    refused=1,
)


@dataclass
class FakeService:
    """Holds a real state and remembers what it was asked."""

    now: Snapshot
    commands: list = field(default_factory=list)
    callers: list = field(default_factory=list)
    trail: list = field(default_factory=list)
    refusal: Exception | None = None
    thread: int | None = None
    archive: Archive | None = None

    def snapshot(self):
        return self.now

    async def submit(self, command, caller, order_id=""):
        if self.refusal is not None:
            raise self.refusal
        self.commands.append(command)
        self.callers.append(caller)
        if isinstance(command, Refit):
            job = RefitJob(
                id=order_id,
                state=RefitState.RUNNING,
                n_modes=command.n_modes or 1,
                asked_ns_utc=self.now.now_ns,
            )
            self.now = replace(self.now, tracker=changed(self.now.tracker, refits=(job,)))
        return as_message("command", f"{type(command).__name__} is on its way")

    def audit(self, entry):
        self.trail.append(entry)

    async def audited(self, entry):
        self.trail.append(entry)

    def matrix(self, matrix_id):
        self.thread = threading.get_ident()
        if self.refusal is not None:
            raise self.refusal
        if matrix_id != "cm-1":
            raise UnknownIdError(f"reconstructor {matrix_id}: no such matrix in the archive")
        return MATRIX

    @property
    def tracker(self):
        return self.now.tracker

    def change(self, **changes):
        self.now = replace(self.now, tracker=changed(self.now.tracker, **changes))


def a_snapshot(tracker=STATE, **changes):
    """Return what a service of 60 s knows, with changes."""
    given = {"link": LINK, "ready": True, "ready_reason": "telemetry flows", "policy": POLICY}
    given |= {"now_ns": 100 * SECOND, "started_ns": 40 * SECOND} | changes
    return Snapshot(tracker=tracker, **given)


async def body_of(client, path, **parameters):
    response = await client.get(path, params=parameters)
    assert response.status_code == 200, response.text
    return response.json()


def assert_problem(response, status, kind, *words):
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert set(problem) == {"type", "title", "status", "detail", "instance"}
    assert problem["type"] == f"urn:pyrcal:problem:{kind}"
    assert problem["status"] == status
    assert problem["title"]
    assert problem["instance"] == response.request.url.path
    for word in words:
        assert word in problem["detail"], problem["detail"]
