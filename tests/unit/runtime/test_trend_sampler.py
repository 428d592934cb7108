"""The samples of a night's chart: what a residual is taken from."""

from dataclasses import replace

import numpy as np
import pytest

from service.archive.nights import TREND_S
from service.runtime.telemetry_recorder import N_PIECE_FRAMES, PIECE_S, TrendSampler
from service.wire.commands import Loop
from tests.support.api import STATE
from tests.support.states import tracker_state
from tests.support.streams import block

MATRIX = np.full((3, block(0).slopes.shape[1]), 0.5, np.float32)


class Telemetry:
    """Blocks of frames, and what the RTC says of its loop."""

    def __init__(self):
        self.frames, self.seq, self.in_loop = None, 0, True
        self.sampler = TrendSampler(
            state=self.state, frames=lambda: self.frames, matrix=lambda _: MATRIX, keep=print
        )

    def state(self):
        loop = Loop.CLOSED if self.in_loop else Loop.OPEN
        return tracker_state(rtc=replace(STATE.loop.rtc, loop=loop))

    def come(self, scale, **given):
        """A block of frames whose slopes are so many times as large, seen by the sampler."""
        self.seq += 1000
        frames = block(self.seq, 2 * N_PIECE_FRAMES, **given)
        self.frames = replace(frames, slopes=np.float32(scale) * frames.slopes)
        self.sampler.add_piece()
        return self.frames.slopes[-N_PIECE_FRAMES:]


@pytest.fixture
def telemetry():
    return Telemetry()


def rms(pieces):
    modes = np.concatenate(pieces) @ MATRIX.T
    return pytest.approx(np.sqrt(np.mean(np.sum(modes**2, axis=1))), rel=1e-5)


def test_a_residual_is_that_of_the_whole_time_since_the_last_sample(telemetry):
    """Of one block of 50 ms it varied by 15 % on a simulated star, and limits are 10 %."""
    for _ in range(2):
        pieces = [telemetry.come(scale) for scale in (1.0, 3.0, 0.5)]
        assert telemetry.sampler.take().residual_m == rms(pieces)
    assert TREND_S / PIECE_S >= 15


def test_slopes_of_another_matrix_or_of_an_open_loop_do_not_count(telemetry):
    telemetry.come(5.0)
    kept = [telemetry.come(1.0, cm_id="next"), telemetry.come(2.0, cm_id="next")]
    assert telemetry.sampler.take().residual_m == rms(kept)
    telemetry.come(5.0, cm_id="next")
    telemetry.in_loop = False
    telemetry.come(1.0, cm_id="next")
    assert telemetry.sampler.take().residual_m is None


def test_frames_that_stay_when_telemetry_has_stopped_count_once(telemetry):
    kept = telemetry.come(1.0)
    telemetry.sampler.add_piece()
    sample = telemetry.sampler.take()
    assert sample.residual_m == rms([kept])
    assert sample.telemetry_ns_utc is not None
    telemetry.sampler.add_piece()
    sample = telemetry.sampler.take()
    assert sample.residual_m is None
    assert sample.telemetry_ns_utc is None
