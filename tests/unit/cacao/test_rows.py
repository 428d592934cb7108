"""Rows of telemetry: slopes k beside the command that was on the mirror while they were exposed."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cacao_bridge.rows import LEAST_KEPT, Rows

N = 300


def slopes_of(k):
    return np.array([k, 2 * k, -k], dtype=np.float32)


def answer_to(k):
    return np.array([1000 + k, 5 * k], dtype=np.float32)


def rows_of(runs):
    return {seq + i: row for seq, rows in runs for i, row in enumerate(rows)}


@settings(deadline=None, max_examples=40)
@given(
    cuts=st.lists(st.integers(1, N - 1), max_size=30),
    late=st.integers(0, 5),
    delay=st.sampled_from([1.0, 1.7, 2.0, 3.25]),
    start=st.integers(1, 10**9),
)
def test_each_row_holds_its_own_frame_however_the_streams_come(cuts, late, delay, start):
    rows, sent, edges = Rows(3, 2, delay, dither=False), {}, sorted({0, N, *cuts})
    commands_at = 0
    for first, end in itertools.pairwise(edges):
        rows.take_slopes(start + first, np.array([slopes_of(k) for k in range(first, end)]))
        upto = max(end - late, commands_at) if end < N else N
        if upto > commands_at:
            answers = np.array([answer_to(k) for k in range(commands_at, upto)])
            rows.take_commands(start + commands_at, answers)
            commands_at = upto
        new = rows_of(rows.ready())
        assert not new.keys() & sent.keys()
        sent |= new
    whole, part = int(delay), delay - int(delay)
    for seq, row in sent.items():
        k = seq - start
        older = answer_to(k - whole - 1) if part else 0.0
        expected = part * older + (1 - part) * answer_to(k - whole)
        np.testing.assert_allclose(row, [*slopes_of(k), *expected], rtol=1e-6)
    first = whole + bool(part)
    assert sorted(sent) == [start + k for k in range(first, N)]


def test_a_command_that_never_comes_costs_its_row_alone():
    rows = Rows(3, 2, 2.0, dither=False)
    sent = {}
    for k in range(200):
        rows.take_slopes(k, slopes_of(k)[None])
        if k != 50:
            rows.take_commands(k, answer_to(k)[None])
        sent |= rows_of(rows.ready())
    assert sorted(set(range(2, 200)) - sent.keys()) == [52]
    assert rows.n_unpaired == 3  # the two before any command, and that one


def test_no_command_at_all_sends_nothing_and_is_counted():
    rows = Rows(3, 2, 1.0, dither=False)
    for k in range(1000):
        rows.take_slopes(k, slopes_of(k)[None])
        assert rows.ready() == []
    assert rows.n_unpaired == 999 - LEAST_KEPT // 2


def test_commands_that_come_a_look_later_than_many_slopes_cost_nothing():
    """The bridge stood still, and then the writer was at the commands: 200 frames, none lost."""
    rows = Rows(3, 2, 1.0, dither=False)
    rows.take_slopes(0, slopes_of(0)[None])
    rows.take_commands(0, answer_to(0)[None])
    frames = range(1, 201)
    rows.take_slopes(1, np.array([slopes_of(k) for k in frames]))
    sent = rows_of(rows.ready())
    rows.take_commands(1, np.array([answer_to(k) for k in frames]))
    sent |= rows_of(rows.ready())
    assert sent.keys() == set(frames)
    assert rows.n_unpaired <= 1  # the first frame answers nothing


def test_what_came_before_is_not_mixed_with_what_comes_after_a_new_stream():
    rows = Rows(3, 2, 1.0, dither=False)
    rows.take_slopes(10, np.array([slopes_of(10)]))
    rows.take_commands(10, answer_to(10)[None])
    rows.forget()
    rows.take_slopes(11, np.array([slopes_of(11)]))
    assert rows.ready() == []


@pytest.mark.parametrize("delay", [1.0, 2.5])
def test_the_dither_is_a_part_of_the_command_as_late_as_it(delay):
    rows = Rows(3, 2, delay, dither=True)
    u = np.array([7.0, -3.0], dtype=np.float32)
    rows.take_slopes(0, np.array([slopes_of(k) for k in range(600)])[:500])
    rows.take_commands(0, np.zeros((500, 2), dtype=np.float32))
    rows.take_dither(20, 29, u)
    sent = rows_of(rows.ready(answers_to=40))
    assert max(sent) == 40 + int(delay)
    part = delay - int(delay)
    for k, row in sent.items():
        played = [20 <= k - int(delay) - i < 30 for i in (0, 1)]
        expected = ((1 - part) * played[0] + part * played[1]) * u
        np.testing.assert_allclose(row[3:], [*expected, *expected])
    rows.take_slopes(500, np.array([slopes_of(k) for k in range(500, 560)]))
    rows.take_commands(500, np.zeros((60, 2), dtype=np.float32))
    later = rows_of(rows.ready())
    assert all(not row[3:].any() for row in later.values()), "the ring has come around"


def test_a_message_holds_as_many_rows_as_it_may():
    for n_slopes, most in ((10, 50), (24_998, 40)):
        rows = Rows(n_slopes, 2, 1.0, dither=False)
        rows.take_slopes(0, np.zeros((70, n_slopes), dtype=np.float32))
        rows.take_commands(0, np.zeros((70, 2), dtype=np.float32))
        runs = rows.ready()
        assert max(len(part) for _, part in runs) == most
        assert [seq for seq, _ in runs] == list(range(1, 70, most))
