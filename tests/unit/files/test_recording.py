import re
import signal
import subprocess
import sys
import time

import h5py
import pytest

from service.errors import ConfigurationError
from service.files.recording import RecordedKind, Recording, RecordingWriter
from tests.support.pace import in_time

WRITER = """
import sys, time
from pathlib import Path
from service.files.recording import RecordedKind, RecordingWriter
with RecordingWriter(Path(sys.argv[1]), system="small") as recorder:
    for number in range(10**6):
        recorder.put(RecordedKind.FRAMES, number.to_bytes(8, "little") * 1000, b"header")
        if number % 100 == 0:
            print(number, flush=True)
        time.sleep(0.002)
"""


def read(path):
    with Recording(path) as recording:
        return list(recording.messages())


def test_messages_come_back_byte_for_byte_in_order(tmp_path):
    path = tmp_path / "night.h5"
    given = [
        (RecordedKind.LIVELINESS, b"\x01", b""),
        (RecordedKind.MATRIX, b"matrix" * 300_000, b"manifest"),
        *[(RecordedKind.FRAMES, bytes([k % 256]) * k, b"attachment") for k in range(1000)],
        (RecordedKind.STATUS, b"status", b""),
    ]
    with RecordingWriter(path, system="small") as recorder:
        for message in given:
            recorder.put(*message)
    with Recording(path) as recording:
        found = list(recording.messages())
        assert (recording.system, recording.n_dropped) == ("small", 0)
    assert [(m.kind, m.payload, m.attachment) for m in found] == given
    times = [m.time_s for m in found]
    assert times == sorted(times)
    assert 0.0 <= times[0] < 5.0


def test_what_waits_is_bounded_and_what_is_dropped_is_counted(tmp_path):
    path = tmp_path / "night.h5"
    with RecordingWriter(path, system="small", backlog_bytes=1000) as recorder:
        began = time.monotonic()
        for _ in range(100):
            recorder.put(RecordedKind.FRAMES, bytes(100))
        assert in_time(began, 0.4)
    with Recording(path) as recording:
        n_found = len(list(recording.messages()))
        assert recording.n_dropped == recorder.n_dropped > 0
        assert n_found + recording.n_dropped == 100


def test_a_killed_writer_leaves_a_file_that_lacks_at_most_two_seconds(tmp_path):
    path = tmp_path / "night.h5"
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        last = 0
        while last < 1500:
            last = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        last = max([last, *(int(line) for line in process.stdout.read().split())])
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    found = read(path)
    assert [m.payload for m in found] == [
        number.to_bytes(8, "little") * 1000 for number in range(len(found))
    ]
    # at most 500 messages a second
    assert last - len(found) < 1000


def test_a_file_that_is_still_being_written_can_be_read(tmp_path):
    path = tmp_path / "night.h5"
    with RecordingWriter(path, system="small") as recorder:
        recorder.put(RecordedKind.STATUS, b"one")
        deadline = time.monotonic() + 10.0
        while not read(path) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert [m.payload for m in read(path)] == [b"one"]


def test_a_recording_is_never_overwritten(tmp_path):
    path = tmp_path / "night.h5"
    path.write_bytes(b"last night")
    with (
        pytest.raises(ConfigurationError, match="it exists already"),
        RecordingWriter(path, system="small"),
    ):
        pass
    assert path.read_bytes() == b"last night"


def test_other_files_are_refused_with_what_was_expected(tmp_path):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w"):
        pass
    with pytest.raises(ConfigurationError, match=r"expected .*pyrcal-telemetry"), Recording(path):
        pass
    path.write_bytes(b"no hdf5")
    with pytest.raises(ConfigurationError, match="cannot be read"), Recording(path):
        pass


def test_damaged_headers_are_refused_at_once(tmp_path):
    """HDF5 reads metadata of a growing file again and again while its checksum is wrong."""
    path = tmp_path / "night.h5"
    with RecordingWriter(path, system="small") as recorder:
        recorder.put(RecordedKind.STATUS, b"one")
    content = path.read_bytes()
    headers = [m.start() for m in re.finditer(b"OHDR", content)]
    assert len(headers) == 4  # of the file, its two growing datasets, and the number of dropped
    for start in headers:
        damaged = bytearray(content)
        damaged[start + 12] ^= 0xFF
        path.write_bytes(damaged)
        script = f"from tests.unit.files.test_recording import read; read({str(path)!r})"
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, timeout=60, check=False
        )
        assert b"ConfigurationError" in done.stderr
        assert b"damaged" in done.stderr
