"""Random dither in the streams of a running service."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.estimation.description import Description
from service.estimation.dither_windows import DitherWindows
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn
from service.estimation.random_dither import Correlated
from service.runtime.estimator_bank import EstimatorBank, process_block, with_dither, with_rtc
from service.tracking.dither_request import Dither, plan_random
from service.tracking.products import ModeSet
from service.wire import DitherKind, DitherRequest
from tests.unit.tracking.situations import POLICY, rtc

N_SLOPES, N_MODES = 6, 8
DESCRIPTION = Description(
    n_slopes=N_SLOPES, n_modes=N_MODES, mode_variance_m2=np.full(N_MODES, 1e-16)
)
RTC = rtc(4, n_modes=N_MODES, n_slopes=N_SLOPES, gains=(0.4,) * 4 + (0.0,) * 4)
REQUEST = DitherRequest(
    id="noisy-1",
    kind=DitherKind.BINARY,
    modes=(1, 6),
    amplitude_m=(2e-9, 2e-9),
    seed=5,
    duration_s=1.2,
)
ASKED = {"dither_id": "noisy-1", "total_m": 5e-9, "duration_s": 30.0}
DITHER = Dither(request=REQUEST, window_s=0.4, start_seq=0, asked_ns_utc=0)


def block(first_seq, n=100, *, dither=True, cm_id="initial"):
    rng = np.random.default_rng(first_seq)
    added = np.zeros((n, N_MODES), np.float32)
    added[:, [1, 6]] = 2e-9 * rng.choice([-1.0, 1.0], (n, 2))
    return FrameBlock(
        session="s1",
        first_seq=first_seq,
        t0_ns_utc=first_seq * 1_000_000,
        dt_ns=1_000_000,
        slopes=rng.standard_normal((n, N_SLOPES)).astype(np.float32),
        commands_m=added + 1e-9 * rng.standard_normal((n, N_MODES)).astype(np.float32),
        dither_m=added if dither else None,
        cm_id=cm_id,
    )


@pytest.fixture
def streams():
    return with_dither(with_rtc(EstimatorBank.of(DESCRIPTION), RTC), DITHER, 2.0)


def play(streams, first_seq, n_blocks, **changes):
    windows = []
    for index in range(n_blocks):
        streams, ended = process_block(streams, block(first_seq + 100 * index, **changes))
        windows += ended
    return streams, windows


def test_random_signs_are_correlated_in_windows_of_the_dithers_own_length(streams):
    streams, windows = play(streams, 0, 12)
    assert [(type(w), w.first_seq) for w in windows] == [(Correlated, 300), (Correlated, 700)]
    assert windows[0].plan.modes == (1, 6)
    # a third window would be cut by the end of the dither: it is never begun
    assert streams[DitherWindows].cutter is None


def test_a_sine_after_random_signs_is_read_as_a_sine(streams):
    request = DitherRequest(
        id="d-2",
        kind=DitherKind.SINE,
        modes=(6,),
        amplitude_m=(5e-9,),
        frequency_hz=(240.0,),
        duration_s=60.0,
    )
    sine = Dither(request=request, start_seq=0, window_s=0.5, asked_ns_utc=0)
    streams = with_dither(streams, sine, 2.0)
    assert isinstance(streams[DitherWindows].cutter, LockIn)
    assert streams[DitherWindows].cutter.plan.modes == (6,)


def test_a_window_too_short_for_its_modes_is_refused_with_how_long_it_must_be(streams):
    short = replace(DITHER, request=replace(REQUEST, id="d-3"), window_s=0.1)
    found = with_dither(streams, short, 2.0)
    assert found[DitherWindows].cutter is None
    expected = "found windows of 100 frames, expected at least 192"
    assert expected in found.loop.dither.why_unreadable


def test_all_modes_of_a_basis_may_share_a_few_nanometres():
    """5 nm on 594 modes: 0.205 nm each; windows of 594 modes at 1 kHz last 4.75 s at least."""
    dither = plan_random(rtc(), POLICY, 77, modes=ModeSet.ALL, **ASKED)
    request = dither.request
    assert request.modes == tuple(range(594))
    assert np.sqrt(np.sum(np.square(request.amplitude_m))) == pytest.approx(5e-9)
    assert (request.kind, request.seed, dither.frequency_hz) == (DitherKind.BINARY, 77, ())
    assert dither.window_s == pytest.approx(5.0)
    assert request.duration_s >= 30.0


def test_more_modes_than_the_rtc_dithers_are_refused():
    with pytest.raises(CommandError, match="found 594 modes; the RTC dithers at most 64"):
        plan_random(rtc(max_dither_modes=64), POLICY, 0, modes=ModeSet.ALL, **ASKED)
