"""A service and a simulated RTC as processes of their own, met as an operator would."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx

from tests.support.cable import free_port
from tests.support.pace import Deadline, patience, slowness

ROOT = Path(__file__).parents[2]
INSTRUMENT = Path(__file__).parents[1] / "system" / "small.toml"
N_START, N_TARGET = 45, 60
ALPHA = {
    "shift_x_subap": 0.12,
    "shift_y_subap": -0.08,
    "rotation_deg": 0.3,
    "magnification": 1.004,
}
# The simulator's actuators are displaced by 2 % of the pitch: with 144 of them that alone turns and
# scales the mirror's image by 7e-4, more than on the full instrument.
SETTINGS = f"""
[tracking]
floor_rotation_deg = 0.04
floor_magnification = 0.0007
[dither]
window_s = 1.0
longest_window_s = 1.0
longest_pause_s = 0
budget_m = 40e-9
amplitude_m = 20e-9
[control]
n_modes_target = {N_TARGET}
minimum_interval_s = 1.0
"""

UNDER_LOAD = {"worker-behind", "estimate-stale", "frames-lost", "windows-refused"}
"""Alarms that are right where others need the processors, too."""


def wait_for(condition, timeout_s=30.0, what="", *, every_s=0.1):
    """Return the first truthy answer; say what was waited for, a text or how to get it, if none."""
    deadline = Deadline(timeout_s)
    while not (found := condition()):
        if deadline.passed:
            text = what() if callable(what) else what or condition
            raise AssertionError(f"not within {deadline}: {text}")
        time.sleep(every_s)
    return found


def _processes():
    """Yield (id, parent, session) of every process that lives."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with suppress(OSError):
                state, parent, _, session = (
                    (entry / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[:4]
                )
                if state != "Z":
                    yield int(entry.name), int(parent), int(session)


def session_members(leader):
    """Return the processes of the session a process leads: itself and all it has started."""
    return [pid for pid, _, session in _processes() if session == leader]


def children_of(pid):
    """Return the processes a process has started, whatever sessions they lead."""
    return [child for child, parent, _ in _processes() if parent == pid]


class Process:
    """A child in a session of its own, its output in a file."""

    def __init__(self, name, words, directory, cwd=ROOT):
        self.log_path = directory / f"{name}-{time.monotonic_ns()}.log"
        with self.log_path.open("wb") as log:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                cwd=cwd,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
            )

    @property
    def log(self):
        return self.log_path.read_text(encoding="utf-8")

    def send(self, number):
        self.popen.send_signal(number)

    def ended(self, timeout_s):
        """Wait for its end; return its status."""
        wait_for(lambda: self.popen.poll() is not None, timeout_s, lambda: f"its end; {self.log}")
        return self.popen.returncode

    def alone(self):
        """Wait until none is left of the processes that it has started."""
        wait_for(lambda: not session_members(self.popen.pid), 5.0, "no child process left")

    def kill(self):
        leaders = [self.popen.pid, *children_of(self.popen.pid)]
        for member in [member for leader in leaders for member in session_members(leader)]:
            with suppress(ProcessLookupError):
                os.kill(member, signal.SIGKILL)
        self.popen.wait(patience(5.0))


def client_of(port):
    return httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=patience(5.0))


class Night:
    """One system: where its service and its RTC meet, and what an operator asks there."""

    def __init__(self, directory):
        self.directory = directory
        self.zenoh = f"tcp/127.0.0.1:{free_port()}"
        self.port = free_port()
        self.client = client_of(self.port)
        self.settings = directory / "settings.toml"
        self.settings.write_text(SETTINGS, encoding="utf-8")
        self.processes = []

    def start(self, name, words, cwd=ROOT):
        process = Process(name, words, self.directory, cwd)
        self.processes.append(process)
        return process

    def second_service(self):
        """Start another service of the same system, a client of the first one's router."""
        other = Night.__new__(Night)
        other.__dict__ |= self.__dict__ | {"port": free_port()}
        other.client = client_of(other.port)
        words = ["service", "run", "--config", str(self.settings), "--instrument", str(INSTRUMENT)]
        words += ["--mode", "auto", "--connect", self.zenoh, "--port", str(other.port)]
        other.start("second", [*words, "--data-dir", str(self.directory / "second")])
        return other

    def service(self, mode="auto", instrument=INSTRUMENT, *, wait=True):
        words = ["service", "run", "--config", str(self.settings), "--instrument", str(instrument)]
        words += ["--mode", mode, "--listen", self.zenoh, "--port", str(self.port)]
        process = self.start("service", [*words, "--data-dir", str(self.directory / "data")])
        if wait:
            wait_for(lambda: self.ready(process), 40.0, f"a ready service; {process.log_path}")
        return process

    def ready(self, process):
        assert process.popen.poll() is None, process.log
        try:
            return self.state["ready"]
        except httpx.HTTPError:
            return False

    def rtc(self, *words, alpha=ALPHA, instrument=INSTRUMENT, seed=3):
        values = ",".join(str(value) for value in alpha.values())
        given = ["sim_rtc", "--connect", self.zenoh, "--instrument", str(instrument)]
        given += [f"--alpha={values}", "--seed", str(seed), "--mag", "6"]
        return self.start("rtc", [*given, "--n-controlled", str(N_START), *words])

    @property
    def state(self):
        answer = self.client.get("/v1/state")
        answer.raise_for_status()
        return answer.json()

    @property
    def shelf(self):
        return self.client.get("/v1/reconstructors").json()["reconstructors"]

    def ids(self, state):
        return [record["id"] for record in self.shelf if record["state"] == state]

    @property
    def alarms(self):
        return {alarm["name"]: alarm["text"] for alarm in self.state["alarms"]}

    def check_alarms(self, *expected):
        """See that there is no other alarm, but for those that a loaded machine deserves."""
        others = {name: text for name, text in self.alarms.items() if name not in expected}
        if others.keys() & UNDER_LOAD and slowness(again=True) > 1.5:
            others = {name: text for name, text in others.items() if name not in UNDER_LOAD}
        assert not others

    def no_frame_is_lost(self):
        """Wait for it: a frame that comes late counts as lost until then."""
        wait_for(
            lambda: self.state["link"]["frames_lost"] == 0,
            5.0,
            lambda: f"no frame lost; {self.state['link']}",
        )

    def rtc_says(self, key):
        """Return a field of the RTC's status, None while there is none."""
        return (self.state["rtc"] or {}).get(key)

    @property
    def metrics(self):
        lines = self.client.get("/metrics").text.splitlines()
        pairs = (line.rpartition(" ") for line in lines if not line.startswith("#"))
        return {name: float(value) for name, _, value in pairs}

    def post(self, path, body=None):
        answer = self.client.post(path, json=body)
        assert answer.status_code == httpx.codes.ACCEPTED, answer.text

    def n_modes_in_use(self):
        """Modes of the reconstructor in use that this service made; 0 while it is another's."""
        in_use = self.state["in_use"]
        own = [r["n_modes"] for r in self.shelf if r["id"] == in_use and r["parent"] is not None]
        return own[0] if own else 0

    def wait_for_rtc(self, process):
        """Wait until the service knows the RTC; return the state then."""

        def met():
            assert process.popen.poll() is None, process.log
            state = self.state
            return state if state["rtc"] is not None else None

        return wait_for(met, 30.0, f"the RTC is known; {process.log_path}")

    def wait_for_modes(self, n_modes, timeout_s=40.0):
        wait_for(
            lambda: self.n_modes_in_use() == n_modes,
            timeout_s,
            lambda: f"{n_modes} modes in use; {self.alarms}, {self.state['pace']}",
        )


@contextmanager
def a_night(directory):
    night = Night(directory)
    try:
        yield night
    finally:
        night.client.close()
        for process in night.processes:
            process.kill()
