"""What the work costs, and what is said where it does not keep up."""

import pytest

from service.runtime import workers as workers_module
from service.runtime.workers import WorkerLoadMeter
from service.tracking.alarms import Alarm
from service.tracking.state import TrackerState
from tests.states import tracker_state

QUIET = TrackerState(system="small")


def alarmed(name):
    return tracker_state(system="small", active=(Alarm(name=name, text="", since_ns_utc=1),))


class Clocks:
    """A worker and a machine as a test would have them."""

    def __init__(self):
        self.now_s = self.service_s = 0.0
        self.busy_s, self.cpu_s = 0.0, {}
        self.problem = self.cluster_problem = ""

    def monotonic(self):
        return self.now_s

    def process_time(self):
        return self.service_s


@pytest.fixture
def clocks(monkeypatch):
    clocks = Clocks()
    monkeypatch.setattr(workers_module, "time", clocks)
    return clocks


def work(clocks, meter, seconds, *, busy=0.3, cpu=0.25, late=False):
    """Let seconds pass: telemetry at half its speed, a window of 2 s each two seconds."""
    for second in range(seconds):
        clocks.now_s += 1.0
        clocks.service_s += 0.08
        clocks.busy_s += busy
        clocks.cpu_s["fit"] = clocks.cpu_s.get("fit", 0.0) + 0.8 * cpu
        clocks.cpu_s["margin"] = clocks.cpu_s.get("margin", 0.0) + 0.2 * cpu
        meter.count_frames(0.5)
        if second % 2:
            meter.fitted(2.0)
            if late:
                meter.was_late()
        meter.look()


def test_costs_are_told_for_each_second_of_telemetry_and_by_job(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 10)
    load = meter.worker_load
    assert load.worker_per_s == pytest.approx(0.25 / 0.5)
    assert load.by_job == pytest.approx({"fit": 0.4, "margin": 0.1})
    assert list(load.by_job) == ["fit", "margin"]
    assert load.service_per_s == pytest.approx(0.08)
    assert (load.busy_ratio, load.window_s, load.windows_late) == (pytest.approx(0.3), 2.0, 0)


def test_it_is_of_the_last_minute(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 100, cpu=0.9)
    work(clocks, meter, 61, cpu=0.1)
    assert meter.worker_load.worker_per_s == pytest.approx(0.2)


def test_without_telemetry_a_cost_per_second_of_it_is_not_known(clocks):
    meter = WorkerLoadMeter(clocks)
    clocks.now_s = 5.0
    meter.look()
    assert meter.worker_load.worker_per_s is None
    assert meter.worker_load.window_s is None


def test_a_worker_that_does_not_keep_up_is_named_with_cause_and_cure(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 30, busy=0.97, cpu=0.9, late=True)
    (trouble,) = meter.detect_changes(QUIET)
    assert (trouble.name, trouble.over) == ("worker-behind", False)
    assert "1.80 s of processor time for each second of telemetry (fit 1.44, margin" in trouble.text
    assert "the machine is too slow" in trouble.text
    assert "Windows are now 2.0 s long" in trouble.text


def test_a_cluster_that_does_not_help_is_named_for_as_long_as_that_lasts(clocks):
    meter = WorkerLoadMeter(clocks)
    clocks.cluster_problem = "tcp://there:8786: found no Dask scheduler there"
    (trouble,) = meter.detect_changes(QUIET)
    assert (trouble.name, trouble.over) == ("cluster-lost", False)
    assert trouble.text == f"{clocks.cluster_problem}; until then the worker computes alone"
    clocks.cluster_problem = ""
    (over,) = meter.detect_changes(alarmed("cluster-lost"))
    assert (over.name, over.over) == ("cluster-lost", True)
    assert meter.detect_changes(QUIET) == []


def test_a_loaded_machine_is_told_from_a_slow_one(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 30, busy=0.97, cpu=0.2, late=True)
    (trouble,) = meter.detect_changes(QUIET)
    assert "the machine is loaded: of a second at work it gets 0.2 s" in trouble.text


def test_a_matrix_that_takes_some_seconds_is_no_reason_for_an_alarm(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 6, busy=1.0, late=True)
    assert not meter.detect_changes(QUIET)
    work(clocks, meter, 30)
    assert not meter.detect_changes(QUIET)


def test_the_alarm_lasts_until_the_worker_is_at_ease_again(clocks):
    meter = WorkerLoadMeter(clocks)
    work(clocks, meter, 60, busy=0.97, cpu=0.9, late=True)
    assert meter.detect_changes(QUIET)
    work(clocks, meter, 10, busy=0.8, late=True)
    assert not meter.detect_changes(alarmed("worker-behind"))
    work(clocks, meter, 60, busy=0.8)
    (over,) = meter.detect_changes(alarmed("worker-behind"))
    assert over.over


def test_a_lost_worker_is_an_alarm_until_another_has_done_a_job(clocks):
    meter = WorkerLoadMeter(clocks)
    clocks.problem = "the worker process died during fit"
    (trouble,) = meter.detect_changes(QUIET)
    assert (trouble.name, trouble.over) == ("worker-lost", False)
    assert "died during fit" in trouble.text
    assert not meter.detect_changes(alarmed("worker-lost"))
    clocks.problem = ""
    (over,) = meter.detect_changes(alarmed("worker-lost"))
    assert over.over
