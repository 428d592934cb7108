"""A stage closes the loop of the registration itself, in simulated time; the RTC sends pixels."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Latencies, Observatory
from service.config import load_settings
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from tests.support.small import COMPUTE, INSTRUMENT, N_CONTROLLED

GIVEN = {
    "dither.budget_m": 20e-9,
    "dither.amplitude_m": 10e-9,
    "dither.window_s": 1.0,
    "dither.longest_pause_s": 0.0,
    "control.n_modes_target": N_CONTROLLED,
    "offload.enabled": True,
    "offload.settle_s": 0.5,
    "control.minimum_interval_s": 1.0,
}


def a_night(seconds, instrument, *words, mode=Mode.AUTO, **changes):
    with threadpool_limits(1):
        policy = policy_of(load_settings(None, {}, GIVEN | changes))
        night = Observatory(
            [
                f"--instrument={instrument}",
                "--plant=linear",
                "--optical-gain=0.7,0.9",
                f"--n-controlled={N_CONTROLLED}",
                "--seed=1",
                *words,
            ],
            policy,
            mode,
            OpticsWorker(load_instrument(instrument), COMPUTE),
            latencies=Latencies(fit_s=0.2, make_s=0.4, judge_s=0.2),
            with_poles=False,
        )
        night.advance(seconds)
    return night


def way(night):
    """The true registration over time, in the units of every boundary, less the nominal one."""
    alpha = np.array([m.alpha.vector for m in night.dome.moments]) - [0.0, 0.0, 0.0, 1.0]
    return alpha * BOUNDARY_SCALE


def logged(night, name):
    return [entry.text for entry in night.state.log if entry.name == name]


@pytest.mark.long
def test_from_30_percent_and_half_a_degree_it_is_home_in_five_moves(tmp_path):
    """Within 2 % of a subaperture and 0.02 deg, no more than a tenth of the way too far."""
    path = tmp_path / "pixels.toml"
    path.write_text(INSTRUMENT.read_text() + '\n[slopes]\nkind = "intensity"\n')
    night = a_night(26.0, path, "--alpha=0.3,-0.2,0.5,1.004", "--stage=1.2,0")
    assert night.state.loop.rtc.n_slopes == 4 * int(night.dome.telescope.plant.valid.sum())
    assert logged(night, "instrument-mismatch") == []
    assert len(night.swaps) >= 2
    moved = way(night)
    assert 1 <= night.state.alpha.offload.n_moves <= 5, logged(night, "offload.asked")
    assert np.all(np.abs(moved[-1]) <= [0.02, 0.02, 0.02, 0.002])
    overshoot = (moved * -np.sign(moved[0])).max(axis=0) / np.abs(moved[0])
    assert overshoot.max() <= 0.1
    assert logged(night, "registration.jump") == []
    assert logged(night, "registration.jump-suspected") == []
