"""An RTC whose single modes differ from the file keeps its loop, and is told which modes."""

import re
import time

import numpy as np
import pytest

from tests.support.night import a_night, wait_for
from tests.support.other_rtc import OtherRtc

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150)]

NAMED_S = 15.0
"""Of telemetry, until an alarm says what differs."""

WATCHED_S = 25.0


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def exchanged(first, second, n_modes=90):
    order = np.arange(n_modes)
    order[[first, second]] = second, first
    return order


def named(night, *words):
    """Return the alarm that has all of the words, as words of their own; None: there is none."""
    for text in night.alarms.values():
        if all(re.search(rf"\b{word}\b", text, re.IGNORECASE) for word in words):
            return text
    return None


def watched(night, rtc, *words):
    """Let telemetry pass; return the alarm with these words and how much telemetry it took."""
    found = None
    while rtc.seq < WATCHED_S * rtc.rate_hz:
        time.sleep(0.5)
        text = named(night, *words) if words and found is None else None
        if text is not None:
            found = (rtc.seq / rtc.rate_hz, text)
    return found


def test_modes_that_differ_are_named_and_the_loop_is_left_as_good_as_it_was(night):
    night.service("auto")
    scale = np.where(np.arange(90) == 10, -1.0, 1.0)
    with OtherRtc(night.zenoh, order=exchanged(3, 40), scale=scale) as rtc:
        found = watched(night, rtc, "3", "40")
        assert named(night, "sign", "10"), night.alarms
        assert rtc.worse_s() <= 1.0, (rtc.applied, night.alarms)
        assert found is not None, night.alarms
        assert found[0] <= NAMED_S, found


def test_an_rtc_that_plays_another_matrix_than_it_acknowledges_is_not_left_with_it(night):
    """Whatever it is sent it plays three times as strongly: going back does not help it."""
    night.service("auto")
    with OtherRtc(night.zenoh, loads=lambda matrix: 3.0 * matrix) as rtc:
        wait_for(lambda: rtc.applied, 40.0, lambda: f"a matrix applied; {night.alarms}")
        wait_for(lambda: not rtc.closed, 10.0, lambda: f"an open loop; {night.alarms}")
        assert rtc.worse_s(ratio=30.0) <= 5.0
