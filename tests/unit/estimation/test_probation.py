"""Is the loop worse with a matrix than with the one before?"""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy

from service.estimation import probation
from service.estimation.comparison import PRIOR_SCATTER, measure_sigma
from service.estimation.estimator import Change, LoopContext
from service.estimation.frames import FrameBlock
from service.estimation.probation import MAX_PROBATION_S, Comparison, observe, restart
from service.records.operations import Verdict

N_MODES, BLOCK, DT_NS = 60, 50, 1_000_000
BEFORE_S, AFTER_S = 2.0, 4.5
LINE_HZ = (205.0, 293.0)


def residual(rng, seconds, *, ring=None):
    """What the loop sees: white noise in front of slow turbulence; some modes may ring.

    ``ring`` is pole radius, turns a frame and modes.
    """
    n_frames = round(seconds * 1e9 / DT_NS)
    noise = rng.normal(size=(n_frames, N_MODES)) * np.linspace(1.0, 2.0, N_MODES)
    slow = scipy.signal.lfilter([1.0], [1.0, -0.98], rng.normal(size=noise.shape), axis=0)
    seen = noise + slow * np.linspace(1.0, 0.05, N_MODES)
    if ring is not None:
        radius, turns, modes = ring
        denominator = [1.0, -2.0 * radius * np.cos(2.0 * np.pi * turns), radius**2]
        seen[:, modes] += scipy.signal.lfilter([0.15], denominator, noise[:, modes], axis=0)
    return 1e-9 * seen


def blocks(parts, dither=None):
    """Blocks of telemetry of matrices one after the other, each with its residual."""
    commands = -0.5 * np.cumsum(np.concatenate([part for _, part in parts]), axis=0)
    ids = np.repeat([name for name, _ in parts], [len(part) for _, part in parts])
    played = np.zeros_like(commands) if dither is None else dither
    for k in range(0, len(commands), BLOCK):
        some = slice(k, k + BLOCK)
        yield FrameBlock(
            session="s",
            first_seq=k,
            t0_ns_utc=k * DT_NS,
            dt_ns=DT_NS,
            slopes=np.float32(np.diff(commands, axis=0, prepend=commands[:1])[some, ::4]),
            commands_m=np.float32(commands + played)[some],
            dither_m=np.float32(played[some]) if played[some].any() else None,
            cm_id=str(ids[k]),
        )


def judged(parts, modes=N_MODES, lines=(), dither=None):
    state = Comparison()
    for block in blocks(parts, dither):
        state = observe(state, block, np.arange(modes), lines)
        if state.found is not None:
            break
    return state.found


def test_good_matrices_in_changing_seeing_pass():
    """Seeing doubles the noise and triples the turbulence of some, or the other way round."""
    rng, verdicts = np.random.default_rng(1), []
    for k in range(8):
        seeing = np.linspace(1.0, 1.5, round(AFTER_S * 1000))[:, None]
        after = residual(rng, AFTER_S) * (seeing if k % 2 else 1.0 / seeing)
        found = judged([("a", residual(rng, BEFORE_S)), ("b", after)])
        verdicts.append(found.verdict)
    assert verdicts == [Verdict.AS_GOOD] * 8


@pytest.mark.parametrize("turns", [0.05, 0.1, 0.15])
def test_a_few_modes_at_the_edge_of_stability_are_found(turns):
    rng = np.random.default_rng(2)
    after = residual(rng, AFTER_S, ring=(0.99, turns, slice(40, 44)))
    found = judged([("a", residual(rng, BEFORE_S)), ("b", after)])
    assert found.verdict is Verdict.WORSE
    assert 40 <= found.mode < 44
    assert found.after_s <= MAX_PROBATION_S
    assert found.common_ratio == pytest.approx(1.0, abs=0.1)
    assert re.fullmatch(
        rf"mode {found.mode} moves [\d.]+ times as much, against all modes, as with a "
        rf"\({found.limit:.2f} is too much\)",
        found.text,
    )


def test_all_modes_running_away_together_are_found_at_once():
    rng = np.random.default_rng(3)
    grown = np.exp(np.linspace(0.0, 20.0, 1000))[:, None]
    found = judged([("a", residual(rng, BEFORE_S)), ("b", residual(rng, 1.0) * grown)])
    assert found.verdict is Verdict.WORSE
    assert found.after_s <= 0.4
    assert len(found.text) < 110


def test_a_matrix_after_a_bad_one_is_not_blamed_for_what_has_become_calm():
    rng = np.random.default_rng(4)
    bad = residual(rng, BEFORE_S, ring=(0.99, 0.08, slice(10, 50)))
    assert judged([("a", bad), ("b", residual(rng, AFTER_S))]).verdict is Verdict.AS_GOOD


def test_a_good_matrix_passes_at_the_decision_and_no_sooner():
    rng = np.random.default_rng(5)
    found = judged([("a", residual(rng, BEFORE_S)), ("b", residual(rng, AFTER_S))])
    assert MAX_PROBATION_S - 0.15 < found.after_s <= MAX_PROBATION_S
    assert found.text.startswith("as good: at most, ")
    assert len(found.text) < 110


@pytest.mark.parametrize("first", [True, False])
def test_a_dither_that_begins_or_ends_with_the_swap_does_not_count(first):
    """Its lines stand in every mode, above all noise; two modes outside the loop play it."""
    rng = np.random.default_rng(6)
    before, after = residual(rng, BEFORE_S), residual(rng, AFTER_S)
    t = np.arange(len(before) + len(after)) * 1e-9 * DT_NS
    plays = (t < BEFORE_S) if first else (t >= BEFORE_S)
    tone = (np.sin(2.0 * np.pi * np.outer(t, LINE_HZ)) * plays[:, None]).sum(axis=1)
    seen = 6e-9 * tone[:, None] * np.linspace(0.0, 1.0, N_MODES)
    dither = np.zeros((len(t), N_MODES))
    dither[:, -2:] = 2e-8 * tone[:, None]
    parts = [("a", before + seen[: len(before)]), ("b", after + seen[len(before) :])]
    assert judged(parts, N_MODES - 2, LINE_HZ, dither).verdict is Verdict.AS_GOOD
    assert judged(parts, N_MODES - 2, (), None).verdict is (
        Verdict.AS_GOOD if first else Verdict.WORSE
    ), "the lines do count where nobody tells of them: the test would show it"


def test_a_night_of_many_dithers_keeps_the_sines_of_a_few():
    """Each dither has other lines."""
    played = np.zeros((400, N_MODES))
    played[:, -1] = 1e-9
    for k in range(4 * probation.N_SINE_BASES):
        lines = (205.0 + k, 293.0)
        judged([("a", residual(np.random.default_rng(1), 0.4))], N_MODES - 2, lines, played)
    assert probation._sines.cache_info().currsize <= probation.N_SINE_BASES


def test_new_references_are_no_swap_and_the_frames_in_which_the_loop_follows_do_not_count():
    """0.03 s of a residual ten times as large, in one part, would be no chance."""
    rng = np.random.default_rng(7)
    state = Comparison()
    for block in blocks([("a", residual(rng, BEFORE_S))]):
        state = observe(state, block, np.arange(N_MODES))
    parts = state.parts
    state = state.restart(LoopContext(description=None), Change.REFERENCES)
    (follows, after) = blocks([("a", 10.0 * residual(rng, 0.03))]), residual(rng, 0.5)
    for block in follows:
        state = observe(state, block, np.arange(N_MODES))
    assert (state.parts, state.found) == (parts, None)
    for block in blocks([("a", after)]):
        state = observe(state, block, np.arange(N_MODES))
    assert len(state.parts) > len(parts)


def test_without_enough_before_nothing_is_said():
    rng = np.random.default_rng(7)
    found = judged([("a", residual(rng, 0.5)), ("b", residual(rng, 1.0))])
    assert found.verdict is Verdict.UNKNOWN
    assert "only 0.5 s of telemetry with a" in found.text


def test_another_loop_ends_a_comparison_without_a_verdict():
    rng, state = np.random.default_rng(8), Comparison()
    for block in blocks([("a", residual(rng, BEFORE_S)), ("b", residual(rng, 1.0))]):
        state = observe(state, block, np.arange(N_MODES))
    assert state.before is not None
    state = restart(state, "the gains changed")
    assert (state.found.verdict, state.found.text) == (Verdict.UNKNOWN, "the gains changed")
    assert state.before is None
    assert not state.parts


def test_modes_that_only_one_of_them_controls_do_not_count():
    rng = np.random.default_rng(9)
    before, after = residual(rng, BEFORE_S), residual(rng, AFTER_S)
    before[:, 50:] *= 1e-3
    state = Comparison()
    for block in blocks([("a", before), ("b", after)]):
        state = observe(state, block, np.arange(50 if block.cm_id == "a" else N_MODES))
    assert state.found.verdict is Verdict.AS_GOOD
    assert state.found.mode < 50


def test_a_burst_in_one_mode_right_after_the_swap_is_turbulence():
    """FLAO, 400 modes: one of them moved 1.65 times as much in the first tenth of a second."""
    rng = np.random.default_rng(8)
    after = residual(rng, AFTER_S)
    after[30:130, 35] *= 3.0
    found = judged([("a", residual(rng, BEFORE_S)), ("b", after)])
    assert found.verdict is Verdict.AS_GOOD
    assert found.text.endswith("did not last") == (found.mode_ratio > found.limit)


def test_a_swap_right_after_a_block_of_a_few_frames_is_compared():
    rng, state, n_before = np.random.default_rng(10), Comparison(), round(BEFORE_S * 1000)
    parts = [("a", residual(rng, BEFORE_S)), ("b", residual(rng, AFTER_S))]
    for block in blocks(parts):
        last = block.first_seq + BLOCK == n_before
        for piece in (block.rows(0, BLOCK - 3), block.rows(BLOCK - 3, BLOCK)) if last else (block,):
            state = observe(state, piece, np.arange(N_MODES))
    assert state.found is not None
    assert state.found.verdict is Verdict.AS_GOOD


@pytest.mark.parametrize("begins_s", [0.0, 0.8, 1.7, 3.2])
@pytest.mark.parametrize("modes", [slice(0, 2), slice(None)])
def test_a_gust_of_one_second_is_not_the_matrix_s_doing(begins_s, modes):
    """Twice the RMS in all modes, or a vibration of four times in two: turbulence does that."""
    rng = np.random.default_rng(11)
    after = residual(rng, AFTER_S)
    some = slice(round(begins_s * 1000), round(begins_s * 1000) + 1000)
    after[some, modes] *= 2.0 if modes == slice(None) else 4.0
    found = judged([("a", residual(rng, 4.0)), ("b", after)])
    assert found.verdict is Verdict.AS_GOOD, found.text
    assert found.after_s > MAX_PROBATION_S - 0.15


def test_noise_that_is_correlated_for_several_groups_counts_more():
    rng = np.random.default_rng(12)
    white = rng.normal(size=(20, 200))
    slow = scipy.signal.lfilter([0.6], [1.0, -0.8], rng.normal(size=(400, 200)), axis=0)[-20:]
    assert measure_sigma(white, 0.0) == pytest.approx(1.0, rel=0.1)
    assert measure_sigma(slow, 0.0) > 1.15 * measure_sigma(rng.permuted(slow, axis=0), 0.0)


def test_before_noise_is_measured_it_is_assumed():
    assert measure_sigma(np.zeros((1, 1)), 0.0) == pytest.approx(PRIOR_SCATTER)
    few = measure_sigma(np.zeros((4, 1)), 0.0)
    assert few == pytest.approx(PRIOR_SCATTER * np.sqrt(4.0 / 6.0))


def test_a_gust_before_the_swap_does_not_count_as_noise_of_the_residual():
    """Three of 12 groups: without it σ would be several times as large."""
    logs = np.random.default_rng(13).normal(size=(12, 1)) * 0.15
    blown = logs.copy()
    blown[5:8] += 1.5
    calm = measure_sigma(logs, 0.0, lower_half=True)
    assert measure_sigma(blown, 0.0, lower_half=True) < 2.0 * calm
    assert measure_sigma(blown, 0.0) > 3.0 * calm
