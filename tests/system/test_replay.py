"""A recorded night gives the tracker the very same answers, however often it is played."""

import json
import signal
import subprocess
import sys
import time
from itertools import pairwise

import httpx
import numpy as np
import pytest

from service.model.misregistration import PARAMETERS
from tests.support.night import INSTRUMENT, N_TARGET, ROOT, a_night, wait_for
from tests.support.pace import patience

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150)]


def tracked(path, settings):
    """Return what ``pyrcal track`` says of a recording, as it says it."""
    words = ["track", str(INSTRUMENT), str(path), "--config", str(settings), "--json"]
    program = [sys.executable, "-m", "pyrcal", *words]
    return subprocess.run(program, cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout


def lived(night):
    """Return what the service measured that night, by the end of the window."""
    answer = night.client.get("/v1/alpha/history")
    answer.raise_for_status()
    entries = [e for e in answer.json()["entries"] if e["source"] == "lock-in"]
    return {e["t_ns_utc"]: [e["measured"][name] for name in PARAMETERS] for e in entries}


def spanned_s(night):
    """From the end of the first window that was measured to that of the last."""
    ends_ns = lived(night)
    return (max(ends_ns) - min(ends_ns)) * 1e-9 if ends_ns else 0.0


def assert_close(here, there, tolerance):
    np.testing.assert_allclose(here, there, rtol=0.0, atol=tolerance)


def test_a_recorded_night_gives_the_same_answers_every_time(tmp_path):
    path = tmp_path / "night.h5"
    with a_night(tmp_path) as night:
        night.service("auto")
        # near the nominal registration, about which a busy live worker may still linearise
        alpha = "--alpha=0.01,-0.01,0.03,1.0005"
        rtc = night.rtc("--record", str(path), "--seconds", "16", alpha)
        assert rtc.ended(60.0) == 0, rtc.log
        there = lived(night)
        settings = night.settings
        first, second = tracked(path, settings), tracked(path, settings)
    assert first == second
    here = {
        entry["t_ns_utc"]: [entry["measured"][name] for name in PARAMETERS]
        for entry in json.loads(first)["entries"]
        if entry["source"] == "lock-in"
    }
    same = sorted(set(there) & set(here))
    assert len(same) >= 6
    assert len(same) >= len(there) - 1  # the night's last window may have had no time to be fitted
    # a busy live worker has fitted some windows together with those before, which had waited
    alone = [
        t
        for before, t in pairwise([0, *sorted(there)])
        if t in here and not any(before < other < t for other in here)
    ]
    assert len(alone) >= 4
    # its linearisation may be another one: both are within 0.01 subaperture of α; one window
    # scatters by 0.0003 subapertures and 0.002 deg
    assert_close([here[t] for t in alone], [there[t] for t in alone], 3e-4)


def test_a_replay_over_zenoh_is_an_rtc_that_carries_out_nothing(tmp_path):
    path = tmp_path / "night.h5"
    (tmp_path / "recorded").mkdir()
    with a_night(tmp_path / "recorded") as night:
        night.service("auto")
        rtc = night.rtc("--record", str(path))
        night.wait_for_modes(N_TARGET)
        time.sleep(patience(8.0))  # what is done to the replay afterwards takes some of it
        rtc.send(signal.SIGTERM)
        assert rtc.ended(60.0) == 0, rtc.log
        session = night.state["link"]["session"]
        alpha = night.state["registration"]["alpha"]
    (tmp_path / "replayed").mkdir()
    with a_night(tmp_path / "replayed") as night:
        service = night.service("hold")
        words = ["sim_rtc", "--connect", night.zenoh, "--replay", str(path)]
        replay = night.start("replay", words)
        # a busy worker fits some of them together
        wait_for(lambda: spanned_s(night) > 2.9, 60.0, "replayed windows of four seconds")
        state = night.state
        assert state["link"]["session"] == session
        assert state["registration"]["alpha"]["shift_x_subap"] == pytest.approx(
            alpha["shift_x_subap"], abs=0.01
        )
        assert "dither.adopted" in service.log
        wait_for(lambda: night.rtc_says("n_controlled") == N_TARGET, 20.0, "its last matrix")
        night.post("/v1/refit")
        made = wait_for(lambda: night.ids("proposed"), 20.0, "a reconstructor")

        def sent():  # refused by the service while the RTC's own matrix is being read back
            answer = night.client.post(f"/v1/reconstructors/{made[-1]}/approve")
            assert answer.status_code == httpx.codes.CONFLICT, answer.text
            return "the RTC refused" in answer.json()["detail"]

        wait_for(sent, 10.0, lambda: f"it may be sent; {night.state['waiting_for']}")
        wait_for(lambda: night.ids("rejected"), 10.0, "its refusal")
        (refused,) = [r for r in night.shelf if r["state"] == "rejected"]
        assert refused["reason"] == "unsupported: a replay"
        assert replay.ended(30.0) == 0, replay.log


def test_a_replay_cannot_be_disturbed_or_found_nowhere(tmp_path):
    def run(*words):
        return subprocess.run(
            [sys.executable, "-m", "sim_rtc", *words],
            capture_output=True,
            text=True,
            check=False,
            timeout=patience(60.0),
            cwd=ROOT,
        )

    both = run("--replay", "night.h5", "--fault", "lost@1")
    assert (both.returncode, both.stderr.count("\n")) == (2, 1)
    assert "plays a file as it is" in both.stderr
    missing = run("--replay", str(tmp_path / "none.h5"))
    assert missing.returncode == 2
    assert "none.h5: cannot be read" in missing.stderr
    assert "Traceback" not in missing.stderr
