"""The demo on the full instrument, as a new user would run it."""

import json
import os
import signal
import time

import pytest

from service.model.misregistration import PARAMETERS
from tests.system.night import a_night, children_of, session_members, wait_for

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]

TOLERANCE = dict(zip(PARAMETERS, (0.02, 0.02, 0.05, 0.002), strict=True))


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def demo(night, *words):
    given = ["service", "demo", "--port", str(night.port), "--dir", str(night.directory / "demo")]
    given += ["--zenoh-port", night.zenoh.rpartition(":")[2]]
    return night.start("demo", [*given, *words])


def test_the_main_job_is_done_within_a_minute(night):
    figures = night.directory / "figures.json"
    given = {
        "shift_x_subap": -0.11,
        "shift_y_subap": 0.13,
        "rotation_deg": 0.21,
        "magnification": 1.004,
    }
    alpha = ",".join(str(value) for value in given.values())
    began = time.monotonic()
    process = demo(night, "--seconds", "60", f"--alpha={alpha}", "--json", str(figures))
    assert process.popen.wait(100.0) == 0, process.log
    assert 60.0 < time.monotonic() - began < 85.0

    report = json.loads(figures.read_text(encoding="utf-8"))
    assert report["good"]
    assert report["true_alpha"] == pytest.approx(given)
    for name, tolerance in TOLERANCE.items():
        error = report["estimated_alpha"][name] - given[name]
        assert abs(error) < min(tolerance, 4 * report["sigma"][name]), (name, error)
        assert report["sigma"][name] >= report["floor"][name]
    stages = [report[name] for name in ("start", "first_update", "target_modes")]
    assert [stage["n_modes"] for stage in stages] == [400, 400, 500]
    assert stages[1]["worst_pole_radius"] < stages[0]["worst_pole_radius"]
    assert stages[2]["wavefront_error_nm"] < stages[0]["wavefront_error_nm"]
    assert report["reconstructors_applied"] == report["reconstructors_published"] >= 2
    assert report["frames_lost"] == 0
    assert all(swap["frames_skipped"] == 0 for swap in report["swaps"])
    assert report["seconds_to_first_applied"] < 45.0
    assert "GOOD: the main job was done" in process.log
    wait_for(lambda: not session_members(process.popen.pid), 5.0, "no child process left")


def test_interrupted_it_stops_both_processes_and_says_what_is_missing(night):
    process = demo(night)
    children = wait_for(
        lambda: len(found := children_of(process.popen.pid)) == 2 and found, 20.0, "two children"
    )
    wait_for(lambda: "the optical model is being prepared" in process.log, 20.0, "a first look")
    os.killpg(process.popen.pid, signal.SIGINT)
    assert process.popen.wait(20.0) == 1, process.log
    assert "FAILED: no estimate of the registration" in process.log
    assert not [member for child in children for member in session_members(child)]
