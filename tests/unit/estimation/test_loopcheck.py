"""Commands off the loop equation, on loops integrated here, frame by frame."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.loopcheck import (
    KEPT_SAMPLES,
    MIN_SAMPLES,
    LoopCheck,
    command_residual,
    last_samples,
    observe,
)
from tests.support.loopcheck import (
    GAINS,
    INVERSE,
    N_CONTROLLED,
    RESPONSE,
    blocks,
    closed_loop,
    terms,
)


def verdict(telemetry, told=None, first_seq=500, **how):
    told = told or terms()
    check = LoopCheck()
    for block in blocks(telemetry, **how):
        check = observe(check, block, told)
    return command_residual(check, told, first_seq, 10**9)[1]


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_a_loop_that_does_what_it_says_obeys_to_rounding(delay):
    found = verdict(closed_loop(delay=delay), terms(float(delay)))
    assert found.holds
    np.testing.assert_allclose(found.share, 1.0, atol=1e-3)


def test_how_telemetry_is_cut_into_blocks_does_not_matter():
    telemetry = closed_loop()
    whole = verdict(telemetry, lengths=(2500,))
    for lengths in [(1,), (2, 3), (7, 50)]:
        np.testing.assert_allclose(verdict(telemetry, lengths=lengths).share, whole.share)


def test_a_dither_is_no_disobedience():
    found = verdict(closed_loop(dither_m=5e-8))
    np.testing.assert_allclose(found.share, 1.0, atol=1e-3)


@pytest.mark.parametrize("lag_frames", [0.15, 0.32, 0.64])
def test_a_mirror_that_lags_obeys(lag_frames):
    """0.32 frames at 1 kHz are a rise of 0.7 ms; 0.64 the same at 2 kHz."""
    found = verdict(closed_loop(lag_frames=lag_frames))
    assert found.holds
    np.testing.assert_allclose(found.share, 1.0, atol=0.07)


def test_a_delay_between_two_frames_is_found_whatever_the_status_says():
    telemetry = closed_loop()
    slopes, commands, _ = telemetry
    late = commands.copy()
    late[1:] = 0.7 * commands[1:] + 0.3 * commands[:-1]
    for said in (2.0, 2.3, 2.9):
        assert verdict((slopes, late, None), terms(said)).holds


@pytest.mark.parametrize("rms_m", [2e-7, 2e-6])
def test_turbulence_played_on_the_mirror_is_no_disobedience(rms_m):
    assert verdict(closed_loop(played_m=rms_m)).holds


@pytest.mark.parametrize("stroke_m", [5e-8, 1.5e-7])
@pytest.mark.parametrize("lag_frames", [0.0, 0.32])
def test_a_saturated_mirror_does_not_obey(stroke_m, lag_frames):
    found = verdict(closed_loop(stroke_m=stroke_m, lag_frames=lag_frames))
    assert found.disobeys.sum() > N_CONTROLLED / 2
    assert np.median(found.share[found.disobeys]) < 0.9
    assert "saturated" in found.text


def test_gains_other_than_the_status_says_are_named_with_their_modes():
    gains = GAINS.copy()
    gains[3:6] = 0.1
    gains[9] = 0.0
    found = verdict(closed_loop(gains=gains))
    assert np.flatnonzero(found.disobeys).tolist() == [3, 4, 5, 9]
    np.testing.assert_allclose(found.share[[3, 4, 5]], 0.25, atol=1e-3)
    assert "4 of 16 modes (3 to 5, 9)" in found.text
    assert "least mode 9: 0.00" in found.text


def test_an_eighth_of_gain_missing_everywhere_is_seen():
    found = verdict(closed_loop(gains=0.875 * GAINS))
    assert found.disobeys.all()
    np.testing.assert_allclose(found.share, 0.875, atol=1e-3)
    assert verdict(closed_loop(gains=0.95 * GAINS)).holds


def test_another_reconstructor_than_the_one_named_is_seen():
    other = np.linalg.pinv(np.roll(RESPONSE, 1, axis=1)[:, :N_CONTROLLED]).astype(np.float32)
    found = verdict(closed_loop(n_frames=1200, matrix=other, gains=0.05 * GAINS), first_seq=0)
    assert found.disobeys.all()


def test_a_delay_that_is_wrong_by_a_frame_too_many_is_seen():
    assert not verdict(closed_loop(), terms(3.0)).holds


def test_a_mode_that_is_asked_for_nothing_is_not_judged():
    gains = GAINS.copy()
    gains[5] = 0.0
    found = verdict(closed_loop(gains=gains), terms(gains=gains))
    assert np.isnan(found.share[5])
    assert found.holds


def test_a_few_frames_judge_nothing():
    telemetry = [part if part is None else part[:300] for part in closed_loop()]
    assert verdict(telemetry, first_seq=0) is None


def test_a_hole_or_another_matrix_costs_samples_only():
    check, told = LoopCheck(), terms()
    for number, block in enumerate(blocks(closed_loop(), (50,))):
        if number % 7:
            check = observe(check, block, told)
    _, found = command_residual(check, told, 0, 10**9, enough=5)
    np.testing.assert_allclose(found.share, 1.0, atol=1e-3)


def test_frames_that_may_be_of_an_older_loop_are_left_out():
    check, told = LoopCheck(from_seq=1000), terms()
    for block in blocks(closed_loop()):
        check = observe(check, block, told)
    check, _ = command_residual(check, told, 0, 10**9)
    first, last = last_samples(check, 10**9)
    assert 1000 <= first < last < 2500
    assert last_samples(check, 1100) is None


def test_the_last_samples_span_a_second():
    check, told = LoopCheck(), terms()
    for block in blocks(closed_loop()):
        check = observe(check, block, told)
    check, _ = command_residual(check, told, 0, 10**9)
    first, last = last_samples(check, 1800)
    assert last <= 1800
    assert last - first == (MIN_SAMPLES - 1) * 50


def test_memory_is_bounded():
    check, told = LoopCheck(), terms(rate_hz=20.0)
    telemetry = closed_loop(n_frames=700)
    for block in blocks(telemetry):
        check = observe(check, block, told)
    assert sum(len(batch.seq) for batch in check.batches) <= KEPT_SAMPLES


def test_frames_of_another_matrix_begin_another_check():
    old, new = terms(), replace(terms(gains=GAINS[:12], matrix=INVERSE[:12]), cm_id="cm-2")
    first, *_ = blocks(closed_loop(), lengths=(300,))  # fewer samples than are multiplied at once
    check = observe(LoopCheck(), first, old)
    for block in blocks(closed_loop(matrix=INVERSE[:12], gains=GAINS[:12]), first=300):
        check = observe(check, replace(block, cm_id="cm-2"), new)
    assert command_residual(check, old, 0, 10**9)[1] is None
    assert command_residual(check, new, 0, 10**9)[1].holds


def opposite(telemetry, told=None, **how):
    """Return what the first frames show if the commands go the opposite way, else None."""
    check = LoopCheck()
    for block in blocks(telemetry, **how):
        check = observe(check, block, told or terms())
    assert check.swap_seq is None, "the first frames have been judged"
    return check.opposite_id


@pytest.mark.parametrize("lengths", [(37, 5, 50, 1, 20), (300,), (1,)])
def test_a_matrix_of_the_wrong_sign_is_found_in_its_first_frames(lengths):
    assert opposite(closed_loop(n_frames=60, matrix=-INVERSE), lengths=lengths) == "cm-1"


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"delay": 3},
        {"lag_frames": 0.64},
        {"played_m": 2e-7},
        {"dither_m": 5e-8},
        {"stroke_m": 5e-9},
        {"gains": 5.0 * GAINS, "stroke_m": 1e-7},
    ],
)
def test_a_mirror_at_its_limits_or_late_goes_the_right_way(how):
    """The last loop diverges by its gains, as the status says, and is at its limits at once."""
    told = terms(float(how.get("delay", 2)), gains=how.get("gains", GAINS))
    assert opposite(closed_loop(n_frames=300, **how), told) is None


def test_each_reconstructor_is_judged_anew_from_its_first_frame():
    check = LoopCheck()
    for block in blocks(closed_loop(n_frames=400)):
        check = observe(check, block, terms())
    assert check.opposite_id is None
    turned = closed_loop(n_frames=60, matrix=-INVERSE, seed=3)
    for block in blocks(turned, first=400):
        named = replace(terms(), cm_id="cm-2")
        check = observe(check, replace(block, cm_id="cm-2"), named)
    assert check.opposite_id == "cm-2"
