"""The whole service with an RTC that changes its reference slopes every 15 s."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import START_NS, Observatory
from service.config import load_settings
from service.records.registration import Source, Validity
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from tests.support.small import COMPUTE, INSTRUMENT, N_CONTROLLED, small_instrument

PERIOD_S, N_CHANGES = 15, 5


@pytest.fixture(scope="module", params=["reference_id", "config_id"])
def night(request):
    """Ninety seconds on the linear plant, in auto: shapes of 60 nm, named in either way."""
    given = {"control.n_modes_target": N_CONTROLLED}
    words = [
        f"--instrument={INSTRUMENT}",
        "--plant=linear",
        f"--n-controlled={N_CONTROLLED}",
        "--seed=1",
        "--alpha=0.05,-0.03,0.1,1.002",
        f"--references=60,{PERIOD_S}",
        f"--references-named-by={request.param}",
    ]
    with threadpool_limits(1):
        bench = OpticsWorker(small_instrument(), COMPUTE)
        policy = policy_of(load_settings(None, {}, given))
        night = Observatory(words, policy, Mode.AUTO, bench, with_poles=False)
        night.advance(PERIOD_S * (N_CHANGES + 1) - 1.0)
    night.named_by = request.param
    return night


def test_windows_are_accepted_under_each_set_of_references(night):
    """A window of 2 s under way is lost at each change."""
    ends_s = np.array(
        [
            (entry.t_ns_utc - START_NS) / 1e9
            for entry in night.state.alpha.history
            if entry.source is Source.LOCK_IN and entry.entered
        ]
    )
    n_windows = np.bincount((ends_s // PERIOD_S).astype(int), minlength=N_CHANGES + 1)
    assert n_windows.min() >= 4
    assert night.state.loop.reference_id == f"references-{N_CHANGES}"
    assert night.state.windows.outlying == 0


def test_alpha_stays_fresh_and_right_and_no_alarm_is_critical(night):
    known = night.state.alpha.registration
    assert known.validity.level is Validity.FRESH
    error = known.alpha.vector - night.dome.alpha.vector
    assert (np.abs(error) < 3.0 * known.sigma).all()
    raised = {name for glance in night.glances for name in glance.alarms}
    assert raised == ({"sensor-renamed"} if night.named_by == "config_id" else set())


def test_ordinary_telemetry_is_looked_at_and_agrees(night):
    assert night.state.alpha.passive.consistent


def test_matrices_and_session_stay(night):
    assert len(night.swaps) == 1
    assert night.swaps[0].id == night.state.matrices.in_use
    made = night.state.reconstructor(night.swaps[0].id)
    # The RTC had no name for its references before the first change but that of its sensor.
    assert made.reference_id == made.config_id == night.state.loop.config_id
    assert night.state.operations.probation.state.value == "passed"
    assert night.state.loop.renamed_ns_utc is None
    started = [entry for entry in night.state.log if entry.name == "rtc.session"]
    assert len(started) == 1
