"""Every fault that a night may bring, one after the other, on real processes over a real link.

Run: ``python -m pyrcal_studies.faults`` (``make faults``), ``--only NAME`` for one, ``--quick`` for
those that take seconds. A service in ``auto`` and a simulated RTC of the small telescope, a TCP
connection between them that can be cut. While a fault lasts, and until all is as before, the state
is asked ten times a second: how soon it names something that it did not name before, how soon the
next window of telemetry is taken in, and what must never be.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import httpx

from pyrcal_studies.live import WITHIN_S, Telescope
from pyrcal_studies.shared import study_parser
from sim_rtc.faults import FaultKind

NAMED_S = 3.0
"""Within which a fault that stops the telemetry must be named."""

Doing = Callable[[Telescope], Iterator[None]]


@dataclass(frozen=True, slots=True)
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


def _service_killed(at: Telescope) -> Iterator[None]:
    at.kill()
    yield
    at.start()


def _frozen(at: Telescope, *, what: str) -> Iterator[None]:
    """Stop ``rtc`` or ``service`` without ending it."""
    send_signal(getattr(at, what), signal.SIGSTOP)
    yield
    send_signal(getattr(at, what), signal.SIGCONT)


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


def _link(at: Telescope, *, name: str, value: object) -> Iterator[None]:
    """Change a property of the cable."""
    before = getattr(at.cable, name)
    setattr(at.cable, name, value)
    yield
    setattr(at.cable, name, before)


def _machine(at: Telescope, **like: float) -> Iterator[None]:
    """Change the clock or the disk of the machine that the service runs on."""
    at.machine.be(**like)
    yield
    at.machine.be()


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


def _harmless(name: str, seconds: float, does: Doing) -> Fault:
    """Return a fault that costs windows at most, and that ``--quick`` leaves out."""
    return Fault(name, seconds, does, named_within_s=None, quick=False)


FAULTS = (
    Fault("RTC killed, 5 s", 5.0, _rtc_killed, stops_telemetry=True),
    Fault("RTC frozen, 10 s", 10.0, partial(_frozen, what="rtc"), stops_telemetry=True),
    Fault("service killed", 0.0, _service_killed, named_within_s=None),
    Fault("service frozen, 10 s", 10.0, partial(_frozen, what="service"), named_within_s=None),
    Fault("worker killed", 1.0, _worker_killed, named_within_s=None),
    Fault("worker frozen, 30 s", 30.0, _worker_frozen, named_within_s=6.0, quick=False),
    Fault("link cut, 30 s", 30.0, _link_cut, stops_telemetry=True, quick=False),
    Fault(
        "link half open, 10 s",
        10.0,
        partial(_link, name="held", value=True),
        stops_telemetry=True,
    ),
    _harmless("link delayed by 0.3 s, 10 s", 10.0, partial(_link, name="delay_s", value=0.3)),
    Fault(
        "link throttled to 100 kB/s, 10 s",
        10.0,
        partial(_link, name="bytes_per_s", value=100_000.0),
    ),
    Fault("disk refuses every write, 15 s", 15.0, _disk_refuses, named_within_s=6.0),
    _harmless("each flush to the disk takes 2 s, 15 s", 15.0, partial(_machine, flush_s=2.0)),
    _harmless(
        "a bit flipped in each matrix of the archive", 0.0, partial(_disk_flipped, files="*.h5")
    ),
    _harmless("a bit flipped in each file of the archive", 0.0, _disk_flipped),
    Fault("the service's clock an hour ahead, 12 s", 12.0, partial(_machine, ahead_s=3600.0)),
    Fault(
        "the service's clock an hour behind, 12 s",
        12.0,
        partial(_machine, ahead_s=-3600.0),
        quick=False,
    ),
    _harmless("20 MB of memory left, 15 s", 15.0, _memory_short),
    _harmless("second service, 15 s", 15.0, _second_service),
    Fault("20 stream clients that never read, 10 s", 10.0, _dead_clients, named_within_s=None),
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


POLL_S = 0.1
REST_S = 15.0
"""So long the alarms of one fault may stand before the next comes."""

LEAD_S = 1.0
"""How long before a fault of the simulated RTC's own the state is looked at as it was."""


@dataclass(kw_only=True)
class Outcome:
    """What came of one."""

    fault: Fault
    named: str = ""
    named_s: float | None = None
    back_s: float | None = None
    """From its end until a window of telemetry is taken in."""

    lost: int = 0
    sent: int = 0
    """Reconstructors published while it lasted."""

    broken: list[str] = field(default_factory=list)

    def line(self) -> str:
        """Return a row of the table."""
        named = "-" if self.named_s is None else f"{self.named_s:.1f} s: {self.named}"
        back = "never" if self.back_s is None else f"{self.back_s:.1f} s"
        wrong = "; ".join(self.broken) or "-"
        return f"| {self.fault.name} | {named} | {back} | {self.lost} | {self.sent} | {wrong} |"


def _begin_s(at: Telescope, fault: Fault) -> float:
    """Wait until shortly before a fault; return when it begins, by ``time.monotonic``.

    The simulated RTC writes twice a second how many frames it has computed: its own faults are of
    that time.
    """
    if fault.begins_s is None:
        return time.monotonic()
    n_known, begin_s = len(at.truth.lines), None
    while begin_s is None or time.monotonic() < begin_s - LEAD_S:
        at.truth.read()
        fresh, n_known = at.truth.lines[n_known:], len(at.truth.lines)
        computed = [line["seq"] for line in fresh if line["kind"] == "truth"]
        if computed:
            setup = next(line for line in reversed(at.truth.lines) if line["kind"] == "setup")
            computed_s = (computed[-1] + 1) / setup["frame_rate_hz"]
            begin_s = time.monotonic() + fault.begins_s - computed_s
        time.sleep(0.01)
    return float(begin_s)


def tried(at: Telescope, fault: Fault) -> Outcome:
    """Let one fault come and go; return what came of it."""
    _rest(at)
    begin_s = _begin_s(at, fault)
    outcome, before = Outcome(fault=fault), _looked(at)
    n_before, lost_before = len(before["shelf"]), before["lost"]
    time.sleep(max(begin_s - time.monotonic(), 0.0))
    with contextmanager(fault.does)(at):
        begun_s, begun_ns = time.monotonic(), time.time_ns()
        while time.monotonic() - begun_s < fault.seconds:
            _watch(at, outcome, before, begun_s)
    ended_s = time.monotonic()
    while outcome.back_s is None and time.monotonic() - ended_s < WITHIN_S:
        state = _watch(at, outcome, before, begun_s)
        if state is None or state["rtc"] is None or state["registration"] is None:
            continue
        taken = state["registration"]["window_age_s"]
        lasted_s = time.monotonic() - ended_s
        if taken is not None and taken < lasted_s and state["ready"]:
            outcome.back_s = lasted_s
    after = _counted(at)
    outcome.lost = max(after["lost"] - lost_before, 0)
    outcome.sent = max(len(after["shelf"]) - n_before, 0)
    if fault.stops_telemetry:
        late = begun_ns + NAMED_S * 1e9, begun_ns + fault.seconds * 1e9
        outcome.broken += [
            f"{one['id']} was published though no frame came"
            for one in after["shelf"]
            if late[0] < (one["published_ns_utc"] or 0) < late[1]
        ]
    outcome.broken += _broken(at, outcome)
    return outcome


def _watch(
    at: Telescope, outcome: Outcome, before: dict[str, Any], begun_s: float
) -> dict[str, Any] | None:
    """Look once: note what is named that was not."""
    state, now_s = at.state(), time.monotonic() - begun_s
    if state is not None and outcome.named_s is None:
        fresh = _names(state) - before["names"]
        if fresh:
            outcome.named, outcome.named_s = ", ".join(sorted(fresh)), now_s
    time.sleep(POLL_S)
    return state


def _names(state: dict[str, Any]) -> set[str]:
    alarms = {alarm["name"] for alarm in state["alarms"]}
    waits = {wait["name"] for wait in state["waiting_for"]}
    return alarms | waits - {"window"}


def _rest(at: Telescope) -> None:
    """Wait until the alarms of the fault before are over."""
    until_s = time.monotonic() + REST_S
    while ((state := at.state()) is None or state["alarms"]) and time.monotonic() < until_s:
        time.sleep(POLL_S)


def _looked(at: Telescope) -> dict[str, Any]:
    while (state := at.state()) is None:
        time.sleep(POLL_S)
    return _counted(at) | {"names": _names(state)}


def _counted(at: Telescope) -> dict[str, Any]:
    return {
        "shelf": at.get("/v1/reconstructors")["reconstructors"],
        "lost": at.get("/v1/state")["link"]["frames_lost"],
    }


def _broken(at: Telescope, outcome: Outcome) -> list[str]:
    """Return which rules do not hold now."""
    broken = []
    within_s = outcome.fault.named_within_s
    if within_s is not None and (outcome.named_s is None or outcome.named_s > within_s):
        when = "never" if outcome.named_s is None else f"after {outcome.named_s:.1f} s"
        broken.append(f"named {when}, expected {within_s:g} s")
    if outcome.back_s is None:
        broken.append(f"no window within {WITHIN_S:g} s: {at.says()}")
    said, in_use = at.agreed_in_use()
    if said != in_use:
        broken.append(f"{said} is said to be in use, the RTC has {in_use}")
    for record in at.get("/v1/reconstructors")["reconstructors"]:
        used = record["state"] in {"applied", "superseded"} and record["parent"] is not None
        if used and record["origin"] == "the service's" and not record["gate"]:
            broken.append(f"{record['id']} was used and never judged")
    log = (at.directory / "service.log").read_text(encoding="utf-8", errors="replace")
    if "Traceback" in log:
        broken.append("a traceback in the service's log")
    return broken


def _words(fault: Fault) -> str:
    """Return the simulated RTC's own words for a fault of its: ``KIND@T:ARGUMENTS``."""
    kind, _, arguments = fault.name.partition(": ")
    return f"{kind}@{fault.begins_s:g}:{arguments}"


def _all(at: Telescope, faults: list[Fault]) -> Iterator[Outcome]:
    for fault in faults:
        outcome = tried(at, fault)
        sys.stderr.write(outcome.line() + "\n")
        with suppress(httpx.HTTPError):
            at.client.put("/v1/mode", json={"mode": "auto"})
        yield outcome


def report(outcomes: list[Outcome]) -> str:
    """Return the table."""
    head = (
        "| fault | named after | the next window after its end | frames lost | matrices sent | "
        "broken |\n| --- | --- | --- | --- | --- | --- |"
    )
    return "\n".join([head, *(outcome.line() for outcome in outcomes)])


def main() -> int:
    """Run what is asked for; the exit status is 1 if anything was broken."""
    parser = study_parser("pyrcal_studies.faults", __doc__)
    parser.add_argument("--only", metavar="NAME", help="those whose name has this in it")
    parser.add_argument("--quick", action="store_true", help="those that take seconds")
    parser.add_argument("--directory", type=Path, help="data folder and logs, kept afterwards")
    given = parser.parse_args()
    chosen, of_frames = (
        [
            fault
            for fault in faults
            if (given.only or "") in fault.name and (fault.quick or not given.quick)
        ]
        for faults in (FAULTS, OF_FRAMES)
    )
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        directory = given.directory or Path(folder)
        directory.mkdir(parents=True, exist_ok=True)
        at = Telescope(directory, seed=3)
        try:
            begun_s = at.start()
            at.start_rtc()
            if at.wait(begun_s, lambda state: len(at.applied()) > 2) is None:
                raise RuntimeError(f"no matrix was applied within {WITHIN_S:g} s: {at.says()}")
            outcomes += _all(at, chosen)
            if of_frames:
                send_signal(at.rtc, signal.SIGKILL)
                at.start_rtc(*(_words(fault) for fault in of_frames))
                outcomes += _all(at, of_frames)
        finally:
            at.end()
    sys.stdout.write(report(outcomes) + "\n")
    return int(any(outcome.broken for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
