"""Read and write cacao's streams (ImageStreamIO, format 2.00).

A file holds, each part rounded up to 8 bytes: 384 bytes of metadata, the data, keywords of 128
bytes, the semaphores and who waits for them, traces of 64 bytes that say which frame of which
stream made this one, for a cube over time the counter of each slice, and a ring of the last frames.
Source: ``ImageStruct.h`` and ``ImageStreamIO_image_sizing`` of github.com/milk-org/ImageStreamIO.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.errors import PyrcalError

Array32 = NDArray[np.float32]

VERSION: Final = "2.00"
DEFAULT_DIRECTORY: Final = "/milk/shm"

_FIELDS: Final = {
    "version": ("S32", 0),
    "name": ("S80", 32),
    "naxis": ("u1", 112),
    "size": (("<u4", (3,)), 116),
    "nelement": ("<u8", 128),
    "datatype": ("u1", 136),
    "imagetype": ("<u8", 144),
    "creationtime": (("<i8", (2,)), 152),
    "writetime": (("<i8", (2,)), 200),
    "creatorPID": ("<i4", 216),
    "shared": ("u1", 224),
    "inode": ("<u8", 232),
    "location": ("i1", 240),
    "sem": ("<u2", 258),
    "NBproctrace": ("<u2", 260),
    "cnt0": ("<u8", 264),
    "cnt1": ("<u8", 272),
    "write": ("u1", 288),
    "NBkw": ("<u2", 290),
    "CBsize": ("<u4", 292),
    "CBindex": ("<u4", 296),
    "CBcycle": ("<u8", 304),
    "imdatamemsize": ("<u8", 312),
}
_METADATA: Final = np.dtype(
    {
        "names": list(_FIELDS),
        "formats": [kind for kind, _ in _FIELDS.values()],
        "offsets": [offset for _, offset in _FIELDS.values()],
        "itemsize": 384,
    }
)
_TRACE: Final = np.dtype(
    {
        "names": ["pid", "trigger_inode", "cnt0"],
        "formats": ["<i4", "<u8", "<u8"],
        "offsets": [4, 8, 56],
        "itemsize": 64,
    }
)
_KEYWORD: Final = np.dtype(
    {
        "names": ["name", "type", "value", "comment"],
        "formats": ["S16", "S1", "S16", "S80"],
        "offsets": [0, 16, 24, 48],
        "itemsize": 128,
    }
)
_TYPES: Final = {9: "<f4", 10: "<f8"}
_TYPE_NAMES: Final = {
    **{1: "uint8", 2: "int8", 3: "uint16", 4: "int16", 5: "uint32", 6: "int32", 7: "uint64"},
    **{8: "int64", 11: "complex-float", 12: "complex-double", 13: "half"},
}
_CUBE_OVER_TIME: Final = 0x20001
_KIND_OF_CUBE: Final = 0xF000F
_MATHEMATICAL: Final = 0x2
_SEMAPHORE_BYTES: Final = 32
_N_SEMAPHORES: Final = 10
_MOST_SEMAPHORE: Final = 10
_TRIES: Final = 20
"""Attempts to read a frame that is being written, before it is skipped."""

_LOOKS: Final = 4
"""Consistent readings of a ring that are required before its first use."""

_LOOK_S: Final = 3e-4
"""Polling interval of a stream, seconds."""

_MAKE_ANEW: Final = "create it again with milk and cacao of that format"
_ADRIFT_S: Final = 0.5
"""Longest suspension of a writer within a frame, seconds; a ring should hold more frames."""

_TWO_WRITERS_S: Final = 10.0
"""Within which a process that was taken over from may not come back."""


class StreamError(PyrcalError):
    """A stream cannot be read; the message says which, what was found and what was expected."""


class GoneError(StreamError):
    """The file was deleted, created again or truncated since it was opened: open it again."""


class Frames(NamedTuple):
    """Consecutive frames of a stream."""

    first: int
    """Counter of the first."""

    values: Array32
    """``(n_frames, n_values)``, in the order of memory."""

    n_lost: int
    """Frames before these that were overwritten before they were read."""


class _Layout(NamedTuple):
    """Offsets of the parts of a file."""

    keywords: int
    semaphores: int
    writers: int
    trace: int
    counters: int
    ring: int
    end: int


def _layout(found: Any) -> _Layout:  # noqa: ANN401  a record of _METADATA
    """Return the offsets of a file's parts from its metadata."""
    at = _METADATA.itemsize + _eights(int(found["imdatamemsize"]))
    keywords, at = at, at + _KEYWORD.itemsize * int(found["NBkw"])
    n_semaphores = int(found["sem"])
    semaphores, at = at, at + _SEMAPHORE_BYTES * (n_semaphores + 1)
    writers = at + _eights(4 * n_semaphores)
    at += 4 * _eights(4 * n_semaphores)
    trace, at = at, at + _TRACE.itemsize * int(found["NBproctrace"])
    counters = at
    if int(found["imagetype"]) & _KIND_OF_CUBE == _CUBE_OVER_TIME:
        n_slices = int(found["size"][2])
        counters, at = at + 32 * n_slices, at + 40 * n_slices
    n_ring = int(found["CBsize"])
    ring = at + 48 * n_ring
    end = ring + _eights(n_ring * int(found["imdatamemsize"]))
    return _Layout(keywords, semaphores, writers, trace, counters, ring, end)


def _eights(n_bytes: int) -> int:
    return (n_bytes + 7) // 8 * 8


def path_of(name: str, directory: str = "") -> Path:
    """Return the file of a stream: in ``directory``, ``$MILK_SHM_DIR`` or ``/milk/shm``."""
    return Path(directory or os.environ.get("MILK_SHM_DIR") or DEFAULT_DIRECTORY) / f"{name}.im.shm"


class Stream:
    """One stream, mapped into memory for as long as its file stays the same.

    Parameters
    ----------
    path
        Its file.
    writable
        Whether :meth:`write` may be called; else nothing of it is ever changed.

    Raises
    ------
    StreamError
        If there is no such file, or it is not what format 2.00 says: version, byte order, kind of
        number, sizes and length of the file are looked at.
    """

    def __init__(self, path: Path, *, writable: bool = False) -> None:
        self.path, self.name = path, path.name.removesuffix(".im.shm")
        try:
            self._fd = os.open(path, os.O_RDWR if writable else os.O_RDONLY)
        except OSError as error:
            raise StreamError(f"{self.name}: no stream: {path}: {error.strerror}") from error
        try:
            self._n_bytes = os.fstat(self._fd).st_size
            if self._n_bytes < _METADATA.itemsize:
                raise self._error(f"{self._n_bytes} bytes", f"at least {_METADATA.itemsize}")
            # Read-only mapping of the system: no mistake here can change cacao's streams.
            access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
            self._map = mmap.mmap(self._fd, self._n_bytes, access=access)
            self._about = np.frombuffer(self._map, _METADATA, 1)[0]
            self._check()
        except StreamError:
            os.close(self._fd)
            raise
        self._at = _layout(self._about)
        kind = np.dtype(_TYPES[int(self._about["datatype"])])
        sizes = [int(n) for n in self._about["size"][: int(self._about["naxis"])]]
        n_slices = sizes[2] if self._is_cube else 1
        self.shape = tuple(reversed(sizes[:2] if self._is_cube else sizes))
        """Shape of a frame, slowest axis first: cacao's ``size`` reversed."""
        self.n_values = math.prod(self.shape)
        self.inode = os.fstat(self._fd).st_ino
        data = np.frombuffer(self._map, kind, self.n_values * n_slices, _METADATA.itemsize)
        self._data = data.reshape(n_slices, self.n_values)
        n_ring = int(self._about["CBsize"])
        ring = np.frombuffer(self._map, kind, self.n_values * n_ring, self._at.ring)
        self._slots = self._data if self._is_cube else ring.reshape(n_ring, self.n_values)
        n_traces = int(self._about["NBproctrace"])
        self._trace = np.frombuffer(self._map, _TRACE, n_traces, self._at.trace)
        self._counters = memoryview(self._map)[264:280].cast("Q")
        self._index = memoryview(self._map)[296:300].cast("I")
        self._writing = memoryview(self._map)[288:289]
        self._offset: int | None = None
        self._shift: int | None = 0 if self._is_cube else None
        """Slot of the newest frame less the one that the writer's index names; None: not known."""
        self._adrift_s = math.inf
        """Time since which ring and counter have disagreed, on a monotonic clock, seconds."""
        self._writers: list[tuple[int, float]] = []

    def __del__(self) -> None:
        """Close the file; the mapping goes with the last array that views it."""
        if hasattr(self, "_trace"):
            os.close(self._fd)

    @property
    def _is_cube(self) -> bool:
        return int(self._about["imagetype"]) & _KIND_OF_CUBE == _CUBE_OVER_TIME

    def _error(self, found: str, expected: str) -> StreamError:
        return StreamError(f"{self.name}: found {found}, expected {expected}")

    def _check(self) -> None:
        about = self._about
        version = bytes(about["version"]).decode("ascii", "replace")
        if version != VERSION:
            raise self._error(f"version {version!r:.40}", f"{VERSION!r}: {_MAKE_ANEW}")
        naxis, size = int(about["naxis"]), about["size"]
        if not 1 <= naxis <= 3:
            raise self._error(f"{naxis} axes", "1 to 3")
        self._check_axes(size[:naxis], about["nelement"])
        kind = int(about["datatype"])
        if kind not in _TYPES:
            name = _TYPE_NAMES.get(kind, "unknown")
            raise self._error(f"numbers of type {kind} ({name})", "float (9) or double (10)")
        if int(about["location"]) != -1:
            found = f"its data in the memory of GPU {about['location']}"
            raise self._error(found, "a stream in the host's memory: make it so, or a copy there")
        n_bytes = int(about["nelement"]) * np.dtype(_TYPES[kind]).itemsize
        if int(about["imdatamemsize"]) != n_bytes:
            raise self._error(f"{about['imdatamemsize']} bytes of data", f"{n_bytes}")
        if (end := _layout(about).end) != self._n_bytes:
            raise self._error(f"a file of {self._n_bytes} bytes", f"one of {end}, format 2.00")

    def _check_axes(self, size: NDArray[np.uint32], told: np.uint64) -> None:
        n_values = math.prod(size.tolist())
        if n_values == told and n_values:
            return
        if math.prod(size.byteswap().tolist()) == int(told.byteswap()):
            raise self._error("big-endian numbers", "little-endian ones")
        raise self._error(f"{told} numbers", f"{n_values} for axes {size.tolist()}")

    def here(self) -> None:
        """Check that the file is still the one that was opened, and one process writes it.

        Raises
        ------
        GoneError
            If it was deleted, created again, or truncated.
        StreamError
            If two processes write it in turns.
        """
        now = os.fstat(self._fd)
        if now.st_nlink == 0:
            raise GoneError(f"{self.name}: deleted or created again")
        if now.st_size != self._n_bytes:
            raise GoneError(f"{self.name}: found {now.st_size} bytes, before {self._n_bytes}")
        writer, now_s = self.writer, time.monotonic()
        others = [(pid, seen_s) for pid, seen_s in self._writers if now_s - seen_s < _TWO_WRITERS_S]
        if others and others[-1][0] != writer and any(pid == writer for pid, _ in others):
            both = f"{writer} and {others[-1][0]}"
            raise StreamError(f"{self.name}: two writers, processes {both}: end one of them")
        self._writers = [one for one in others if one[0] != writer] + [(writer, now_s)]

    @property
    def counter(self) -> int:
        """Counter of the newest frame, ``cnt0``."""
        return int(self._counters[0])

    @property
    def writer(self) -> int:
        """Process that wrote it last, by its trace; 0: unknown."""
        return int(self._trace["pid"][0]) if len(self._trace) else 0

    @property
    def orphaned(self) -> str:
        """Text that the last writer has ended; empty: it runs."""
        try:
            # Signal 0 only asks whether the process exists.
            os.kill(self.writer, 0)
        except ProcessLookupError:
            return f"process {self.writer}, which wrote it, has ended"
        except PermissionError:
            pass
        return ""

    @property
    def written_ns(self) -> int:
        """Time of the newest frame, nanoseconds since the Unix epoch, UTC; 0: unknown."""
        seconds, ns = self._about["writetime"].tolist()
        return int(seconds * 1_000_000_000 + ns)

    @property
    def n_kept(self) -> int:
        """Frames that can be read later than they came; 1: only the newest."""
        return max(1, len(self._slots) - 1)

    def made_by(self, inode: int) -> tuple[int, int] | None:
        """Return the newest frame's counter, and the frame of another stream that led to it.

        None if its trace has no stream with that inode, or is being written.
        """
        for _ in range(_TRIES):
            counter, trace = self.counter, self._trace[["trigger_inode", "cnt0"]].tolist()
            if self.counter == counter and not self._writing[0]:
                found = [int(made) for told, made in trace if told == inode]
                return (counter, found[0]) if found else None
        return None

    def after(self, counter: int | None) -> Frames | None:
        """Return the frames after one, as many as are left; None: there is none.

        ``counter`` None is the newest frame alone.

        Raises
        ------
        GoneError
            If the stream is another one by now, also by its counter.
        StreamError
            If two processes write it, or its ring is not kept as the library does.
        """
        self.here()
        now = self.counter
        counter = now - 1 if counter is None else counter
        if now < counter:
            raise GoneError(f"{self.name}: its counter went back from {counter} to {now}")
        if now == counter:
            return None
        if len(self._slots) < 2:
            return self._newest(counter)
        turn = self._turn()
        if turn is None:
            return None
        first = max(counter + 1, now - self.n_kept + 1)
        values = self._slots[self._slots_of(first, now, turn)].astype(np.float32, copy=False)
        # Read again after the copy: frames that the writer has passed meanwhile may be torn. One
        # slot more, because it may be writing.
        overwritten = max(0, self.counter - len(self._slots) + 2 - first)
        first, values = first + overwritten, values[overwritten:]
        return Frames(first, values, first - counter - 1) if len(values) else None

    def _newest(self, after: int) -> Frames | None:
        """Return a frame that did not change while it was read, twice the same."""
        for _ in range(_TRIES):
            now, values = self.counter, self._data[0].astype(np.float32)
            same = np.array_equal(values, self._data[0].astype(np.float32), equal_nan=True)
            if same and not self._writing[0] and self.counter == now > after:
                return Frames(now, values[None], now - after - 1)
        return None

    def _slots_of(self, first: int, last: int, turn: int) -> NDArray[np.int64]:
        counters = np.arange(first, last + 1)
        slots = (counters + turn) % len(self._slots)
        if self._is_cube:
            place = self._at.counters
            kept = np.frombuffer(self._map, "<u8", len(self._slots), place)[slots]
            # All but the newest, whose counter may not be written yet.
            if not np.array_equal(kept[:-1], counters[:-1]):
                told = f"slices of frames {kept[:4].tolist()}..."
                raise self._error(told, f"{counters[:4].tolist()}...: another process writes it")
        return slots

    def _turn(self) -> int | None:
        """Return the offset of a frame's counter from its place in the ring; it must stay.

        A writer moves the place first, so a value is accepted when it is read again, and the
        first time when it is read several times in a row. None if that fails; a busy machine may
        suspend a writer within a frame.
        """
        if self._shift is None and (shift := self._find_shift()) is not None:
            self._shift, self._offset = shift, None  # learned before from frames all alike
        turn, now_s = read_settled(self._read_turn, self._offset), time.monotonic()
        if turn is not None and self._offset in {None, turn}:
            self._offset, self._adrift_s = turn, math.inf
            return turn
        self._adrift_s = min(self._adrift_s, now_s)
        if now_s - self._adrift_s < _ADRIFT_S:
            return None
        why = self.orphaned or "do two processes write it?"
        raise StreamError(f"{self.name}: ring and counter drift apart: {why}")

    def _read_turn(self) -> int | None:
        idle, place = not self._writing[0], self._place
        counter = self.counter
        if not idle or self._writing[0] or (place, counter) != (self._place, self.counter):
            return None
        return (place + (self._shift or 0) - counter) % len(self._slots)

    def _find_shift(self) -> int | None:
        """Return how far the newest frame's slot is from the one that the writer's index names.

        The library's index names the newest slot; other writers leave it at the next one to be
        written, the oldest. The data of the stream itself decides. None if frames are written too
        fast, or if several slots still hold the same numbers.
        """
        for _ in range(_TRIES):
            counter, place = self.counter, self._place
            alike = np.flatnonzero(self._same_as_newest())
            if self._writing[0] or (counter, place) != (self.counter, self._place):
                continue
            return int((alike[0] - place) % len(self._slots)) if len(alike) == 1 else None
        return None

    def _same_as_newest(self) -> NDArray[np.bool_]:
        """Return for each slot of the ring whether it holds the frame of the stream, bit by bit."""
        # Compared as integers: NaN is not equal to itself.
        newest = self._data[0].view(f"u{self._data.itemsize}")
        found: NDArray[np.bool_] = (self._slots.view(newest.dtype) == newest).all(axis=1)
        return found

    @property
    def _place(self) -> int:
        return int(self._counters[1] if self._is_cube else self._index[0])

    def latest(self) -> Array32:
        """Return the newest frame ``shape``.

        Raises
        ------
        StreamError
            If it is gone, or never settles.
        """
        frames = self.after(self.counter - 1)
        if frames is None:
            raise StreamError(f"{self.name}: never still: is it written all the time?")
        return np.asarray(frames.values[-1].reshape(self.shape))

    def write(self, values: Array32) -> None:
        """Write a frame of ``shape`` as the library does: ring, counter, semaphores."""
        about = self._about
        # The order is the library's: readers take what they see between the flag and the counter as
        # unfinished.
        self._writing[0] = 1
        self._data[0] = values.ravel()
        if len(self._slots):
            self._index[0] = (self._index[0] + 1) % len(self._slots)
            self._slots[self._index[0]] = self._data[0]
            about["CBcycle"] += self._index[0] == 0
        about["writetime"] = divmod(time.time_ns(), 1_000_000_000)
        if len(self._trace):
            self._trace["pid"][0] = os.getpid()
        self._counters[0] += 1
        self._writing[0] = 0
        self._post()

    def _post(self) -> None:
        """Wake the processes that wait for this stream."""
        libc, value = ctypes.CDLL(None), ctypes.c_int()
        for k in range(int(self._about["sem"]) + 1):
            place = self._at.semaphores + k * _SEMAPHORE_BYTES
            semaphore = ctypes.c_char.from_buffer(self._map, place)
            libc.sem_getvalue(ctypes.byref(semaphore), ctypes.byref(value))
            # A reader that is gone never takes its semaphore down; it must not overflow.
            if value.value < _MOST_SEMAPHORE:
                libc.sem_post(ctypes.byref(semaphore))


def read_settled(look: Callable[[], int | None], known: int | None) -> int | None:
    """Return a consistent view of numbers that a process writes one after the other.

    A value that was ``known`` is accepted when it is read again, another one when it is read
    several times in a row; None if it never settles.
    """
    seen: list[int | None] = []
    for _ in range(_TRIES):
        seen.append(look())
        if seen[-1] is not None and seen[-1] == known:
            return known
        if known is None and len(seen) >= _LOOKS and len(set(seen[-_LOOKS:])) == 1:
            break
        time.sleep(_LOOK_S)
    return seen[-1] if len(set(seen[-_LOOKS:])) == 1 else None


def create(path: Path, values: Array32, keywords: Mapping[str, tuple[str, str]]) -> None:
    """Create a stream, completely or not at all; one of that name is replaced.

    Parameters
    ----------
    path
        Its file.
    values
        Its first frame, slowest axis first, at most three.
    keywords
        Texts of at most 15 characters, with a comment of at most 79, by names of at most 15.

    Raises
    ------
    StreamError
        If it cannot be written.
    """
    about = np.zeros((), _METADATA)
    about["version"], about["name"] = VERSION.encode(), path.name.removesuffix(".im.shm").encode()
    about["naxis"], about["nelement"], about["datatype"] = values.ndim, values.size, 9
    about["size"][: values.ndim] = values.shape[::-1]
    about["imagetype"], about["location"], about["shared"] = _MATHEMATICAL, -1, 1
    about["sem"] = about["NBproctrace"] = _N_SEMAPHORES
    about["NBkw"], about["cnt0"] = len(keywords), 1
    about["imdatamemsize"], about["creatorPID"] = 4 * values.size, os.getpid()
    about["creationtime"] = about["writetime"] = divmod(time.time_ns(), 1_000_000_000)
    at = _layout(about)
    rows = np.zeros(len(keywords), _KEYWORD)
    for row, (name, (value, comment)) in zip(rows, keywords.items(), strict=True):
        row["name"], row["type"], row["value"] = name.encode(), b"S", value.encode()
        row["comment"] = comment.encode()
    # Under another name first: programs that wait for the stream must not open half of it.
    fresh = path.with_name(f".{path.name}.new")
    try:
        with fresh.open("wb") as file:
            file.truncate(at.end)
            about["inode"] = os.fstat(file.fileno()).st_ino
            file.write(about.tobytes() + np.ascontiguousarray(values, "<f4").tobytes())
            file.seek(at.keywords)
            file.write(rows.tobytes())
            for place in (at.writers - _eights(4 * _N_SEMAPHORES), at.writers):
                file.seek(place)
                file.write(np.full(_N_SEMAPHORES, -1, "<i4").tobytes())
        fresh.replace(path)
    except OSError as error:
        raise StreamError(f"{path}: cannot be written: {error.strerror}") from error
