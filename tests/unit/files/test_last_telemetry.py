"""The last telemetry in memory, and recordings that begin with it."""

import time

import pytest

from service.files import recording
from service.files.recording import (
    OVERHEAD_BYTES,
    LastTelemetry,
    Message,
    RecordedKind,
    Recording,
    RecordingWriter,
)


@pytest.fixture
def clock(monkeypatch):
    """Give a clock that stands until it is set."""
    at = {"s": 100.0}
    monkeypatch.setattr(recording.time, "monotonic", lambda: at["s"])
    return at


def payloads(held):
    return [one.payload for one in held]


def test_what_is_too_old_goes(clock):
    last = LastTelemetry(10.0, 10**9)
    for k in range(30):
        clock["s"] = 100.0 + k
        last.put(RecordedKind.FRAMES, bytes([k]))
    assert payloads(last.since(60.0)) == [bytes([k]) for k in range(19, 30)]
    assert payloads(last.since(2.0)) == [bytes([k]) for k in (27, 28, 29)]
    assert last.since(-1.0) == []


def test_it_takes_no_more_memory_than_it_may(clock):
    message = bytes(1000)
    last = LastTelemetry(1e6, 10 * (1000 + OVERHEAD_BYTES))
    for _ in range(50):
        last.put(RecordedKind.FRAMES, message)
    assert len(last.since(1e6)) == 10
    last.put(RecordedKind.FRAMES, bytes(10**6))
    assert last.since(1e6) == [], "one that alone is too much is not held either"


def test_with_nothing_to_hold_it_holds_nothing():
    last = LastTelemetry(0.0, 10**9)
    last.put(RecordedKind.FRAMES, b"x")
    assert last.since(60.0) == []


def test_a_recording_begins_with_what_came_before_and_drops_none_of_it(tmp_path):
    now_s = time.monotonic()
    past = [Message(now_s - 3.0 + k, RecordedKind.FRAMES, bytes([k]) * 5000) for k in range(3)]
    writer = RecordingWriter(tmp_path / "r.h5", system="small", backlog_bytes=6000)
    with writer:
        writer.begin_with(past)
        writer.put(RecordedKind.STATUS, b"now")
    assert (writer.n_dropped, writer.n_bytes) == (0, 15_003)
    with Recording(tmp_path / "r.h5") as read:
        found = list(read.messages())
    assert [one.payload[:1] for one in found] == [b"\0", b"\1", b"\2", b"n"]
    assert [one.time_s for one in found[:3]] == pytest.approx([0.0, 1.0, 2.0])
    assert found[3].time_s == pytest.approx(3.0, abs=0.5)
