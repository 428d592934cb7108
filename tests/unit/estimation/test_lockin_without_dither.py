"""Frames without dither columns, where a dither was expected: an RTC may end one at any time."""

import numpy as np
import pytest

from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.windows import RefusalKind, WindowRefused

PLAN = LockInPlan(
    modes=(0,),
    frequencies_hz=(200.0,),
    amplitude_m=(5e-9,),
    frame_rate_hz=1000.0,
    n_frames=100,
    first_seq=0,
)


def block(first_seq, n_frames, *, dither):
    commands = np.zeros((n_frames, 2), np.float32)
    frames = np.arange(first_seq, first_seq + n_frames)
    commands[:, 0] = 5e-9 * np.sqrt(2) * np.sin(2 * np.pi * 0.2 * frames)
    return FrameBlock(
        session="s",
        first_seq=first_seq,
        t0_ns_utc=first_seq * 1_000_000,
        dt_ns=1_000_000,
        slopes=np.zeros((n_frames, 4), np.float32),
        commands_m=commands,
        dither_m=commands if dither else None,
        cm_id="cm",
    )


@pytest.mark.timeout(10)
def test_a_dither_that_ends_inside_a_window_costs_that_window_once():
    lock_in, ended = LockIn(plan=PLAN).accumulate(block(0, 50, dither=True))
    assert not ended
    lock_in, ended = lock_in.accumulate(block(50, 50, dither=False))
    assert [type(window) for window in ended] == [WindowRefused]
    assert ended[0].kind is RefusalKind.CUT_SHORT
    _, ended = lock_in.accumulate(block(100, 50, dither=False))
    assert not ended


@pytest.mark.timeout(10)
def test_no_window_opens_before_the_dither_is_there():
    lock_in, ended = LockIn(plan=PLAN).accumulate(block(0, 70, dither=False))
    assert not ended
    _, ended = lock_in.accumulate(block(70, 100, dither=True))
    assert [(type(window), window.first_seq) for window in ended] == [(Spectra, 70)]
