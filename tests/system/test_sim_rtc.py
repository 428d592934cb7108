"""The simulated RTC as a process, met over real zenoh by nothing but the wire contract."""

from __future__ import annotations

import itertools
import json
import queue
import signal
import threading
import time
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from benchmarks.plant import measure_linear
from pyrcal.rtc.session import client_config
from service.config.link_tables import Router
from service.wire import (
    Acknowledgement,
    Keys,
    Manifest,
    Reply,
    Role,
    Status,
    decode,
    decode_frames,
    encode,
    layout_of,
    split,
)
from tests.support.cable import Cable, free_port
from tests.support.night import Process, wait_for
from tests.support.pace import patience, slowness

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(180)]

KEYS = Keys("flao-lbt")
BLOCK = zenoh.CongestionControl.BLOCK
"""As a service puts them: others are dropped where a busy machine does not take them at once."""

START_UP_S = 60.0
CHUNK_BYTES = 500_000
_attempts = itertools.count()


def fresh(name: str) -> str:
    """Return an id that was never used: the RTC answers one it knows as it did before."""
    return f"{name}-{next(_attempts)}"


def open_router(port: int) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return zenoh.open(config)


def test_a_second_of_linear_telemetry_costs_little_more_than_a_large_product():
    """Beside a product of 2000 x 2000: what else the machine does slows both."""
    assert measure_linear(4).in_products < 2.5


class Listener:
    """A minimal service: a router that keeps what the RTC says and can answer and ask."""

    def __init__(self, port: int) -> None:
        self.session = open_router(port)
        self.lock = threading.Lock()
        self.batches = []
        self.statuses = []
        self.tokens: queue.Queue = queue.Queue()
        self.acknowledgements: queue.Queue = queue.Queue()
        self.session.declare_subscriber(KEYS.frames, self._on_frames)
        self.session.declare_subscriber(KEYS.status, self._on_status)
        self.session.declare_subscriber(
            KEYS.acknowledgement,
            lambda sample: self.acknowledgements.put(
                decode(Acknowledgement, sample.payload.to_bytes())
            ),
        )
        self.session.liveliness().declare_subscriber(
            KEYS.alive(Role.RTC), lambda sample: self.tokens.put(sample.kind), history=True
        )

    def _on_frames(self, sample: zenoh.Sample) -> None:
        batch = decode_frames(sample.payload.to_bytes(), sample.attachment.to_bytes())
        with self.lock:
            self.batches.append(batch)

    def _on_status(self, sample: zenoh.Sample) -> None:
        status = decode(Status, sample.payload.to_bytes())
        with self.lock:
            self.statuses.append(status)

    def close(self) -> None:
        self.session.close()

    def next_status(self, wanted=lambda status: True):
        """Wait for one that comes from now on and says what is wanted."""
        with self.lock:
            seen = len(self.statuses)

        def look():
            return next((status for status in self.statuses[seen:] if wanted(status)), None)

        return wait_for(look, START_UP_S, lambda: f"a status; {self.statuses[seen:]}")

    def seq(self) -> int:
        with self.lock:
            return self.batches[-1].header.seq0 if self.batches else -1

    def frames(self, first: int, stop: int):
        """Wait for these frames; return them in order: headers, slopes, commands, dither."""
        wait_for(lambda: self.seq() >= stop, 30.0, lambda: f"frame {stop}; {self.seq()}")
        with self.lock:
            chosen = [
                b
                for b in self.batches
                if b.header.seq0 + b.header.n > first and b.header.seq0 < stop
            ]
        return sorted(chosen, key=lambda batch: batch.header.seq0)

    def rest(self) -> None:
        """Leave no answers to matrices of the test before."""
        while not self.acknowledgements.empty():
            self.acknowledgements.get()

    def fetch(self, selector: str) -> bytes:
        (reply,) = self.session.get(selector, timeout=patience(5.0))
        return reply.ok.payload.to_bytes()

    def applied(self) -> tuple[Manifest, np.ndarray]:
        manifest = decode(Manifest, self.fetch(KEYS.applied))
        data = b"".join(
            self.fetch(f"{KEYS.applied}?chunk={k}") for k in range(manifest.layout.n_chunks)
        )
        return manifest, np.frombuffer(data, "<f4").reshape(manifest.layout.shape)

    def commit(self, manifest: Manifest) -> None:
        self.session.put(KEYS.commit(manifest.id), encode(manifest), congestion_control=BLOCK)

    def send_chunks(self, manifest: Manifest, matrix: np.ndarray, leave_out=()) -> None:
        for k, data in enumerate(split(matrix, manifest.layout.chunk_bytes)):
            if k not in leave_out:
                self.session.put(KEYS.chunk(manifest.id, k), data, congestion_control=BLOCK)

    def offer_as_current(self, manifest: Manifest, matrix: np.ndarray) -> None:
        """Do what a service does: answer queries first, then say that it is alive."""
        parts = split(matrix, manifest.layout.chunk_bytes)

        def answer(query: zenoh.Query) -> None:
            with query:
                wanted = query.parameters.get("chunk")
                data = encode(manifest) if wanted is None else parts[int(wanted)]
                query.reply(query.key_expr, data)

        self.session.declare_queryable(KEYS.current, answer)
        self.session.declare_queryable(KEYS.matrix(manifest.id), answer)
        self.token = self.session.liveliness().declare_token(KEYS.alive(Role.SERVICE))

    def acknowledgement(self, timeout_s: float = 30.0):
        return self.acknowledgements.get(timeout=patience(timeout_s))


@contextmanager
def an_rtc(directory, port: int, *options: str):
    """A simulated RTC as a process."""
    words = ["sim_rtc", "--connect", f"tcp/127.0.0.1:{port}", *options]
    process = Process("rtc", words, directory)
    try:
        yield process
    finally:
        process.kill()


def stopped(process: Process) -> str:
    """Ask it to end, as it must; return what it has said."""
    process.send(signal.SIGTERM)
    assert process.ended(15.0) == 0, process.log
    return process.log


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """One RTC for all tests of the module, met by one listener."""
    folder, port = tmp_path_factory.mktemp("rtc"), free_port()
    options = ("--seed", "5", "--gain", "0.35", "--truth", str(folder / "truth.jsonl"))
    with closing(Listener(port)) as listener, an_rtc(folder, port, *options) as process:
        listener.truth = folder / "truth.jsonl"
        wait_for(lambda: listener.seq() > 200, START_UP_S, lambda: f"frames; {process.log}")
        yield listener
        stopped(process)


@pytest.fixture
def rtc(running):
    running.rest()
    return running


def test_a_connection_left_over_under_its_name_does_not_silence_it_for_ever(tmp_path):
    """What is left when both ends stood still and zenoh reconnected twice at once."""
    port = free_port()
    cable = Cable(port)
    with (
        closing(Listener(port)) as listener,
        an_rtc(tmp_path, cable.port, "--quiet") as process,
    ):
        wait_for(lambda: listener.seq() > 200, START_UP_S, lambda: f"frames; {process.log}")
        (zid,) = [transport.zid for transport in listener.session.info.transports()]
        cable.cut()
        wait_for(lambda: listener.tokens.qsize() > 1, what="it is gone")
        config = client_config(Router(endpoint=f"tcp/127.0.0.1:{port}", security={}))
        config.insert_json5("id", json.dumps(str(zid)))
        with zenoh.open(config):
            cable.plugged.set()
            seen = listener.seq()
            wait_for(lambda: listener.seq() > seen + 1000, 20.0, lambda: process.log)
        assert "link.cut-off" in stopped(process)


def manifest_for(base: Manifest, matrix: np.ndarray, matrix_id: str, **changes) -> Manifest:
    return replace(
        base, id=matrix_id, layout=layout_of(matrix, CHUNK_BYTES), parent=base.id, **changes
    )


def test_frames_are_contiguous_and_come_in_real_time(rtc):
    first = rtc.seq()
    began = time.monotonic()
    batches = rtc.frames(first, first + 2000)
    assert time.monotonic() - began == pytest.approx(2.0, abs=patience(0.5))
    starts = [b.header.seq0 for b in batches]
    assert starts == list(range(starts[0], starts[0] + 50 * len(starts), 50))
    header = batches[0].header
    assert header.dt_ns == 1_000_000
    assert {b.header.t0_ns - b.header.seq0 * header.dt_ns for b in batches} == {
        header.t0_ns - header.seq0 * header.dt_ns
    }


def test_status_describes_the_telemetry(rtc):
    status = rtc.next_status()
    batch = rtc.frames(status.seq, status.seq + 10)[0]
    assert batch.header.session == status.session
    assert (batch.header.n_slopes, batch.header.n_modes) == (status.n_slopes, status.n_modes)
    assert batch.header.cm_id == status.cm_id
    assert (status.n_controlled, status.delay_frames) == (400, 2.0)
    assert set(status.gains[:400]) == {0.35}
    assert set(status.gains[400:]) == {0.0}
    # A star of R = 8 gives 1.8e5 electrons per frame in the four images together.
    assert 1e5 < float(status.flux_images.sum()) < 3e5


def test_an_unreadable_command_is_answered(rtc):
    (reply,) = rtc.session.get(KEYS.command("dither"), payload=b"\x01nonsense", timeout=5.0)
    refused = decode(Reply, reply.ok.payload.to_bytes())
    assert not refused.accepted
    assert refused.id is None


def test_a_reconstructor_is_swapped_between_two_frames_at_the_announced_one(rtc):
    base, matrix = rtc.applied()
    new = manifest_for(base, 0.97 * matrix, fresh("swap"))
    rtc.commit(new)
    rtc.send_chunks(new, 0.97 * matrix)
    staged, applied = rtc.acknowledgement(2.0), rtc.acknowledgement(2.0)
    assert (staged.state, staged.id, staged.sha256) == ("staged", new.id, new.layout.sha256)
    assert (applied.state, applied.id) == ("applied", new.id)
    batches = rtc.frames(applied.frame_seq - 200, applied.frame_seq + 200)
    for batch in batches:
        before = batch.header.seq0 < applied.frame_seq
        assert batch.header.cm_id == (base.id if before else new.id)
    starts = np.array([b.header.seq0 for b in batches])
    assert set(np.diff(starts)) == {50}
    assert rtc.applied()[0].layout.sha256 == new.layout.sha256
    rtc.commit(new)
    assert rtc.acknowledgement() == applied


def test_a_missing_chunk_is_asked_for(rtc):
    base, matrix = rtc.applied()
    new = manifest_for(base, matrix, fresh("holes"))
    parts = split(matrix, CHUNK_BYTES)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, parts[int(query.parameters.get("chunk"))])

    queryable = rtc.session.declare_queryable(KEYS.matrix(new.id), answer)
    rtc.send_chunks(new, matrix, leave_out=(1,))
    rtc.commit(new)
    assert [rtc.acknowledgement().state for _ in range(2)] == ["staged", "applied"]
    queryable.undeclare()


def test_the_truth_is_beside_the_run_and_not_on_the_wire(rtc):
    def lines(kind):
        # the last line may be under way
        found = [json.loads(line) for line in rtc.truth.read_text().split("\n")[:-1]]
        return [line for line in found if line["kind"] == kind]

    base, matrix = rtc.applied()
    new = manifest_for(base, matrix, fresh("known"))
    rtc.commit(new)
    rtc.send_chunks(new, matrix)
    wait_for(lambda: new.id in {line["cm_id"] for line in lines("swap")}, what="a swap on record")
    truth, swaps = lines("truth"), lines("swap")
    assert {line["frames_skipped"] for line in swaps} == {0}
    assert 80.0 < truth[-1]["wavefront_error_nm"] < 250.0
    shift = np.hypot(truth[-1]["shift_x_subap"], truth[-1]["shift_y_subap"])
    assert 0.0 < shift <= 0.2
    # The only registration on the wire is the one the matrix in use was made for: none.
    assert set(rtc.applied()[0].alpha.values()) == {0.0, 1.0}


def test_it_waits_for_the_service_outlives_it_and_ends_cleanly(tmp_path):
    port = free_port()
    with an_rtc(tmp_path, port, "--alpha", "-0.1,0.05,0.1,1.002", "--quiet") as process:
        time.sleep(8.0)
        with closing(Listener(port)) as listener:
            session = listener.next_status().session
            assert listener.tokens.get(timeout=patience(5.0)) == zenoh.SampleKind.PUT
        with closing(Listener(port)) as listener:
            assert listener.next_status().session == session
            base, matrix = listener.applied()
            assert "Traceback" not in stopped(process)
            offered = manifest_for(base, 0.9 * matrix, "offered-1")
            listener.offer_as_current(offered, 0.9 * matrix)
            with an_rtc(tmp_path, port, "--seconds", "10") as another:
                again = listener.next_status(lambda status: status.session != session)
                assert again.seq < 1000 * slowness(again=True)
                answers = [listener.acknowledgement() for _ in range(2)]
                assert [(a.id, a.state) for a in answers] == [
                    ("offered-1", "staged"),
                    ("offered-1", "applied"),
                ]
                assert another.ended(30.0) == 0, another.log
