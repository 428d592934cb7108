"""The whole service on a loop whose operator has set some gains to 0."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Observatory
from service.config import load_settings
from service.estimation.description import LOW_MODES
from service.estimation.health import LoopHealth
from service.records import commands as cmd
from service.records.registration import Source
from service.records.state import Mode
from service.runtime.engine import shape_mismatch
from service.runtime.estimator_bank import EstimatorBank, process_block, with_rtc
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from tests.support.handmade import take_sums
from tests.support.small import COMPUTE, INSTRUMENT, N_CONTROLLED, small_instrument
from tests.support.streams import DESCRIPTION, MANY, N_MANY, RING, driven

STILL = ((10, 14), (30, 39))


@pytest.fixture(scope="module")
def night():
    """Eighteen seconds, the gains set to 0 after two: on the linear plant, in auto."""
    given = {"control.n_modes_target": N_CONTROLLED}
    words = [
        f"--instrument={INSTRUMENT}",
        "--plant=linear",
        f"--n-controlled={N_CONTROLLED}",
        "--seed=1",
        "--alpha=0.05,-0.03,0.1,1.002",
    ]
    with threadpool_limits(1):
        bench = OpticsWorker(small_instrument(), COMPUTE)
        policy = policy_of(load_settings(None, {}, given))
        night = Observatory(words, policy, Mode.AUTO, bench, with_poles=False)
        night.advance(2.0)
        groups = tuple(cmd.GainGroup(first=first, last=last, gain=0.0) for first, last in STILL)
        night.command(cmd.SetLoop(gains=groups))
        night.advance(16.0)
    return night


def test_alpha_is_tracked_and_a_matrix_made_for_it_is_in_use(night):
    assert night.state.loop.rtc.loop == "partial"
    assert len(night.state.loop.rtc.in_loop) == N_CONTROLLED - 15
    known = night.state.alpha.registration
    assert known.n_windows > 5
    error = known.alpha.vector - night.dome.alpha.vector
    assert (np.abs(error) < 5.0 * known.sigma).all()
    assert not night.state.alarms.active
    assert night.swaps
    assert all(swap.time_s > 2.0 for swap in night.swaps)


def test_the_gate_judges_the_modes_that_move_by_the_bound_it_was_given(night):
    made = night.state.reconstructor(night.state.matrices.in_use)
    assert made.gate.accepted
    assert made.gate.bound == 0.95
    assert made.gate.worst_pole_radius < 0.9


def test_ordinary_telemetry_is_looked_at_and_agrees(night):
    looks = [entry for entry in night.state.alpha.history if entry.source is Source.PASSIVE]
    assert looks
    assert night.state.alpha.passive.consistent


@pytest.fixture
def many():
    """Streams of a mirror whose outer ring can be watched."""
    variance = np.full(N_MANY, 1e-16)
    return EstimatorBank.of(
        replace(DESCRIPTION, n_modes=N_MANY, mode_variance_m2=variance, actuators=RING)
    )


def partial(gains):
    return replace(MANY, loop="partial", gains=gains)


def standing(first_seq, dither_m=None):
    """Frames of a loop in which modes 60 to 64 have stopped far from zero."""
    frames = driven(first_seq, 0.0)
    frames.commands_m[:, 60:65] = 1e-6
    if dither_m is None:
        return frames
    added = np.zeros_like(frames.commands_m)
    added[:, 62] = dither_m
    return replace(frames, commands_m=frames.commands_m + added, dither_m=added)


class TestTheStreams:
    GAINS = (*(0.4,) * 60, *(0.0,) * 5, *(0.4,) * (N_MANY - 65))

    def test_the_edge_is_watched_on_the_modes_that_move(self, many):
        bank = with_rtc(many, partial(self.GAINS))
        assert bank.loop.edge is not None
        assert not np.isin(np.arange(60, 65), bank.loop.edge.modes).any()
        few = (*(0.4,) * (2 * LOW_MODES), *(0.0,) * (N_MANY - 2 * LOW_MODES))
        assert with_rtc(many, partial(few)).loop.edge is None

    def test_what_stands_in_the_others_is_no_instrument_of_the_passive_estimate(self, many):
        bank = with_rtc(many, partial(self.GAINS))
        for first_seq in range(0, 2000, 10):
            bank, _ = process_block(bank, standing(first_seq))
        _, heard = take_sums(bank)
        _, moved, power = heard.sums
        assert not power[60:65].any()
        assert not moved[60:65].any()
        assert np.diag(power)[:60].all()

    def test_a_dither_of_theirs_is_one(self, many):
        bank, rng = with_rtc(many, partial(self.GAINS)), np.random.default_rng(1)
        for first_seq in range(0, 2000, 10):
            bank, _ = process_block(bank, standing(first_seq, 1e-8 * rng.standard_normal(10)))
        _, heard = take_sums(bank)
        expected, power = heard.n_effective * 1e-16, heard.sums[2]
        assert 0.1 * expected < power[62, 62] < 10.0 * expected
        assert not power[61].any()

    def test_without_any_gain_it_is_open_and_says_nothing(self, many):
        bank = with_rtc(many, partial((0.0,) * N_MANY))
        assert bank.loop.edge is None
        assert take_sums(bank)[1] == "no passive estimate: all gains of the loop are 0"
        bank, _ = process_block(bank, driven(0, 1e-3))
        assert not bank[LoopHealth].diverging

    def test_an_rtc_of_more_modes_than_the_instrument_file_knows_ends_nothing(self, many):
        """It is named, and its frames are not used, as soon as its status has been seen."""
        other = replace(MANY, n_modes=2 * N_MANY, n_controlled=100, gains=(0.4,) * 2 * N_MANY)
        bank = with_rtc(many, other)
        assert shape_mismatch(bank.loop.description, other)
        assert bank.loop.in_loop.max() < N_MANY
