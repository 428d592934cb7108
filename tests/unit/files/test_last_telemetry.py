"""The last telemetry in memory, and recordings that begin with it."""

import time

import numpy as np
import pytest

from service.files import last_telemetry
from service.files.last_telemetry import CHUNK_BYTES, OVERHEAD_BYTES, LastTelemetry
from service.files.recording import Message, RecordedKind, Recording, RecordingWriter


@pytest.fixture
def clock(monkeypatch):
    """Give a clock that stands until it is set."""
    at = {"s": 100.0}
    monkeypatch.setattr(last_telemetry.time, "monotonic", lambda: at["s"])
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
    assert list(last.since(-1.0)) == []


def test_it_takes_no_more_memory_than_it_may(clock):
    message = bytes(1000)
    last = LastTelemetry(1e6, 10 * (1000 + OVERHEAD_BYTES))
    for _ in range(50):
        last.put(RecordedKind.FRAMES, message)
    assert len(list(last.since(1e6))) == 10
    last.put(RecordedKind.FRAMES, bytes(10**6))
    assert list(last.since(1e6)) == [], "one that alone is too much is not held either"


def test_with_nothing_to_hold_it_holds_nothing():
    last = LastTelemetry(0.0, 10**9)
    last.put(RecordedKind.FRAMES, b"x")
    assert list(last.since(60.0)) == []
    assert last.since(60.0).start_s is None
    none_held = LastTelemetry(60.0, 0)
    none_held.put(RecordedKind.FRAMES, b"x")
    assert list(none_held.since(60.0)) == []


def frames(rng, n, n_slopes=100, n_modes=60, n_moved=3):
    """Return a batch: slopes, commands, and a dither of a few modes alone."""
    rows = np.zeros((n, n_slopes + 2 * n_modes), np.float32)
    rows[:, : n_slopes + n_modes] = rng.standard_normal((n, n_slopes + n_modes))
    rows[:, -n_moved:] = rng.standard_normal((n, n_moved))
    return rows.tobytes()


def test_every_byte_comes_back_whatever_it_is(clock):
    rng, last, sent = np.random.default_rng(1), LastTelemetry(1e6, 10**9), []
    for k in range(400):  # three chunks, and some that wait
        clock["s"] += 0.01
        payload = [frames(rng, 10), rng.bytes(k), bytes(k), b""][k % 4] * 3
        sent.append(Message(clock["s"], list(RecordedKind)[k % 5], payload, rng.bytes(k % 7)))
        last.put(sent[-1].kind, sent[-1].payload, sent[-1].attachment)
    assert sum(one.n_bytes for one in sent) > 2 * CHUNK_BYTES
    assert list(last.since(1e6)) == sent
    assert list(last.since(1.5)) == [one for one in sent if one.time_s >= clock["s"] - 1.5]
    assert last.since(1.5).start_s == pytest.approx(clock["s"] - 1.5, abs=0.011)


def test_old_chunks_go_as_old_messages_do(clock):
    last, rng = LastTelemetry(1.0, 10**9), np.random.default_rng(3)
    for _ in range(600):
        clock["s"] += 0.01
        last.put(RecordedKind.FRAMES, frames(rng, 10))
    found = list(last.since(60.0))
    assert found[0].time_s == pytest.approx(clock["s"] - 1.0, abs=0.011)
    assert len(found) == pytest.approx(100, abs=1)
    clock["s"] += 10.0
    last.put(RecordedKind.STATUS, b"x")
    assert payloads(last.since(60.0)) == [b"x"]


def test_a_recording_begins_with_what_came_before_and_drops_none_of_it(tmp_path):
    now_s = time.monotonic()
    past = [Message(now_s - 3.0 + k, RecordedKind.FRAMES, bytes([k]) * 5000) for k in range(3)]
    writer = RecordingWriter(tmp_path / "r.h5", system="small", backlog_bytes=6000)
    with writer:
        writer.begin_with(past, past[0].time_s)
        writer.put(RecordedKind.STATUS, b"now")
    assert (writer.n_dropped, writer.n_bytes) == (0, 15_003)
    with Recording(tmp_path / "r.h5") as read:
        found = list(read.messages())
    assert [one.payload[:1] for one in found] == [b"\0", b"\1", b"\2", b"n"]
    assert [one.time_s for one in found[:3]] == pytest.approx([0.0, 1.0, 2.0])
    assert found[3].time_s == pytest.approx(3.0, abs=0.5)
