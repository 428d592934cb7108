"""What keeps a wanted reconstructor from being made is in the state, with what to change."""

from dataclasses import replace

import numpy as np
import pytest

from service.records import events as ev
from service.records.messages import compose
from service.records.products import ModeProof
from service.records.state import Mode
from service.tracking.mode_proof import awaits_proof
from service.tracking.step_context import StepContext
from service.wire import DitherRequest
from tests.support.situations import POLICY, PRECISE, Story, dither_answered, of_kind, rtc
from tests.support.states import changed


def hindrance(story):
    return story.state.matrices.hindrance


def test_nothing_hinders_a_service_that_has_just_begun():
    assert hindrance(Story().meet()) == ""


def test_a_dither_that_the_settings_forbid_is_named():
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    assert "[dither] enabled" in hindrance(story)


def test_windows_that_give_no_registration_are_named_with_their_reason():
    story = Story().meet()
    for _ in range(3):
        story.see(covariance=PRECISE * 1e4)
    assert "too uncertain" in hindrance(story)


def test_an_alarm_that_forbids_sending_is_named():
    story = Story().meet()
    story.tell(ev.ConditionChanged(name="matrix-mismatch", text="mode 10 has the other sign"))
    story.tell(ev.Tick(), after_s=1.0)
    assert "matrix-mismatch" in hindrance(story)
    story.tell(ev.ConditionChanged(name="matrix-mismatch", text="over", over=True))
    story.tell(ev.Tick(), after_s=1.0)
    assert hindrance(story) == ""


def test_an_invalid_registration_is_named_with_the_settings_that_make_it_surer():
    story = Story().meet()
    story.see(n_windows=2)
    known = story.state.alpha.registration
    wide = replace(known, covariance=np.diag(POLICY.useless_sigma**2) * 4.0)
    story.state = changed(story.state, registration=wide)
    story.tell(ev.Tick(), after_s=1.0)
    assert "budget_m" in hindrance(story)


@pytest.mark.parametrize("refused", [True, False])
def test_a_stronger_dither_is_no_remedy_where_no_window_is_accepted(refused):
    """A frozen RTC, or one that loses its frames: α grows uncertain because nothing comes."""
    story = Story().meet()
    story.see(n_windows=2)
    story.tell(ev.Tick(), after_s=1.0)
    known = story.state.alpha.registration
    wide = replace(known, covariance=np.diag(POLICY.useless_sigma**2) * 4.0)
    run = -5 if refused else 0
    windows = replace(story.state.windows, run=run, refused_because=compose("window.no-rtc"))
    story.state = changed(story.state, registration=wide, windows=windows)
    story.now_ns += 600 * 10**9 * (not refused)
    story.tell(ev.Tick(), after_s=1.0)
    assert "budget_m" not in hindrance(story)
    assert ("the RTC is not known" if refused else "No window comes any more") in hindrance(story)


class Unseen(Story):
    all_shown = False


def test_modes_that_no_dither_may_show_are_named():
    story = Unseen().meet()
    story.see(n_windows=2)
    story.policy = replace(POLICY, dither_enabled=False)
    story.tell(ev.Tick(), after_s=1.0)
    assert "has not been shown" in hindrance(story)


def test_a_mode_that_answers_otherwise_is_named():
    story = Unseen().meet()
    story.see(n_windows=2)
    proof = ModeProof(proven=frozenset(range(420)), contrary=frozenset({420}))
    story.state = changed(story.state, mode_proof=proof)
    story.tell(ev.Tick(), after_s=1.0)
    assert "Mode 420 does not answer" in hindrance(story)


def test_in_hold_nothing_is_wanted():
    story = Story(Mode.HOLD, policy=replace(POLICY, dither_enabled=False)).meet()
    assert hindrance(story) == ""


@pytest.mark.parametrize("modes", [None, (20, 22, 24, 26)])
def test_modes_that_the_settings_dither_leave_the_proof_of_others_on(modes):
    story = Unseen(policy=replace(POLICY, dither_modes=modes)).meet()
    view = rtc()
    context = StepContext(story.state, story.policy, story.now_ns)
    assert awaits_proof(context, view)


def test_not_found_names_order_and_signs_only_where_the_own_matrix_does_not_deny_it():
    for recognised, said in ((False, "in another order"), (True, "are not the cause")):
        story = Story(policy=replace(POLICY, acquires=True)).meet()
        if recognised:
            event = ev.ModesRecognised(id="initial", strange=(), text="all", response=1.0)
            story.tell(event)
        story.state = changed(story.state, holds=True)
        for _ in range(8):
            story.see(replace(story.policy.start, rotation_rad=1.0))
        text = {a.name: a.text for a in story.state.alarms.active}["registration-not-found"]
        assert said in text


# --- what cannot be had now keeps nothing else waiting


def tracked(rate_hz=1000.0, **policy):
    """α is known, in ``auto``, on an RTC of this frame rate; three minutes go by."""
    story = Story(Mode.AUTO, replace(POLICY, n_modes_target=400, **policy))
    story.meet(frame_rate_hz=rate_hz)
    story.see(n_windows=4)
    story.effects.clear()
    for _ in range(90):
        seen = rtc(frame_rate_hz=rate_hz, t_ns=story.now_ns)
        story.tell(seen, 1.0)
        story.tell(ev.Tick(), 1.0)
    return story


@pytest.mark.parametrize("rate_hz", [1000.0, 80.0, 40.0])
def test_matrices_are_made_though_no_dither_fits_the_frame_rate(rate_hz):
    assert tracked(rate_hz).asked(ev.MakeMatrix)


def test_what_can_be_dithered_at_such_a_rate_is_said():
    story = tracked(80.0)
    (alarm,) = [alarm for alarm in story.state.alarms.active if alarm.name == "dither"]
    assert "room for the side bins" in alarm.text
    assert "random signs" in alarm.text


def test_a_dither_that_the_rtc_refuses_keeps_no_matrix_waiting():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=1)
    dither = story.state.dithers.dither
    story.tell(dither_answered(dither.id, accepted=False, reason="busy", start_seq=None))
    assert of_kind(story.see(n_windows=1), ev.MakeMatrix)
    assert not story.asked(DitherRequest)[1:]


def test_a_matrix_that_cannot_be_fetched_keeps_no_dither_waiting():
    story = Story(Mode.AUTO).meet()
    story.see()
    story.tell(rtc(cm_id="foreign"))
    (fetch,) = story.asked(ev.FetchMatrix)[1:]
    story.effects.clear()
    story.tell(ev.JobFailed(effect=fetch, text="no answer"))
    story.tell(
        dither_answered(story.state.dithers.dither.id, accepted=True, reason="", start_seq=5), 0.1
    )
    story.tell(rtc(cm_id="foreign", seq=500_000), 1.0)
    assert story.asked(DitherRequest)


def test_a_matrix_that_could_not_be_made_keeps_no_dither_waiting():
    story = Story(Mode.AUTO, replace(POLICY, dither_enabled=False)).meet()
    story.see(n_windows=2)
    (made,) = story.asked(ev.MakeMatrix)
    story.policy = POLICY
    story.tell(ev.JobFailed(effect=made, text="no memory"))
    assert story.asked(DitherRequest)
    assert len(story.asked(ev.MakeMatrix)) == 1
    story.wait(6)
    assert len(story.asked(ev.MakeMatrix)) == 2
