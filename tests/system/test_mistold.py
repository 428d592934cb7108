"""An RTC that tells something wrong of its slopes, commands or loop gets no matrix, and is told."""

import time

import numpy as np
import pytest

from tests.support.night import ALPHA, a_night, wait_for
from tests.support.stranger import Stranger, small_telescope

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def test_an_orientation_left_open_is_found_adopted_and_the_matrix_sent_holds(night):
    """The RTC is made from the wire contract alone, and is calibrated like our own."""
    night.service("auto")
    response, variance_m2 = small_telescope(**ALPHA)
    assumed, _ = small_telescope()
    order = np.arange(len(response)).reshape(2, -1).T.ravel()
    with Stranger(night.zenoh, -response[order], variance_m2, assumed=-assumed[order]) as rtc:
        wait_for(lambda: rtc.applied, 40.0, lambda: f"a matrix applied; {night.alarms}")
        known = night.state["registration"]
        for name, truth in ALPHA.items():
            error = known["alpha"][name] - truth
            assert abs(error) < 4 * known["sigma"][name], (name, error, known["sigma"][name])
        n_batches = len(rtc.residuals)
        wait_for(lambda: len(rtc.residuals) > n_batches + 100, 10.0, "two seconds more")
        after = np.median([value for _, value in rtc.residuals[n_batches:]])
        assert after < 1.1 * np.median([value for _, value in rtc.residuals[:n_batches]])


def test_an_rtc_that_starts_anew_with_other_slopes_is_not_believed_by_the_id_of_its_matrix(night):
    night.service("auto")
    response, variance_m2 = small_telescope(**ALPHA)
    assumed, _ = small_telescope()
    with Stranger(night.zenoh, response, variance_m2, assumed=assumed) as rtc:
        wait_for(lambda: rtc.applied, 40.0, f"a matrix applied; {night.state['alarms']}")
        # at once: the next one, of more modes, is being made
        known = rtc.cm_id
        rtc.response, rtc.matrix = -rtc.response, -rtc.matrix
        rtc.restart("stranger-2")
        wait_for(lambda: "wrong-matrix" in night.alarms, 10.0, "an alarm")
        assert known in night.alarms["wrong-matrix"]
        n_applied, rtc.residuals = len(rtc.applied), []
        night.post("/v1/rollback")
        time.sleep(8.0)
        assert len(rtc.applied) == n_applied
        assert "wrong-matrix" in night.alarms
        assert rtc.worst_m < 1e-6
