"""What the frames hold of a dither: strength, modes and lines, by the columns alone."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.dither_monitor import DitherMonitor, measure_block
from service.estimation.frames import FrameBlock
from service.estimation.windows import ExpectedDither

RATE_HZ = 1000.0
N_MODES = 12
ASKED = ExpectedDither(
    modes=(8, 9, 10, 11),
    amplitude_m=(4e-9,) * 4,
    frequency_hz=(211.0, 239.0, 283.0, 331.0),
    frame_rate_hz=RATE_HZ,
    first_seq=1000,
    stop_seq=21_000,
    own=(True,) * 4,
)
SIGNS = replace(ASKED, frequency_hz=())


def columns(first_seq, n, *, asked=ASKED, by=1.0, shift_hz=0.0, modes=None):
    out = np.zeros((n, N_MODES))
    seq = first_seq + np.arange(n)
    lines = asked.frequency_hz or (None,) * len(asked.modes)
    for mode, amplitude, line in zip(modes or asked.modes, asked.amplitude_m, lines, strict=True):
        if line is None:
            wave = np.random.default_rng([mode, first_seq]).choice([-1.0, 1.0], n)
        else:
            turns = (line + shift_hz) * (seq - asked.first_seq) / RATE_HZ
            wave = np.sqrt(2.0) * np.sin(2 * np.pi * turns)
        out[:, mode] = by * amplitude * wave
    return out


def played(dither, *, asked=ASKED, commands=None, slopes=None, seconds=1):
    monitor, found = DitherMonitor(asked=asked), []
    for k in range(20 * seconds):
        first_seq, n = asked.first_seq + 50 * k, 50
        held = dither(first_seq, n).astype(np.float32)
        moved = held if commands is None else commands(first_seq, n).astype(np.float32)
        block = FrameBlock(
            session="s1",
            first_seq=first_seq,
            t0_ns_utc=first_seq * 1_000_000,
            dt_ns=1_000_000,
            slopes=np.zeros((n, 4), np.float32) if slopes is None else slopes(held),
            commands_m=moved,
            dither_m=held,
            cm_id="initial",
        )
        monitor, new = measure_block(monitor, block)
        found += [] if new is None else [new]
    return found


@pytest.mark.parametrize("asked", [ASKED, SIGNS], ids=["sines", "signs"])
def test_what_is_as_it_was_asked_for_is_said_once_a_second_with_its_strength(asked):
    found = played(lambda s, n: columns(s, n, asked=asked), asked=asked, seconds=3)
    assert len(found) == 3
    assert all(one.text == "" for one in found)
    assert found[0].found_m == pytest.approx(8e-9, rel=0.01)
    assert found[0].asked_m == pytest.approx(8e-9)


@pytest.mark.parametrize("asked", [ASKED, SIGNS], ids=["sines", "signs"])
def test_twenty_times_too_strong_is_told_with_found_and_asked(asked):
    (found,) = played(lambda s, n: columns(s, n, asked=asked, by=20.0), asked=asked)
    assert found.found_m == pytest.approx(160e-9, rel=0.01)
    assert "160 nm RMS" in found.text
    assert " 8 nm: " in found.text
    assert "mode 8 carries 80 nm instead of 4 nm" in found.text


def test_much_weaker_is_told():
    (found,) = played(lambda s, n: columns(s, n, by=0.1))
    assert "mode 9 carries 0.4 nm instead of 4 nm" in found.text


def test_a_tenth_more_or_a_third_less_is_a_mirror_that_clips_and_no_news():
    for by in (0.66, 1.1):
        (found,) = played(lambda s, n, by=by: columns(s, n, by=by))
        assert found.text == ""


def test_other_modes_are_named():
    (found,) = played(lambda s, n: columns(s, n, modes=(0, 1, 2, 3)))
    assert "carry 8 nm, above all 0 to 3" in found.text
    assert "mode 8 carries 0 nm instead of 4 nm" in found.text


def test_other_lines_are_named():
    (found,) = played(lambda s, n: columns(s, n, shift_hz=20.0))
    assert "mode 10 moves at another frequency than 283 Hz" in found.text


def test_a_mode_outside_the_loop_that_moves_more_than_its_column_says_is_named_and_counted():
    (found,) = played(columns, commands=lambda s, n: columns(s, n, by=20.0))
    assert "the commands of mode 11 hold 80 nm at 331 Hz, its dither column 4 nm" in found.text
    assert found.found_m == pytest.approx(160e-9, rel=0.01)


def test_commands_that_lack_the_dither_are_named():
    """And not taken for slopes of another sign or unit."""
    (found,) = played(columns, commands=lambda s, n: np.zeros((n, N_MODES)))
    assert "the commands of mode 11 hold 0 nm at 331 Hz, its dither column 4 nm" in found.text


def test_a_mode_of_the_loop_may_answer_the_dither():
    asked = replace(ASKED, own=(False,) * 4)
    (found,) = played(columns, asked=asked, commands=lambda s, n: columns(s, n, by=3.0))
    assert found.text == ""
    assert found.found_m == pytest.approx(8e-9, rel=0.01)


def test_columns_of_zeros_before_it_begins_are_none_of_it():
    assert not played(lambda s, n: np.zeros((n, N_MODES)))


def test_slow_turbulence_played_on_the_mirror_is_no_dither():
    def moved(first_seq, n):
        slow = 3e-7 * np.sin(2 * np.pi * 0.7 * (first_seq + np.arange(n)) / RATE_HZ)
        return columns(first_seq, n) + slow[:, None]

    (found,) = played(columns, commands=moved)
    assert found.text == ""


SENSOR = 1e6 * np.random.default_rng(1).standard_normal((N_MODES, 40)).astype(np.float32)
ANSWERED = replace(ASKED, response=tuple(np.sum(SENSOR[8:] ** 2, axis=1).tolist()))


def answered(gain, noise, *, asked=ANSWERED):
    rng = np.random.default_rng(5)

    def slopes(held):
        made = gain * held @ SENSOR + noise * rng.standard_normal((len(held), 40))
        return made.astype(np.float32)

    (found,) = played(columns, asked=asked, slopes=slopes)
    return found.unanswered


def test_slopes_that_answer_and_slopes_that_do_not_are_told_apart():
    assert answered(1.0, 1e-3) == ""
    assert answered(0.3, 1e-3) == "", "an optical gain of bad seeing"
    assert "modes 8, 9, 10, 11 should put on their lines" in answered(0.0, 1e-3)
    assert answered(0.0, 1e-3).startswith("the slopes hold 0.0 ±")


def test_too_little_light_says_neither():
    assert answered(0.0, 0.1) is None
    assert answered(1.0, 0.5) is None


def test_frozen_slopes_and_an_unknown_response_ratio_tell_nothing_of_the_mirror():
    assert answered(0.0, 0.0) is None
    assert answered(0.0, 1e-3, asked=ASKED) is None
