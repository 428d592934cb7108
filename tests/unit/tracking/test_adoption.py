"""A dither that runs already when the service meets the RTC: after a restart, or in a replay."""

from dataclasses import replace

import pytest

from service.runtime.translate import rtc_view
from service.tracking import events as ev
from service.tracking.alarms import OVER_BUDGET
from service.tracking.dither_plan import plan_dither, why_unusable
from service.wire import (
    DitherKind,
    DitherRequest,
    DitherStatus,
    Loop,
    Status,
)
from tests.unit.tracking.situations import POLICY, START_NS, Story, foreign, rtc

RUNNING = replace(plan_dither(rtc(), POLICY, START_NS), start_seq=4000, asked_ns_utc=0)


def with_dither(dither=RUNNING, **changes):
    return {"dither_id": dither.id, "dither": dither} | changes


def status(request):
    view = rtc()
    return Status(
        session=view.session,
        seq=5000,
        t_ns=START_NS,
        loop=Loop.CLOSED,
        frame_rate_hz=view.frame_rate_hz,
        delay_frames=view.delay_frames,
        gains=view.gains,
        leak=view.leak,
        n_slopes=view.n_slopes,
        n_modes=view.n_modes,
        n_controlled=view.n_controlled,
        cm_id=view.cm_id,
        basis_id=view.basis_id,
        config_id=view.config_id,
        dither=DitherStatus(request=request, start_seq=4000),
        max_dither_m=view.max_dither_m,
        max_dither_modes=view.max_dither_modes,
        magnitude=None,
        flux=None,
    )


def test_a_running_dither_is_adopted_with_its_first_frame_and_none_is_asked_for():
    story = Story().meet(**with_dither())
    assert story.state.dither == replace(RUNNING, asked_ns_utc=story.state.dither.asked_ns_utc)
    assert story.state.dither.asked_ns_utc >= START_NS
    assert not story.asked(ev.AskDither)
    assert not story.asked(ev.AskNoDither)
    assert "dither.adopted" in story.logged


def test_another_is_asked_for_when_the_adopted_one_has_ended():
    story = Story().meet(**with_dither())
    story.tell(ev.StatusSeen(rtc=rtc()), after_s=3)
    assert story.asked(ev.AskDither)


def test_a_refusal_because_one_runs_is_no_alarm_once_it_is_adopted():
    story = Story().meet()
    (asked,) = story.asked(ev.AskDither)
    story.tell(ev.DitherAnswered(id=asked.dither.id, accepted=False, reason="busy", start_seq=None))
    assert "dither" in story.alarms
    story.tell(ev.StatusSeen(rtc=rtc(**with_dither())))
    assert story.state.dither.id == RUNNING.id
    assert "dither" not in story.alarms


def test_an_operator_who_stopped_the_dither_is_obeyed():
    story = Story().meet(**with_dither())
    story.tell(ev.StopDither())
    story.tell(ev.StatusSeen(rtc=rtc(**with_dither())))
    assert story.state.dither is None


def test_lines_that_do_not_fit_a_window_are_not_adopted_and_the_services_own_is_stopped():
    odd = replace(RUNNING, frequency_hz=(211.317, 239.0, 283.0, 331.0))
    story = Story().meet(**with_dither(odd))
    assert story.state.dither is None
    assert story.asked(ev.AskNoDither)


def test_one_over_budget_from_before_a_restart_is_stopped_and_read_only_where_it_will_not_stop():
    loud = replace(RUNNING, amplitude_m=(20e-9,) * 4)
    story = Story()
    story.tell(ev.SessionStarted(session="s1"))
    assert story.tell(ev.StatusSeen(rtc=rtc(**with_dither(loud)))) == (
        ev.FetchMatrix(id="initial"),
        ev.AskNoDither(),
    )
    assert OVER_BUDGET in story.alarms
    story.tell(ev.MatrixFetched(record=foreign()))
    assert story.state.dither is None
    story.tell(ev.StatusSeen(rtc=rtc(**with_dither(loud))), after_s=1)
    assert story.state.dither is None
    story.tell(ev.StatusSeen(rtc=rtc(**with_dither(loud))), after_s=5)
    assert story.state.dither.id == loud.id


@pytest.mark.parametrize(
    ("kind", "frequency_hz", "seed"),
    [(DitherKind.SINE, (240.0, 260.0), None), (DitherKind.BINARY, None, 7)],
)
def test_only_a_sine_of_the_status_can_be_demodulated(kind, frequency_hz, seed):
    request = DitherRequest(
        id="d-1",
        kind=kind,
        modes=(501, 520),
        amplitude_m=(5e-9, 4e-9),
        frequency_hz=frequency_hz,
        duration_s=60.0,
        seed=seed,
    )
    view = rtc_view(status(request))
    assert view.dither_id == "d-1"
    if kind is DitherKind.BINARY:
        assert why_unusable(view.dither, view, POLICY) == "d-1 is binary, not a sine"
    else:
        assert (view.dither.modes, view.dither.start_seq) == ((501, 520), 4000)
        assert view.dither.frequency_hz == frequency_hz
