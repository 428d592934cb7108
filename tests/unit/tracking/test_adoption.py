"""A dither that runs already when the service meets the RTC: after a restart, or in a replay."""

from dataclasses import replace

from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.alarms import OVER_BUDGET
from service.tracking.dither_request import (
    Dither,
    DitherParameters,
    check_dither_usable,
    plan_dither,
)
from service.wire import DitherRequest, DitherStop
from tests.unit.tracking.situations import (
    POLICY,
    START_NS,
    Story,
    dither_answered,
    dither_request,
    foreign,
    rtc,
    stopping,
)

CHOICE = DitherParameters(total_m=8e-9, window_s=2.0, n_windows=59)
RUNNING = replace(plan_dither(rtc(), POLICY, START_NS, choice=CHOICE), start_seq=4000)


def with_dither(dither=RUNNING, **changes):
    return {"dither": dither} | changes


def other(**changes):
    """The dither that runs, with something of its request otherwise."""
    return replace(RUNNING, request=replace(RUNNING.request, **changes))


def test_a_running_dither_is_adopted_with_its_first_frame_and_none_is_asked_for():
    story = Story().meet(**with_dither())
    assert story.state.dithers.dither == replace(
        RUNNING, asked_ns_utc=story.state.dithers.dither.asked_ns_utc
    )
    assert story.state.dithers.dither.asked_ns_utc >= START_NS
    assert not story.asked(DitherRequest)
    assert not story.asked(DitherStop)
    assert "dither.adopted" in story.logged


def test_another_is_asked_for_when_the_adopted_one_has_ended():
    story = Story().meet(**with_dither())
    story.tell(rtc(), after_s=3)
    assert story.asked(DitherRequest)


def test_a_refusal_because_one_runs_is_no_alarm_once_it_is_adopted():
    story = Story().meet()
    (asked,) = story.asked(DitherRequest)
    story.tell(dither_answered(asked.id, accepted=False, reason="busy", start_seq=None))
    assert "dither" in story.alarms
    story.tell(rtc(**with_dither()))
    assert story.state.dithers.dither.id == RUNNING.id
    assert "dither" not in story.alarms


def test_an_operator_who_stopped_the_dither_is_obeyed():
    story = Story().meet(**with_dither())
    story.tell(cmd.StopDither())
    story.tell(rtc(**with_dither()))
    assert story.state.dithers.dither is None


def test_lines_that_do_not_fit_a_window_are_not_adopted_and_the_services_own_is_stopped():
    odd = other(frequency_hz=(211.317, 239.0, 283.0, 331.0))
    story = Story().meet(**with_dither(odd))
    assert story.state.dithers.dither is None
    assert story.asked(DitherStop)


def test_one_over_budget_from_before_a_restart_is_stopped_and_read_only_where_it_will_not_stop():
    loud = other(amplitude_m=(20e-9,) * 4)
    story = Story()
    story.tell(ev.SessionStarted(session="s1"))
    assert story.tell(rtc(**with_dither(loud))) == (
        ev.FetchMatrix(id="initial"),
        stopping(story),
    )
    assert OVER_BUDGET in story.alarms
    story.tell(ev.MatrixFetched(record=foreign()))
    assert story.state.dithers.dither is None
    story.tell(rtc(**with_dither(loud)), after_s=1)
    assert story.state.dithers.dither is None
    story.tell(rtc(**with_dither(loud)), after_s=5)
    assert story.state.dithers.dither.id == loud.id


def test_only_a_sine_can_be_demodulated():
    random = Dither(request=dither_request("d-1"), start_seq=4000, asked_ns_utc=0)
    assert check_dither_usable(random, rtc(), POLICY) == "d-1 is binary, not a sine"
    assert check_dither_usable(RUNNING, rtc(), POLICY) is None
