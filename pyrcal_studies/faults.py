"""Every fault that a night may bring, one after the other, on real processes over a real link.

Run: ``python -m pyrcal_studies.faults`` (``make faults``), ``--only NAME`` for one, ``--quick`` for
those that take seconds. A service in ``auto`` and a simulated RTC of the small telescope, a TCP
connection between them that can be cut. While a fault lasts, and until all is as before, the state
is asked ten times a second: how soon it names something that it did not name before, how soon the
next window of telemetry is taken in, and what must never be.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from pyrcal_studies.harms import FAULTS, NAMED_S, OF_FRAMES, Fault, send_signal
from pyrcal_studies.live import WITHIN_S, Telescope

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
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.faults")
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
