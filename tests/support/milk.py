"""A writer of cacao's streams, made from ImageStruct.h as a C compiler would lay it out.

It knows nothing of the reader: offsets come from ctypes, the order of writing from the library's
``ImageStreamIO_UpdateIm_atime`` and milk's ``processinfo_update_output_stream``.
"""

import ctypes as c
import mmap
import os
import time

import numpy as np

CUBE_OVER_TIME = 0x0001 | 0x20000


class Timespec(c.Structure):
    _fields_ = [("tv_sec", c.c_int64), ("tv_nsec", c.c_int64)]


class Metadata(c.Structure):
    _fields_ = [
        ("version", c.c_char * 32),
        ("name", c.c_char * 80),
        ("naxis", c.c_uint8),
        ("size", c.c_uint32 * 3),
        ("nelement", c.c_uint64),
        ("datatype", c.c_uint8),
        ("imagetype", c.c_uint64),
        ("creationtime", Timespec),
        ("lastaccesstime", Timespec),
        ("atime", Timespec),
        ("writetime", Timespec),
        ("creatorPID", c.c_int32),
        ("ownerPID", c.c_int32),
        ("shared", c.c_uint8),
        ("inode", c.c_uint64),
        ("location", c.c_int8),
        ("status", c.c_uint8),
        ("flag", c.c_uint64),
        ("logflag", c.c_uint8),
        ("sem", c.c_uint16),
        ("NBproctrace", c.c_uint16),
        ("cnt0", c.c_uint64),
        ("cnt1", c.c_uint64),
        ("cnt2", c.c_uint64),
        ("write", c.c_uint8),
        ("NBkw", c.c_uint16),
        ("CBsize", c.c_uint32),
        ("CBindex", c.c_uint32),
        ("CBcycle", c.c_uint64),
        ("imdatamemsize", c.c_uint64),
        ("cudaMemHandle", c.c_char * 64),
    ]


class Trace(c.Structure):
    _fields_ = [
        ("triggermode", c.c_int),
        ("procwrite_PID", c.c_int32),
        ("trigger_inode", c.c_uint64),
        ("ts_procstart", Timespec),
        ("ts_streamupdate", Timespec),
        ("trigsemindex", c.c_int),
        ("triggerstatus", c.c_int),
        ("cnt0", c.c_uint64),
    ]


class Keyword(c.Structure):
    _fields_ = [
        ("name", c.c_char * 16),
        ("type", c.c_char),
        ("value", c.c_int64 * 2),
        ("cnt", c.c_uint64),
        ("comment", c.c_char * 80),
    ]


class FrameMetadata(c.Structure):
    _fields_ = [
        ("cnt0", c.c_uint64),
        ("cnt1", c.c_uint64),
        ("atime", Timespec),
        ("writetime", Timespec),
    ]


SEMAPHORE = 32


def keywords_in(path):
    """The texts among the keywords of a stream: value and comment by name."""
    data = path.read_bytes()
    md = Metadata.from_buffer_copy(data)
    start = c.sizeof(Metadata) + (md.imdatamemsize + 7) // 8 * 8
    found = [Keyword.from_buffer_copy(data, start + k * c.sizeof(Keyword)) for k in range(md.NBkw)]
    return {
        one.name.decode(): (bytes(one.value).rstrip(b"\0").decode(), one.comment.decode())
        for one in found
        if one.type == b"S"
    }


class Milk:
    """A stream that a process of cacao's writes; ``size`` as cacao has it, x first."""

    def __init__(self, path, size, *, n_ring=0, cube=False, pid=None, kind="<f4"):
        self.pid = os.getpid() if pid is None else pid
        self.kind = np.dtype(kind)
        n_values = int(np.prod(size))
        n_bytes = n_values * self.kind.itemsize
        n_slices = size[2] if cube else 0
        parts = {
            "md": c.sizeof(Metadata),
            "data": n_bytes,
            "semaphores": SEMAPHORE * 10,
            "semlog": SEMAPHORE,
            "read": 40,
            "write": 40,
            "ctrl": 40,
            "status": 40,
            "trace": 10 * c.sizeof(Trace),
            "atimes": 16 * n_slices,
            "writetimes": 16 * n_slices,
            "counts": 8 * n_slices,
            "ring_md": n_ring * c.sizeof(FrameMetadata),
            "ring": n_ring * n_bytes,
        }
        self.at, end = {}, 0
        for name, n in parts.items():
            self.at[name] = end
            end += (n + 7) // 8 * 8
        path.unlink(missing_ok=True)
        with open(path, "xb+") as file:
            file.truncate(end)
            self.map = mmap.mmap(file.fileno(), end)
        self.path = path
        self.md = md = Metadata.from_buffer(self.map)
        md.version, md.name = b"2.00", path.name.removesuffix(".im.shm").encode()
        md.naxis, md.nelement = len(size), n_values
        for axis, n in enumerate(size):
            md.size[axis] = n
        md.datatype = {"<f4": 9, "<f8": 10, "<u2": 3}[self.kind.str]
        md.imagetype = CUBE_OVER_TIME if cube else 2
        md.location, md.shared, md.inode = -1, 1, path.stat().st_ino
        md.sem, md.NBproctrace, md.CBsize, md.imdatamemsize = 10, 10, n_ring, n_bytes
        md.creationtime.tv_sec = int(time.time())
        self.n_slices = n_slices
        self.data = self._array("data", (n_slices or 1, n_values // (n_slices or 1)))
        self.ring = self._array("ring", (n_ring, n_values)) if n_ring else None
        self.counts = np.frombuffer(self.map, "<u8", n_slices, self.at["counts"])
        self.trace = [
            Trace.from_buffer(self.map, self.at["trace"] + k * c.sizeof(Trace)) for k in range(10)
        ]

    def _array(self, name, shape):
        array = np.frombuffer(self.map, self.kind, int(np.prod(shape)), self.at[name])
        return array.reshape(shape)

    names_next = False
    """Whether the index names the next slot to be written, the oldest, as some writers have it."""

    def put(self, values, *triggers):
        """Write a frame, made from the newest of these streams: nearest first."""
        md = self.md
        md.write = 1
        if self.n_slices:
            place = (md.cnt1 + 1) % self.n_slices
            self.data[place], self.counts[place] = np.ravel(values), md.cnt0 + 1
            md.cnt1 = place
        else:
            self.data[0] = np.ravel(values)
        self.trace[0].procwrite_PID = self.pid
        for trace, trigger in zip(self.trace, triggers, strict=False):
            trace.trigger_inode, trace.cnt0 = trigger.md.inode, trigger.md.cnt0
        if self.ring is not None:
            place = md.CBindex if self.names_next else md.CBindex + 1
            wrapped = place >= md.CBsize
            place = 0 if wrapped else place
            self.ring[place] = self.data[0]
            md.CBcycle += wrapped
            md.CBindex = (place + self.names_next) % md.CBsize
        now = time.time_ns()
        md.writetime.tv_sec, md.writetime.tv_nsec = divmod(now, 10**9)
        md.cnt0 += 1
        md.write = 0
