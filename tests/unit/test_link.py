"""The parts of the link that need no network: sessions, offers, events, the ring's edges."""

from unittest.mock import Mock, patch

import numpy as np
import pytest

from service.errors import LinkError, UnknownIdError, WireError
from service.link import session
from service.link.intake import MAX_QUEUED_EVENTS, MAX_UNDECODED_BATCHES, Intake
from service.link.leader_election import LeaderElection, SessionWatch, Standby
from service.link.matrices import MAX_OFFERS, MeasuredIntake, Offer, Outbox
from service.link.session import Endpoint
from service.records import events as ev
from service.wire import (
    Acknowledgement,
    Keys,
    Loop,
    Manifest,
    RampRequest,
    Reply,
    Role,
    Status,
    decode,
    encode,
    layout_of,
)
from service.wire.signing import Signatures
from tests.support.link import applied, send


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def told(event, name):
    """Return the text of what is noted, or of trouble, if it has this name."""
    return event.text if getattr(event, "name", "") == name else ""


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def intake(clock):
    return Intake(Endpoint(system="bench", ring_seconds=0.5), clock)


def spans(blocks):
    return [(b.session, b.first_seq, b.n_frames) for b in blocks]


# ---------------------------------------------------------------- sessions


def test_a_session_is_replaced_once_it_has_been_silent():
    watch = SessionWatch()
    first = watch.admit("a", 0.0)
    assert (first.accepted, first.changed) == (True, True)
    assert not watch.admit("b", 1.0).accepted
    assert watch.waiting(1.0) == "b"
    second = watch.admit("b", 2.0)
    assert (second.accepted, second.changed) == (True, True)
    assert not watch.admit("b", 3.0).changed


def test_a_session_is_in_doubt_from_the_first_word_of_another_to_the_next_of_its_own():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    assert watch.other is None
    watch.admit("b", 0.1)
    assert watch.other == "b"
    watch.admit("a", 0.2)
    assert watch.other is None
    watch.admit("b", 0.3)
    watch.admit("b", 2.3)
    assert (watch.current, watch.other) == ("b", None)
    watch.admit("a", 2.4)
    assert watch.other is None


def test_one_message_of_an_unknown_session_takes_nothing_over_and_is_named():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    assert not watch.admit("stray", 0.1).accepted
    named = [watch.admit("a", 0.1 * k).other_session for k in range(2, 30)]
    assert watch.current == "a"
    assert [rival for rival in named if rival] == ["stray"]


def test_the_last_words_of_a_replaced_session_are_refused_but_no_second_rtc():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    watch.admit("b", 2.0)
    assert not watch.admit("a", 2.5).accepted
    assert watch.admit("b", 4.0).other_session is None


def test_a_straggler_of_the_old_session_does_not_make_the_new_one_a_second_rtc():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    watch.admit("b", 0.1)
    assert watch.admit("a", 0.6).other_session is None
    assert watch.admit("b", 2.7).changed


def test_a_session_that_goes_on_beside_the_one_that_counts_is_a_second_rtc():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    named = []
    for k in range(1, 40):
        watch.admit("b", 0.1 * k)
        named.append(watch.admit("a", 0.1 * k + 0.05).other_session)
    assert watch.current == "a"
    assert "b" in named


def test_after_a_goodbye_nothing_is_waited_for_unless_the_session_speaks_again():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    watch.leave()
    watch.admit("a", 0.1)
    assert not watch.admit("b", 0.2).accepted
    watch.leave()
    assert watch.admit("b", 0.3).changed


def test_endless_strangers_are_remembered_within_bounds():
    watch = SessionWatch()
    watch.admit("a", 0.0)
    for k in range(100):
        watch.admit(f"s{k}", 0.01 * k)
    assert len(watch._other_sessions) <= 16
    assert watch.other == "s99"


# ---------------------------------------------------------------- several services


def order(found=(), own="b", now_ns=1000, **facts):
    made = LeaderElection()
    made.contract_held = facts.get("contract_held", False)
    made.join(found, own, now_ns)
    return made


def test_a_service_alone_drives():
    alone = order()
    assert alone.settle()
    assert alone.others(0.0) == ()
    alone.contract_held = True  # its own token
    assert alone.settle()


def test_a_later_service_stands_by_whatever_its_clock_says_and_takes_over_when_the_first_goes():
    late = order(["5000-aa"], now_ns=1000, contract_held=True)
    assert late.name == "5001-b"
    assert not late.settle()
    assert late.others(0.0) == ("aa (there since 1970-01-01T00:00:00Z)",)
    late.contract_held = False
    assert not late.settle()
    late.notice("5000-aa", alive=False)
    assert late.settle()


def test_the_first_of_two_drives_on():
    first = order()
    first.settle()
    first.notice("2000-aa", alive=True)
    assert first.settle()
    assert len(first.others(0.0)) == 1
    first.notice("2000-aa", alive=False)
    assert first.others(0.0) == ()


@pytest.mark.parametrize("starts", [(1000, 1000), (1000, 999), (1000, 1001)])
def test_of_two_that_come_at_the_same_time_exactly_one_drives(starts):
    one, other = order(own="a", now_ns=starts[0]), order(own="b", now_ns=starts[1])
    one.notice(other.name, alive=True)
    other.notice(one.name, alive=True)
    assert one.settle() is not other.settle()


def test_one_that_gives_no_name_was_first_if_it_was_there_first():
    late = order(contract_held=True)
    assert not late.settle()
    assert late.others(0.0) == ("one that gives no name",)
    late.contract_held = False
    assert late.settle()
    late.receive(10.0)
    assert late.settle()
    assert late.others(11.0) == ("one that gives no name",)
    assert late.others(16.0) == ()


def test_tokens_that_are_no_names_are_nobody():
    alone = order(["x", "12-XYZ", "-ab"])
    alone.notice("rubbish", alive=True)
    assert alone.settle()
    assert alone.others(0.0) == ()


def test_routers_that_answer_slowly_keep_nobody_waiting(monkeypatch):
    standby = Standby(Keys("flao"), drive=lambda _: [], report=lambda _: None)
    free = []

    def tokens(*_):
        # What zenoh's threads do with a token or a state that comes meanwhile takes this lock.
        free.append(standby._lock.acquire(timeout=0.0))
        standby._lock.release()
        return []

    monkeypatch.setattr(session, "tokens", tokens)
    for name in ("announce", "watch", "subscribe"):
        monkeypatch.setattr(session, name, lambda *_: None)
    standby.join(Mock(), lambda _, callback: callback, wait=False)
    assert free == [True, True]
    assert standby.drives


# ---------------------------------------------------------------- intake


def test_what_a_new_session_leaves_behind_is_void_and_counted(intake, clock):
    send(intake, 500)
    clock.now_s += 2.0
    send(intake, 0, session="s2")
    assert spans(intake.drain()) == [("s2", 0, 10)]
    statistics = intake.statistics()
    assert (statistics.frames_received, statistics.frames_overwritten) == (20, 10)
    assert ev.SessionStarted(session="s2") in intake.events()


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
    intake.status(encode(Status(**(values | changes))))


def test_frames_that_came_before_an_event_are_had_before_it_and_the_others_after(intake):
    say(intake)
    intake.events()
    send(intake, 0)
    applied(intake, "s1")
    send(intake, 10)
    applied(intake, "s1")
    assert spans(intake.drain(before_events=True)) == [("s1", 0, 10)]
    assert intake.drain(before_events=True) == []
    assert len(intake.events()) == 2
    assert spans(intake.drain(before_events=True)) == [("s1", 10, 10)]


def test_a_new_session_is_told_before_its_frames(intake, clock):
    send(intake, 500)
    intake.events()
    clock.now_s += 2.0
    send(intake, 0, session="s2")
    assert intake.drain(before_events=True) == []
    assert ev.SessionStarted(session="s2") in intake.events()
    assert spans(intake.drain(before_events=True)) == [("s2", 0, 10)]


def test_frames_of_another_shape_than_the_status_says_cost_themselves_only(intake):
    say(intake)
    send(intake, 0)
    send(intake, 10, n_slopes=2)
    send(intake, 20)
    send(intake, 30, n_slopes=2)
    fate = next(f for f in intake.statistics().dispositions if f.outcome == "shape")
    assert (fate.kind, fate.n) == ("frames", 20)
    assert fate.text.startswith("2 slopes and 2 modes, expected 3 and 2")
    assert intake.statistics().frames_refused == {"shape": 20}
    assert intake.statistics().frames_overwritten == 0
    assert spans(intake.drain()) == [("s1", 0, 10)]


def test_a_status_of_another_shape_brings_frames_of_that_shape(intake, clock):
    say(intake)
    send(intake, 0)
    say(intake, n_slopes=4)
    send(intake, 10, n_slopes=4)
    assert spans(intake.drain()) == [("s1", 10, 10)]
    clock.now_s += 2.0
    say(intake, session="s2", n_slopes=4)
    send(intake, 0, session="s2", n_slopes=4)
    assert intake.statistics().frames_refused == {}


def test_a_new_session_need_not_have_the_shape_of_the_one_before(intake, clock):
    say(intake)
    clock.now_s += 2.0
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


def fate(intake, outcome, kind="frames"):
    """Return what the link says of frames, or messages, that met this fate."""
    fates = intake.statistics().dispositions
    return next((f for f in fates if (f.kind, f.outcome) == (kind, outcome)), None)


@pytest.mark.parametrize("leap", [2_000, 20_000, 2**61])
def test_one_frame_with_a_leap_of_its_number_costs_itself_only(intake, leap):
    send(intake, 0)
    send(intake, leap, n=1, t0_ns=10**18 + 10_000_000)
    for k in range(1, 5):
        send(intake, 10 * k)
    assert sum(b.n_frames for b in intake.drain()) == 50
    assert (fate(intake, "leap").n, fate(intake, "late")) == (1, None)
    assert "leaps from 10 to" in fate(intake, "leap").text


def test_a_leap_that_the_next_batches_confirm_is_believed_and_costs_no_memory(intake, clock):
    send(intake, 0)
    intake.drain()
    for k in range(4):
        send(intake, 2**50 + 10 * k, t0_ns=10**18 + 10_000_000 * (k + 1))
    clock.now_s += 0.6
    assert spans(intake.drain()) == [("s1", 2**50, 40)]
    assert intake.statistics().frames_lost == 2**50 - 10


def test_leaps_that_lead_nowhere_are_never_believed(intake):
    for k in range(10):
        send(intake, 10 * k)
        send(intake, 2**50 + 10_000 * k, t0_ns=10**18)
    assert sum(b.n_frames for b in intake.drain()) == 100


@pytest.mark.parametrize("n_batches", [20, 2000])
def test_a_sequence_that_starts_over_in_its_session_is_named_at_once(intake, n_batches):
    for k in range(n_batches):
        send(intake, 10 * k)
    newest_ns = 10**18 + n_batches * 10_000_000
    send(intake, 0, t0_ns=newest_ns)
    assert fate(intake, "sequence").n == 10
    assert f"goes back from {10 * n_batches} to 0" in fate(intake, "sequence").text


def test_frames_that_come_late_or_again_are_no_fault_of_the_sequence(intake):
    send(intake, 0)
    send(intake, 20)
    send(intake, 10)
    send(intake, 10)
    assert fate(intake, "sequence") is None
    assert (fate(intake, "used").n, fate(intake, "duplicate").n) == (30, 10)


def test_more_frames_than_one_hold_of_the_lock_copies_are_all_drained(intake):
    for k in range(50):
        send(intake, 10 * k)
    with patch("service.link.intake.FRAMES_PER_COPY", 256):
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
    for k in range(1, 30):
        clock.now_s += 0.3
        send(intake, 300 * k)
        send(intake, 300 * k, session="s2")
    assert sum("sessions s1 and s2" in told(e, "second-rtc") for e in intake.events()) == 1
    assert intake.statistics().frames_refused == {"session": 290}


@pytest.mark.parametrize("kind", ["frames", "status", "ack"])
def test_no_message_of_an_unknown_session_takes_over_from_one_that_sends(intake, clock, kind):
    send(intake, 0)
    say(intake)
    if kind == "frames":
        send(intake, 0, session="other")
    elif kind == "status":
        say(intake, session="other")
    else:
        applied(intake, session="other")
    events = intake.events()
    assert intake.statistics().session == "s1"
    assert not [e for e in events if isinstance(e, ev.SessionStarted) and e.session == "other"]
    assert not [e for e in events if isinstance(e, Acknowledgement)]
    assert fate(intake, "session", kind) is not None


def flood(intake, clock, n, **changes):
    for k in range(n):
        clock.now_s += 0.002
        say(intake, seq=k, **changes)


def test_of_a_flood_of_statuses_two_a_second_are_taken_and_the_latest_is_not_lost(intake, clock):
    taken = []
    for k in range(5000):
        clock.now_s += 0.002
        say(intake, seq=k)
        taken += [e.seq for e in intake.events() if isinstance(e, Status)]
    clock.now_s += 0.5
    taken += [e.seq for e in intake.events() if isinstance(e, Status)]
    assert 15 <= len(taken) <= 25
    assert taken == sorted(taken)
    assert taken[-1] == 4999
    assert intake.statistics().statuses_received == 5000 + 1


@pytest.mark.parametrize("follows", ["vanished", "applied"])
def test_a_status_kept_back_is_told_before_what_the_rtc_does_next(intake, clock, follows):
    for k in range(2):
        say(intake, seq=k)
    intake.events()
    if follows == "vanished":
        intake.liveliness(alive=False)
    else:
        applied(intake, session="s1")
    clock.now_s += 1.0
    kept, after = intake.events()
    assert kept.seq == 1
    assert isinstance(after, ev.RtcVanished if follows == "vanished" else Acknowledgement)


@pytest.mark.parametrize(
    "change", [{"loop": Loop.OPEN}, {"cm_id": "other"}, {"n_controlled": 1}, {"n_slopes": 4}]
)
def test_what_matters_in_a_flood_of_statuses_is_taken_at_once(intake, clock, change):
    flood(intake, clock, 20)
    intake.events()
    clock.now_s += 0.002
    say(intake, **change)
    flood(intake, clock, 20)
    taken = [e for e in intake.events() if isinstance(e, Status)]
    (key, value) = next(iter(change.items()))
    assert [getattr(status, key) for status in taken[:2]] == [value, getattr(taken[1], key)]
    assert getattr(taken[1], key) != value


def test_a_complaint_is_reported_again_after_a_while_and_always_counted(intake, clock):
    for _ in range(3):
        intake.malformed("status", WireError("range: x"))
        clock.now_s += 6.0
    reported = [e for e in intake.events() if told(e, "message.malformed")]
    assert len(reported) == 2
    assert intake.statistics().messages_malformed == {"status": 3}


def test_the_age_of_the_last_frame_is_told_by_arrival(intake, clock):
    assert intake.statistics().frame_age_s is None
    send(intake, 0)
    clock.now_s += 3.0
    assert intake.statistics().frame_age_s == 3.0


def test_of_too_many_events_the_oldest_give_way_and_are_counted(intake):
    for number in range(MAX_QUEUED_EVENTS + 1):
        intake.event(ev.LogEvent(name=f"{number}", text=""))
    intake.event(ev.RtcVanished())
    events = intake.events()
    assert (len(events), events[0].name, events[-1]) == (MAX_QUEUED_EVENTS, "2", ev.RtcVanished())
    assert intake.statistics().events_dropped == 2
    assert intake.events() == []


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
        commit=encode(manifest),
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
    assert outbox.answer("used", None, 1e6) == outbox.current.commit
    assert outbox.knows("old")


def test_the_number_of_offers_is_bounded_and_the_oldest_go_first():
    outbox = Outbox(60.0)
    outbox.add(offer("used"))
    outbox.set_current("used")
    for k in range(MAX_OFFERS):
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


def test_messages_are_kept_as_long_as_frames_of_theirs_wait_and_no_longer(clock):
    """Five seconds of a thousand frames each wait, then nobody is behind any more."""
    intake = Intake(Endpoint(system="bench", ring_seconds=5.0), clock)
    for k in range(500):
        send(intake, 10 * k)
    assert intake.statistics().frames_received == 5000
    ring = intake._ring
    assert len(set(map(id, ring._batch))) == 500
    assert sum(block.n_frames for block in intake.drain()) == 5000
    assert set(ring._batch) == {None}
    send(intake, 5000)
    assert [block.first_seq for block in intake.drain()] == [5000]


def test_batches_do_not_pile_up_where_nobody_asks_for_them(clock):
    intake = Intake(Endpoint(system="bench", ring_seconds=5.0), clock)
    for k in range(100):
        send(intake, 10 * k)
        assert len(intake._arrived) < MAX_UNDECODED_BATCHES
    assert sum(block.n_frames for block in intake.drain()) == 1000


def test_frames_of_a_known_mode_of_the_sensor_are_used_and_of_another_named(clock):
    intake = Intake(Endpoint(system="bench"), clock)
    intake.expect("b", "other", ("other", "c"))
    send(intake, 0)
    assert spans(intake.drain()) == [("s1", 0, 10)]
    assert intake.statistics().config_id == "c"
    intake.expect("b", "other", ("other", "third"))
    send(intake, 10)
    send(intake, 20)
    assert intake.statistics().frames_refused == {"config": 20}
    (told,) = [e.text for e in intake.events() if isinstance(e, ev.ConditionChanged)]
    assert told.endswith(
        "the instrument file has the modes other, third: set the RTC to one of them, or add "
        "[[wfs.mode]] config_id = 'c' to the file"
    )


def test_an_rtc_that_names_its_references_by_its_configuration_is_used(intake):
    send(intake, 0)
    send(intake, 10, config_id="references-1")
    send(intake, 20)
    assert spans(intake.drain()) == [("s1", 0, 10), ("s1", 10, 10), ("s1", 20, 10)]
    assert not any(intake.statistics().frames_refused.values())
    assert not [event for event in intake.events() if isinstance(event, ev.ConditionChanged)]


def test_a_configuration_with_other_sizes_is_another_sensor(intake):
    say(intake)
    send(intake, 0)
    send(intake, 10, config_id="mask-2", n_slopes=4)
    assert intake.statistics().frames_refused == {"config": 10}
    assert [event.name for event in intake.events() if isinstance(event, ev.ConditionChanged)] == [
        "basis-mismatch"
    ]


@pytest.mark.parametrize("expected", [("b", "c", ()), ("b", None, ("c", "d"))])
def test_a_configuration_that_the_instrument_file_states_is_the_only_one(clock, expected):
    intake = Intake(Endpoint(system="bench"), clock)
    intake.expect(*expected)
    send(intake, 0)
    send(intake, 10, config_id="references-1")
    assert intake.statistics().frames_refused == {"config": 10}


def test_a_batch_is_judged_by_what_was_expected_when_it_came(clock):
    intake = Intake(Endpoint(system="bench"), clock)
    send(intake, 0)
    intake.expect("another", "c")
    send(intake, 10)
    assert spans(intake.drain()) == [("s1", 0, 10)]
    assert intake.statistics().frames_refused == {"basis": 10}


def asked_for_a_ramp(monkeypatch, token_there):
    """Send a ramp that nobody serves; the RTC's token is there at each attempt, or is not."""
    there = iter(token_there)
    monkeypatch.setattr(session, "ask", lambda *_, **__: None)
    monkeypatch.setattr(session, "tokens", lambda *_: ["alive/rtc"] if next(there) else [])
    monkeypatch.setattr(session, "ABSENT_PAUSE_S", 0.0)
    command = RampRequest(id="ramp", groups=((0, 9),), gains=(0.5,), frames_per_gain=100)
    endpoint = Endpoint(system="flao", command_attempts=3)
    return session.send_command(None, endpoint, command, Signatures(None, Role.SERVICE))


def test_an_rtc_that_is_there_and_serves_no_ramp_offers_none(monkeypatch):
    reply = decode(Reply, asked_for_a_ramp(monkeypatch, [True] * 3))
    assert (reply.accepted, reply.reason) == (False, "unsupported: the RTC offers no ramp")


@pytest.mark.parametrize("there", [[False] * 3, [False, True, True], [True, False, True]])
def test_an_rtc_that_has_just_lost_its_link_is_not_said_to_offer_no_ramp(monkeypatch, there):
    with pytest.raises(LinkError, match="was not carried out"):
        asked_for_a_ramp(monkeypatch, there)
