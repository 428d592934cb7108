from itertools import count

import numpy as np
import pytest

from pyrcal.rtc.replies import ReplyCache
from service.wire import (
    DitherStop,
    Loop,
    LoopRequest,
    MeasureRequest,
    OffloadRequest,
    Pattern,
    ReferencesRequest,
    checksum,
)
from sim_rtc.computer.feed import OpenLoopBlock
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import LoopSettings
from tests.support.real_time_computer import (
    IDENTITY,
    N_MODES,
    OPTICS,
    RESPONSE,
    dither_request,
    reconstructor,
)


def blocks():
    """Blocks of three batches with a constant wavefront of 100 nm in every mode."""
    slopes = np.tile(RESPONSE.sum(axis=1) * np.float32(1e-7), (30, 1))
    for first in count(0, 30):
        yield OpenLoopBlock(
            first_frame=first, optics=OPTICS, slopes=slopes, phases_m=np.zeros((3, 5), np.float32)
        )


@pytest.fixture
def computer():
    return RealTimeComputer(
        blocks(),
        identity=IDENTITY,
        settings=LoopSettings(
            frame_rate_hz=1000.0,
            delay_frames=2,
            gains=(0.4,) * N_MODES,
            leak=1.0,
            n_controlled_next=3,
        ),
        reconstructor=reconstructor("first", 3),
        optics=OPTICS,
        stroke_m=1e-5,
    )


def run(computer, n_batches):
    return [computer.next_batch() for _ in range(n_batches)]


def loop_request(name, **changes):
    return LoopRequest(id=name, **changes)


def test_the_loop_takes_out_what_it_controls(computer):
    last = run(computer, 10)[-1]
    np.testing.assert_allclose(last.commands_m[-1], [-1e-7, -1e-7, -1e-7, 0.0], rtol=1e-3)


def test_matrices_are_swapped_one_per_batch_and_told(computer):
    run(computer, 2)
    computer.stage(reconstructor("second", 3))
    computer.stage(reconstructor("third", 3))
    batches = run(computer, 3)
    assert [(b.seq0, b.cm_id) for b in batches] == [(20, "second"), (30, "third"), (40, "third")]
    assert computer.take_swaps() == [("second", 20), ("third", 30)]
    assert computer.take_swaps() == []


def test_the_number_of_modes_waits_for_a_matrix_of_that_shape(computer):
    computer.execute(loop_request("a", n_controlled=4))
    assert computer.terms().n_controlled == (4, 3)
    computer.stage(reconstructor("still-three", 3))
    run(computer, 1)
    assert computer.terms().n_controlled == (4, 3)
    computer.stage(reconstructor("four", 4))
    last = run(computer, 10)[-1]
    assert last.commands_m[-1, 3] == pytest.approx(-1e-7, rel=1e-3)
    assert computer.terms().n_controlled == (4,)
    assert computer.status().gains == (0.4,) * 4


def test_modes_that_are_given_up_go_to_zero(computer):
    computer.stage(reconstructor("four", 4))
    run(computer, 10)
    computer.stage(reconstructor("three", 3))
    (batch,) = run(computer, 1)
    np.testing.assert_array_equal(batch.commands_m[:, 3], 0.0)
    assert abs(batch.commands_m[0, 2]) > 5e-8


def test_opening_begins_a_session_with_an_empty_integrator_and_nothing_pending(computer):
    (before,) = run(computer, 1)
    computer.execute(dither_request("d"))
    computer.stage(reconstructor("second", 3))
    assert computer.execute(loop_request("o", loop=Loop.OPEN)).accepted
    after = run(computer, 3)
    assert {b.session for b in after} == {computer.session}
    assert after[0].session != before.session
    assert after[0].seq0 == before.seq0 + 10
    assert not any(b.commands_m.any() for b in after)
    assert {b.cm_id for b in after} == {"first"}
    assert computer.status().loop is Loop.OPEN
    assert set(computer.status().gains) == {0.0}


def test_a_controlled_mode_without_gain_makes_the_loop_partial(computer):
    computer.execute(loop_request("g", gains=(0.4, 0.0, 0.4, 0.4), leak=0.99))
    status = computer.status()
    assert status.loop is Loop.PARTIAL
    assert status.gains == (0.4, 0.0, 0.4, 0.0)
    assert computer.settings.leak == 0.99
    last = run(computer, 30)[-1]
    assert last.commands_m[-1, 1] == 0.0


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"gains": (0.4,) * 3}, "range: 3 gains, expected 4"),
        ({"gains": (2.5,) * 4}, "range: gain 2.5, expected at most 2"),
        ({"n_controlled": 5}, "range: n_controlled 5, expected 1 to 4"),
        ({"loop": Loop.PARTIAL}, "unsupported: loop 'partial'"),
    ],
)
def test_impossible_loop_commands_change_nothing(computer, changes, reason):
    before = computer.settings
    reply = computer.execute(loop_request("x", leak=0.5, **changes))
    assert not reply.accepted
    assert reply.reason.startswith(reason)
    assert computer.settings == before


def test_a_dither_starts_at_the_announced_frame_and_ends_by_itself(computer):
    run(computer, 1)
    reply = computer.execute(dither_request("d"))
    batches = run(computer, 110)
    playing = [b for b in batches if b.dither_m is not None]
    assert (playing[0].seq0, playing[-1].seq0) == (reply.start_seq, reply.start_seq + 990)
    assert computer.status().dither is None


def test_a_second_dither_is_refused_until_the_first_is_stopped(computer):
    assert computer.execute(dither_request("first")).accepted
    assert computer.execute(dither_request("second")).reason.startswith("busy")
    assert computer.execute(DitherStop(id="stop")).accepted
    assert computer.execute(dither_request("third")).accepted


def test_a_command_is_carried_out_once_for_ten_minutes(computer):
    desk = ReplyCache(computer.execute)
    first = desk.handle(dither_request("d"), 0.0)
    assert first.accepted
    assert desk.handle(dither_request("d"), 600.0) == first
    other = desk.handle(loop_request("d", leak=0.5), 600.0)
    assert other.reason.startswith("id: d was used for another command")
    assert desk.handle(dither_request("d"), 601.0).reason.startswith("busy")


def test_the_image_is_moved_by_who_can_and_refused_by_who_cannot(computer):
    request = OffloadRequest(
        id="o-1", shift_x_subap=-0.1, shift_y_subap=0.0, rotation_deg=90.0, magnification=0.002
    )
    refused = computer.execute(request)
    assert not refused.accepted
    assert refused.reason.startswith("unsupported: ")
    moved = []
    computer._move = lambda vector: moved.append(vector) or 2.5
    reply = computer.execute(request)
    assert reply.accepted
    assert reply.start_seq >= 2500
    np.testing.assert_allclose(moved, [[-0.1, 0.0, np.pi / 2, 0.002]])


@pytest.mark.parametrize("named_by", ["reference_id", "config_id"])
def test_new_references_put_their_shape_on_the_mirror_from_the_batch_that_names_them(
    computer, named_by
):
    """0.1 %: single precision after 30 batches of a loop with a gain of 0.4."""
    before = run(computer, 30)[-1]
    shape_m = np.array([0.0, 3e-8, -2e-8, 0.0], np.float32)
    computer.use_references(RESPONSE @ shape_m, **{named_by: "ncpa-1"})
    after = run(computer, 30)
    assert getattr(before.identity, named_by) != "ncpa-1"
    assert getattr(after[0].identity, named_by) == "ncpa-1"
    assert getattr(computer.status(), named_by) == "ncpa-1"
    assert after[0].session == before.session
    # The first frame still has the command of before, against the new zero point.
    step = before.slopes[-1] - after[0].slopes[0]
    np.testing.assert_allclose(step, RESPONSE @ shape_m, atol=1e-11)
    moved = (after[-1].commands_m - before.commands_m)[-1]
    np.testing.assert_allclose(moved, shape_m, atol=3e-11)
    np.testing.assert_allclose((after[-1].slopes @ RESPONSE)[-1, :3], 0.0, atol=1e-10)


def references(name, slopes, **changes):
    slopes = np.asarray(slopes, "<f4")
    told = {"id": f"ask-{name}", "reference_id": name, "config_id": "sensor", "ramp_s": 0.05}
    told |= {"slopes": slopes.tobytes(), "sha256": checksum(slopes)}
    return ReferencesRequest(**told | changes)


def offset_of(computer):
    return computer.references_in_use().offset


def test_an_offset_is_reached_by_a_ramp_named_on_its_way_and_read_back(computer):
    """A ramp of 50 frames in batches of 10; the slopes are linear in the offset."""
    before = run(computer, 30)[-1]
    shape_m = np.array([0.0, 3e-8, -2e-8, 0.0], np.float32)
    request = references("ncpa", RESPONSE @ shape_m)
    reply = computer.execute(request)
    assert (reply.accepted, reply.start_seq) == (True, 310)
    after = run(computer, 40)
    names = [batch.identity.reference_id for batch in after]
    assert names[:8] == [None, *["ncpa~"] * 5, "ncpa", "ncpa"]
    # A loop behind a ramp of constant rate: the zero point moves on by 1/50 in each frame.
    first = before.slopes[-1] - after[1].slopes[0]
    np.testing.assert_allclose(first, RESPONSE @ shape_m / 50, atol=2e-11)
    moved = (after[-1].commands_m - before.commands_m)[-1]
    np.testing.assert_allclose(moved, shape_m, atol=3e-11)
    assert computer.references_in_use().sha256 == request.sha256
    assert computer.status().reference_id == "ncpa"
    assert {batch.session for batch in after} == {before.session}


def test_a_second_offset_replaces_the_first_from_where_its_ramp_is(computer):
    computer.execute(references("a", np.full(8, 1e-9)))
    run(computer, 3)
    np.testing.assert_allclose(offset_of(computer), 0.4e-9, rtol=1e-5)
    computer.execute(references("b", np.full(8, -1e-9)))
    batches = run(computer, 3)
    assert [batch.identity.reference_id for batch in batches] == ["a~", "b~", "b~"]
    # from 0.4, which stays until the second ramp begins, 20 of 50 frames towards -1
    np.testing.assert_allclose(offset_of(computer), (0.4 - 1.4 * 0.4) * 1e-9, rtol=1e-3)


def test_an_offset_stays_when_the_loop_opens_and_ends_with_the_rtc(computer):
    computer.execute(references("a", np.full(8, 1e-9), ramp_s=0.0))
    batches = run(computer, 3)
    assert [batch.identity.reference_id for batch in batches] == [None, "a", "a"]
    computer.execute(loop_request("open", loop=Loop.OPEN))
    assert run(computer, 1)[0].identity.reference_id == "a"
    np.testing.assert_allclose(offset_of(computer), 1e-9)
    computer.restart()
    assert run(computer, 1)[0].identity.reference_id is None
    assert not offset_of(computer).any()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"config_id": "other"}, "range: config_id other, expected sensor"),
        ({"slopes": np.zeros(7)}, "range: 7 slopes, expected 8"),
    ],
)
def test_an_offset_for_another_sensor_is_refused(computer, changes, reason):
    slopes = changes.pop("slopes", np.zeros(8))
    refused = computer.execute(references("a", slopes, **changes))
    assert (refused.accepted, refused.reason) == (False, reason)


def test_an_offset_waits_for_the_end_of_a_measurement(computer):
    modes, amplitudes = (0, 1), (1e-8, 1e-8)
    computer.execute(
        MeasureRequest(
            id="im",
            pattern=Pattern.PUSH_PULL_MODAL,
            modes=modes,
            amplitude_m=amplitudes,
            n_average=1,
        )
    )
    refused = computer.execute(references("a", np.zeros(8)))
    assert refused.reason.startswith("busy: matrix im is being measured")


@pytest.mark.parametrize("hidden", [False, True])
def test_an_rtc_at_fault_applies_what_it_likes_and_may_deny_it(computer, hidden):
    computer.spoil_references(lambda _, requested: -requested, hidden=hidden)
    shape_m = np.array([0.0, 3e-8, 0.0, 0.0], np.float32)
    before = run(computer, 30)[-1]
    request = references("ncpa", RESPONSE @ shape_m)
    assert computer.execute(request).accepted
    after = run(computer, 40)[-1]
    assert after.identity.reference_id == "ncpa"
    np.testing.assert_allclose((after.commands_m - before.commands_m)[-1], -shape_m, atol=3e-11)
    assert (computer.references_in_use().sha256 == request.sha256) is hidden
