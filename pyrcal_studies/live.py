"""A service and a simulated RTC as processes, and a TCP connection between them that can be cut."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx

from pyrcal.demo.truth import TruthFile
from pyrcal_studies.campaign.observatory import SETTINGS, SMALL
from pyrcal_studies.machine import Machine
from pyrcal_studies.shared import free_port


class Cable:
    """What comes to ``port`` of loopback goes to ``to_port``, as long as it is plugged."""

    def __init__(self, to_port: int) -> None:
        self.to_port, self.plugged = to_port, threading.Event()
        self.plugged.set()
        self.delay_s = 0.0
        """Between a piece's coming and its going."""

        self.bytes_per_s: float | None = None
        """At most so many go through, either way; None: no limit."""

        self.held = False
        """Nothing goes through, and nobody is told: the other side looks alive and says nothing."""

        self.ends: list[socket.socket] = []
        self.door = socket.create_server(("127.0.0.1", 0))
        self.port = int(self.door.getsockname()[1])
        threading.Thread(target=self._serve, daemon=True).start()

    def cut(self) -> None:
        """End every connection, and let none come until ``plugged`` is set."""
        self.plugged.clear()
        for end in self.ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self.ends = []

    def close(self) -> None:
        """End it for good."""
        self.cut()
        self.door.close()

    def _serve(self) -> None:
        while True:
            try:
                near, _ = self.door.accept()
                if not self.plugged.is_set():
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self.to_port))
            except OSError:
                if self.door.fileno() < 0:
                    return
                near.close()  # nobody is at the other end yet
                continue
            self.ends += [near, far]
            for a, b in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(a, b), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                while self.held:
                    time.sleep(0.02)
                if self.delay_s:
                    time.sleep(self.delay_s)
                if self.bytes_per_s:
                    time.sleep(len(data) / self.bytes_per_s)
                sink.sendall(data)
        except OSError:
            pass
        finally:
            for end in (source, sink):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)


WITHIN_S = 60.0
"""Longer than this is never."""

ALPHA = "0.12,-0.08,0.3,1.004"
N_START = 45


class Telescope:
    """A service of the small telescope, and a simulated RTC, each a process of its own."""

    def __init__(self, directory: Path, seed: int) -> None:
        self.directory = directory
        self.port, self.zenoh_port = free_port(), free_port()
        self.cable = Cable(self.zenoh_port)
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=10.0)
        self.truth = TruthFile(directory / "truth.jsonl")
        self.settings = directory / "settings.toml"
        self.settings.write_text(_toml(), encoding="utf-8")
        self.seed = seed
        self.archive = directory / "data"
        self.machine = Machine(directory / "machine")
        self.service: subprocess.Popen[bytes] | None = None
        self.rtc: subprocess.Popen[bytes] | None = None

    def start_rtc(self, *faults: str) -> None:
        """Start the simulated RTC, at the other end of the cable."""
        self.rtc = self._process(
            "rtc",
            *("sim_rtc", "--connect", f"tcp/127.0.0.1:{self.cable.port}", "--instrument", SMALL),
            *(f"--alpha={ALPHA}", "--mag", "6", "--n-controlled", str(N_START), "--quiet"),
            *("--seed", str(self.seed), "--truth", str(self.directory / "truth.jsonl")),
            *(f"--fault={fault}" for fault in faults),
        )

    def start(self) -> float:
        """Start the service; return the moment."""
        begun_s = time.monotonic()
        self.service = self._process(
            "service",
            *("service", "run", "--config", str(self.settings), "--instrument", SMALL),
            *("--listen", f"tcp/127.0.0.1:{self.zenoh_port}", "--port", str(self.port)),
            *("--data-dir", str(self.archive), "--mode", "auto"),
            **self.machine.environment,
        )
        return begun_s

    def second_service(self) -> subprocess.Popen[bytes]:
        """Start another service of the same system, on the first one's router."""
        return self._process(
            "second",
            *("service", "run", "--config", str(self.settings), "--instrument", SMALL),
            *("--connect", f"tcp/127.0.0.1:{self.zenoh_port}", "--port", str(free_port())),
            *("--data-dir", str(self.directory / "second"), "--mode", "auto"),
        )

    def kill(self) -> None:
        """Kill the service, and it alone: its worker has to notice."""
        if self.service is not None:
            self.service.send_signal(signal.SIGKILL)
            self.service.wait()

    def end(self) -> None:
        """End everything."""
        self.client.close()
        self.cable.close()
        for process in (self.service, self.rtc):
            if process is not None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def get(self, path: str) -> Any:  # noqa: ANN401 - JSON
        """Return the answer of REST."""
        return self.client.get(path).raise_for_status().json()

    def state(self) -> dict[str, Any] | None:
        """Return the state; None: the service does not answer."""
        try:
            found: dict[str, Any] = self.get("/v1/state")
        except httpx.HTTPError:
            return None
        return found

    def wait(self, begun_s: float, condition: Callable[[dict[str, Any]], object]) -> float | None:
        """Return how long after ``begun_s`` the state fulfils it; None: not in time."""
        while (now_s := time.monotonic() - begun_s) < WITHIN_S:
            state = self.state()
            if state is not None and condition(state):
                return now_s
            time.sleep(0.05)
        return None

    def says(self) -> str:
        """Return what the service says that it waits for."""
        state = self.state()
        if state is None:
            return "it does not answer"
        waits = [wait["text"] for wait in state["waiting_for"]]
        alarms = [alarm["text"] for alarm in state["alarms"]]
        return "; ".join([state["ready_reason"], *waits, *alarms])

    def applied(self) -> list[str]:
        """Return the reconstructors that are or were in use, oldest first."""
        found = self.get("/v1/reconstructors")["reconstructors"]
        return [one["id"] for one in found if one["state"] in {"applied", "superseded"}]

    def in_use(self) -> str | None:
        """Return the matrix in use, as the RTC itself accounts for it."""
        self.truth.read()
        last = self.truth.last
        return None if last is None else last["cm_id"]

    def agreed_in_use(self) -> tuple[str | None, str | None]:
        """Return the matrix in use by the service and by the RTC; they get two seconds to agree.

        A service that has just begun, and the truth, which is written twice a second, may be late.
        """
        until_s = time.monotonic() + 2.0
        while True:
            state, in_use = self.state(), self.in_use()
            said = None if state is None else state["in_use"]
            if said == in_use or time.monotonic() > until_s:
                return said, in_use
            time.sleep(0.1)

    def _process(self, name: str, *words: str, **also: str) -> subprocess.Popen[bytes]:
        """Start a program of ours; ``also``: of its environment."""
        with (self.directory / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", **also},
            )


def tracks(state: dict[str, Any]) -> bool:
    """Return whether frames come in, the RTC is known and so is the registration."""
    known, rtc = state["registration"], state["rtc"]
    received = state["ready"] and rtc is not None and state["link"]["frames_received"] > 0
    return bool(received and known is not None and known["restored_ns_utc"] is not None)


def _toml() -> str:
    """Return the settings of the small telescope, one table after the other."""
    tables: dict[str, list[str]] = {}
    for name, value in SETTINGS.items():
        table, key = name.split(".")
        tables.setdefault(table, []).append(f"{key} = {value!r}")
    tables["dither"].append("longest_pause_s = 0")
    return "\n".join(line for name, keys in tables.items() for line in (f"[{name}]", *keys)) + "\n"
