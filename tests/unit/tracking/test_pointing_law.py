"""The law of pointing: α moves with it, the filter follows the deviation, slews keep α."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError, UnknownIdError
from service.model.misregistration import Misregistration
from service.model.pointing_law import PointingLaw, Term
from service.records import commands as cmd
from service.records import events as ev
from service.records.registration import Validity
from service.tracking.pointing_law import (
    LEAP_CONFIRMATION_S,
    registration_ahead,
    start_of_fit,
)
from service.tracking.policy import SensorModePolicy
from service.tracking.resume import resumed, saved_of
from service.tracking.validity import law_at
from service.wire import Pointing
from tests.support.situations import ALPHA, POLICY, SECOND, START_NS, Story, estimate, of_kind, rtc
from tests.support.states import tracker_state

LAW = PointingLaw(
    rotation_deg=Term("azimuth - 12.98"), shift_x_subap=Term("elevation", (20.0, 80.0), (0.2, -0.1))
)
WITH_LAW = replace(POLICY, law=LAW)


def at(azimuth_deg, elevation_deg=50.0):
    return Pointing(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg)


def placed(azimuth_deg, elevation_deg=50.0, off=ALPHA):
    """α where the mirror lies off the law by ``off``."""
    nominal = LAW.at({"azimuth": azimuth_deg, "elevation": elevation_deg})
    return Misregistration.from_vector(nominal.vector + off.vector - Misregistration().vector)


class Night(Story):
    """An RTC that tells a pointing, and windows that measure the same deviation."""

    def __init__(self, policy=WITH_LAW, **changes):
        super().__init__(policy=policy, **changes)
        self.seen = None

    def point(self, pointing, after_s=0.2):
        self.now_ns += round(after_s * SECOND)
        self.seen = pointing
        return self.tell(rtc(t_ns=self.now_ns, pointing=pointing))

    def slew(self, azimuth_deg, elevation_deg=50.0, deg_per_s=2.0):
        """Turn there as a telescope does, the status five times a second."""
        while self.seen != at(azimuth_deg, elevation_deg):
            by = np.clip(azimuth_deg - self.seen.azimuth_deg, -0.2 * deg_per_s, 0.2 * deg_per_s)
            up = np.clip(elevation_deg - self.seen.elevation_deg, -0.4, 0.4)
            self.point(at(self.seen.azimuth_deg + by, self.seen.elevation_deg + up))
        return self

    def window(self, alpha, lasts_s=2.0):
        """Have a window fitted that ended just now."""
        fitted = estimate(alpha, t_ns=self.now_ns)
        began_ns = self.now_ns - round(lasts_s * SECOND)
        return self.tell(ev.WindowFitted(estimate=fitted, began_ns_utc=began_ns))

    @property
    def alpha(self):
        return self.state.alpha.registration.alpha

    def report(self, values, after_s=0.2):
        """Have the observatory report values, and the RTC its status."""
        self.now_ns += round(after_s * SECOND)
        for name, value in values.items():
            self.tell(cmd.SetValue(name=name, value=value, for_s=60.0))
        return self.tell(rtc(t_ns=self.now_ns))

    def _text(self, alarm):
        alarm = self.state.alarm(alarm)
        return "" if alarm is None else alarm.text

    @property
    def problem(self):
        return self._text("pointing-law")

    @property
    def leap(self):
        return self._text("law-leap")

    @property
    def known(self):
        return self.state.alpha.registration


@pytest.fixture
def night():
    night = Night().meet(t_ns=START_NS)
    for _ in range(3):
        night.point(at(100.0), after_s=2.0)
        night.window(placed(100.0))
    return night


def test_alpha_is_the_laws_place_and_a_deviation(night):
    assert night.state.alpha.law.nominal == LAW.at({"azimuth": 100.0, "elevation": 50.0})
    assert night.alpha.vector == pytest.approx(placed(100.0).vector)
    assert night.problem == ""


def test_a_slew_keeps_alpha_and_takes_it_along(night):
    """By 60 degrees, and past any slew limit."""
    windows = night.state.alpha.registration.n_windows
    night.slew(160.0, 60.0)
    registration = night.state.alpha.registration
    assert registration.alpha.vector == pytest.approx(placed(160.0, 60.0).vector)
    assert registration.validity.level is not Validity.INVALID
    assert registration.n_windows == windows
    night.point(at(160.0, 60.0), after_s=2.5)
    night.window(placed(160.0, 60.0))
    assert night.state.alpha.registration.suspected_jump is None
    assert night.alpha.vector == pytest.approx(placed(160.0, 60.0).vector)


def test_without_a_law_the_same_slew_makes_alpha_invalid():
    night = Night(policy=POLICY).meet(t_ns=START_NS)
    night.point(at(100.0))
    for _ in range(3):
        night.point(at(100.0), after_s=2.0)
        night.window(ALPHA)
    night.slew(160.0, 60.0)
    night.tell(ev.Tick())
    assert night.state.alpha.registration.validity.level is Validity.INVALID


def test_windows_of_a_turning_field_are_brought_to_the_present_pointing(night):
    """A twelfth of a degree a second, fitted two seconds late: five σ of a window each second."""
    azimuth, night.seen = 100.0, at(100.0)
    innovations = []
    for _ in range(30):
        for _ in range(5):
            azimuth += 0.2 / 12
            night.point(at(azimuth))
        middle = azimuth - 1.0 / 12
        fitted = estimate(placed(middle), t_ns=night.now_ns)
        began_ns = night.now_ns - 2 * SECOND
        for _ in range(10):
            azimuth += 0.2 / 12
            night.point(at(azimuth))
        night.tell(ev.WindowFitted(estimate=fitted, began_ns_utc=began_ns))
        innovations.append(night.state.alpha.history[-1].innovation)
    assert night.alpha.vector == pytest.approx(placed(azimuth).vector, abs=2e-5)
    assert max(innovations) < 1.0
    assert night.state.alpha.registration.suspected_jump is None


def test_a_deviation_is_followed_whatever_the_law_does(night):
    off = replace(ALPHA, rotation_rad=ALPHA.rotation_rad + np.deg2rad(0.02))
    night.slew(130.0)
    for _ in range(20):
        night.point(at(130.0), after_s=2.0)
        night.window(placed(130.0, off=off))
    night.slew(70.0)
    assert night.alpha.vector == pytest.approx(placed(70.0, off=off).vector, abs=3e-5)


def test_the_short_way_is_taken_past_north(night):
    night.slew(179.9)
    turned = np.deg2rad(night.alpha.rotation_rad)
    night.point(at(-179.9))
    assert night.problem == ""
    assert np.rad2deg(night.alpha.rotation_rad) == pytest.approx(180.1 - 12.98 + 0.2)
    assert turned != night.alpha.rotation_rad


def test_the_fit_of_a_window_begins_where_alpha_was_then(night):
    t_ns = night.now_ns
    night.slew(110.0)
    begins = start_of_fit(night.state, night.alpha, t_ns)
    assert begins.vector == pytest.approx(placed(100.0).vector)
    nominal = start_of_fit(night.state, None, t_ns)
    assert nominal == law_at(night.state, t_ns)


def test_a_window_in_which_the_law_moved_too_far_tells_no_one_place(night):
    night.slew(104.0)
    night.window(placed(102.0))
    assert night.state.windows.refusal.text.startswith(
        "the law of pointing moved α inside the window, by +0.000, +0.000 subap, +4.0"
    )
    assert night.state.windows.run >= 0, "it is no fault"


def test_a_law_without_pointing_is_named_with_what_to_do():
    night = Night().meet(t_ns=START_NS)
    assert "PUT /v1/pointing" in night.problem
    assert "PUT /v1/pointing" in night.problem
    night.tell(cmd.SetPointing(elevation_deg=50.0, azimuth_deg=100.0))
    assert night.problem == ""
    assert night.state.alpha.law.nominal is not None


def test_a_value_that_the_law_needs_is_asked_for_by_name():
    law = PointingLaw(rotation_deg=Term("azimuth - 2 * derotator"))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    night.point(at(100.0))
    assert "PUT /v1/values/derotator" in night.problem
    with pytest.raises(UnknownIdError, match="did you mean derotator"):
        night.tell(cmd.SetValue(name="derotador", value=3.0, for_s=60.0))
    with pytest.raises(CommandError, match="expected a number: the law of pointing needs it"):
        night.tell(cmd.SetValue(name="derotator", value="left", for_s=60.0))
    night.tell(cmd.SetValue(name="derotator", value=3.0, for_s=60.0))
    assert night.problem == ""
    assert np.rad2deg(night.state.alpha.law.nominal.rotation_rad) == pytest.approx(94.0)
    night.wait(61.0)
    assert "needs derotator" in night.problem


def test_a_law_that_gives_no_number_is_named():
    law = PointingLaw(magnification=Term("1 / (elevation - 50)"))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    night.point(at(100.0))
    assert "1 / (elevation - 50)" in night.problem


def test_one_pointing_that_leaps_moves_nothing(night):
    before = night.alpha
    night.point(at(10.0))
    assert "azimuth went from 100 to 10" in night.leap
    assert night.alpha == before
    assert night.known.validity.level is Validity.PREDICTED
    night.point(at(100.0))
    assert (night.leap, night.alpha) == ("", before)
    assert night.known.validity.level is Validity.FRESH


def test_a_far_leap_that_lasts_is_taken_and_alpha_predicted(night):
    """No fit begins 90 degrees away: α follows the law before a window has confirmed it."""
    night.point(at(10.0))
    for _ in range(round(LEAP_CONFIRMATION_S / 0.2)):
        night.point(at(10.0))
    assert night.alpha.vector == pytest.approx(placed(10.0).vector)
    assert night.known.validity.level is Validity.PREDICTED
    assert night.state.alpha.dither_due_reason == night.known.doubt != ""
    assert night.leap != ""
    night.point(at(10.0), after_s=3.0)
    night.window(placed(10.0))
    assert (night.leap, night.known.doubt) == ("", "")


def test_a_far_leap_that_was_wrong_is_taken_back(night):
    """The window that is refused where the law leads has the next fit begin where α was."""
    for _ in range(round(LEAP_CONFIRMATION_S / 0.2) + 2):
        night.point(at(10.0))
    night.point(at(10.0), after_s=2.0)
    night.window(placed(55.0))
    assert start_of_fit(night.state, night.alpha, night.now_ns).vector == pytest.approx(
        placed(100.0).vector
    )
    night.point(at(10.0), after_s=2.0)
    night.window(placed(100.0))
    assert (night.leap, night.known.doubt) == ("", "")
    assert night.alpha.vector == pytest.approx(placed(100.0).vector)


def test_a_telescope_that_nobody_asked_for_long_has_not_leapt(night):
    night.point(at(160.0), after_s=60.0)
    assert night.problem == ""
    assert night.alpha.vector == pytest.approx(placed(160.0).vector)


def test_after_a_restart_alpha_is_where_the_law_has_it_now(night):
    saved = saved_of(night.state, night.now_ns)
    fresh = tracker_state(system="flao", mode=night.state.operator.mode)
    again = Night(state=resumed(fresh, saved, WITH_LAW, night.now_ns))
    again.now_ns = night.now_ns
    again.meet(t_ns=again.now_ns, session="s2")
    again.point(at(340.0, 70.0), after_s=60.0)
    found = again.alpha.vector
    expected = placed(340.0, 70.0).vector
    assert found[[0, 1, 3]] == pytest.approx(expected[[0, 1, 3]])
    assert np.cos(found[2] - expected[2]) == pytest.approx(1.0)


def test_shifts_of_the_law_are_in_the_subapertures_of_the_first_mode():
    modes = {
        "fine": SensorModePolicy(subaperture_m=0.2, n_controlled=None),
        "pyramid-30": SensorModePolicy(subaperture_m=0.4, n_controlled=None),
    }
    night = Night(policy=replace(WITH_LAW, sensor_modes=modes)).meet(t_ns=START_NS)
    night.point(at(100.0, 20.0))
    assert night.state.alpha.law.nominal.shift_x_subap == pytest.approx(0.1)


def test_a_law_that_leaps_at_north_does_not_move_alpha():
    """By 0.288 subapertures, while the telescope turns by 0.7 deg: no matrix is made for it."""
    law = PointingLaw(shift_x_subap=Term("0.0008 * azimuth"))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    for _ in range(3):
        night.point(at(359.6), after_s=2.0)
        night.window(law.at({"azimuth": 359.6, "elevation": 50.0}))
    before = night.alpha.shift_x_subap
    night.point(at(0.3))
    assert night.alpha.shift_x_subap == pytest.approx(before)
    assert "azimuth went from 359.6 to 0.3" in night.leap
    assert night.known.doubt


def test_a_law_of_the_pointing_may_move_as_fast_as_the_telescope(night):
    """Three degrees of azimuth in one status: the rotation follows at once."""
    night.point(at(103.0))
    assert night.problem == ""
    assert night.alpha.vector == pytest.approx(placed(103.0).vector)


def wrapping(shift_subap, rotation_deg):
    """A derotator whose table does not close, at half of each step before it wraps."""
    table = [
        Term("derotator", (-180.0, 180.0), (-s / 2, s / 2)) for s in (shift_subap, rotation_deg)
    ]
    law = PointingLaw(shift_x_subap=table[0], rotation_deg=table[1])
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    for angle in (179.4, 179.6, 179.8):
        night.report({"derotator": angle}, after_s=2.0)
        night.window(ALPHA)
    return night


LEAPS = [(0.24, 0.0), (0.48, 2.8), (0.0, 2.88), (0.1, 0.0), (1.0, 3.0), (0.0, 0.5), (-0.7, 1.5)]


@pytest.mark.parametrize(("shift_subap", "rotation_deg"), LEAPS)
@pytest.mark.parametrize("follows", [False, True], ids=["stays", "follows"])
def test_a_value_that_wraps_moves_alpha_only_by_a_window(shift_subap, rotation_deg, follows):
    night = wrapping(shift_subap, rotation_deg)
    before = night.alpha
    night.effects.clear()
    night.report({"derotator": -179.8})
    assert "derotator went from 179.8 to -179.8" in night.leap
    assert night.known.validity.level is Validity.PREDICTED
    assert night.alpha.vector == pytest.approx(before.vector, abs=1e-3)
    night.make("cm-7")
    for _ in range(5):
        night.report({"derotator": -179.8}, after_s=1.0)
    assert of_kind(night.effects, ev.MakeMatrix | ev.SendMatrix) == []
    step = np.array([-shift_subap, 0.0, -np.deg2rad(rotation_deg), 0.0])
    there = before.add_step(step) if follows else before
    night.window(there)
    assert (night.leap, night.known.doubt) == ("", "")
    assert night.alpha.vector == pytest.approx(there.vector, abs=3e-3)


def test_a_value_that_wraps_to_and_fro_teaches_no_motion():
    night = wrapping(0.24, 0.0)
    before = night.alpha
    for angle in (-179.9, 179.9) * 4:
        night.report({"derotator": angle})
        assert night.alpha.vector == pytest.approx(before.vector, abs=1e-3)
        assert bool(night.leap) is (angle < 0.0)


def test_nothing_is_made_by_order_from_a_predicted_alpha():
    night = wrapping(0.0, 2.88)
    night.report({"derotator": -179.8})
    night.make("cm-7")
    with pytest.raises(CommandError, match="α is predicted"):
        night.tell(cmd.Refit())
    with pytest.raises(CommandError, match="α is predicted"):
        night.tell(cmd.Approve(id="cm-7"))


def test_a_pointing_that_is_reported_wrong_is_undone_by_a_window(night):
    """By less than a telescope turns in a second: α follows, and nothing is made from it."""
    before = night.alpha
    night.tell(cmd.SetPointing(elevation_deg=50.0, azimuth_deg=102.0))
    assert "azimuth went from 100 to 102" in night.leap
    assert night.known.validity.level is Validity.PREDICTED
    night.tell(rtc(t_ns=night.now_ns), after_s=3.0)
    night.tell(rtc(t_ns=night.now_ns))
    night.window(before)
    assert (night.leap, night.known.doubt) == ("", "")
    assert night.alpha.vector == pytest.approx(before.vector, abs=3e-3)


def test_a_table_with_a_period_that_closes_does_not_leap():
    term = Term("derotator", (-180.0, -90.0, 90.0), (0.0, -0.2, 0.2), 360.0)
    night = Night(policy=replace(POLICY, law=PointingLaw(shift_x_subap=term))).meet(t_ns=START_NS)
    for angle in (179.4, 179.6, 179.8, -180.0, -179.8):
        night.report({"derotator": angle}, after_s=2.0)
        night.window(ALPHA)
        assert night.leap == ""


@pytest.mark.parametrize("rate_hz", [0.2, 1.0, 5.0])
@pytest.mark.parametrize("deg_per_s", [0.1, 1.0, 3.0])
def test_a_derotator_that_turns_is_followed(deg_per_s, rate_hz):
    """From rest to full speed at once: after the second report nothing is in doubt."""
    law = PointingLaw(rotation_deg=Term("derotator"))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    for _ in range(3):
        night.report({"derotator": 0.0}, after_s=2.0)
        night.window(ALPHA)
    before, doubted = night.alpha.rotation_rad, 0
    for k in range(1, 13):
        night.report({"derotator": k * deg_per_s / rate_hz}, after_s=1.0 / rate_hz)
        doubted += bool(night.known.doubt)
    turned = np.deg2rad(12 * deg_per_s / rate_hz)
    assert doubted <= (1 if deg_per_s / rate_hz <= 3.0 else 12)
    assert night.alpha.rotation_rad == pytest.approx(before + turned)


def test_a_step_of_a_table_is_no_motion_though_two_reports_cross_it():
    law = PointingLaw(rotation_deg=Term("derotator", (-0.01, 0.01), (0.0, 1.5)))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    for angle in (-0.03, -0.02, -0.01):
        night.report({"derotator": angle}, after_s=2.0)
        night.window(ALPHA)
    before = night.alpha
    for angle in (0.0, 0.01, 0.02, 0.03):
        night.report({"derotator": angle})
        assert night.known.validity.level is Validity.PREDICTED
        assert night.alpha.vector == pytest.approx(before.vector)
    night.report({"derotator": 0.04}, after_s=3.0)
    night.window(before.add_step(np.array([0.0, 0.0, np.deg2rad(1.5), 0.0])))
    assert night.known.doubt == ""
    assert np.rad2deg(night.alpha.rotation_rad - before.rotation_rad) == pytest.approx(1.5)


def test_a_value_that_comes_once_an_hour_is_confirmed_first():
    """α has followed the mirror by windows meanwhile: it must not be moved a second time."""
    law = PointingLaw(shift_x_subap=Term("0.02 * temperature"))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    night.report({"temperature": 10.0})
    for _ in range(3):
        night.now_ns += 2 * SECOND
        night.window(ALPHA)
    night.wait(100.0)
    night.now_ns += 3500 * SECOND
    night.report({"temperature": 4.0})
    assert "temperature went from 10 to 4" in night.leap
    night.report({"temperature": 4.0}, after_s=3.0)
    night.window(ALPHA)
    assert (night.leap, night.known.doubt) == ("", "")
    assert night.alpha.shift_x_subap == pytest.approx(ALPHA.shift_x_subap, abs=3e-3)


def test_a_matrix_is_not_made_ahead_of_a_single_step():
    law = PointingLaw(shift_x_subap=Term("0.02 * temperature"))
    night = Night(policy=replace(POLICY, law=law)).meet(t_ns=START_NS)
    for _ in range(3):
        night.report({"temperature": 10.0}, after_s=2.0)
        night.window(ALPHA)
    night.report({"temperature": 11.0})
    assert night.leap == ""
    assert registration_ahead(night.state, night.known).alpha == night.alpha
    for k in range(1, 21):
        night.report({"temperature": 11.0 + 0.02 * k})
    ahead = registration_ahead(night.state, night.known).alpha
    # Half a second of the path is one straight piece.
    assert ahead.shift_x_subap - night.alpha.shift_x_subap == pytest.approx(0.012, abs=0.0015)


def test_after_a_restart_a_window_decides_whether_the_law_was_right():
    """The derotator has wrapped meanwhile: α is 2.8 deg off until the first window."""
    night = wrapping(0.48, 2.8)
    saved = saved_of(night.state, night.now_ns)
    fresh = tracker_state(system="flao", mode=night.state.operator.mode)
    again = Night(policy=night.policy, state=resumed(fresh, saved, night.policy, night.now_ns))
    again.now_ns = night.now_ns
    again.meet(t_ns=again.now_ns, session="s2")
    again.seen = None
    again.report({"derotator": -179.8}, after_s=60.0)
    assert again.known.validity.level is Validity.PREDICTED
    again.tell(rtc(t_ns=again.now_ns, session="s2"))
    for _ in range(2):
        again.now_ns += 3 * SECOND
        again.tell(rtc(t_ns=again.now_ns, session="s2"))
        fitted = estimate(ALPHA, t_ns=again.now_ns, session="s2")
        again.tell(ev.WindowFitted(estimate=fitted, began_ns_utc=again.now_ns - 2 * SECOND))
    assert again.known.n_windows == 2
    assert again.alpha.vector == pytest.approx(ALPHA.vector, abs=3e-3)
