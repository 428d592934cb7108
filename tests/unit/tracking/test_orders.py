"""What an operator has ordered outlives the service."""

from dataclasses import replace

import pytest

from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.resume import resumed, saved_of
from service.tracking.state import Level, Mode
from service.wire import DitherRequest, DitherStop
from tests.states import tracker_state
from tests.unit.tracking.situations import (
    ALPHA,
    POLICY,
    SECOND,
    Story,
    of_kind,
    rtc,
)


def restarted(before, mode=Mode.AUTO, **changes):
    """Return the service five seconds later, its settings saying ``mode``."""
    now_ns = before.now_ns + 5 * SECOND
    fresh = tracker_state(**({"system": "flao", "mode": mode} | changes))
    saved = saved_of(before.state, before.now_ns)
    state = fresh if saved is None else resumed(fresh, saved, POLICY, now_ns)
    again = Story(state=state)
    again.now_ns = now_ns
    return again


@pytest.fixture
def rolled_back():
    """In auto, by the settings; the operator has gone back to the matrix before."""
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    story.use("cm-1").use("cm-2")
    story.tell(cmd.Rollback())
    story.make("copy", alpha=ALPHA, wanted=True)
    story.acknowledge("copy")
    assert story.state.operator.mode is Mode.HOLD
    return story


class TestTheMode:
    def test_a_matrix_gone_back_to_is_not_replaced_after_a_restart(self, rolled_back):
        again = restarted(rolled_back)
        assert again.state.operator.mode is Mode.HOLD
        again.meet(cm_id="copy")
        again.see(replace(ALPHA, shift_x_subap=0.3), n_windows=10)
        assert not again.asked(ev.MakeMatrix)
        (entry,) = [entry for entry in again.state.log if entry.name == "mode"]
        assert entry.level is Level.WARNING
        assert "mode is hold, as an operator set it" in entry.text
        assert "not auto as the settings say; set the mode to" in entry.text

    def test_it_stands_through_two_restarts(self, rolled_back):
        assert restarted(restarted(rolled_back)).state.operator.mode is Mode.HOLD

    def test_settings_that_have_been_changed_since_have_the_last_word(self, rolled_back):
        again = restarted(rolled_back, Mode.PROPOSE)
        assert again.state.operator.mode is Mode.PROPOSE
        assert restarted(again, Mode.AUTO).state.operator.mode is Mode.AUTO

    def test_what_was_said_last_counts(self, rolled_back):
        rolled_back.tell(cmd.SetMode(mode=Mode.PROPOSE))
        assert restarted(rolled_back).state.operator.mode is Mode.PROPOSE
        rolled_back.tell(cmd.SetMode(mode=Mode.AUTO))
        again = restarted(rolled_back)
        assert again.state.operator.mode is Mode.AUTO
        assert "mode" not in again.logged

    def test_where_nobody_has_ordered_one_the_settings_may_change_it(self):
        story = Story(Mode.HOLD).meet()
        story.see(n_windows=3)
        again = restarted(story, Mode.AUTO)
        assert again.state.operator.mode is Mode.AUTO
        assert "mode" not in again.logged


class TestTheDither:
    def test_off_it_stays_off_until_the_operator_wants_it(self):
        story = Story().meet()
        story.tell(cmd.StopDither())
        again = restarted(story)
        again.meet()
        again.wait(60)
        assert not again.asked(DitherRequest)
        assert again.state.dithers.policy.reason == "stopped by the operator"
        assert of_kind(again.tell(cmd.StartDither()), DitherRequest)
        assert not restarted(again).state.dithers.stopped

    def test_what_the_dead_service_left_on_the_mirror_is_stopped(self):
        story = Story().meet()
        dither = replace(story.state.dithers.dither, start_seq=1000, asked_ns_utc=0)
        story.tell(cmd.StopDither())
        again = restarted(story).meet(dither_id=dither.id, dither=dither)
        assert again.asked(DitherStop)
        assert again.state.dithers.dither is None


@pytest.mark.parametrize("changes", [{"basis_id": "kl-300"}, {"config_id": "binned"}])
def test_orders_stand_where_alpha_does_not_fit(rolled_back, changes):
    rolled_back.tell(cmd.StopDither())
    again = restarted(rolled_back, **changes)
    assert again.state.alpha.registration is None
    assert (again.state.operator.mode, again.state.dithers.stopped) == (Mode.HOLD, True)


def test_those_for_another_system_are_none(rolled_back):
    rolled_back.tell(cmd.StopDither())
    again = restarted(rolled_back, system="other")
    assert (again.state.operator.mode, again.state.dithers.stopped) == (Mode.AUTO, False)


def test_a_new_session_of_the_rtc_undoes_none(rolled_back):
    rolled_back.tell(cmd.StopDither())
    rolled_back.tell(ev.SessionStarted(session="s2"))
    rolled_back.tell(rtc(session="s2"))
    assert (rolled_back.state.operator.mode, rolled_back.state.dithers.stopped) == (
        Mode.HOLD,
        True,
    )
