"""References for a shape: offered like a reconstructor, followed, and read back."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError, UnknownIdError
from service.model.misregistration import Misregistration
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import Frame, MatrixState, ShapeKind
from service.records.state import Mode, ReferenceStates
from service.tracking.invariants import find_violations
from service.tracking.references import (
    FOLLOW_INTERVAL_S,
    READ_BACK_INTERVAL_S,
    RETRY_INTERVAL_S,
    explain_waiting,
    mean_gain,
)
from service.tracking.resume import restored_references
from tests.support.shaped import LOADED, OTHER_SUM, ShapedStory
from tests.support.situations import ALPHA, moved, rtc
from tests.support.states import changed


@pytest.fixture
def auto():
    return ShapedStory(Mode.AUTO).load()


def states(story):
    return [record.state for record in story.references]


def test_a_loaded_shape_has_references_made_at_once():
    story = ShapedStory(Mode.PROPOSE)
    assert not story.asked(ev.MakeReferences)
    story.load()
    (asked,) = story.asked(ev.MakeReferences)
    assert asked.worst_seeing_arcsec == 1.2
    shape = story.state.references.shape
    assert shape.values == pytest.approx((0.0, 0.0, 60e-9))
    assert (shape.by, shape.frame) == ("E. Hubble", Frame.MIRROR)


def test_in_propose_they_wait_for_approval_and_are_applied_when_the_status_names_them():
    story = ShapedStory(Mode.PROPOSE).load().make_references()
    assert states(story) == [MatrixState.PROPOSED]
    story.wait(5)
    assert not story.asked(ev.SendReferences)
    story.tell(cmd.ApproveReferences(id=story.last.id, by="E. Hubble"))
    (sent,) = story.asked(ev.SendReferences)
    assert (sent.id, sent.ramp_s) == (story.last.id, 1.0)
    story.answer_references()
    assert states(story) == [MatrixState.PUBLISHED]
    story.name_references(f"{story.last.id}~")
    assert states(story) == [MatrixState.STAGED]
    assert story.state.references.used_id is None
    story.name_references()
    assert states(story) == [MatrixState.APPLIED]
    assert story.last.by == "E. Hubble"
    assert story.last.applied_ns_utc == story.now_ns
    assert "references.applied" in story.logged


def test_in_auto_they_are_sent_without_approval_and_read_back(auto):
    auto.make_references()
    assert [one.id for one in auto.asked(ev.SendReferences)] == [auto.last.id]
    auto.name_references()
    assert len(auto.asked(ev.FetchReferences)) == 1
    auto.show_references()
    assert auto.state.references.verified_id == auto.last.id
    auto.wait(3 * READ_BACK_INTERVAL_S)
    assert len(auto.asked(ev.FetchReferences)) == 1


def test_references_that_the_rtc_does_not_show_are_asked_for_again(auto):
    auto.use_references()
    auto.wait(READ_BACK_INTERVAL_S + 1.0)
    assert len(auto.asked(ev.FetchReferences)) == 2


@pytest.mark.parametrize(
    ("gain", "alpha", "n_made"),
    [
        (0.6, ALPHA, 1),
        (0.62, ALPHA, 1),
        (0.65, ALPHA, 2),
        (0.55, ALPHA, 2),
        (0.6, moved(shift_x_subap=0.08), 1),
        (0.6, moved(shift_x_subap=0.12), 2),
        (0.6, moved(rotation_rad=np.deg2rad(0.6)), 2),
    ],
)
def test_others_are_made_when_gain_or_registration_has_changed_by_a_share(
    auto, gain, alpha, n_made
):
    auto.use_references()
    known = replace(auto.state.alpha.registration, alpha=alpha)
    auto.state = changed(auto.state, registration=known)
    auto.measure_gain(gain)
    auto.wait(FOLLOW_INTERVAL_S - 2.0)
    assert len(auto.asked(ev.MakeReferences)) == 1
    auto.wait(4.0)
    assert len(auto.asked(ev.MakeReferences)) == n_made


def test_a_change_of_references_touches_nothing_else(auto):
    before = auto.state
    auto.use_references()
    after = auto.state
    assert after.alpha.registration.alpha == before.alpha.registration.alpha
    assert after.matrices.in_use == before.matrices.in_use
    assert after.operations.probation is before.operations.probation
    assert after.alarms.active == ()


def test_those_in_use_before_are_superseded_and_a_rollback_sends_them_again(auto):
    auto.use_references()
    first = auto.last
    auto.measure_gain(0.5).wait(FOLLOW_INTERVAL_S)
    auto.use_references()
    assert states(auto) == [MatrixState.SUPERSEDED, MatrixState.APPLIED]
    auto.tell(cmd.RollBackReferences(by="E. Hubble", reason="image got worse"))
    assert (auto.last.parent, auto.last.sha256) == (first.id, first.sha256)
    assert auto.asked(ev.SendReferences)[-1].id == auto.last.id != first.id
    auto.name_references()
    assert auto.state.references.used_id == auto.last.id
    auto.measure_gain(0.7).wait(2 * FOLLOW_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 2
    assert "rolled back" in explain_waiting(auto.state)
    auto.load()
    assert len(auto.asked(ev.MakeReferences)) == 3


def test_the_first_rollback_and_a_cleared_shape_send_zeros(auto):
    auto.use_references()
    auto.tell(cmd.RollBackReferences())
    assert (auto.last.shape, auto.last.parent) == (None, None)
    auto.name_references()
    auto.load().use_references()
    auto.tell(cmd.ClearShape())
    assert (auto.last.shape, auto.last.state) == (None, MatrixState.PUBLISHED)
    auto.name_references().wait(2 * RETRY_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 2


def test_rejected_references_are_made_no_more():
    story = ShapedStory(Mode.PROPOSE).load().make_references()
    story.tell(cmd.RejectReferences(id=story.last.id, reason="sign unclear"))
    assert states(story) == [MatrixState.DISCARDED]
    story.wait(2 * RETRY_INTERVAL_S)
    assert len(story.asked(ev.MakeReferences)) == 1


def test_a_shape_that_is_too_large_is_refused_and_those_in_use_stay(auto):
    auto.use_references()
    used = auto.last.id
    auto.load()
    auto.make_references(MatrixState.REFUSED, reason="100 nm, at most 70 nm")
    assert auto.last.state is MatrixState.REFUSED
    assert auto.state.references.used_id == used
    assert len(auto.asked(ev.SendReferences)) == 1


def test_after_a_refusal_the_shape_before_is_followed_and_the_refused_one_is_not_sent(auto):
    auto.use_references()
    held = auto.state.references.shape
    auto.load()
    auto.make_references(MatrixState.REFUSED, reason="100 nm, at most 70 nm")
    assert auto.state.references.shape == held
    auto.wait(FOLLOW_INTERVAL_S)
    auto.see(n_windows=3)
    auto.measure_gain(0.5).wait(1.0)
    auto.make_references()
    assert auto.last.shape == held.id
    assert len(auto.asked(ev.SendReferences)) == 2


def test_a_refusal_does_not_end_the_pause_of_the_shape_before(auto):
    auto.use_references()
    auto.tell(cmd.RollBackReferences(reason="the image is worse"))
    auto.name_references().wait(1.0)
    paused = auto.state.references.paused
    auto.load()
    auto.make_references(MatrixState.REFUSED, reason="100 nm, at most 70 nm")
    assert auto.state.references.paused == paused != ""


def test_references_without_an_answer_are_given_up_and_made_again_later(auto):
    auto.make_references()
    auto.wait(15.0)
    assert states(auto) == [MatrixState.FAILED]
    auto.wait(RETRY_INTERVAL_S)
    auto.see(n_windows=3)
    auto.measure_gain(0.6).wait(1.0)
    assert len(auto.asked(ev.MakeReferences)) == 2


def test_an_rtc_that_cannot_is_told_apart(auto):
    auto.make_references()
    auto.answer_references(accepted=False, reason="unsupported: the RTC offers no references")
    assert states(auto) == [MatrixState.REJECTED]
    assert "topic references" in auto.state.references.unsupported
    auto.wait(3 * RETRY_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 1
    # Another program may apply them.
    auto.name_references()
    assert states(auto) == [MatrixState.APPLIED]


def test_other_numbers_than_sent_are_named_and_in_auto_the_rtc_returns_to_its_own(auto):
    auto.use_references()
    wrong = auto.last.id
    auto.show_references(OTHER_SUM)
    assert alarms.REFERENCES_MISAPPLIED in auto.alarms
    assert (auto.last.shape, auto.last.state) == (None, MatrixState.PUBLISHED)
    auto.name_references().show_references()
    assert alarms.REFERENCES_MISAPPLIED not in auto.alarms
    assert auto.state.references_of(wrong).state is MatrixState.SUPERSEDED
    auto.wait(2 * RETRY_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 1


@pytest.mark.parametrize(("log_odds", "wrong"), [(-20.0, False), (7.9, False), (8.1, True)])
def test_references_are_named_where_another_shape_is_much_more_likely(auto, log_odds, wrong):
    auto.use_references()
    auto.show_references()
    used = auto.last.id
    held = ev.ShapeHeld(id=used, ratio=2.1, sigma=0.1, other="twice as large", log_odds=log_odds)
    auto.tell(held)
    found = auto.state.references_of(used)
    assert (found.held_ratio, found.held_sigma) == (2.1, 0.1)
    assert (alarms.REFERENCES_MISAPPLIED in auto.alarms) is wrong
    assert ("twice as large" in auto.state.references.difference) is wrong
    assert (auto.last.shape is None) is wrong


def test_a_loop_that_slips_does_not_show_what_is_held(auto):
    """It once held 3.5 ± 0.5 times the shape, and its references were taken back."""
    auto.use_references().show_references()
    used, began_ns = auto.last.id, auto.now_ns
    held = ev.ShapeHeld(id=used, ratio=3.5, sigma=0.5, log_odds=20.0, began_ns_utc=began_ns)
    for over in (False, True):
        auto.wait(5.0)
        slip = ev.ConditionChanged(
            name=alarms.EDGE_SLIP, text="slipped", over=over, t_ns_utc=auto.now_ns
        )
        auto.tell(slip)
        auto.tell(held)
    assert alarms.REFERENCES_MISAPPLIED not in auto.alarms
    assert auto.state.references_of(used).held_ratio is None
    auto.tell(replace(held, began_ns_utc=auto.now_ns))
    assert alarms.REFERENCES_MISAPPLIED in auto.alarms


def test_in_the_first_window_after_a_change_of_seeing_no_references_are_made(auto):
    auto.use_references()
    auto.measure_gain(0.5, sigma=0.1).wait(2 * FOLLOW_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 1
    auto.measure_gain(0.4, sigma=0.02).wait(1.0)
    assert len(auto.asked(ev.MakeReferences)) == 2


def test_the_return_to_the_rtcs_own_references_is_not_judged(auto):
    auto.use_references()
    auto.tell(ev.ShapeHeld(id=auto.last.id, ratio=-1.0, sigma=0.1, log_odds=20.0))
    auto.name_references().show_references()
    assert alarms.REFERENCES_MISAPPLIED not in auto.alarms
    auto.tell(ev.ShapeHeld(id=auto.last.id, ratio=-1.0, sigma=0.1, log_odds=20.0))
    assert alarms.REFERENCES_MISAPPLIED not in auto.alarms
    assert auto.last.held_ratio is None


def test_in_propose_other_numbers_are_named_and_nothing_is_sent():
    story = ShapedStory(Mode.PROPOSE).load().use_references()
    story.show_references(OTHER_SUM)
    assert alarms.REFERENCES_MISAPPLIED in story.alarms
    assert len(story.asked(ev.SendReferences)) == 1


def test_what_the_rtc_shows_during_a_ramp_says_nothing(auto):
    auto.use_references()
    auto.show_references(OTHER_SUM, name="ref-other~")
    assert alarms.REFERENCES_MISAPPLIED not in auto.alarms


def test_a_restarted_rtc_is_offered_references_again(auto):
    auto.use_references()
    auto.tell(ev.SessionStarted(session="s2"))
    auto.tell(rtc(session="s2", reference_id="own"))
    assert auto.state.references.used_id is None
    assert states(auto) == [MatrixState.SUPERSEDED]
    auto.see(n_windows=6)
    auto.measure_gain(0.6).wait(FOLLOW_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 2


def test_a_new_session_that_keeps_the_offset_keeps_the_references(auto):
    auto.use_references()
    auto.show_references()
    auto.tell(ev.SessionStarted(session="s2"))
    auto.tell(rtc(session="s2", reference_id=auto.last.id))
    assert states(auto) == [MatrixState.APPLIED]
    assert len(auto.asked(ev.FetchReferences)) == 2


def test_references_that_another_program_changes_are_left_to_it(auto):
    auto.use_references()
    auto.name_references("of-another")
    assert states(auto) == [MatrixState.SUPERSEDED]
    auto.wait(2 * RETRY_INTERVAL_S)
    assert len(auto.asked(ev.MakeReferences)) == 1
    assert "of-another" in explain_waiting(auto.state)


def test_a_restarted_service_knows_those_in_use_by_their_name(auto):
    auto.use_references()
    kept = restored_references(auto.references)
    after = ShapedStory(Mode.AUTO)
    left = ReferenceStates(records=kept, shape=auto.state.references.shape)
    after.state = replace(after.state, references=left)
    after.name_references()
    assert after.state.references.used_id == auto.last.id
    assert after.last.reason == ""
    after.wait(FOLLOW_INTERVAL_S)
    assert not after.asked(ev.MakeReferences)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"basis_id": "zernike-100"}, "found zernike-100, expected kl-594"),
        ({"values": (0.0,) * 450 + (60.0,)}, "found mode 450, expected modes below 400"),
        (
            {"kind": ShapeKind.SLOPES, "frame": Frame.INSTRUMENT, "unit": None},
            "slopes: found 3, expected 1384",
        ),
    ],
)
def test_a_shape_of_another_basis_or_sensor_is_refused(changes, text):
    story = ShapedStory()
    with pytest.raises(CommandError, match=text):
        story.load(replace(LOADED, **changes))
    assert story.state.references.shape is None


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"unit": "m"}, "found 60 m, is the unit m"),
        ({"unit": None}, "a unit"),
        ({"frame": Frame.INSTRUMENT}, "frame mirror with modes"),
        ({"values": (0.0, 0.0, 0.0)}, "found 0 m"),
        ({"kind": ShapeKind.MAP, "frame": Frame.INSTRUMENT}, "found 3 values"),
    ],
)
def test_a_shape_that_cannot_be_meant_is_refused(changes, text):
    with pytest.raises(ValueError, match=text):
        replace(LOADED, **changes)


def test_unknown_references_are_refused(auto):
    with pytest.raises(UnknownIdError):
        auto.tell(cmd.ApproveReferences(id="ref-0"))


def test_the_mean_gain_is_that_of_the_modes_of_the_shape(auto):
    measured = auto.state.alpha.registration.optical_gains
    assert mean_gain((0.0, 0.0, 1e-8), measured) == pytest.approx(0.6, rel=0.1)
    assert mean_gain((0.0, 0.0, 5e-8), measured) == mean_gain((0.0, 0.0, 1e-8), measured)


def test_a_story_of_references_violates_nothing(auto):
    auto.use_references()
    auto.tell(cmd.RollBackReferences())
    auto.name_references()
    assert find_violations(auto.state) == []
    assert auto.state.alpha.registration.alpha != Misregistration()
