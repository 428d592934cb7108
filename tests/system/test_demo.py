"""The demo on the full instrument, as a new user would run it."""

import json
import math
import os
import signal
import statistics
import time
from pathlib import Path

import pytest

from service.model.misregistration import PARAMETERS
from tests.support.night import a_night, children_of, session_members, wait_for
from tests.support.pace import in_time, patience

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(300)]

TOLERANCE = dict(zip(PARAMETERS, (0.02, 0.02, 0.05, 0.002), strict=True))


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def demo(night, *words):
    given = ["pyrcal", "demo", "--port", str(night.port), "--dir", str(night.directory / "demo")]
    given += ["--zenoh-port", night.zenoh.rpartition(":")[2]]
    return night.start("demo", [*given, *words])


def test_the_main_job_is_done_within_a_minute(night):
    """As a new user runs it: far away, few modes in the loop, then many and half of the error."""
    figures, picture = night.directory / "figures.json", night.directory / "night.png"
    began = time.monotonic()
    words = ["--seconds", "120", "--json", str(figures), "--plot", str(picture)]
    process = demo(night, *words)
    assert process.ended(280.0) == 0, process.log

    report = json.loads(figures.read_text(encoding="utf-8"))
    assert in_time(began, report["seconds_to_ready"] + 135.0)
    assert "preparing: " in process.log
    assert report["good"]
    true = report["true_alpha"]
    assert 0.4 < math.hypot(true["shift_x_subap"], true["shift_y_subap"]) < 0.42
    for name, tolerance in TOLERANCE.items():
        error = report["estimated_alpha"][name] - true[name]
        assert abs(error) < min(tolerance, 4 * report["sigma"][name]), (name, error)
        assert report["sigma"][name] >= report["floor"][name]
    stages = [report[name] for name in ("start", "first_update", "target_modes")]
    assert stages[0]["n_modes"] == 120
    assert stages[2]["n_modes"] >= 400
    assert stages[1]["worst_pole_radius"] < stages[0]["worst_pole_radius"]
    assert report["wavefront_ratio"] >= 1.5
    assert report["reconstructors_applied"] == report["reconstructors_published"] >= 2
    assert report["frames_lost"] == 0
    assert all(swap["frames_skipped"] == 0 for swap in report["swaps"])
    assert report["seconds_to_first_applied"] < patience(45.0)
    assert "GOOD: the main job was done" in process.log
    assert never_worse(night.directory / "demo" / "truth.jsonl")
    assert picture.read_bytes().startswith(b"\x89PNG")
    process.alone()


@pytest.mark.slow  # two minutes of a whole processor: the same program with another file
def test_another_telescope_is_another_instrument_and_nothing_else(night):
    figures = night.directory / "figures.json"
    words = ["--instrument", "soul-lbt", "--seconds", "120", "--json", str(figures)]
    process = demo(night, *words)
    assert process.ended(280.0) == 0, process.log
    report = json.loads(figures.read_text(encoding="utf-8"))
    assert report["good"]
    assert report["target_modes"]["n_modes"] == 500
    process.alone()


def never_worse(truth):
    """Whether the error was never a fifth above that of the start, once the loop was closed."""
    lines = [json.loads(line) for line in truth.read_text(encoding="utf-8").splitlines()]
    errors = [line["wavefront_error_nm"] for line in lines if line["kind"] == "truth"][2:]
    return max(errors) < 1.2 * statistics.median(errors[:6])


def test_interrupted_it_stops_both_processes_and_says_what_is_missing(night):
    process = demo(night)
    children = both_children(process)
    wait_for(lambda: "preparing: " in process.log, 20.0, "a first look")
    os.killpg(process.popen.pid, signal.SIGINT)
    ended_within(5.0, process, children)
    assert process.popen.returncode == 1, process.log
    assert "FAILED: " in process.log


def both_children(process):
    return wait_for(
        lambda: len(found := children_of(process.popen.pid)) == 2 and found, 20.0, "two children"
    )


def ended_within(seconds, process, children):
    process.ended(seconds)
    wait_for(
        lambda: not [member for child in children for member in session_members(child)],
        1.0,  # what the standard library puts beside workers ends after them
        "no child process left",
    )


def running(process, children):
    """Wait until the service has received frames; return the processes the service has started."""
    wait_for(lambda: "the clock starts" in process.log, 150.0, f"ready; {process.log_path}")
    (service,) = [child for child in children if b"\0service\0" in command_of(child)]
    return service, [member for member in session_members(service) if member != service]


def command_of(pid):
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def test_an_rtc_that_sends_nothing_is_named_as_the_reason(night):
    """Before, the service stands still for a moment: its old figures are not shown as new."""
    process = demo(night, "--seconds", "12")
    children = both_children(process)
    service, _ = running(process, children)
    os.kill(service, signal.SIGSTOP)
    wait_for(lambda: "no answer from the service for" in process.log, 10.0, "the silence is said")
    os.kill(service, signal.SIGCONT)
    (simulator,) = [child for child in children if b"\0sim_rtc\0" in command_of(child)]
    os.kill(simulator, signal.SIGSTOP)
    wait_for(lambda: "FAILED" in process.log, 40.0, f"a verdict; {process.log_path}")
    ended_within(5.0, process, children)
    assert process.popen.returncode == 1
    assert "because: the simulator has made nothing for" in process.log
    assert "because: no frames: the last reached the service" in process.log


def test_a_worker_that_stands_still_is_named_as_the_reason(night):
    process = demo(night, "--seconds", "12")
    children = both_children(process)
    _, theirs = running(process, children)
    for pid in theirs:
        os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: "FAILED" in process.log, 120.0, f"a verdict; {process.log_path}")
    ended_within(5.0, process, children)
    assert process.popen.returncode == 1
    told = [line for line in process.log.splitlines() if "worker" in line]
    assert any(line.startswith(("FAILED: ", "because: ")) for line in told), process.log
