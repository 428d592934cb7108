"""What is done to service, RTC, link and machine while they work: the faults of ``make faults``."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pyrcal_studies.live import Telescope
from sim_rtc.faults import FaultKind

NAMED_S = 3.0
"""Within which a fault that stops the telemetry must be named."""

Doing = Callable[[Telescope], Iterator[None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault: what begins it, how long it lasts, and what is expected."""

    name: str
    seconds: float
    does: Doing
    """Begins it, yields, and ends it."""

    named_within_s: float | None = NAMED_S
    """Of one that keeps the service from its job; None: it costs windows at most."""

    quick: bool = True

    begins_s: float | None = None
    """Of the simulated RTC's time, where it makes the fault by itself; None: now."""

    stops_telemetry: bool = False
    """Whether no frame comes while it lasts: nothing may be published then."""


def _rtc_killed(at: Telescope) -> Iterator[None]:
    send_signal(at.rtc, signal.SIGKILL)
    yield
    at.start_rtc()


def _rtc_frozen(at: Telescope) -> Iterator[None]:
    send_signal(at.rtc, signal.SIGSTOP)
    yield
    send_signal(at.rtc, signal.SIGCONT)


def _service_killed(at: Telescope) -> Iterator[None]:
    at.kill()
    yield
    at.start()


def _service_frozen(at: Telescope) -> Iterator[None]:
    send_signal(at.service, signal.SIGSTOP)
    yield
    send_signal(at.service, signal.SIGCONT)


def _worker_killed(at: Telescope) -> Iterator[None]:
    for pid in _workers(at):
        os.kill(pid, signal.SIGKILL)
    yield


def _worker_frozen(at: Telescope) -> Iterator[None]:
    stopped = _workers(at)
    for pid in stopped:
        os.kill(pid, signal.SIGSTOP)
    yield
    for pid in stopped:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def _link_cut(at: Telescope) -> Iterator[None]:
    at.cable.cut()
    yield
    at.cable.plugged.set()


def _link_half_open(at: Telescope) -> Iterator[None]:
    at.cable.held = True
    yield
    at.cable.held = False


def _link_delayed(at: Telescope) -> Iterator[None]:
    at.cable.delay_s = 0.3
    yield
    at.cable.delay_s = 0.0


def _link_throttled(at: Telescope) -> Iterator[None]:
    at.cable.bytes_per_s = 100_000.0
    yield
    at.cable.bytes_per_s = None


def _disk_refuses(at: Telescope) -> Iterator[None]:
    """No file of the service may grow: as on a full disk, each write is refused."""
    if at.service is None:
        raise RuntimeError("no service runs")
    _prlimit(at.service.pid, "--fsize=0:")
    yield
    _prlimit(at.service.pid, "--fsize=unlimited:")


def _simulated(_: Telescope) -> Iterator[None]:
    """One that the simulated RTC makes by itself, at its time."""
    yield


def _disk_slow(at: Telescope) -> Iterator[None]:
    """Each file that is flushed to the disk takes two seconds."""
    at.machine.be(flush_s=2.0)
    yield
    at.machine.be()


def _disk_flipped(at: Telescope, *, files: str = "*") -> Iterator[None]:
    """While the service is not there, one bit flips in each of these files of its archive."""
    at.kill()
    for path in sorted(at.archive.rglob(files)):
        if path.is_file() and path.stat().st_size:
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 1
            path.write_bytes(data)
    yield
    at.start()


def _clock_ahead(at: Telescope) -> Iterator[None]:
    """Somebody sets the machine's clock an hour ahead, and back."""
    at.machine.be(ahead_s=3600.0)
    yield
    at.machine.be()


def _clock_behind(at: Telescope) -> Iterator[None]:
    at.machine.be(ahead_s=-3600.0)
    yield
    at.machine.be()


def _memory_short(at: Telescope) -> Iterator[None]:
    """Leave the service 20 MB more than it has, as if others had taken the rest."""
    if at.service is None:
        raise RuntimeError("no service runs")
    status = Path(f"/proc/{at.service.pid}/status").read_text(encoding="utf-8")
    (has_kb,) = re.findall(r"VmSize:\s*(\d+) kB", status)
    _prlimit(at.service.pid, f"--as={(int(has_kb) + 20_000) * 1024}:")
    yield
    _prlimit(at.service.pid, "--as=unlimited:")


def _second_service(at: Telescope) -> Iterator[None]:
    other = at.second_service()
    yield
    other.send_signal(signal.SIGKILL)
    other.wait()


def _dead_clients(at: Telescope) -> Iterator[None]:
    """Twenty who ask for the stream and read none of it."""
    ends = []
    for _ in range(20):
        end = socket.create_connection(("127.0.0.1", at.port))
        end.sendall(b"GET /v1/stream HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        ends.append(end)
    yield
    for end in ends:
        end.close()


FIRST_S, EVERY_S = 30.0, 40.0
"""Of the simulated RTC's time: when its first own fault begins, and from one to the next."""

SCHEDULE = {
    FaultKind.LOST: "0.05,5",
    FaultKind.LATE: "0.3,5",
    FaultKind.DUPLICATED: "0.2,5",
    FaultKind.REORDERED: "0.2,5",
    FaultKind.NAN: "0.05,5",
    FaultKind.FROZEN: "5",
    FaultKind.GARBAGE: "0.2,5",
    FaultKind.SHAPE: "5",
    FaultKind.BASIS: "5",
    FaultKind.SECOND: "5",
    FaultKind.STALL: "4",
    FaultKind.PAUSE: "4",
    FaultKind.DITHER_LOST: "5",
    FaultKind.CLOCK: "3600",
}
"""Faults of frames on their way, of dither and clock, with their arguments; the clock is last: the
simulated RTC tells its time by it."""

SILENT = {
    FaultKind.LOST,
    FaultKind.LATE,
    FaultKind.DUPLICATED,
    FaultKind.REORDERED,
    FaultKind.NAN,
    FaultKind.GARBAGE,
    FaultKind.CLOCK,
    FaultKind.DITHER_LOST,
}
"""Those that cost windows at most, or show at the next window only."""

OF_FRAMES = tuple(
    Fault(
        name=f"{kind}: {arguments}",
        seconds=5.0,
        does=_simulated,
        begins_s=FIRST_S + EVERY_S * k,
        named_within_s=None if kind in SILENT else NAMED_S,
        quick=False,
    )
    for k, (kind, arguments) in enumerate(SCHEDULE.items())
)

FAULTS = (
    Fault(name="RTC killed, 5 s", stops_telemetry=True, seconds=5.0, does=_rtc_killed),
    Fault(name="RTC frozen, 10 s", stops_telemetry=True, seconds=10.0, does=_rtc_frozen),
    Fault(name="service killed", seconds=0.0, does=_service_killed, named_within_s=None),
    Fault(name="service frozen, 10 s", seconds=10.0, does=_service_frozen, named_within_s=None),
    Fault(name="worker killed", seconds=1.0, does=_worker_killed, named_within_s=None),
    Fault(
        name="worker frozen, 30 s",
        seconds=30.0,
        does=_worker_frozen,
        named_within_s=6.0,
        quick=False,
    ),
    Fault(name="link cut, 30 s", stops_telemetry=True, seconds=30.0, does=_link_cut, quick=False),
    Fault(name="link half open, 10 s", stops_telemetry=True, seconds=10.0, does=_link_half_open),
    Fault(
        name="link delayed by 0.3 s, 10 s",
        seconds=10.0,
        does=_link_delayed,
        named_within_s=None,
        quick=False,
    ),
    Fault(name="link throttled to 100 kB/s, 10 s", seconds=10.0, does=_link_throttled),
    Fault(
        name="disk refuses every write, 15 s", seconds=15.0, does=_disk_refuses, named_within_s=6.0
    ),
    Fault(
        name="each flush to the disk takes 2 s, 15 s",
        seconds=15.0,
        does=_disk_slow,
        named_within_s=None,
        quick=False,
    ),
    Fault(
        name="a bit flipped in each matrix of the archive",
        seconds=0.0,
        does=partial(_disk_flipped, files="*.h5"),
        named_within_s=None,
        quick=False,
    ),
    Fault(
        name="a bit flipped in each file of the archive",
        seconds=0.0,
        does=_disk_flipped,
        named_within_s=None,
        quick=False,
    ),
    Fault(
        name="the service's clock an hour ahead, 12 s",
        seconds=12.0,
        does=_clock_ahead,
    ),
    Fault(
        name="the service's clock an hour behind, 12 s",
        seconds=12.0,
        does=_clock_behind,
        quick=False,
    ),
    Fault(
        name="20 MB of memory left, 15 s",
        seconds=15.0,
        does=_memory_short,
        named_within_s=None,
        quick=False,
    ),
    Fault(
        name="second service, 15 s",
        seconds=15.0,
        does=_second_service,
        named_within_s=None,
        quick=False,
    ),
    Fault(
        name="20 stream clients that never read, 10 s",
        seconds=10.0,
        does=_dead_clients,
        named_within_s=None,
    ),
)


def _workers(at: Telescope) -> list[int]:
    """Return the service's children that compute: those that were spawned."""
    if at.service is None:
        return []
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == at.service.pid and b"spawn_main" in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def send_signal(process: subprocess.Popen[bytes] | None, number: signal.Signals) -> None:
    """Send a signal to a program that was started; of one that it ends, the end is waited for."""
    if process is not None:
        process.send_signal(number)
        if number is signal.SIGKILL:
            process.wait()


def _prlimit(pid: int, limit: str) -> None:
    subprocess.run(["prlimit", f"--pid={pid}", limit], check=True)
