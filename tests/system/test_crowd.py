"""Strangers who hold connections to REST, and the operator who comes after them."""

import pytest

from tests.support.night import a_night, wait_for
from tests.system.crowd import crowded, has_alarm, time_of

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


@pytest.mark.parametrize("kind", ["silent", "slow-body"])
def test_a_crowd_keeps_no_operator_from_the_stop(tmp_path, kind):
    with a_night(tmp_path) as night:
        night.service("auto")
        with crowded(night, kind, 600):
            wait_for(lambda: has_alarm(night), 30.0, "the alarm")
            for _ in range(5):
                assert time_of(night, "GET", "/healthz") < float("inf")
                assert time_of(night, "POST", "/v1/stop") < float("inf")
                assert time_of(night, "POST", "/v1/resume") < float("inf")
        wait_for(lambda: not has_alarm(night), 40.0, "its end")
