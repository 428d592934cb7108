"""Whatever the service is at, it ends within five seconds of being asked to, and leaves nothing."""

import os
import signal
import socket
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.support.ending import maps_of, stranger, workers_of
from tests.support.night import INSTRUMENT, a_night, session_members, wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(120)]

BOTH = SIGINT, SIGTERM = signal.SIGINT, signal.SIGTERM
"""One handler hears both: a moment is tried with one, and the next one with the other."""


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def check_end(night, service, number, *, group=False):
    """Ask the service to end; it does in good order, whatever it was at."""
    if group:
        os.killpg(service.popen.pid, number)
    else:
        service.send(number)
    assert service.ended(5.0) == 0, service.log
    assert "Traceback" not in service.log, service.log
    # the tracker that the standard library puts beside workers ends after the service has
    service.alone()
    assert not list(night.directory.rglob("*.part"))


@pytest.mark.parametrize(
    ("library", "number"),
    [
        ("_struct", SIGINT),
        ("zenoh", SIGTERM),
    ],
)
def test_while_it_imports(night, library, number):
    service = night.service(wait=False)
    wait_for(lambda: library in maps_of(service.popen.pid), 20.0, f"{library} is imported")
    check_end(night, service, number)


@pytest.mark.parametrize(("after_s", "number"), [(0.0, SIGINT), (1.0, SIGTERM)])
def test_while_the_model_is_prepared(night, after_s, number):
    service = night.service(instrument="flao-lbt", wait=False)
    wait_for(lambda: "api.listening" in service.log, 20.0, "the first line")
    time.sleep(after_s)
    check_end(night, service, number)


def test_ctrl_c_in_a_terminal_while_the_worker_still_imports(night):
    service = night.service(instrument="flao-lbt", wait=False)
    wait_for(lambda: len(session_members(service.popen.pid)) > 2, 20.0, "the worker is started")
    check_end(night, service, SIGINT, group=True)


def test_while_its_worker_is_stopped(night):
    service = night.service("auto")
    with stranger(night):
        wait_for(lambda: night.state["windows_accepted"] > 0, 40.0, "it tracks")
        (worker,) = workers_of(service)
        os.kill(worker, signal.SIGSTOP)
        time.sleep(3.0)  # a window waits for it by now
        check_end(night, service, SIGTERM)


def test_while_its_worker_is_stopped_before_it_has_begun(night):
    service = night.service("auto", wait=False)
    (worker,) = wait_for(lambda: workers_of(service), 20.0, "a worker")
    os.kill(worker, signal.SIGSTOP)
    time.sleep(0.5)
    check_end(night, service, SIGINT)


def test_while_an_upload_dribbles_in(night):
    service = night.service("hold")
    with closing(socket.create_connection(("127.0.0.1", night.port))) as line:
        line.sendall(b"POST /v1/fits HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100000\r\n\r\n")
        line.sendall(b"\x89HDF\r\n\x1a\n")
        wait_for(lambda: list(night.directory.rglob("upload*")), 10.0, "the upload has begun")
        check_end(night, service, SIGTERM)


def test_while_an_upload_is_fitted(night):
    matrix = Path(__file__).parents[1] / "data" / "tiny" / "tiny.h5"
    service = night.service("hold", wait=True)
    answer = night.client.post("/v1/fits", content=matrix.read_bytes())
    assert answer.is_success, answer.text
    time.sleep(0.5)
    check_end(night, service, SIGINT)


def test_while_somebody_reads_a_matrix_slowly(night):
    service = night.service("auto")
    with stranger(night):
        wait_for(lambda: night.state["in_use"], 40.0, "a matrix in use")
        path = f"/v1/reconstructors/{night.state['in_use']}/matrix"
        with closing(socket.create_connection(("127.0.0.1", night.port))) as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
            line.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            assert line.recv(12).startswith(b"HTTP/1.1 200")
            check_end(night, service, SIGTERM)


def test_while_the_rtc_answers_nothing(night):
    """A question is under way that nobody answers, and its thread waits."""
    service = night.service("auto")
    rtc = stranger(night)
    rtc.on_command = lambda *_: time.sleep(20.0)
    with rtc:
        wait_for(lambda: rtc.commands, 40.0, "a question")
        check_end(night, service, SIGINT)
        rtc.on_command = None


def test_asked_again_and_again(night):
    """An impatient hand on the keyboard makes it neither later nor louder."""
    service = night.service("hold")
    stop = threading.Event()

    def insist():
        while not stop.wait(0.02):
            try:
                os.killpg(service.popen.pid, SIGINT)
            except ProcessLookupError:
                return

    hand = threading.Thread(target=insist)
    hand.start()
    try:
        check_end(night, service, SIGINT)
    finally:
        stop.set()
        hand.join()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_hundred_times_at_any_moment(night):
    """From the first milliseconds to tracking, each time a little later."""
    first = night.service("auto", INSTRUMENT)  # a zenoh client needs someone there to open
    with stranger(night):
        check_end(night, first, SIGINT)
        for k in range(100):
            service = night.service("auto", INSTRUMENT, wait=False)
            wait_for(lambda pid=service.popen.pid: "_struct" in maps_of(pid), 20.0, "it imports")
            time.sleep(0.08 * k)
            check_end(night, service, BOTH[k % 2])
