"""The bookkeeping of an RTC."""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal import rtc
from pyrcal.rtc.identity import Reconstructor
from service.wire import DitherKind, Loop, LoopRequest, ReferencesRequest, checksum

N_MODES, N_SLOPES = 6, 10


def computer():
    return rtc.BasicComputer(
        rtc.Identity(system="bench", basis_id="kl-1", config_id="mask-1"),
        np.zeros((4, N_SLOPES)),
        gains=np.full(N_MODES, 0.4),
        leak=0.99,
        frame_rate_hz=500.0,
        delay_frames=2.0,
        max_dither_m=50e-9,
    )


@pytest.mark.parametrize("n_frames", [10, 50])
def test_a_dither_is_played_from_its_first_frame_whatever_the_batch(n_frames):
    loop = computer()
    dither_m = loop.begin_batch(n_frames)
    request = rtc.DitherRequest(
        id="d",
        kind=DitherKind.SINE,
        duration_s=1.0,
        modes=(2,),
        amplitude_m=(10e-9,),
        frequency_hz=(125.0,),
    )
    reply = loop.execute(request)
    assert reply.accepted
    played = []
    for _ in range(200 // n_frames):
        played.append(dither_m)
        loop.end_batch(np.zeros((n_frames, N_SLOPES)), dither_m, dither_m)
        dither_m = loop.begin_batch(n_frames)
    mode = np.concatenate(played)[:, 2]
    assert not mode[: reply.start_seq].any()
    # a sine of a quarter of the frame rate: zero in its first frame, full in the second
    assert mode[reply.start_seq + 1] == pytest.approx(10e-9 * np.sqrt(2.0))


def test_a_matrix_that_waits_when_the_loop_opens_is_void():
    """R-27: it belongs to the session that ends."""
    loop = computer()
    staged = Reconstructor.own(
        "staged", np.ones((4, N_SLOPES), np.float32), loop.identity, created_ns=1
    )
    loop.stage(staged)
    assert loop.execute(LoopRequest(id="o", loop=Loop.OPEN)).accepted
    loop.begin_batch(10)
    assert not loop.take_swaps()
    loop.stage(staged)
    loop.begin_batch(10)
    assert [name for name, _ in loop.take_swaps()] == ["staged"]


def test_new_references_are_named_in_the_next_batch_and_status_and_nothing_else_changes():
    loop = computer()
    names = []
    for reference_id in (None, "ncpa-1", "ncpa-2"):
        loop.identity = replace(loop.identity, reference_id=reference_id)
        dither_m = loop.begin_batch(10)
        header, _ = loop.end_batch(np.zeros((10, N_SLOPES)), dither_m, dither_m)
        names.append((header.reference_id, loop.status().reference_id))
        assert (header.session, header.config_id) == (loop.status().session, "mask-1")
    assert names == [(None, None), ("ncpa-1", "ncpa-1"), ("ncpa-2", "ncpa-2")]


def run(loop, n_batches, n_frames=10):
    """Play batches of a program that subtracts the offset; return header and offset of each."""
    played = []
    for _ in range(n_batches):
        dither_m = loop.begin_batch(n_frames)
        offset = loop.reference_offset()
        header, _ = loop.end_batch(np.zeros((n_frames, N_SLOPES)), dither_m, dither_m)
        played.append((header, offset))
    return played


def test_references_are_refused_until_the_program_subtracts_them_and_then_ramped():
    loop = computer()
    slopes = np.full(N_SLOPES, 0.5, "<f4")
    request = ReferencesRequest(
        id="r-1",
        reference_id="ncpa",
        config_id="mask-1",
        slopes=slopes.tobytes(),
        sha256=checksum(slopes),
        ramp_s=0.03,
    )
    assert loop.execute(request).reason.startswith("unsupported: ")
    ((_, offset),) = run(loop, 1)
    assert offset.shape == (10, N_SLOPES)
    assert not offset.any()
    assert loop.references_in_use().reference_id == "mask-1"
    reply = loop.execute(request)
    assert (reply.accepted, reply.start_seq) == (True, 10)
    # 15 frames at 500 Hz: the ramp ends within its second batch, and the name is new in the third
    played = run(loop, 3)
    assert [header.reference_id for header, _ in played] == ["ncpa~", "ncpa~", "ncpa"]
    offsets = np.concatenate([offset for _, offset in played])[:, 0]
    np.testing.assert_allclose(offsets, np.minimum(np.arange(1, 31) / 15, 1.0) * 0.5, rtol=1e-6)
    assert loop.status().reference_id == "ncpa"
    in_use = loop.references_in_use()
    assert (in_use.reference_id, in_use.sha256) == ("ncpa", request.sha256)
    assert loop.status().session == played[0][0].session
