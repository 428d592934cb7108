import numpy as np
import pytest

from service.errors import ConfigurationError
from sim_rtc.telescope.sky import SeeingSchedule

LATER = ((60.0, 2.0), (30.0, 0.5))


def test_the_seeing_passes_through_what_was_asked_for_and_stays_at_the_last():
    seeing = SeeingSchedule(start_arcsec=1.0, later=LATER)
    asked = seeing.arcsec(np.array([0.0, 30.0, 60.0, 1000.0]))
    np.testing.assert_allclose(asked, [1.0, 0.5, 2.0, 2.0])
    assert seeing.changes


def test_it_changes_smoothly_and_without_overshoot():
    time_s = np.linspace(0.0, 90.0, 9001)
    arcsec = SeeingSchedule(start_arcsec=1.0, later=LATER).arcsec(time_s)
    assert arcsec.min() == pytest.approx(0.5)
    assert arcsec.max() == pytest.approx(2.0)
    # No kink: the slope changes by less than the steepest slope in a hundredth of the run.
    slope = np.diff(arcsec)
    assert np.abs(np.diff(slope)).max() < 0.01 * np.abs(slope).max()


def test_twice_the_seeing_is_three_times_the_variance():
    seeing = SeeingSchedule(start_arcsec=1.0, later=((10.0, 2.0),))
    ratio = seeing.strength(np.array([0.0, 10.0])) ** 2
    np.testing.assert_allclose(ratio, [1.0, 2 ** (5 / 3)])


def test_without_a_schedule_it_never_changes():
    seeing = SeeingSchedule(start_arcsec=0.8)
    assert not seeing.changes
    np.testing.assert_array_equal(seeing.strength(np.array([0.0, 500.0])), 1.0)


def test_two_values_for_one_time_are_refused():
    with pytest.raises(ConfigurationError, match="--seeing-at: found 5 s twice; expected once"):
        SeeingSchedule(start_arcsec=1.0, later=((5.0, 1.0), (5.0, 2.0)))
