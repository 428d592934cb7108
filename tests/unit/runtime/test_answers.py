"""What an order is answered: what has happened, in one sentence, in a world that answers."""

from dataclasses import replace

import pytest

from service.errors import CommandError, LinkError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.state import Mode
from service.runtime.command_results import GivenCommand
from service.wire import AckState, Pattern, Reply
from tests.support.activities import acquiring, gathering, idle, measuring, own_dither, sending
from tests.support.situations import acknowledged, record, verdict
from tests.support.states import changed


def given(world, command):
    order = GivenCommand(command, "order-1")
    world.tell(command, cause=order.id)
    return order


def told(order, world):
    answer = order.result(world.state)
    text = str(answer.message)
    assert text
    assert "\n" not in text
    return text, answer.final


@pytest.mark.parametrize(
    ("activity", "command", "text"),
    [
        (idle, cmd.SetMode(mode=Mode.AUTO), "mode is auto"),
        (
            idle,
            cmd.SetPointing(elevation_deg=61.5, azimuth_deg=-20.0),
            "the telescope points at elevation 61.5 deg, azimuth -20 deg",
        ),
        (idle, cmd.Refit(), "a reconstructor is being computed; mode is propose"),
        (idle, cmd.Acquire(), "an acquisition is under way: opening the loop"),
        (acquiring, cmd.AbortAcquisition(), "the acquisition has ended by the operator; the loop"),
        (measuring, cmd.GiveUp(id="im-1"), "im-1 is given up by the operator; the RTC"),
        (gathering, cmd.GiveUp(id="noisy-1"), "noisy-1 is given up by the operator"),
        (idle, cmd.StopDither(), "no dither plays; no dither starts until"),
    ],
)
def test_what_the_service_does_by_itself_is_done_when_it_is_answered(activity, command, text):
    world = activity()
    said, final = told(given(world, command), world)
    assert said.startswith(text)
    assert final


def answered_in_the_end(world, order, seconds=3.0):
    """The answer at once, and the one in the end."""
    first = told(order, world)
    world.pass_(seconds)
    return first, told(order, world)


SILENT = "sent, the RTC has not answered yet"


def test_an_approval_tells_the_frame():
    world = sending()
    name = world.state.matrices.reconstructors[-1].id
    order = GivenCommand(cmd.Approve(id=name), "order-1")
    first, last = answered_in_the_end(world, order)
    assert first == (f"{name} {SILENT}", False)
    frame = world.state.reconstructor(name).applied_frame_seq
    assert frame is not None
    assert last == (f"{name} sent, applied at frame {frame}", True)


def test_a_rollback_tells_which_one_went_out_under_which_name_and_that_it_is_hold():
    world = idle()
    order = given(world, cmd.Rollback())
    first, last = answered_in_the_end(world, order)
    assert first == ("initial is being judged before it is sent again", False)
    new = world.state.matrices.reconstructors[-1]
    assert new.parent == "initial"
    frame = new.applied_frame_seq
    words = f"{new.id} sent, applied at frame {frame}; it is initial again; mode is hold"
    assert last == (words, True)


def test_a_copy_that_may_not_be_sent_now_is_said_to_be_kept_and_why():
    world = idle()
    order = given(world, cmd.Rollback())
    world.tell(
        ev.ConditionChanged(name="matrix-mismatch", text="the RTC's matrix is of other slopes")
    )
    world.pass_(2.0)
    (text, final) = told(order, world)
    new = world.state.matrices.reconstructors[-1].id
    assert text.startswith(f"{new} is proposed and not sent: the RTC's matrix is of other slopes")
    assert final


def test_a_copy_that_the_gate_refuses_tells_why_and_that_one_can_go_back_anyway():
    world = idle()
    order = given(world, cmd.Rollback())
    world.pending.clear()
    back = record("cm-back", MatrixState.REFUSED, reason="the operator goes back to initial")
    world.tell(ev.MatrixMade(record=back, wanted=True), cause=order.id)
    words = f"the gate refused cm-back: {back.gate.reason}; ordered with anyway"
    with pytest.raises(CommandError, match=words):
        order.result(world.state)


def test_a_copy_that_cannot_be_made_is_refused_with_the_reason():
    world = idle()
    order = given(world, cmd.Rollback())
    world.pending.clear()
    effect = ev.RepublishMatrix(source="initial", why="so")
    world.tell(ev.JobFailed(effect=effect, text="initial.h5: damaged"), cause=order.id)
    with pytest.raises(CommandError, match=r"initial\.h5: damaged"):
        order.result(world.state)


@pytest.mark.parametrize(
    ("state", "kind", "words"),
    [
        (AckState.REJECTED, CommandError, "the RTC refused .*: range: too large"),
        (None, LinkError, "was not applied within 3 s"),
    ],
)
def test_what_the_rtc_does_not_apply_is_a_refusal(state, kind, words):
    world = sending()
    name = world.state.matrices.reconstructors[-1].id
    order = GivenCommand(cmd.Approve(id=name), "order-1")
    world.pending.clear()
    if state is None:
        world.pass_(6.0)
    else:
        world.tell(acknowledged(name, state=state, reason="range: too large"))
    with pytest.raises(kind, match=words):
        order.result(world.state)


def test_what_the_gate_refuses_at_the_last_moment_is_a_refusal():
    world = sending()
    record = world.state.matrices.reconstructors[-1]
    order = GivenCommand(cmd.Approve(id=record.id), "order-1")
    refused = MatrixState.REFUSED
    reason = verdict(accepted=False).reason
    refused_record = replace(record, state=refused, reason=reason)
    others = tuple(r for r in world.state.matrices.reconstructors if r.id != record.id)
    now = changed(world.state, reconstructors=(*others, refused_record))
    with pytest.raises(CommandError, match=f"the gate refused {record.id}: {reason}"):
        order.result(now)


def test_a_dither_tells_its_first_frame_and_its_cost():
    world = idle()
    order = given(world, cmd.StartDither(modes=(501,), amplitude_m=2e-9, frequency_hz=(250.0,)))
    first, (text, final) = answered_in_the_end(world, order, 0.5)
    assert SILENT in first[0]
    assert not first[1]
    start_seq = world.state.dithers.dither.start_seq
    assert text.endswith(f"plays from frame {start_seq}: 2 nm RMS in all, budget 8 nm")
    assert final


def test_a_dither_the_rtc_will_not_play_is_a_refusal():
    world = idle()
    order = given(world, cmd.StartDither())
    request = world.state.dithers.dither.request
    reply = Reply(id=request.id, accepted=False, reason="busy: other", start_seq=None)
    world.tell(ev.Answered(request=request, reply=reply), cause=order.id)
    with pytest.raises(CommandError, match="the RTC refused the dither: busy: other"):
        order.result(world.state)


def test_a_dither_is_over_when_the_status_shows_none():
    world = own_dither()
    order = given(world, cmd.StopDither())
    first, last = answered_in_the_end(world, order, 1.0)
    assert first[0].startswith("the RTC was asked to stop dither-")
    assert not first[1]
    assert last == ("no dither plays; no dither starts until one is ordered", True)


def test_the_loop_tells_what_the_rtc_has_accepted():
    world = idle()
    order = given(world, cmd.SetLoop(loop="open", leak=0.99))
    first, last = answered_in_the_end(world, order, 0.5)
    assert first == (f"open, leak 0.99: {SILENT}", False)
    assert last == ("the RTC has accepted: open, leak 0.99", True)


def test_a_ramp_the_rtc_refuses_is_a_refusal():
    world = idle()
    order = given(world, cmd.Ramp())
    request = world.pending[-1].request
    world.pending.clear()
    reply = Reply(id=request.id, accepted=False, reason="unsupported: ramp", start_seq=None)
    world.tell(ev.Answered(request=request, reply=reply))
    with pytest.raises(CommandError, match="the RTC refused: unsupported: ramp"):
        order.result(world.state)


def test_a_measurement_tells_its_first_frame():
    world = idle()
    order = given(world, cmd.Measure(id="im-7", pattern=Pattern.SINE))
    first, (text, final) = answered_in_the_end(world, order, 0.5)
    assert first == (f"im-7 {SILENT}", False)
    assert text.startswith("im-7 is running, from frame ")
    assert final


def test_random_signs_wait_for_the_dither_that_plays():
    world = own_dither()
    order = given(world, cmd.MeasureNoisy(id="noisy-7", duration_s=30.0))
    first, last = answered_in_the_end(world, order, 3.0)
    assert first == ("noisy-7 waits for the dither that plays to end", False)
    assert last == ("noisy-7 is running", True)
