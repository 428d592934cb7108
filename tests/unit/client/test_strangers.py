"""``pyrcal watch``, and what answers instead of a service: nonsense, half of it, too late."""

import contextlib
import io
import json
import socket
import threading
import time
from itertools import islice

import pytest
from rich.console import Console

from pyrcal.__main__ import main
from pyrcal.client import rest, watch
from pyrcal.client.rest import Service, UnreachableError
from tests.support.status import told


@contextlib.contextmanager
def saying(*answers):
    """Answer each connection with the next bytes; an answer that is a function has the socket."""
    listener = socket.create_server(("127.0.0.1", 0))
    asked = []

    def serve():
        for answer in answers:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                asked.append(connection.recv(65536).decode())
                with contextlib.suppress(OSError):
                    answer(connection) if callable(answer) else connection.sendall(answer)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", asked
    finally:
        listener.close()


def said(body, *, kind="application/json", status="200 OK"):
    head = f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body


def drips(connection):
    """One byte at a time, each in time, for ever."""
    connection.sendall(b"HTTP/1.1 200 OK\r\n")
    while True:
        connection.sendall(b"X: 1\r\n")
        time.sleep(0.02)


def is_silent(connection):
    connection.recv(1)


STRANGE = {
    "nothing": b"",
    "no HTTP": b"SSH-2.0-OpenSSH_9.2\r\n",
    "half an answer": said(b'{"ready": true}')[:-3],
    "no JSON": said(b"\xff\x00<html>"),
    "deep JSON": said(b"[" * 100_000),
    "another type": said(b'{"ready": 1, "alarms": 7, "now_ns": "x"}'),
    "a refusal of another program": said(b'{"detail": "no"}', status="403 Forbidden"),
    "elsewhere": said(b"{}", status="302 Found\r\nLocation: http://127.0.0.1:1/"),
    "endless head": b"HTTP/1.1 200 OK\r\n" + b"X: 1\r\n" * 1000,
    "too slow": drips,
    "silent": is_silent,
}


@pytest.mark.parametrize("name", STRANGE)
def test_whatever_answers_it_ends_soon_with_one_line_and_status_3(capsys, monkeypatch, name):
    monkeypatch.setattr(rest, "REQUEST_TIMEOUT_S", 0.3)
    with saying(STRANGE[name]) as (url, _):
        assert main(["status", "--url", url]) == 3
    told = capsys.readouterr()
    assert told.out == ""
    (line,) = told.err.splitlines()
    assert line.startswith(f"pyrcal: {url}: ")


def test_an_order_whose_answer_is_lost_is_sent_again_as_the_same(capsys):
    with saying(b"", said(b'{"text": "released"}')) as (url, asked):
        assert main(["resume", "--url", url]) == 0
    assert capsys.readouterr().out == "released\n"
    keys = [
        line for head in asked for line in head.splitlines() if line.startswith("Idempotency-Key")
    ]
    assert len(keys) == 2
    assert keys[0] == keys[1]


def test_an_order_without_any_answer_may_have_been_carried_out(capsys):
    with saying(b"", b"") as (url, _):
        assert main(["stop", "--url", url]) == 3
    told = capsys.readouterr().err
    assert "may have been carried out: see pyrcal status and pyrcal audit" in told


def test_an_answer_of_another_version_is_no_success(capsys):
    with saying(said(b'{"texts": []}')) as (url, _):
        assert main(["stop", "--url", url]) == 3
    assert "not this version" in capsys.readouterr().err


def test_half_a_file_is_none(capsys, tmp_path):
    target = tmp_path / "a.npy"
    with saying(said(b"x" * 3_000_000)[:-1]) as (url, _):
        words = ["export", "reconstructor", "in-use", "--url", url, "--output", str(target)]
        assert main(words) == 3
    assert list(tmp_path.iterdir()) == []


def test_the_key_is_sent_where_there_is_one(tmp_path, monkeypatch):
    state = said(json.dumps(told(active=())).encode())
    file = tmp_path / "key"
    file.write_text("from-file\n", encoding="ascii")
    with saying(state, state, state) as (url, asked):
        main(["status", "--url", url])
        monkeypatch.setenv("PYRCAL_API_KEY", "from-environment")
        main(["status", "--url", url])
        main(["status", "--url", url, "--key-file", str(file)])
    assert "Authorization" not in asked[0]
    assert "Authorization: Bearer from-environment\r\n" in asked[1]
    assert "Authorization: Bearer from-file\r\n" in asked[2]


@pytest.mark.parametrize("content", [b"two words", b"a\r\nX: 1", b"\xff", None])
def test_a_key_that_is_none_is_not_sent(capsys, tmp_path, content):
    file = tmp_path / "key"
    if content is not None:
        file.write_bytes(content)
    assert main(["status", "--url", "http://127.0.0.1:1", "--key-file", str(file)]) == 2
    assert "key" in capsys.readouterr().err


# --- watch


def event(name, data, identity=""):
    head = f"id: {identity}\n" if identity else ""
    return f"event: {name}\n{head}data: {json.dumps(data)}\n\n".encode()


def stream(*events):
    head = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream; charset=utf-8\r\n\r\n"
    return head + b"retry: 1000\n\n" + b": nothing new\n\n" + b"".join(events)


def line(text, t_utc="1970-01-01T00:00:09.5Z"):
    return {"t_utc": t_utc, "level": "alarm", "name": "x", "text": text, "n_times": 2}


@pytest.fixture
def latest(monkeypatch):
    monkeypatch.setattr(watch, "RECONNECT_S", 0.01)
    return watch.Latest()


def test_who_was_cut_off_comes_back_where_it_was(latest):
    log = said(json.dumps({"log": [line("first")]}).encode())
    reset, second_line = event("reset", {}, "r-1"), event("log", line("2"), "r-2")
    first = stream(event("state", told()), reset, second_line)
    second = stream(event("log", line("3"), "r-3"), event("state", told()))
    with saying(first, log, second) as (url, asked):
        events = watch.events(Service(url), "/v1/stream", latest)
        names = [name for name, _ in islice(events, 4)]
        assert names == ["state", "reset", "log", "lost"]
        assert latest.lost
        names += [name for name, _ in islice(events, 2)]
        events.close()
    assert names[4:] == ["log", "state"]
    assert not latest.lost
    assert [one["text"] for one in latest.log] == ["first", "2", "3"]
    assert "Last-Event-ID: r-2" in asked[2]


def test_a_stream_that_falls_silent_is_lost(latest, monkeypatch):
    monkeypatch.setattr(watch, "MAX_SILENCE_S", 1.0)

    def falls_silent(connection):
        connection.sendall(stream(event("state", told())))
        connection.recv(1)  # until nobody listens any more

    with saying(falls_silent) as (url, _):
        events = watch.events(Service(url), "/v1/stream", latest)
        assert [name for name, _ in islice(events, 2)] == ["state", "lost"]
        events.close()
    assert "no answer within 1 s" in latest.lost


@pytest.mark.parametrize(
    "answer", [said(b"{}"), stream(b"data: {\n\n"), stream(b"event: state\ndata: 7\n\n")]
)
def test_what_is_no_stream_of_ours_is_not_watched(latest, answer):
    with saying(answer) as (url, _), pytest.raises(UnreachableError, match="not pyrcal"):
        list(islice(watch.events(Service(url), "/v1/stream", latest), 3))


def drawn(latest, now_s, width=100):
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(watch.screen(latest, now_s))
    return console.file.getvalue()


def test_the_screen_says_what_it_is_how_old_and_nothing_raw():
    state = told()
    state["alarms"][0]["text"] = "\x1b[2Jgone"
    latest = watch.Latest(state=state, at_s=100.0, log=(line("a"), line("b\x07")), lost="")
    text = drawn(latest, 102.0)
    assert text.startswith("connected, the state came 2 s ago")
    assert "ALARM warning rtc.silent (for 30 s): \\x1b[2Jgone" in text
    assert text.index("b\\x07 (2 times)") < text.index("00:00:09Z  alarm    a")


def test_what_is_old_says_so_and_grows_older(latest):
    latest.state, latest.at_s, latest.lost = told(), 100.0, "nothing answers"
    text = drawn(latest, 160.0, 200)
    assert text.startswith(
        "DISCONNECTED: nothing answers; trying again; what is below is 1 min 0 s"
    )
    assert "fresh, 1 min 10 s old" in text
    assert "up 2 min 0 s" in text
    latest.state = {"ready": 1}
    assert "NOT this version of pyrcal" in drawn(latest, 160.0)
    assert drawn(watch.Latest(), 160.0).startswith("DISCONNECTED: not connected yet; trying")
