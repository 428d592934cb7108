"""When a move of the mirror's image is asked for, by how much, and what becomes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.archive.serialisation import TrackingFile
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.records import commands as cmd
from service.records import events as ev
from service.records.registration import OffloadState, Validity
from service.records.state import Mode
from service.runtime.archiving import is_urgent
from service.tracking.resume import resumed, saved_of
from service.tracking.validity import MOVING, end_of
from service.wire import OffloadRequest, Reply
from tests.support.offload import LIMITS, MOVES, STAYS, a_story
from tests.support.situations import ALPHA, SECOND, Story, moved, rtc
from tests.support.states import changed, tracker_state

AFTER = Misregistration.from_vector(
    ALPHA.vector + np.array([-0.06, 0.03, -0.1, 0.0]) / BOUNDARY_SCALE
)


def answer(story, *, accepted=True, reason="", start_seq=None):
    (asked,) = story.asked(OffloadRequest)
    reply = Reply(id=asked.id, accepted=accepted, reason=reason, start_seq=start_seq)
    return story.tell(ev.Answered(request=asked, reply=reply))


def test_a_share_of_the_way_home_is_asked_for_within_the_limits():
    (asked,) = a_story().asked(OffloadRequest)
    # ALPHA is 0.12, -0.08 subap, 0.2 deg, 1.003: half of it, 0.03 at most along y
    assert asked.shift_x_subap == pytest.approx(-0.06, abs=2e-3)
    assert asked.shift_y_subap == pytest.approx(0.03)
    assert asked.rotation_deg == pytest.approx(-0.1, abs=5e-3)
    assert asked.magnification == 0.0


@pytest.mark.parametrize("mode", [Mode.PROPOSE, Mode.HOLD])
def test_nothing_moves_unless_the_service_may_act_by_itself(mode):
    assert a_story(mode).asked(OffloadRequest) == []


def test_nothing_moves_where_nobody_asked_for_it():
    assert a_story(policy=STAYS).asked(OffloadRequest) == []


def test_nothing_moves_while_a_jump_is_suspected():
    story = a_story(n_windows=0)
    story.see(moved(shift_x_subap=0.4))
    assert story.state.alpha.registration.doubt
    story.wait(3.0)
    assert story.asked(OffloadRequest) == []


def test_nothing_moves_while_everything_is_stopped_and_it_does_after():
    story = a_story(policy=STAYS)
    story.tell(cmd.StopEverything())
    story.policy = MOVES
    story.wait(3.0)
    assert story.asked(OffloadRequest) == []
    story.tell(cmd.Resume())
    story.wait(2.0)
    assert len(story.asked(OffloadRequest)) == 1


def test_where_it_was_drawn_nothing_is_asked_for():
    near = Misregistration(shift_x_subap=0.015, rotation_rad=2e-4)
    assert a_story(alpha=near).asked(OffloadRequest) == []


def test_the_filter_is_told_and_a_window_there_is_no_jump():
    story = a_story()
    answer(story)
    known = story.state.alpha.registration
    np.testing.assert_allclose(known.alpha.vector, AFTER.vector, atol=3e-3)
    assert known.n_windows == 0
    assert known.validity.level is Validity.STALE
    assert story.state.alpha.offload.state is OffloadState.MOVED
    story.wait(4.0)
    story.see(AFTER, n_windows=2)
    assert story.state.alpha.registration.n_windows == 2
    assert not [name for name in story.logged if "jump" in name]
    # and the rest of the way is asked for
    assert len(story.asked(OffloadRequest)) == 2
    assert story.state.alpha.offload.n_moves == 1


def test_telemetry_of_the_move_itself_measures_nothing():
    story = a_story()
    story.tell(rtc(cm_id="cm-1", t_ns=story.now_ns))
    answer(story)
    story.see(AFTER)
    assert story.state.windows.refused == 1
    assert story.state.alpha.registration.n_windows == 0
    story.wait(3.0)
    story.see(AFTER)
    assert story.state.alpha.registration.n_windows == 1


def test_without_a_reply_it_may_have_moved_or_not():
    story = a_story()
    before = story.state.alpha.registration
    (asked,) = story.asked(OffloadRequest)
    story.tell(ev.JobFailed(effect=ev.Ask(request=asked), text="nobody answered"))
    known = story.state.alpha.registration
    np.testing.assert_array_equal(known.alpha.vector, before.alpha.vector)
    assert np.sqrt(known.covariance[0, 0]) >= 0.06
    assert story.state.alpha.offload.state is OffloadState.FAILED
    assert story.state.alpha.offload.n_moves == 0
    assert "offload.failed" in story.logged


def test_a_device_that_refuses_is_asked_again_later_and_alpha_stands():
    story = a_story()
    before = story.state.alpha.registration
    answer(story, accepted=False, reason="busy: the stage is parked")
    np.testing.assert_array_equal(story.state.alpha.registration.alpha.vector, before.alpha.vector)
    assert story.state.alpha.offload.text == "busy: the stage is parked"
    story.see(n_windows=4)
    assert len(story.asked(OffloadRequest)) == 1
    story.see(n_windows=14)
    assert len(story.asked(OffloadRequest)) == 2


def test_the_reach_of_the_device_is_never_left():
    short = replace(LIMITS, travel=np.array([0.04, 0.03, 0.0, 0.0]) / BOUNDARY_SCALE)
    story = a_story(policy=replace(MOVES, offloading=short))
    (asked,) = story.asked(OffloadRequest)
    assert asked.shift_x_subap == pytest.approx(-0.04)
    assert asked.rotation_deg == 0.0
    answer(story)
    story.wait(4.0)
    story.see(moved(shift_x_subap=-0.04, shift_y_subap=0.03), n_windows=6)
    assert len(story.asked(OffloadRequest)) == 1


@pytest.mark.parametrize("stops", [False, True])
def test_a_move_without_a_reply_counts_for_the_reach_for_it_may_have_been_made(tmp_path, stops):
    short = replace(LIMITS, travel=np.array([0.04, 0.03, 0.0, 0.0]) / BOUNDARY_SCALE)
    story = a_story(policy=replace(MOVES, offloading=short))
    (asked,) = story.asked(OffloadRequest)
    if stops:
        story = restarted(story, tmp_path)
        story.meet(cm_id="cm-1")
    else:
        story.tell(ev.JobFailed(effect=ev.Ask(request=asked), text="nobody answered"))
    np.testing.assert_allclose(
        story.state.alpha.offload.total * BOUNDARY_SCALE, [-0.04, 0.03, 0.0, 0.0]
    )
    n_asked = len(story.asked(OffloadRequest))
    story.wait(60.0)
    story.see(ALPHA, n_windows=20)
    assert len(story.asked(OffloadRequest)) == n_asked


def restarted(story, tmp_path):
    """The service five seconds later: what it knows went through the file on the disk."""
    file = TrackingFile(tmp_path / "tracking.json")
    file.write(saved_of(story.state, story.now_ns))
    now_ns = story.now_ns + 5 * SECOND
    fresh = tracker_state(system="flao", mode=Mode.AUTO)
    again = Story(Mode.AUTO, story.policy, state=resumed(fresh, file.read(), story.policy, now_ns))
    again.now_ns = now_ns
    return again


def test_the_reach_is_not_left_though_the_service_restarts_between_two_moves(tmp_path):
    short = replace(LIMITS, travel=np.array([0.04, 0.03, 0.0, 0.0]) / BOUNDARY_SCALE)
    story = a_story(policy=replace(MOVES, offloading=short))
    answer(story)
    again = restarted(story, tmp_path)
    np.testing.assert_allclose(again.state.alpha.offload.total, story.state.alpha.offload.total)
    assert again.state.alpha.offload.n_moves == 1
    again.meet(cm_id="cm-1")
    again.see(moved(shift_x_subap=-0.04, shift_y_subap=0.03), n_windows=20)
    assert again.asked(OffloadRequest) == []


def test_a_move_that_nobody_had_answered_when_the_service_ended_may_have_been_made(tmp_path):
    story = a_story()
    assert is_urgent(changed(story.state, offload=None), story.state)
    again = restarted(story, tmp_path)
    assert again.state.alpha.offload.state is OffloadState.FAILED
    before, after = (one.state.alpha.registration.covariance[0, 0] for one in (story, again))
    assert after >= before + 0.06**2


@pytest.mark.parametrize("answered", [True, False])
def test_telemetry_of_a_move_measures_nothing_for_the_next_service_either(tmp_path, answered):
    slow = replace(LIMITS, settle_s=20.0)
    story = a_story(policy=replace(MOVES, offloading=slow))
    if answered:
        answer(story)
    again = restarted(story, tmp_path)
    again.meet(cm_id="cm-1", t_ns=again.now_ns)
    again.see(ALPHA, n_windows=3)
    assert again.state.windows.refused == 3
    assert again.state.alpha.registration.n_windows == 0
    again.wait(20.0)
    again.see(AFTER, n_windows=2)
    assert again.state.alpha.registration.n_windows == 2
    assert not [name for name in again.logged if "jump" in name]


def test_what_else_happens_meanwhile_does_not_make_the_image_stand_still():
    story = a_story()
    story.tell(rtc(cm_id="cm-1", t_ns=story.now_ns))
    answer(story)
    story.tell(ev.ConditionChanged(name="loop-diverging", text="it does"))
    story.tell(ev.ConditionChanged(name="loop-diverging", text="", over=True))
    story.see(ALPHA)
    assert story.state.windows.refused == 1


def test_a_service_that_moves_nothing_forgets_where_the_device_was(tmp_path):
    story = a_story()
    answer(story)
    story.policy = STAYS
    assert restarted(story, tmp_path).state.alpha.offload is None


def test_the_image_is_not_led_away_from_the_matrix_in_use():
    """It was made for where the mirror is: a second step waits for the next matrix."""
    small = replace(LIMITS, max_step=np.array([0.03, 0.03, 0.2, 0.005]) / BOUNDARY_SCALE)
    story = a_story(policy=replace(MOVES, offloading=small))
    assert len(story.asked(OffloadRequest)) == 1
    answer(story)
    story.wait(4.0)
    story.see(moved(shift_x_subap=-0.03, shift_y_subap=0.03, rotation_rad=-0.0017), n_windows=6)
    assert {one.shift_x_subap for one in story.asked(OffloadRequest)[1:]} == {0.0}


def test_the_reply_may_say_from_which_frame_on_the_image_stands_still():
    story = a_story()
    story.meet(seq=10_000)
    now_ns = story.state.loop.rtc.t_ns
    answer(story, start_seq=17_000)
    assert end_of(story.state, MOVING) == pytest.approx(now_ns + 8 * SECOND, abs=SECOND / 10)
