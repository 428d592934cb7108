import threading
import time

from sim_rtc.computer.telemetry import FrameClock, Pace
from tests.support.pace import in_time, patience


def test_timestamps_are_ends_of_exposure_that_follow_the_sequence():
    clock = FrameClock(start_ns_utc=5_000, dt_ns=1_000_000)
    assert clock.end_of_exposure_ns(0) == 1_005_000
    assert clock.end_of_exposure_ns(999) == 5_000 + 10**9


def test_a_late_batch_is_counted_and_made_up_for():
    pace, stopped = Pace(batch_s=0.02), threading.Event()
    began = time.monotonic()
    for k in range(20):
        pace.wait(stopped)
        if k == 5:
            time.sleep(0.07)
        pace.done()
    # The stall of 70 ms is gone by the end: 20 batches of 20 ms.
    assert time.monotonic() - began > 0.35
    assert in_time(began, 0.45)
    assert pace.late_frames >= 2
    assert pace.behind_s < patience(0.02)


def test_without_a_pace_nothing_waits():
    pace, stopped = Pace(batch_s=0.0), threading.Event()
    began = time.monotonic()
    for _ in range(1000):
        pace.wait(stopped)
        pace.done()
    assert in_time(began, 0.5)
    assert pace.late_frames == 0


def test_being_told_to_stop_ends_the_wait():
    pace, stopped = Pace(batch_s=30.0), threading.Event()
    stopped.set()
    began = time.monotonic()
    pace.wait(stopped)
    assert in_time(began, 1.0)
