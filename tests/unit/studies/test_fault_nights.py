"""Random faults in simulated time: what must hold is looked at, and what does not is said."""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal_studies.campaign import fault_nights
from pyrcal_studies.campaign.fault_nights import (
    AT_ONCE,
    DOWN_S,
    LASTING,
    FaultNight,
    Night,
    deeds_of,
    worse,
)
from pyrcal_studies.campaign.observatory import Moment, latencies_of
from service.records import commands as cmd
from service.records.state import Mode
from tests.support.night import INSTRUMENT

WORDS = (f"--instrument={INSTRUMENT}", "--plant=linear", "--n-controlled=45", "--seed=1")


@pytest.fixture
def night(tmp_path):
    night = FaultNight(WORDS, tmp_path, 1, listening=False)
    yield night
    night.close()


def moments(nm, closed=True):
    return [
        Moment(
            time_s=k + 0.5,
            alpha=None,
            wavefront_nm=value,
            n_clipped=0,
            cm_id="cm",
            n_controlled=1,
            closed=closed,
            dither_nm=0.0,
        )
        for k, value in enumerate(nm)
    ]


def test_a_wavefront_that_is_worse_for_longer_than_may_be_is_told():
    without = moments([100.0] * 20)
    assert worse(moments([100.0] * 4 + [120.0] * 6 + [100.0] * 10), without) == [(4.0, 10.0)]
    assert worse(moments([100.0] * 4 + [120.0] * 5 + [100.0] * 11), without) == []
    assert worse(moments([109.0] * 20), without) == []
    assert worse(moments([100.0] * 12 + [200.0] * 8), without) == [(12.0, 20.0)]
    assert worse(moments([200.0] * 20, closed=False), without) == []


def test_everything_happens_and_whatever_begins_ends():
    names = [d.name for seed in range(40) for d in deeds_of(np.random.default_rng(seed), 100.0)]
    assert {*LASTING, *AT_ONCE} <= set(names)
    for name in LASTING:
        assert names.count(name) == names.count(f"no {name}")


class Deaf(FaultNight):
    """Hears of the RTC for a second only."""

    def _hear_status(self):
        if self.time_s < 1.0:
            super()._hear_status()


def test_a_matrix_of_another_name_than_the_rtc_has_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(fault_nights, "AGREE_S", 0.5)
    night = Deaf(WORDS, tmp_path, 1, listening=True)
    night.play((), 1.5)
    assert night.broken == []
    in_use = night.dome.computer.reconstructor
    night.dome.computer.stage(
        replace(in_use, manifest=replace(in_use.manifest, id=f"{in_use.manifest.id}-again"))
    )
    night.play((), 3.0)
    assert ["is said to be in use" in text for text in night.broken] == [True]
    night.close()


def test_an_order_that_a_kill_loses_is_told(night, monkeypatch):
    night.play((), 0.5)
    night.order(cmd.SetMode(mode=Mode.PROPOSE))
    monkeypatch.setattr(FaultNight, "save", lambda _: None)
    night.kill_and_look()
    assert night.broken == ["3.5 s: mode auto after a kill, ordered was propose"]


@pytest.mark.long
def test_ten_faults_and_orders_in_a_hundred_seconds_break_no_rule():
    row = fault_nights.play(Night(seed=0, instrument=str(INSTRUMENT), seconds=100.0))
    assert row["broken"] == []
    assert row["worse"] == []
    assert row["n_windows"] > 10
    assert row["n_swaps"] > 0


def test_a_matrix_that_was_under_way_when_the_frames_stopped_is_not_sent(night):
    """The worker is slow: it is made and judged when nobody knows any more where the mirror is."""
    night.latencies = latencies_of(4.0)
    night.play((), 5.0)
    night.burst = True
    night.play((), 14.0)
    assert night.broken == []
    assert night.state.alarm("no-frames") is not None
    night.burst = False
    night.play((), 26.0)
    assert night.state.alarm("no-frames") is None
    assert night.broken == []


def test_a_service_that_is_killed_begins_again_from_what_it_has_written(night):
    night.play((), 7.0)
    known = night.state.alpha.registration.alpha
    night.kill()
    assert night.time_s == pytest.approx(7.0 + DOWN_S)
    assert np.abs(night.state.alpha.registration.alpha.vector - known.vector).max() < 0.01
    night.play((), night.time_s + 2.0)
    assert night.state.matrices.in_use == night.dome.computer.reconstructor.manifest.id


def test_what_was_on_its_way_when_the_service_was_killed_arrives(night):
    while not any(r.on_its_way for r in night.state.matrices.reconstructors):
        night.advance(0.05)
    sent = next(r.id for r in night.state.matrices.reconstructors if r.on_its_way)
    night.kill()
    assert night.dome.computer.reconstructor.manifest.id == sent
