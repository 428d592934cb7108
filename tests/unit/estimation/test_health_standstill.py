"""A camera that stands is noticed by its slopes, zero or frozen."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.estimation.frames import FrameBlock
from service.estimation.health import Standstill

BLOCK, DT_NS, N_SLOPES = 50, 1_000_000, 30


def blocks(slopes, first_seq=0):
    for k in range(0, len(slopes), BLOCK):
        yield FrameBlock(
            session="s",
            first_seq=first_seq + k,
            t0_ns_utc=(first_seq + k) * DT_NS,
            dt_ns=DT_NS,
            slopes=np.float32(slopes[k : k + BLOCK]),
            commands_m=np.zeros((BLOCK, 3), np.float32),
            dither_m=None,
            cm_id="a",
        )


def noise(n_frames):
    return np.random.default_rng(1).normal(size=(n_frames, N_SLOPES))


def after(slopes, state=None):
    state = state or Standstill()
    for block in blocks(slopes):
        state = state.update(SimpleNamespace(block=block))
    return state


@pytest.mark.parametrize(("value", "words"), [(0.0, "all zero"), (0.3, "the same in every frame")])
def test_slopes_that_stand_for_half_a_second_are_an_alarm(value, words):
    state = after(np.concatenate([noise(200), np.full((600, N_SLOPES), value)]))
    assert state.marks
    assert words in state.conditions[0]
    assert "since frame 200, 00:00:00 UTC" in state.conditions[0]
    assert "open the loop" in state.conditions[0]


def test_a_tenth_of_a_second_is_no_alarm_and_no_measurement():
    state = after(np.concatenate([noise(200), np.zeros((100, N_SLOPES))]))
    assert state.marks
    assert state.conditions[0] is None


def test_it_is_over_with_the_first_frame_that_differs():
    state = after(np.concatenate([np.zeros((800, N_SLOPES)), noise(50)]))
    assert not state.marks
    assert state.conditions[0] is None


def test_frames_sent_twice_are_no_camera_that_stands():
    assert not after(np.repeat(noise(200), 2, axis=0)).marks


def test_another_session_begins_anew():
    state = after(np.zeros((800, N_SLOPES)))
    (block,) = blocks(np.zeros((BLOCK, N_SLOPES)), first_seq=800)
    assert not state.update(SimpleNamespace(block=replace(block, session="t"))).marks
