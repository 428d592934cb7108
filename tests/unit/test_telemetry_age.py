"""Telemetry that arrives late is named and not used; clocks that differ are no delay."""

import numpy as np
import pytest

from service.link.intake import Intake
from service.link.session import Endpoint
from service.link.statistics import MAX_AGE_S
from service.records import events as ev
from service.records.alarms import Interlock, blocking_alarm
from service.records.state import Mode
from service.runtime.readiness import complaints
from service.wire import FrameHeader, encode, encode_frames
from tests.support.situations import START_NS, Story
from tests.support.situations import rtc as status

N_FRAMES = 20


class Night:
    """An RTC whose batches arrive after a delay; ``now_s`` is the time of the newest one."""

    def __init__(self, *, stamped=True, batch_s=0.1):
        self.now_s, self.stamped = 100.0, stamped
        self.batch_s, self.dt_ns = batch_s, round(1e9 * batch_s / N_FRAMES)
        self.intake = Intake(Endpoint(system="bench"), lambda: self.now_s)
        self.session, self.seq, self.delay_s = "s1", 0, 0.0
        self.clock_error_s = self.stamp_error_s = 0.0
        self.n_used, self.worst_s = 0, 0.0
        self.named_s = None

    def play(self, seconds, share=1.0, frame_error=0.0):
        """Send for so long over a link that carries a share of it; a queue is never dropped."""
        until_s = self.now_s - self.delay_s + seconds
        while (sent_s := self.now_s - self.delay_s) < until_s:
            frame_s = self.batch_s * (1.0 + frame_error)
            carry_s = frame_s if self.delay_s <= 0 and share >= 1 else self.batch_s / share
            sent_s += frame_s
            self.now_s = max(sent_s, self.now_s + carry_s)
            self.delay_s = self.now_s - sent_s
            self._send(sent_s)

    def _send(self, sent_s):
        header = FrameHeader(
            session=self.session,
            seq0=self.seq,
            n=N_FRAMES,
            t0_ns=START_NS + self.seq * self.dt_ns + round(1e9 * self.clock_error_s),
            dt_ns=self.dt_ns,
            n_slopes=3,
            n_modes=2,
            dither=False,
            cm_id=None,
            basis_id="b",
            config_id="c",
        )
        self.seq += N_FRAMES
        rows = np.zeros((N_FRAMES, 5), np.float32)
        latency_s = self.now_s - sent_s + self.stamp_error_s if self.stamped else None
        self.intake.frames(*encode_frames(header, rows), latency_s=latency_s)
        self.n_used += sum(block.n_frames for block in self.intake.drain())
        self.worst_s = max(self.worst_s, self.age_s)
        if self.named_s is None and "telemetry-old" in complaints(self.intake.statistics()):
            self.named_s = self.delay_s

    @property
    def age_s(self):
        return self.intake.statistics().telemetry_age_s


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("share", [0.45, 0.8])
def test_a_slow_link_is_named_before_telemetry_is_3_s_old_and_nothing_old_is_used(stamped, share):
    night = Night(stamped=stamped)
    night.play(10.0)
    assert (night.named_s, night.n_used) == (None, night.seq)
    night.play(30.0, share)
    assert 2.0 < night.named_s < 3.0
    assert night.age_s == pytest.approx(night.delay_s, rel=0.05)
    used_s = 1e-9 * night.n_used * night.dt_ns
    assert used_s == pytest.approx(10.0 + MAX_AGE_S * share / (1.0 - share), rel=0.1)
    link = night.intake.statistics()
    assert link.frames_refused == {"old": night.seq - night.n_used}
    assert (link.frames_lost, link.frames_late, link.frames_overwritten) == (0, 0, 0)
    assert set(complaints(link)) == {"telemetry-old"}
    night.play(100.0, 1.0 / share)
    assert night.delay_s == pytest.approx(0.0, abs=1e-6)
    before, sent = night.n_used, night.seq
    night.play(5.0)
    assert night.n_used - before == night.seq - sent
    assert not complaints(night.intake.statistics())


@pytest.mark.parametrize("stamped", [True, False])
def test_a_delay_that_stays_for_an_hour_is_not_forgotten(stamped):
    night = Night(stamped=stamped, batch_s=1.0)
    night.play(5.0)
    night.play(4.0, 0.25)
    used = night.n_used
    night.play(3600.0)
    assert night.age_s == pytest.approx(night.delay_s, abs=0.1)
    assert night.n_used == used


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("error", [-1e-3, 1e-3, 5e-3])
def test_a_rate_that_differs_from_dt_for_an_hour_is_no_age(stamped, error):
    night = Night(stamped=stamped, batch_s=1.0)
    night.play(3600.0, frame_error=error)
    assert night.worst_s < 0.1
    assert night.n_used == night.seq


def test_an_rtc_in_slow_motion_that_stamps_its_messages_is_not_old():
    night = Night()
    night.play(100.0, frame_error=19.0)
    assert night.worst_s < 0.1


@pytest.mark.parametrize("stamped", [True, False])
def test_a_clock_that_is_set_and_a_pause_of_the_loop_are_no_age(stamped):
    night = Night(stamped=stamped)
    for error_s in (3600.0, 0.0, -3600.0, 0.0):
        night.play(2.0)
        night.clock_error_s = error_s
    night.play(2.0)
    night.now_s += 10.0  # the loop pauses: its frames have later times, and no number is missing
    night.clock_error_s = 10.0
    night.play(2.0)
    assert night.worst_s < 0.1
    for error_s in (10.0, 0.0) * night.stamped:
        night.stamp_error_s = error_s
        night.play(2.0)
    night.session, night.seq = "s2", 10**6
    night.play(4.0)
    assert night.worst_s < 0.1


def test_a_new_session_over_an_old_link_is_as_old_and_one_with_another_clock_is_not():
    night = Night()
    night.play(5.0)
    night.play(10.0, 0.45)
    night.session, night.seq, night.clock_error_s = "s2", 7, 50.0
    night.play(10.0)
    assert night.age_s == pytest.approx(night.delay_s, rel=0.05)
    night.intake.liveliness(alive=False)
    night.delay_s, night.session, night.stamp_error_s = 0.0, "s3", 20.0
    night.play(10.0)
    assert night.age_s < 0.1


def test_a_queue_in_the_rtc_shows_in_the_number_of_its_statuses():
    night = Night()
    for ahead, age_s in ((10, 0.0), (800, 4.0), (9, 0.0)):
        night.play(2.0)
        told = status(
            seq=night.seq + ahead,
            frame_rate_hz=200.0,
            n_slopes=3,
            n_modes=2,
            n_controlled=2,
            gains=(0.4, 0.4),
            basis_id="b",
            config_id="c",
        )
        night.intake.status(encode(told))
        assert night.age_s == pytest.approx(age_s, abs=0.1)
        used = night.n_used
        night.play(0.4)
        assert (night.n_used == used) == (age_s > 3.0)


def test_old_telemetry_forbids_to_measure_and_to_decide_and_lets_alpha_age_by_arrival():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    story.tell(ev.ConditionChanged(name="telemetry-old", text="telemetry is 3 s old"))
    active = story.state.alarms.active
    for interlock in (Interlock.MEASURE, Interlock.DECIDE, Interlock.SEND_NEW):
        assert blocking_alarm(active, interlock).name == "telemetry-old"
    for interlock in (Interlock.SEND_KNOWN, Interlock.ASK):
        assert blocking_alarm(active, interlock) is None
    known = story.state.alpha.registration
    story.tell(status(t_ns=known.t_ns_utc + 1))  # a status that is as old as the telemetry
    story.wait(30)
    grown = story.state.alpha.registration.grown
    np.testing.assert_allclose(grown, 30.0 * story.policy.drift_rate**2, rtol=0.05)
