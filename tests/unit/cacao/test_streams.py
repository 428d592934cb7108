"""cacao's streams: every frame once and as it was written, and what is wrong said by name."""

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from cacao_bridge.streams import GoneError, Stream, StreamError, create, path_of
from tests.support.milk import Milk, keywords_in

ROOT = Path(__file__).parents[3]


@pytest.fixture
def path(tmp_path):
    return path_of("aol1_imWFS2", str(tmp_path))


def frame(k, n=6):
    return np.arange(n) + 100.0 * k


def test_where_a_stream_lies(monkeypatch):
    monkeypatch.delenv("MILK_SHM_DIR", raising=False)
    assert path_of("aol1_dmC") == Path("/milk/shm/aol1_dmC.im.shm")
    monkeypatch.setenv("MILK_SHM_DIR", "/dev/shm/milk")
    assert path_of("aol1_dmC") == Path("/dev/shm/milk/aol1_dmC.im.shm")
    assert path_of("aol1_dmC", "/elsewhere") == Path("/elsewhere/aol1_dmC.im.shm")


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize(
    ("size", "how"), [((3, 2), {"n_ring": 8}), ((3, 2, 8), {"cube": True}), ((6,), {"n_ring": 8})]
)
def test_a_ring_gives_every_frame_once_in_order(path, size, how, kind):
    milk = Milk(path, size, kind=kind, **how)
    for k in range(1, 4):
        milk.put(frame(k))
    stream = Stream(path)
    assert stream.shape == ((6,) if len(size) == 1 else (2, 3))
    assert stream.n_kept == 7
    first = stream.after(None)
    assert (first.first, first.n_lost) == (3, 0)
    assert stream.after(3) is None
    seen, counter = [], 3
    for k in range(4, 40):
        milk.put(frame(k))
        if k % 6 == 0:  # as many as the ring keeps, around its end many times
            frames = stream.after(counter)
            assert (frames.first, frames.n_lost) == (counter + 1, 0)
            seen += [values.tolist() for values in frames.values]
            counter += len(frames.values)
    assert seen == [frame(k).tolist() for k in range(4, counter + 1)]


def test_what_was_overwritten_is_counted_and_never_another_frame(path):
    milk = Milk(path, (6,), n_ring=8)
    stream = Stream(path)
    for k in range(1, 21):
        milk.put(frame(k))
    frames = stream.after(3)
    assert (frames.first, frames.n_lost) == (14, 10)
    np.testing.assert_array_equal(frames.values[:, 0], 100.0 * np.arange(14, 21))


def test_without_a_ring_only_the_newest_is_there(path):
    milk = Milk(path, (6,))
    stream = Stream(path)
    assert stream.n_kept == 1
    for k in range(1, 4):
        milk.put(frame(k))
    frames = stream.after(1)
    assert (frames.first, frames.n_lost) == (3, 1)
    np.testing.assert_array_equal(frames.values, [frame(3)])
    milk.md.write = 1  # somebody is at it
    milk.data[0] = frame(4)
    assert stream.after(1) is None


def test_frames_of_another_process_come_whole_while_it_writes(path):
    """Each frame holds one number only, its counter: one torn or taken for another is seen."""
    text = f"""
        import pathlib, sys, time
        sys.path.insert(0, {str(ROOT)!r})
        from tests.support.milk import Milk, keywords_in
        milk = Milk(pathlib.Path({str(path)!r}), (20, 10), n_ring=64)
        print("made", flush=True)
        for k in range(1, 1001):
            milk.put(k)
            time.sleep(0.0002)
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(text)], stdout=subprocess.PIPE
    ) as writer:
        writer.stdout.readline()
        stream, counter, ends = Stream(path), 0, time.monotonic() + 20.0
        while counter < 1000 and time.monotonic() < ends:
            frames = stream.after(counter)
            if frames is None:
                time.sleep(0.001)
                continue
            expected = frames.first + np.arange(len(frames.values))
            assert frames.first == counter + frames.n_lost + 1
            np.testing.assert_array_equal(frames.values, np.repeat(expected[:, None], 200, 1))
            counter = int(expected[-1])
    assert counter == 1000


def big_endian(milk):
    md = np.frombuffer(milk.map, "<u4", 3, 116)
    md[:] = md.byteswap()
    count = np.frombuffer(milk.map, "<u8", 1, 128)
    count[:] = count.byteswap()


def cut(milk):
    os.truncate(milk.path, 200)


def shorter(milk):
    os.truncate(milk.path, len(milk.map) - 8)


WRONG = {
    "version": (lambda milk: setattr(milk.md, "version", b"1.00"), "version '1.00', expected '2.0"),
    "endian": (big_endian, "found big-endian numbers, expected little-endian ones"),
    "axes": (lambda milk: setattr(milk.md, "naxis", 4), "found 4 axes, expected 1 to 3"),
    "size": (lambda milk: setattr(milk.md, "nelement", 7), "found 7 numbers, expected 6 for axes"),
    "type": (lambda milk: setattr(milk.md, "datatype", 3), r"type 3 \(uint16\), expected float"),
    "no type": (lambda milk: setattr(milk.md, "datatype", 99), r"type 99 \(unknown\), expected fl"),
    "gpu": (lambda milk: setattr(milk.md, "location", 0), "in the memory of GPU 0, expected"),
    "bytes": (lambda milk: setattr(milk.md, "imdatamemsize", 1), "found 1 bytes of data, expected"),
    "cut off": (cut, "found 200 bytes, expected at least 384"),
    "short": (shorter, "found a file of .* bytes, expected one of .* format 2.00"),
    "destroyed": (lambda milk: setattr(milk.md, "sem", 0), "found a file of .* bytes, expected"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_such_stream_is_refused_with_what_was_found(path, name):
    twist, expected = WRONG[name]
    milk = Milk(path, (3, 2), n_ring=8)
    Stream(path)
    twist(milk)
    with pytest.raises(StreamError, match=f"aol1_imWFS2: .*{expected}"):
        Stream(path)


def test_no_stream_is_said_by_name(path):
    with pytest.raises(StreamError, match=r"aol1_imWFS2: no stream: .*No such file"):
        Stream(path)


def test_one_that_is_deleted_made_anew_cut_off_or_begun_again_is_gone(path):
    stream = Stream(path) if Milk(path, (6,), n_ring=8) else None
    path.unlink()
    with pytest.raises(GoneError, match="deleted"):
        stream.after(0)
    stream = Stream(path) if Milk(path, (6,), n_ring=8) else None
    Milk(path, (6,), n_ring=8)
    with pytest.raises(GoneError, match="deleted"):
        stream.after(0)
    milk = Milk(path, (6,), n_ring=8)
    stream = Stream(path)
    milk.put(frame(1))
    with pytest.raises(GoneError, match="went back from 5 to 1"):
        stream.after(5)
    os.truncate(path, 1000)
    with pytest.raises(GoneError, match="found 1000 bytes, before"):
        stream.after(0)


def test_two_writers_are_told_from_one_that_was_restarted(path):
    milk = Milk(path, (6,), n_ring=8, pid=11)
    stream = Stream(path)
    for counter, pid in enumerate((11, 11, 12, 12)):  # a restart
        milk.pid = pid
        milk.put(frame(counter + 1))
        assert stream.after(counter).first == counter + 1
    milk.pid = 11
    milk.put(frame(5))
    with pytest.raises(StreamError, match="two writers, processes 11 and 12: end one of them"):
        stream.after(4)


def test_a_ring_that_drifts_from_its_counter_is_refused(path):
    milk = Milk(path, (6,), n_ring=8)
    stream = Stream(path)
    milk.put(frame(1))
    assert stream.after(0).first == 1
    milk.md.cnt0 += 1  # counted by somebody who does not write the ring
    assert stream.after(1) is None
    stream._adrift_s -= 1.0  # a second ago
    with pytest.raises(StreamError, match="ring and counter drift apart"):
        stream.after(1)
    cube = Milk(path, (3, 2, 8), cube=True)
    stream = Stream(path)
    cube.put(frame(1))
    cube.put(frame(2))
    cube.counts[1] = 7
    with pytest.raises(StreamError, match=r"found slices of frames \[7, 2\].*, expected \[1, 2\]"):
        stream.after(0)


@pytest.mark.parametrize("rest", [0, 3])
def test_a_writer_whose_index_names_the_oldest_slot_is_read_right(path, rest):
    """Frames that are all alike tell nothing: the index is believed until they differ."""
    milk = Milk(path, (6,), n_ring=8)
    milk.names_next = True
    stream, counter = Stream(path), None
    for _ in range(rest):
        milk.put(np.zeros(6))
        frames = stream.after(counter)
        counter = frames.first
        assert not frames.values.any()
    for k in range(rest + 1, 30):
        milk.put(frame(k))
        frames = stream.after(counter)
        assert (frames.first, frames.n_lost) == (k, 0)
        np.testing.assert_array_equal(frames.values, [frame(k)])
        counter = k


@pytest.mark.parametrize("tells", [True, False])
def test_a_writer_put_aside_in_the_midst_of_a_frame_costs_nothing(path, tells):
    """It may be so for longer than anybody looks; not every writer says that it is at it."""
    milk = Milk(path, (6,), n_ring=8)
    stream = Stream(path)
    for k in (1, 2, 3):
        milk.put(frame(k))
        stream.after(0)
    before = milk.md.CBindex
    milk.put(frame(4))
    milk.put(frame(5))
    milk.md.cnt0, milk.md.write = 4, int(tells)  # of frame 5 the place alone is told yet
    assert stream.after(3) is None
    milk.md.cnt0, milk.md.write = 5, 0
    frames = stream.after(3)
    assert (frames.first, frames.n_lost, before) == (4, 0, 3)
    np.testing.assert_array_equal(frames.values[:, 0], [400.0, 500.0])


def test_which_frame_of_another_stream_led_to_one(path, tmp_path):
    wfs = Milk(path, (6,))
    values = Milk(path_of("aol1_modevalWFS", str(tmp_path)), (4,))
    mirror = Milk(path_of("aol1_modevalDM", str(tmp_path)), (4,))
    stream = Stream(mirror.path)
    for k in range(1, 6):
        wfs.put(frame(k))
        if k > 2:  # the loop began later than the sensor
            values.put(np.ones(4), wfs)
            mirror.put(np.ones(4), values, wfs)
    assert stream.made_by(Stream(path).inode) == (3, 5)
    assert stream.made_by(1234567) is None


def test_a_stream_is_made_whole_with_keywords_and_written_again(path):
    create(path, np.arange(12, dtype=np.float32).reshape(2, 2, 3), {"PYRCAL": ("abc", "cm-1")})
    stream = Stream(path, writable=True)
    assert stream.shape == (2, 2, 3)
    assert keywords_in(path) == {"PYRCAL": ("abc", "cm-1")}
    before = stream.counter
    stream.write(np.full((2, 2, 3), 7.0, dtype=np.float32))
    assert stream.counter == before + 1
    np.testing.assert_array_equal(Stream(path).latest(), np.full((2, 2, 3), 7.0))
    assert Stream(path).writer == os.getpid()
    assert abs(Stream(path).written_ns - time.time_ns()) < 1e9
    create(path, np.ones((1, 2), dtype=np.float32), {})
    with pytest.raises(GoneError):
        stream.latest()


def test_writing_into_a_ring_is_what_the_library_does(path):
    Milk(path, (6,), n_ring=4)
    writer, stream = Stream(path, writable=True), Stream(path)
    for k in range(1, 11):
        writer.write(frame(k).astype(np.float32))
    np.testing.assert_array_equal(stream.after(0).values[:, 0], [800.0, 900.0, 1000.0])
    milk = np.frombuffer(path.read_bytes(), "<u8", 1, 304)
    assert milk[0] == 2  # times around
