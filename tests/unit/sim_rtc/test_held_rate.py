"""The rate that a machine holds."""

import pytest

from service.instrument import load_instrument
from sim_rtc.assembly import at_held_rate
from sim_rtc.held_rate import RATES_HZ, SHARE, frame_s, held_rate_hz
from sim_rtc.options import parse_options


@pytest.mark.parametrize(
    ("one_frame_s", "rate_hz"),
    [(1e-5, 1000.0), (SHARE / 1000.0, 1000.0), (SHARE / 700.0, 500.0), (SHARE / 60.0, 50.0)],
)
def test_it_is_the_highest_at_which_frames_leave_enough_of_the_clock(one_frame_s, rate_hz):
    assert held_rate_hz(1000.0, one_frame_s) == rate_hz


def test_no_more_is_run_than_was_asked_for_and_never_less_than_the_least():
    assert held_rate_hz(430.0, 1e-5) == 430.0
    assert held_rate_hz(430.0, SHARE / 410.0) == 400.0
    assert held_rate_hz(1000.0, 10.0) == RATES_HZ[-1]


def test_a_larger_telescope_takes_longer():
    assert frame_s(4000, 1200, 1000, 1000.0) > 2.0 * frame_s(200, 60, 50, 1000.0)


def test_the_simulator_takes_the_rate_over(monkeypatch):
    monkeypatch.setattr("sim_rtc.assembly.frame_s", lambda *_: SHARE / 600.0)
    options = parse_options(["--instrument", "soul-lbt", "--held-rate"])
    assert at_held_rate(options, load_instrument("soul-lbt")).frame_rate_hz == 500.0


def test_below_what_a_dither_needs_the_loop_keeps_its_rate_in_slow_motion(monkeypatch):
    monkeypatch.setattr("sim_rtc.assembly.frame_s", lambda *_: SHARE / 120.0)
    options = parse_options(["--instrument", "soul-lbt", "--rate", "500", "--held-rate"])
    held = at_held_rate(options, load_instrument("soul-lbt"))
    assert (held.frame_rate_hz, held.speed) == (500.0, pytest.approx(0.24))


def test_one_who_asks_for_a_low_rate_gets_it(monkeypatch):
    monkeypatch.setattr("sim_rtc.assembly.frame_s", lambda *_: SHARE / 120.0)
    options = parse_options(["--instrument", "soul-lbt", "--rate", "100", "--held-rate"])
    held = at_held_rate(options, load_instrument("soul-lbt"))
    assert (held.frame_rate_hz, held.speed) == (100.0, 1.0)
