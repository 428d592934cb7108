"""The parts of the link that need no network: sessions, offers, events, the ring's edges."""

import numpy as np
import pytest

from service.errors import UnknownIdError, WireError
from service.link.endpoint import Endpoint
from service.link.events import (
    EventQueue,
    MalformedMessage,
    RtcAppeared,
    SecondRtc,
    SessionChanged,
    WrongShape,
)
from service.link.intake import Intake
from service.link.measured import MeasuredIntake
from service.link.outbox import OFFERS, Offer, Outbox
from service.link.sessions import SessionWatch
from service.wire import (
    FrameHeader,
    Keys,
    Loop,
    Manifest,
    Status,
    encode_frames,
    encode_manifest,
    encode_status,
    layout_of,
)


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def intake(clock):
    return Intake(Endpoint(system="bench", ring_seconds=0.5), clock)


def send(intake, seq0, n=10, rows=None, **changes):
    values = {
        "session": "s1",
        "seq0": seq0,
        "n": n,
        "t0_ns": 10**18 + seq0 * 1_000_000,
        "dt_ns": 1_000_000,
        "n_slopes": 3,
        "n_modes": 2,
        "dither": False,
        "cm_id": None,
        "basis_id": "b",
        "config_id": "c",
    }
    header = FrameHeader(**(values | changes))
    rows = np.zeros((n, header.n_columns), np.float32) if rows is None else rows
    intake.frames(*encode_frames(header, rows), recoverable=True)


def spans(blocks):
    return [(b.session, b.first_seq, b.n_frames) for b in blocks]


# ---------------------------------------------------------------- sessions


def test_the_newest_session_replaces_the_one_before():
    watch = SessionWatch()
    first = watch.admit("a", 0.0)
    assert (first.accepted, first.changed, first.previous) == (True, True, None)
    second = watch.admit("b", 1.0)
    assert (second.accepted, second.changed, second.previous) == (True, True, "a")
    assert not watch.admit("b", 2.0).changed


def test_the_last_words_of_a_replaced_session_are_refused_but_no_second_rtc():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    watch.admit("b", 1.0)
    echo = watch.admit("a", 1.5)
    assert (echo.accepted, echo.second) == (False, False)


def test_a_replaced_session_that_goes_on_beside_the_new_one_is_a_second_rtc():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    watch.admit("b", 1.0)
    watch.admit("b", 2.4)
    assert watch.admit("a", 2.5).second


def test_a_replaced_session_takes_over_when_the_new_one_has_fallen_silent():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    watch.admit("b", 1.0)
    back = watch.admit("a", 3.5)
    assert (back.accepted, back.changed, back.previous) == (True, True, "b")


def test_endless_restarts_are_remembered_within_bounds():
    watch = SessionWatch()
    for k in range(100):
        watch.admit(f"s{k}", float(k))
    assert not watch.admit("s98", 99.5).accepted
    assert watch.admit("s3", 99.5).accepted


# ---------------------------------------------------------------- intake


def test_what_a_new_session_leaves_behind_is_void_and_counted(intake):
    send(intake, 500)
    send(intake, 0, session="s2")
    assert spans(intake.drain()) == [("s2", 0, 10)]
    statistics = intake.statistics()
    assert (statistics.frames_received, statistics.frames_overwritten) == (20, 10)
    assert SessionChanged(old="s1", new="s2") in intake.events()


def test_frames_of_another_size_start_over_in_the_same_session(intake):
    send(intake, 0)
    send(intake, 10, n_modes=4)
    (block,) = intake.drain()
    assert block.commands_m.shape == (10, 4)


def say(intake, **changes):
    """The RTC's status: 3 slopes, 2 modes unless told otherwise."""
    values = {
        "session": "s1",
        "seq": 0,
        "t_ns": 10**18,
        "loop": Loop.CLOSED,
        "frame_rate_hz": 1000.0,
        "delay_frames": 2.0,
        "gains": (0.4, 0.4),
        "leak": 1.0,
        "n_slopes": 3,
        "n_modes": 2,
        "n_controlled": 2,
        "cm_id": None,
        "basis_id": "b",
        "config_id": "c",
        "dither": None,
        "max_dither_m": 1e-8,
        "max_dither_modes": 2,
        "magnitude": None,
        "flux": None,
    }
    intake.status(encode_status(Status(**(values | changes))))


def test_frames_of_another_shape_than_the_status_says_cost_themselves_only(intake):
    say(intake)
    send(intake, 0)
    send(intake, 10, n_slopes=2)
    send(intake, 20)
    send(intake, 30, n_slopes=2)
    assert [e for e in intake.events() if isinstance(e, WrongShape)] == [
        WrongShape(expected=(3, 2), found=(2, 2))
    ]
    assert intake.statistics().frames_refused == {"shape": 20}
    assert intake.statistics().frames_overwritten == 0
    assert spans(intake.drain()) == [("s1", 0, 10)]


def test_a_status_of_another_shape_brings_frames_of_that_shape(intake):
    say(intake)
    send(intake, 0)
    say(intake, n_slopes=4)
    send(intake, 10, n_slopes=4)
    assert spans(intake.drain()) == [("s1", 10, 10)]
    say(intake, session="s2", n_slopes=4)
    send(intake, 0, session="s2", n_slopes=4)
    assert intake.statistics().frames_refused == {}


def test_a_new_session_need_not_have_the_shape_of_the_one_before(intake):
    say(intake)
    send(intake, 0, session="s2", n_slopes=4)
    assert intake.statistics().frames_refused == {}


def test_frames_behind_a_hole_are_held_back_until_patience_ends(intake, clock):
    send(intake, 0)
    send(intake, 20)
    assert spans(intake.drain()) == [("s1", 0, 10)]
    clock.now_s += 0.49
    assert intake.drain() == []
    clock.now_s += 0.02
    assert spans(intake.drain()) == [("s1", 20, 10)]


def test_a_sequence_that_leaps_further_than_the_ring_is_long_costs_no_memory(intake):
    send(intake, 0)
    send(intake, 2**50, t0_ns=0)
    statistics = intake.statistics()
    assert statistics.frames_lost == 2**50 - 10
    assert statistics.frames_overwritten == 10


def test_more_frames_than_one_hold_of_the_lock_copies_are_all_drained(intake):
    for k in range(50):
        send(intake, 10 * k)
    blocks = intake.drain()
    assert sum(b.n_frames for b in blocks) == 500
    assert [b.first_seq for b in blocks[1:]] == [256]


def test_drained_frames_are_copies(intake):
    send(intake, 0, rows=np.ones((10, 5), np.float32))
    (block,) = intake.drain()
    send(intake, 500, rows=np.full((10, 5), 2.0, np.float32))
    assert block.slopes.tolist() == [[1.0] * 3] * 10


def test_two_interleaved_sessions_are_reported_once_per_burst(intake, clock):
    send(intake, 0)
    send(intake, 0, session="s2")
    for k in range(1, 30):
        clock.now_s += 0.3
        send(intake, 10 * k, session="s2")
        send(intake, 10 * k)
    assert intake.events().count(SecondRtc(current="s2", other="s1")) == 1
    assert intake.statistics().frames_refused == {"session": 290}


def test_a_complaint_is_reported_again_after_a_while_and_always_counted(intake, clock):
    for _ in range(3):
        intake.malformed("status", WireError("range: x"))
        clock.now_s += 6.0
    reported = [e for e in intake.events() if isinstance(e, MalformedMessage)]
    assert len(reported) == 2
    assert intake.statistics().messages_malformed == {"status": 3}


def test_the_age_of_the_last_frame_is_told_by_arrival(intake, clock):
    assert intake.statistics().frame_age_s is None
    send(intake, 0)
    clock.now_s += 3.0
    assert intake.statistics().frame_age_s == 3.0


def test_the_event_queue_drops_the_oldest_and_counts_it():
    queue = EventQueue(length=2)
    for kind in ("a", "b", "c"):
        queue.put(MalformedMessage(kind=kind, text=""))
    queue.put(RtcAppeared())
    assert [type(e) for e in queue.take()] == [MalformedMessage, RtcAppeared]
    assert queue.dropped == 2
    assert queue.take() == []


# ---------------------------------------------------------------- offers


def offer(name, offered_s=0.0, value=1.0):
    matrix = np.full((1, 2), value, np.float32)
    manifest = Manifest(
        id=name,
        layout=layout_of(matrix, 4),
        alpha=None,
        sigma=None,
        im_id=None,
        parent=None,
        basis_id="b",
        config_id="c",
        system="bench",
        created_ns=0,
    )
    return Offer(
        manifest=manifest,
        commit=encode_manifest(manifest),
        parts=(b"1234", b"5678"),
        offered_s=offered_s,
    )


def test_an_offer_is_forgotten_after_its_time_unless_it_is_the_current_one():
    outbox = Outbox(60.0)
    outbox.add(offer("old"))
    outbox.add(offer("used"))
    outbox.set_current("used")
    assert outbox.answer("old", 1, 59.0) == b"5678"
    with pytest.raises(UnknownIdError, match="old is not on offer"):
        outbox.answer("old", 1, 61.0)
    assert outbox.answer("used", None, 1e6) == outbox.current_commit()
    assert outbox.knows("old")


def test_the_number_of_offers_is_bounded_and_the_oldest_go_first():
    outbox = Outbox(60.0)
    outbox.add(offer("used"))
    outbox.set_current("used")
    for k in range(OFFERS):
        outbox.add(offer(f"r{k}"))
    with pytest.raises(UnknownIdError):
        outbox.answer("r0", None, 1.0)
    assert outbox.answer("r1", 0, 1.0) == b"1234"
    assert outbox.answer("used", 0, 1.0) == b"1234"


def test_an_id_may_be_offered_again_only_with_the_same_sum():
    outbox = Outbox(60.0)
    outbox.add(offer("r"))
    outbox.add(offer("r", offered_s=50.0))
    assert outbox.answer("r", 0, 100.0) == b"1234"
    with pytest.raises(WireError, match="r already names a matrix"):
        outbox.add(offer("r", value=2.0))


# ---------------------------------------------------------------- measured matrices


def test_a_measured_matrix_for_another_system_or_under_another_name_is_refused():
    keys = Keys("bench")
    intake = MeasuredIntake(keys)
    assert intake.take(keys.measured_chunk("m1", 0), b"1234") is None
    with pytest.raises(WireError, match="is no key of a matrix"):
        intake.take("ao/v1/other/im/m1/chunk/0", b"1234")
    with pytest.raises(WireError, match="chunk 0 has 0 bytes"):
        intake.take(keys.measured_chunk("m2", 0), b"")
