"""An RTC made from the wire contract alone is calibrated like our own."""

import numpy as np
import pytest

from tests.system.night import ALPHA, a_night, wait_for
from tests.system.stranger import Stranger, small_telescope

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def test_a_strangers_loop_is_registered_and_given_a_matrix_that_holds(night):
    night.service("auto")
    response, variance_m2 = small_telescope(**ALPHA)
    assumed, _ = small_telescope()
    with Stranger(night.zenoh, response, variance_m2, assumed=assumed) as rtc:
        wait_for(lambda: rtc.applied, 40.0, lambda: f"a matrix applied; {night.alarms}")
        known = night.state["registration"]
        for name, truth in ALPHA.items():
            error = known["alpha"][name] - truth
            assert abs(error) < 4 * known["sigma"][name], (name, error, known["sigma"][name])
        n_batches = len(rtc.residuals)
        wait_for(lambda: len(rtc.residuals) > n_batches + 100, 10.0, "two seconds more")
        after = np.median([value for _, value in rtc.residuals[n_batches:]])
        assert after < 1.1 * np.median([value for _, value in rtc.residuals[:n_batches]])
