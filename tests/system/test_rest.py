"""What strangers send to a real service over HTTP, and what a disk that refuses costs."""

import contextlib
import io
import os
import resource
import signal
import socket
import sqlite3
from concurrent.futures import ThreadPoolExecutor

import h5py
import httpx
import pytest

from tests.support.night import N_TARGET, a_night, wait_for
from tests.support.pace import patience

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A service that nobody gives an order to."""
    with a_night(tmp_path_factory.mktemp("night")) as night:
        night.service("hold")
        yield night


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        night.service("hold")
        yield night


@contextlib.contextmanager
def no_file_may_grow(process):
    """A disk that refuses, of this process alone, without the rights to make a real one."""
    limits = resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (1, limits[1]))
    try:
        yield
    finally:
        resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, limits)


def audit_of(night):
    index = night.directory / "data" / "index.sqlite"
    with contextlib.closing(sqlite3.connect(f"file:{index}?mode=ro", uri=True)) as connection:
        return connection.execute("SELECT name, text FROM audit WHERE whence != ''").fetchall()


def resident_mb(pid):
    with open(f"/proc/{pid}/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def a_bomb():
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        shape, chunks = (22_000, 24_000), (22, 24_000)
        file.create_dataset("interaction_matrix", shape, "f8", chunks=chunks)
    return buffer.getvalue()


def a_thief(path):
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file["interaction_matrix"] = h5py.ExternalLink(str(path), "/interaction_matrix")
    return buffer.getvalue()


def fate(night, content):
    link = night.client.post("/v1/fits", content=content).json()["links"]["fit"]

    def answer():
        found = night.client.get(link)
        return found if found.status_code != httpx.codes.ACCEPTED else None

    found = wait_for(answer, 60.0, "the end of the fit")
    assert found.json()["state"] == "failed", found.text
    return found.json()["reason"]


def test_an_upload_reaches_no_file_of_the_server_and_claims_no_memory(shared):
    secret = shared.directory / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["interaction_matrix"] = [[1.0]]
    assert f"found a link to another file, {secret}" in fate(shared, a_thief(secret))
    assert "of 0 bytes in the file" in fate(shared, a_bomb())


def endless():
    while True:
        yield b" " * 1_000_000


@pytest.mark.long
def test_endless_bodies_and_half_open_requests_cost_next_to_nothing(night):
    (process,) = night.processes
    before_mb = resident_mb(process.popen.pid)

    def send_without_end(_):
        with contextlib.suppress(httpx.TransportError):  # it may be cut before the answer is read
            answer = night.client.post("/v1/refit", content=endless())
            assert answer.status_code == httpx.codes.REQUEST_ENTITY_TOO_LARGE

    with ThreadPoolExecutor(5) as clients:  # the connection is closed with the refusal
        list(clients.map(send_without_end, range(5)))
    with contextlib.ExitStack() as held:
        for _ in range(400):  # beyond MAX_CONNECTIONS the oldest are ended
            line = socket.create_connection(("127.0.0.1", night.port), timeout=patience(10.0))
            held.enter_context(line).sendall(b"GET /v1/state HTTP/1.1\r\n")
        # within the patience of the client
        assert night.client.get("/healthz").status_code == httpx.codes.OK
        assert resident_mb(process.popen.pid) - before_mb < 30.0
    wait_for(lambda: n_sockets(process.popen.pid) < 50, 20.0, "all of them to be ended")


def n_sockets(pid):
    n_found, folder = 0, f"/proc/{pid}/fd"
    for name in os.listdir(folder):
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            n_found += os.readlink(os.path.join(folder, name)).startswith("socket:")
    return n_found


def test_a_page_from_elsewhere_and_a_foreign_name_give_no_orders(shared):
    before = audit_of(shared)
    for headers, status in (
        ({"Origin": "http://evil.example"}, httpx.codes.FORBIDDEN),
        ({"Host": "evil.example"}, httpx.codes.MISDIRECTED_REQUEST),
    ):
        headers |= {"Content-Type": "text/plain"}
        answer = shared.client.post("/v1/dither", headers=headers)
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"
    wait_for(lambda: len(audit_of(shared)) == len(before) + 2, 5.0, "two refusals on record")
    refused = [name for name, _ in audit_of(shared)[len(before) :]]
    assert refused == ["request.foreign-origin", "request.foreign-host"]


@pytest.mark.long
def test_on_a_disk_that_refuses_nothing_is_ordered_and_afterwards_all_is_on_record(night):
    (process,) = night.processes
    with no_file_may_grow(process):
        refused = night.client.put("/v1/mode", json={"mode": "auto"})
        assert refused.status_code == httpx.codes.INSUFFICIENT_STORAGE, refused.text
        assert "index.sqlite" in refused.json()["detail"]
        assert night.state["mode"] == "hold"
        wait_for(lambda: "archive-failed" in night.alarms, 5.0, "the alarm")
        held = night.client.put("/v1/mode", json={"mode": "hold"})
        assert held.status_code == httpx.codes.ACCEPTED, held.text
        assert night.metrics["pyrcal_archive_failures_total"] > 0
        assert night.client.get("/healthz").status_code == httpx.codes.OK
    wait_for(lambda: "archive-failed" not in night.alarms, 10.0, "the end of the alarm")
    assert night.client.put("/v1/mode", json={"mode": "auto"}).status_code == httpx.codes.ACCEPTED
    unknown = night.client.post("/v1/reconstructors/cm-7/approve")
    assert unknown.status_code == httpx.codes.NOT_FOUND
    wait_for(lambda: len(audit_of(night)) == 8, 5.0, "the refusal in the audit trail")
    names = [name for name, _ in audit_of(night)]
    orders = ["SetMode", "SetMode.refused", *("SetMode", "SetMode.answered") * 2]
    assert names == [*orders, "Approve", "Approve.refused"]
    process.send(signal.SIGTERM)
    assert process.ended(30.0) == 0, process.log


@pytest.mark.long
def test_on_a_full_disk_a_matrix_is_taken_back_and_the_loop_is_opened(tmp_path):
    with a_night(tmp_path) as night:
        service = night.service("auto")
        night.rtc()
        night.wait_for_modes(N_TARGET)
        sent = night.rtc_says("cm_id")
        with no_file_may_grow(service):
            for path, order in (
                ("/v1/rollback", {"anyway": True}),
                ("/v1/dither", {"action": "stop"}),
                ("/v1/loop", {"loop": "open"}),
                ("/v1/stop", {}),
            ):
                answer = night.client.post(path, json=order)
                assert answer.status_code == httpx.codes.ACCEPTED, answer.text
                if path == "/v1/rollback":
                    wait_for(lambda: night.rtc_says("cm_id") != sent, 10.0, "the matrix before")
            wait_for(lambda: night.rtc_says("loop") == "open", 10.0, "an open loop")
            assert "archive-failed" in night.alarms
        wait_for(lambda: "archive-failed" not in night.alarms, 10.0, "the end of the alarm")
        wait_for(lambda: len(audit_of(night)) == 8, 5.0, "orders and answers on record")
        assert "Traceback" not in service.log


@pytest.mark.long
def test_a_mode_that_was_ordered_stays_though_the_service_is_killed_at_once(night):
    """An order that has been answered outlives the service: by chance it was found not to."""
    answer = night.client.put("/v1/mode", json={"mode": "propose"})
    assert answer.status_code == httpx.codes.ACCEPTED, answer.text
    night.processes.pop().kill()
    assert answer.json()["text"] == "mode is propose"
    night.service("hold")
    assert night.state["mode"] == "propose"


@pytest.mark.long
def test_what_was_stopped_stays_so_though_the_service_is_killed_at_once(night):
    order = {"by": "Ada", "reason": "someone is on the platform"}
    answer = night.client.post("/v1/stop", json=order)
    assert answer.status_code == httpx.codes.ACCEPTED, answer.text
    night.processes.pop().kill()
    assert answer.json()["text"].startswith("everything was stopped by Ada (someone is on the")
    night.service("auto")
    assert "Ada" in night.state["stopped_because"]
    assert "stopped" in night.alarms
    refused = night.client.post("/v1/refit")
    assert refused.status_code == httpx.codes.CONFLICT
    assert "stopped by Ada" in refused.json()["detail"]
    released = night.client.post("/v1/resume", json={"by": "Bob"})
    assert released.json()["text"] == "released: mode is auto"
    assert night.state["stopped_because"] == ""
    entries = night.client.get("/v1/audit").json()["entries"]
    told = [(entry["name"], entry["who"]) for entry in entries if entry["channel"]]
    stop, resume = "StopEverything", "Resume"
    assert told[0] == (stop, "Ada")
    assert told[-1] == (resume, "Bob") or told[-1] == (f"{resume}.answered", "Bob")
    assert ("Refit.refused", "127.0.0.1") in told
