"""Dithers of an RTC that does otherwise than it says; windows of one that never stands still."""

import threading
import time

import pytest

from tests.system.night import ALPHA, a_night, wait_for
from tests.system.stranger import Stranger, small_telescope

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def stranger(night, kind=Stranger, **changes):
    response, variance_m2 = small_telescope(**ALPHA)
    assumed, _ = small_telescope()
    return kind(night.zenoh, response, variance_m2, assumed=assumed, **changes)


class Loud(Stranger):
    """Plays twenty times what is asked for, and says that it does as it was asked."""

    def _dither_at(self, seq):
        return 20.0 * super()._dither_at(seq)


def alarms(night):
    return {alarm["name"]: alarm["text"] for alarm in night.state["alarms"]}


def test_a_dither_twenty_times_too_strong_is_stopped_and_nothing_is_measured_with_it(night):
    night.service("auto")
    with stranger(night, Loud) as rtc:
        wait_for(lambda: "dither-over-budget" in alarms(night), 40.0, "the alarm")
        assert "were asked for" in alarms(night)["dither-over-budget"]
        wait_for(lambda: rtc.dither is None, 3.0, "no dither on the mirror")
        time.sleep(5.0)
        assert rtc.dither is None
        assert night.state["registration"] is None
        assert not rtc.applied


def test_an_rtc_whose_gains_follow_the_seeing_is_registered(night):
    night.service("auto")
    with stranger(night) as rtc:
        gains, stopped = rtc.gains.copy(), threading.Event()

        def follow():
            n = 0
            while not stopped.wait(1.0):
                n += 1
                rtc.gains = gains * (1.0 + 0.01 * (n % 2))

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            wait_for(lambda: rtc.applied, 60.0, f"a matrix applied; {alarms(night)}")
        finally:
            stopped.set()
            thread.join()


def test_an_rtc_at_no_round_rate_is_registered(night):
    night.service("auto")
    with stranger(night, rate_hz=300.00003) as rtc:
        wait_for(lambda: rtc.applied, 60.0, f"a matrix applied; {alarms(night)}")
