"""A worker that is slow or hangs, as an operator and a process manager see it."""

import os
import signal
import time

import pytest

from tests.support.ending import stranger, workers_of
from tests.support.night import a_night, session_members, wait_for
from tests.support.pace import Deadline

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(180)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def test_a_worker_that_hangs_is_named_killed_and_replaced(night):
    service = night.service("hold")
    with stranger(night):
        wait_for(lambda: night.state["windows_accepted"] > 0, 40.0, "it tracks")
        (worker,) = workers_of(service)
        os.kill(worker, signal.SIGSTOP)
        wait_for(lambda: night.alarms.get("worker-lost"), 12.0, "the alarm")
        answer = night.client.get("/readyz")
        assert answer.status_code == 503
        assert "stood still" in answer.json()["detail"]
        wait_for(lambda: worker not in session_members(service.popen.pid), 20.0, "it is killed")
        accepted = night.state["windows_accepted"]
        wait_for(lambda: night.state["windows_accepted"] > accepted, 40.0, "another one works")
        wait_for(lambda: "worker-lost" not in night.alarms, 5.0, "the alarm is over")
        wait_for(lambda: night.client.get("/readyz").status_code == 200, 5.0, "it is ready")


def test_a_slow_worker_gets_longer_windows_and_is_named(night):
    """A worker that runs for 0.3 of every 5 s: no window is lost, and the alarm says why."""
    service = night.service("hold")
    with stranger(night):
        wait_for(lambda: night.state["windows_accepted"] > 0, 40.0, "it tracks")
        (worker,), before = workers_of(service), night.state
        deadline = Deadline(70.0)
        try:
            # what its first joined window is like shows when it is fitted, after the alarm perhaps
            while (
                "worker-behind" not in night.alarms or night.state["worker_load"]["window_s"] <= 2.0
            ):
                assert not deadline.passed, (night.state["worker_load"], night.alarms)
                os.kill(worker, signal.SIGSTOP)
                time.sleep(4.7)
                os.kill(worker, signal.SIGCONT)
                time.sleep(0.3)
        finally:
            os.kill(worker, signal.SIGCONT)
        after = night.state
        assert "Windows are now" in night.alarms["worker-behind"]
        assert "the machine is loaded" in night.alarms["worker-behind"]
        assert after["windows_accepted"] > before["windows_accepted"]
        assert after["windows_refused"] == before["windows_refused"]
        assert night.metrics["pyrcal_windows_late"] >= 3
        wait_for(lambda: "worker-behind" not in night.alarms, 90.0, "the alarm is over")
