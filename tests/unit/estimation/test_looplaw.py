"""What frames say of leak, gain and delay, on loops integrated in the tests of the loop check."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.control_law import KEPT_FRAMES, ControlLawCheck, follow, judge_frames
from tests.support.loopcheck import GAINS, INVERSE, blocks, closed_loop, terms


def found(telemetry, told=None, *, keep=lambda block: True, **how):
    told, law = told or terms(), ControlLawCheck()
    for block in blocks(telemetry, **how):
        if keep(block):
            law = follow(law, block, told)
    return judge_frames(law, told, 10**9)[1]


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_a_loop_that_does_what_it_says_is_found_to_the_third_digit(delay):
    law = found(closed_loop(delay=delay), terms(float(delay)))
    assert not law.wrong
    assert law.leak == pytest.approx(0.995, abs=5e-4)
    assert law.gain == pytest.approx(1.0, abs=5e-3)
    assert law.delay_frames == pytest.approx(delay, abs=0.01)


@pytest.mark.parametrize("told", [0.9, 0.98, 0.9999])
def test_another_leak_than_told_is_named_with_both(told):
    law = found(closed_loop(), replace(terms(), leak=told))
    assert law.wrong == f"leak 0.995 found, {told:.3f} in the status"


@pytest.mark.parametrize("told", [1.0, 3.0, 4.0])
def test_another_delay_than_told_is_named_with_both(told):
    law = found(closed_loop(), terms(told))
    assert law.wrong == f"delay 2.00 frames found, {told:.2f} in the status"


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.25, 2.0])
def test_another_gain_than_told_is_named(factor):
    law = found(closed_loop(), terms(gains=GAINS / np.float32(factor)))
    assert law.wrong == f"gain {factor:.3g} times the one in the status"


def test_slopes_that_are_sent_with_the_other_sign_are_named():
    slopes, commands, dither = closed_loop()
    assert "the other sign" in found((-slopes, commands, dither)).wrong


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nanometres"), (1e6, "micrometres")])
def test_commands_in_another_unit_than_the_matrix_are_named(factor, unit):
    slopes, commands, _ = closed_loop()
    assert f"commands look like {unit}" in found((slopes, commands * factor, None)).wrong


@pytest.mark.parametrize("lag_frames", [0.15, 0.32, 0.64])
def test_a_mirror_that_lags_is_as_told(lag_frames):
    assert not found(closed_loop(lag_frames=lag_frames)).wrong


def test_a_delay_between_two_frames_is_found():
    slopes, commands, _ = closed_loop()
    late = commands.copy()
    late[1:] = 0.6 * commands[1:] + 0.4 * commands[:-1]
    law = found((slopes, late, None), terms(2.4))
    assert not law.wrong
    assert law.delay_frames == pytest.approx(2.4, abs=0.02)


def test_gains_that_follow_the_seeing_are_as_told():
    slopes, commands, dither = closed_loop(gains=GAINS * np.float32(1.05))
    assert not found((slopes, commands, dither)).wrong


def test_modes_whose_gain_is_0_say_nothing():
    gains = GAINS.copy()
    gains[5:] = 0.0
    assert not found(closed_loop(gains=gains), terms(gains=gains)).wrong


def test_a_dither_and_a_standing_offset_are_no_part_of_the_law():
    slopes, commands, dither = closed_loop(dither_m=5e-8)
    law = found((slopes, commands + np.float32(3e-7), dither))
    assert not law.wrong
    assert law.leak == pytest.approx(0.995, abs=1e-3)


def test_lost_frames_are_left_out():
    telemetry = closed_loop(n_frames=4000)
    law = found(telemetry, lengths=(20,), keep=lambda block: block.first_seq % 400 != 100)
    assert not law.wrong
    assert law.leak == pytest.approx(0.995, abs=5e-4)


@pytest.mark.parametrize(
    "trouble",
    [
        {"played_m": 2e-7},
        {"stroke_m": 3e-8},
        {"matrix": np.roll(INVERSE, 3, axis=1)},
    ],
    ids=["turbulence-played", "saturated", "another-matrix"],
)
def test_where_commands_do_not_follow_from_slopes_nothing_is_said(trouble):
    law = found(closed_loop(**trouble))
    assert law is None


@pytest.mark.parametrize("stroke_m", [1e-7, 2e-7, 3e-7, 4e-7, 6e-7])
def test_a_mirror_that_clips_now_and_then_is_no_other_leak(stroke_m):
    law = found(closed_loop(stroke_m=stroke_m))
    assert law is None or not law.wrong


def test_frames_of_another_matrix_are_forgotten():
    telemetry, told, law = closed_loop(), terms(), ControlLawCheck()
    for block in blocks(telemetry):
        law = follow(law, block, told)
    law = follow(law, replace(block, cm_id="cm-2"), replace(told, cm_id="cm-2"))
    assert len(law.seq) == block.n_frames
    assert len(law.seq) < KEPT_FRAMES
    assert judge_frames(law, told, 10**9)[1] is None


def test_a_verdict_is_given_on_new_frames_only():
    told, law = terms(), ControlLawCheck()
    for block in blocks(closed_loop()):
        law = follow(law, block, told)
    law, first = judge_frames(law, told, 2499)
    assert first is not None
    assert judge_frames(law, told, 2499)[1] is None


def test_frames_that_no_verdict_will_look_at_are_left_out_and_it_is_the_same():
    told, every, some, left_out = terms(), ControlLawCheck(), ControlLawCheck(), 0
    for block in blocks(closed_loop()):
        every, before = follow(every, block, told), some
        some = follow(some, block, told)
        left_out += block.n_frames if some is before else 0
        if block.first_seq < 600:
            some = replace(some, judged_seq=1900)
    assert left_out > 700
    every = replace(every, judged_seq=1900)
    assert judge_frames(some, told, 10**9)[1] == judge_frames(every, told, 10**9)[1]
