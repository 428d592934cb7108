"""The page before a service in whatever state a test puts it: no RTC, no worker, no wait."""

import math
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import uvicorn

from service.api import create_app
from service.archive import Archive
from service.instrument import packaged_instrument
from service.model.misregistration import Misregistration
from service.records.alarms import Alarm
from service.records.messages import as_message
from service.records.products import MatrixState, ReconstructorRecord
from service.records.registration import HistoryEntry
from service.runtime.snapshot import Snapshot
from service.tracking.alarm_records import record_of
from tests.support.api import ALPHA, LINK, SECOND, SIGMA, STATE, VERDICT, FakeService
from tests.support.cable import free_port
from tests.support.situations import ALL_SHOWN, POLICY
from tests.support.states import changed

N_HISTORY = 300
JUMPED = Misregistration(
    shift_x_subap=0.5, shift_y_subap=-0.1, rotation_rad=math.radians(1.3), magnification=1.005
)
"""Three tenths of a subaperture and a degree from where it was."""


class StagedService(FakeService):
    """Says what a test wants it to, and that it is now."""

    def snapshot(self):
        return replace(self.now, now_ns=time.time_ns())

    def alarm(self, name, text):
        """Raise an alarm as if it had been found just now."""
        raised = Alarm(
            name=name, since_ns_utc=time.time_ns() - 12 * SECOND, message=as_message("x", text)
        )
        self.change(active=(*self.now.tracker.alarms.active, raised))
        self._note()

    def acknowledge(self, name, remark):
        """Have somebody know of an alarm."""
        notes = {record.name: record for record in self.now.tracker.alarms.records}
        notes[name] = replace(notes[name], acknowledged=remark)
        self.change(records=tuple(notes.values()))

    def mute(self, name, remark):
        """Have somebody mute an alarm, or nobody any more."""
        notes = {record.name: record for record in self.now.tracker.alarms.records}
        notes[name] = replace(notes[name], muted=remark)
        self.change(records=tuple(notes.values()))

    def over(self, name):
        """End an alarm that nobody has acknowledged."""
        state = self.now.tracker
        notes = {record.name: record for record in state.alarms.records}
        notes[name] = replace(notes[name], over_ns_utc=time.time_ns())
        alarms = tuple(alarm for alarm in state.alarms.active if alarm.name != name)
        self.change(records=tuple(notes.values()), active=alarms)

    def calm(self):
        """End all alarms, and forget them."""
        self.change(active=(), records=())

    def _note(self):
        state = self.now.tracker
        notes = {record.name: record for record in state.alarms.records}
        notes |= {alarm.name: record_of(state, alarm) for alarm in state.alarms.active}
        self.change(records=tuple(notes.values()))


def state_of_now(registration=ALPHA):
    """Return a loop that is tracked, its history up to now."""
    now_ns = time.time_ns()
    rng = np.random.default_rng(1)
    scatter = rng.normal(0.0, 1.0, (N_HISTORY, 4)) * SIGMA
    entries = tuple(
        HistoryEntry(
            t_ns_utc=now_ns - 2 * (N_HISTORY - k) * SECOND,
            measured=Misregistration.from_vector(ALPHA.vector + scatter[k]),
            measured_sigma=SIGMA,
            filtered=ALPHA,
            filtered_sigma=0.3 * SIGMA,
            innovation=2.0,
            misfit=1.0,
        )
        for k in range(N_HISTORY)
    )
    made = [
        ReconstructorRecord(
            id=f"cm-20261123-{k:06d}-0001",
            state=MatrixState.SUPERSEDED if k < 3 else MatrixState.APPLIED,
            n_modes=400 + 25 * k,
            created_ns_utc=now_ns - (900 - 200 * k) * SECOND,
            published_ns_utc=now_ns - (890 - 200 * k) * SECOND,
            applied_frame_seq=100_000 * k,
            alpha=ALPHA,
            sigma=SIGMA,
            parent="rtc-0",
            gate=VERDICT,
            reason="wins 1.2 nm of wavefront error",
        )
        for k in range(4)
    ]
    return changed(
        STATE,
        registration=replace(
            STATE.alpha.registration,
            alpha=registration,
            t_ns_utc=now_ns - SECOND,
            arrived_ns_utc=now_ns - SECOND,
        ),
        history=entries,
        active=(),
        reconstructors=tuple(made),
        in_use=made[-1].id,
        verified_ids=frozenset({STATE.loop.rtc.cm_id}),
        mode_proof=ALL_SHOWN,
        log=tuple(
            replace(line, t_ns_utc=now_ns - (4 - k) * SECOND) for k, line in enumerate(STATE.log)
        ),
    )


@contextmanager
def staged(directory, port=None):
    """Serve the page of a staged service on loopback; yield the service and its URL."""
    archive = Archive(directory)
    archive.open()
    service = StagedService(
        archive=archive,
        now=Snapshot(
            policy=POLICY,
            tracker=state_of_now(),
            link=LINK,
            now_ns=0,
            started_ns=time.time_ns() - 3600 * SECOND,
            ready=True,
            ready_reason="telemetry flows",
        ),
    )
    service.instrument, service.policy = packaged_instrument("flao-lbt"), POLICY
    port = port or free_port()
    server = uvicorn.Server(
        uvicorn.Config(
            create_app(service), port=port, log_level="critical", ws="none", lifespan="off"
        )
    )
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.02)
        yield service, f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = server.force_exit = True
        thread.join(10.0)
        archive.close()
