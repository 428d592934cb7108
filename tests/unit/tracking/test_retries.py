"""What cannot be had now keeps nothing else waiting."""

from dataclasses import replace

import pytest

from service.tracking import events as ev
from service.tracking.state import Mode
from service.wire import DitherRequest
from tests.unit.tracking.situations import POLICY, Story, dither_answered, of_kind, rtc


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
