"""A dither leaves modes that the loop has come to control, or is weaker for what that adds."""

from dataclasses import replace

import numpy as np
import pytest

from service.control.loop import compute_amplification
from service.tracking.alarms import OVER_BUDGET
from service.tracking.dither_modes import (
    LINE_RANGE,
    choose_modes,
    controlled,
    expected_amplification,
)
from service.tracking.dither_request import DitherParameters, clear_lines, total_m
from service.wire import DitherRequest, DitherStop
from tests.unit.tracking.dithered import DitheredNight
from tests.unit.tracking.situations import N_MODES, POLICY, of_kind, rtc

ALL = replace(POLICY, n_modes_target=N_MODES)
BUDGET_M = POLICY.dither_budget_m


def raised(night, n_controlled):
    """More modes are controlled from now on."""
    night.view = rtc(n_controlled, magnitude=night.view.magnitude)
    return night


def on_the_mirror_m(request, view):
    """RMS that the loop makes of a dither, all lines together, with the gain that adds most."""
    fractions = np.array(request.frequency_hz) / view.frame_rate_hz
    own = np.isin(request.modes, view.in_loop)
    by = compute_amplification(0.4, fractions, leak=view.leak, delay_frames=view.delay_frames)
    return float(np.sqrt(np.sum((np.where(own, by, 1.0) * request.amplitude_m) ** 2)))


def test_free_modes_are_amplified_by_nothing():
    view = rtc(400)
    assert not controlled(choose_modes(view, POLICY), view)
    assert expected_amplification(view, POLICY) == 1.0


def test_modes_of_the_loop_are_amplified_as_its_gain_leak_and_delay_say():
    view = rtc(N_MODES)
    assert controlled(choose_modes(view, ALL), view) == (590, 591, 592, 593)
    strong = replace(view, gains=(0.6,) * N_MODES)
    assert 1.1 < expected_amplification(view, ALL) < expected_amplification(strong, ALL)
    assert expected_amplification(replace(view, loop="open"), ALL) == 1.0


def test_modes_that_come_into_the_loop_are_left_for_free_ones_at_once():
    night = DitheredNight(POLICY).live(20.0)
    first = night.playing.request
    assert min(first.modes) >= POLICY.n_modes_target
    raised(night, max(first.modes) + 1).live(4.0)
    assert "dither.stopped" in night.logged
    assert min(night.requests[-1].modes) > max(first.modes)
    n_asked = len(night.requests)
    night.live(20.0)
    assert len(night.requests) == n_asked, "and it stays there"
    assert not night.alarms


def test_where_none_is_free_the_dither_is_weaker_by_what_the_loop_makes_of_it():
    night = DitheredNight(ALL, n_controlled=400, magnitude=12.0).live(20.0)
    assert total_m(night.playing.request) == pytest.approx(BUDGET_M)
    raised(night, N_MODES).live(60.0)
    request = night.requests[-1]
    assert set(request.modes) <= set(night.view.in_loop)
    assert 0.6 * BUDGET_M < total_m(request) < BUDGET_M
    assert on_the_mirror_m(request, night.view) <= BUDGET_M * (1.0 + 1e-9)
    assert OVER_BUDGET not in night.logged
    assert not night.alarms


def test_a_dither_amplified_by_much_gives_way_to_a_weaker_one_at_once():
    night = DitheredNight(ALL, n_controlled=400, magnitude=12.0).live(20.0)
    view = rtc(N_MODES, magnitude=12.0, gains=(0.6,) * N_MODES)
    night.view = view
    effects = []
    for _ in range(10):
        before = len(night.effects)
        night.live(0.5)
        effects += night.effects[before:]
    assert of_kind(effects, DitherStop)
    assert of_kind(effects, DitherRequest)
    assert on_the_mirror_m(night.requests[-1], view) <= BUDGET_M
    assert not night.alarms


def test_modes_that_the_settings_fix_stay():
    fixed = replace(POLICY, dither_modes=(500, 501, 502, 503))
    night = DitheredNight(fixed).live(20.0)
    n_asked = len(night.requests)
    raised(night, 594).live(10.0)
    assert {request.modes for request in night.requests} == {(500, 501, 502, 503)}
    assert len(night.requests) <= n_asked + 1


def test_the_amplification_is_that_of_a_loop_that_runs():
    leak, gain, n = 0.99, 0.4, 6000
    for fraction in (*LINE_RANGE, 0.211, 0.05):
        dither = np.sin(2 * np.pi * fraction * np.arange(n))
        command, moved = np.zeros(n + 2), np.zeros(n)
        for k in range(n):
            moved[k] = command[k] + dither[k]
            command[k + 2] = leak * command[k + 1] - gain * moved[k]
        line = np.exp(-2j * np.pi * fraction * np.arange(n))[n // 2 :]
        found = abs(line @ moved[n // 2 :]) / abs(line @ dither[n // 2 :])
        expected = compute_amplification(
            np.array(gain), np.array(fraction), leak=leak, delay_frames=2.0
        )
        assert found == pytest.approx(float(expected), rel=0.01)


def informed(blind):
    """Settings of a telescope whose modes all tell as much of α, but for those that are blind."""
    told = np.broadcast_to(np.diag([1.0, 1.0, 4.0, 4.0]), (N_MODES, 4, 4)).copy()
    told[list(blind)] *= 1e-3
    return replace(ALL, mode_information=told)


def test_where_none_is_free_those_that_tell_most_are_dithered_not_the_last():
    """The last modes of a basis are seen badly: the rotation was 27 of its own σ off by them."""
    policy = informed(range(580, N_MODES))
    for n_controlled in (400, N_MODES):
        modes = choose_modes(rtc(n_controlled), policy)
        assert len(modes) == 4
        assert min(modes) >= N_MODES - 100
        assert max(modes) < 580
    assert choose_modes(rtc(400, max_dither_modes=3), policy) == modes[:3]


def test_the_dither_stays_where_it_is_when_its_modes_come_into_the_loop():
    night = DitheredNight(informed(range(580, N_MODES)), n_controlled=400).live(20.0)
    raised(night, N_MODES).live(20.0)
    assert len({request.modes for request in night.requests}) == 1
    assert on_the_mirror_m(night.requests[-1], night.view) <= BUDGET_M * (1.0 + 1e-9)
    assert not night.alarms


def test_the_lines_of_a_faster_loop_are_left_where_a_slower_one_cannot_tell_them():
    """The RTC may come back at another frame rate: binned, for a faint star."""
    last = (169.0, 207.0, 233.0, 265.0)
    asked = DitherParameters(total_m=1e-9, window_s=1.0, n_windows=1, last_hz=last)
    assert clear_lines(rtc(frame_rate_hz=800.0), 4, asked) == last
    slower = clear_lines(rtc(frame_rate_hz=500.0), 4, asked)
    assert 0.2 * 500.0 <= min(slower) < max(slower) <= 0.35 * 500.0
