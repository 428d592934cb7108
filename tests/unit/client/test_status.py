"""``pyrcal status`` beside the service's own description of its state."""

import http.server
import json
import socket
import threading
from contextlib import contextmanager

import pytest

from pyrcal.__main__ import main
from pyrcal.client.status import status_lines
from service.records.messages import as_message
from service.records.state import Level, LogEntry
from tests.support.api import SECOND, STATE
from tests.support.states import tracker_state
from tests.support.status import told


def test_the_first_line_says_whether_it_is_ready_and_the_next_what_is_wrong():
    lines = status_lines(told())
    assert lines[0] == "flao-lbt: READY"
    assert lines[1].startswith("Operational, Tracking; mode propose (")
    assert lines[1].endswith("up 1 min 0 s")
    assert lines[2] == "ALARM warning rtc.silent (for 30 s): no status: look at it"
    assert lines[3].strip().startswith("To do:")
    assert status_lines(told(ready=False))[0].endswith("NOT READY: no RTC is there")


def test_the_registration_the_loop_and_the_matrix_are_on_the_screen():
    text = "\n".join(status_lines(told()))
    for part in (
        "loop closed at 1000 Hz, 400 of 594 modes controlled",
        "shift x       +0.",
        "rotation",
        " deg",
        "magnification 1.",
        "rtc-0; worst pole radius 0.",
        "sparse: ordinary telemetry keeps σ between windows",
        "4 accepted, 1 rejected",
    ):
        assert part in text, text


def test_it_says_why_the_last_window_was_refused():
    last = LogEntry(
        t_ns_utc=70 * SECOND,
        level=Level.WARNING,
        name="window.refused",
        message=as_message("x", "38 % of its frames were lost"),
        times=3,
        last_ns_utc=88 * SECOND,
    )
    text = "\n".join(status_lines(told(refusal=last)))
    assert "12 s ago (3 times within a minute): 38 % of its frames were lost" in text
    assert "frames were lost" not in "\n".join(status_lines(told()))


def test_references_are_named_once_the_rtc_has_changed_them():
    assert "References" not in "\n".join(status_lines(told()))
    changed_at = told(reference_id="ncpa-2", reference_since_ns_utc=88 * SECOND)
    assert "ncpa-2, for 12 s" in "\n".join(status_lines(changed_at))


def test_a_service_that_knows_nothing_says_so():
    text = "\n".join(status_lines(told(tracker_state(system="small", mode=STATE.operator.mode))))
    assert "not connected" in text
    assert "not measured yet" in text
    assert "unknown; stability not checked" in text


def test_what_cannot_be_told_is_a_question_mark():
    state = told()
    state["margin"]["worst_pole_radius"] = None
    assert "worst pole radius ?, limit" in "\n".join(status_lines(state))


@contextmanager
def answering(body, status=200):
    """Serve one answer to whatever is asked; yield the address."""

    class Answer(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(status if self.path == "/v1/state" else 404)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Answer) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize(
    ("state", "status"),
    [(told(active=()), 0), (told(), 1), (told(ready=False, active=()), 1)],
)
def test_the_exit_status_says_whether_all_is_well(capsys, state, status):
    with answering(json.dumps(state).encode()) as url:
        assert main(["status", "--url", url + "/"]) == status
        assert "flao-lbt" in capsys.readouterr().out
        assert main(["status", "--url", url, "--json"]) == status
        assert json.loads(capsys.readouterr().out) == state


def test_texts_of_strangers_do_not_move_the_cursor(capsys):
    state = told()
    state["alarms"][0]["text"] = "\x1b[2Jgone"
    with answering(json.dumps(state).encode()) as url:
        assert main(["status", "--url", url]) == 1
    assert "\\x1b[2Jgone" in capsys.readouterr().out


def refused(capsys, url, status=3):
    assert main(["status", "--url", url]) == status
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("pyrcal: ")
    assert url in line
    return line


def test_where_nothing_answers_it_says_so_in_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    line = refused(capsys, f"http://127.0.0.1:{port}")
    assert "nothing answers" in line
    assert "--url" in line


@pytest.mark.parametrize(
    "url", ["127.0.0.1:8080", "ftp://127.0.0.1", "http://[", "http://x y", "http://x:port", "http:"]
)
def test_an_address_that_makes_no_sense_is_named(capsys, url):
    assert "expected an address like http://127.0.0.1:8080" in refused(capsys, url, 2)


@pytest.mark.parametrize(
    ("body", "status"), [(b"<html>", 200), (b"{}", 200), (b"[1]", 200), (b"{}", 404)]
)
def test_something_else_that_answers_is_not_taken_for_the_service(capsys, body, status):
    with answering(body, status) as url:
        assert "not pyrcal" in refused(capsys, url)


@pytest.mark.parametrize("status", [502, 503, 504])
def test_a_service_with_too_many_requests_is_not_taken_for_something_else(capsys, status):
    """uvicorn and proxies answer in plain text then."""
    with answering(b"Service Unavailable", status) as url:
        line = refused(capsys, url)
    assert str(status) in line
    assert "try again" in line
    assert "not pyrcal" not in line


def test_another_version_of_the_service_is_told_as_one(capsys):
    with answering(b'{"ready": true, "alarms": []}') as url:
        assert "or not this version" in refused(capsys, url)
