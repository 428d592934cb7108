"""Dithers that are not what was asked for, gains that never stand still: whole nights, no clock."""

import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Latencies
from pyrcal_studies.campaign.strange_nights import StrangeNight
from pyrcal_studies.campaign.strange_rtc import Mischief

WORDS = [
    "--instrument=tests/system/small.toml",
    "--plant=linear",
    "--n-controlled=45",
    "--seed=3",
    "--mag=7.0",
    "--gain=0.4",
    "--alpha=0.1,-0.05,0.2,1.0",
]
SWIFT = Latencies(fit_s=0.5, make_s=2.0, judge_s=1.0, watch_s=0.5)

pytestmark = pytest.mark.timeout(120)


def played(mischief, seconds):
    with threadpool_limits(1):
        night = StrangeNight(WORDS, SWIFT, listening=False)
        if mischief is not None:
            night.dome.begin(mischief)
        night.play([], seconds)
    return night


def test_a_dither_too_strong_is_stopped_within_three_seconds_and_nothing_is_measured_with_it():
    night = played(Mischief.STRONG_DITHER, 3.0)
    (alarm,) = [a for a in night.state.alarms.active if a.name == "dither-over-budget"]
    # 50 nm on each of 19 modes
    assert "218 nm RMS" in alarm.text
    assert " 40 nm: " in alarm.text
    night.play([], 10.0)
    assert night.state.loop.rtc.dither_id is None
    assert night.state.windows.accepted == 0
    assert not night.swaps


@pytest.mark.long
def test_gains_that_follow_the_seeing_cost_no_window():
    plain, following = (played(m, 12.0).state for m in (None, Mischief.SEEING_GAINS))
    assert following.windows.accepted == plain.windows.accepted
    assert following.windows.accepted >= 5
