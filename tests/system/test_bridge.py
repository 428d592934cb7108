"""The bridge over real zenoh on loopback, against a fake RTC."""

import asyncio
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh.ext

from pyrcal.rtc.replies import answer_references
from service.errors import LinkError, UnknownIdError, WireError
from service.link.matrices import MeasuredMatrix
from service.records.events import LogEvent, RtcVanished, ServicesMet, SessionStarted
from service.rtc_bridge import Bridge, Endpoint
from service.wire import (
    Acknowledgement,
    AckState,
    AlarmMessage,
    DitherKind,
    DitherRequest,
    GainsMessage,
    Keys,
    LoopRequest,
    Manifest,
    MeasuredManifest,
    Pattern,
    ReferencesInUse,
    ReferencesRequest,
    Reply,
    Role,
    StateMessage,
    Status,
    checksum,
    decode,
    encode,
    encode_frames,
    layout_of,
)
from tests.support.cable import free_port
from tests.support.fake_rtc import FakeRtc, client_session
from tests.support.pace import Deadline, patience, slowness

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
SYSTEM = "bench"


@pytest.fixture
def endpoint():
    return Endpoint(system=SYSTEM, listen=(f"tcp/127.0.0.1:{free_port()}",))


@pytest.fixture
def bridge(endpoint):
    with Bridge(endpoint) as bridge:
        yield bridge


@pytest.fixture
def rtc(bridge, endpoint):
    with FakeRtc(endpoint.listen[0]) as rtc:
        # its token comes after its subscriptions: what is sent now will reach it
        wait_until(lambda: bridge.statistics().rtc_alive)
        yield rtc


@contextmanager
def rtc_process(endpoint, session, n_slopes=6, n_modes=4, rate_hz=1000, per_batch=10):
    arguments = (endpoint.listen[0], SYSTEM, session, n_slopes, n_modes, rate_hz, per_batch)
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.support.fake_rtc", *map(str, arguments)], cwd=ROOT
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait(patience(10.0))


def wait_until(condition, timeout_s=15.0):
    """Return what the condition returns once it is true."""
    deadline = Deadline(timeout_s)
    while not (found := condition()):
        assert not deadline.passed, "waited in vain"
        time.sleep(0.01)
    return found


MALFORMED = {"name": "message.malformed"}


class Seen:
    """Events collected until the one that is waited for has come."""

    def __init__(self, bridge):
        self.bridge = bridge
        self.events = []

    def first(self, event, timeout_s=15.0, **values):
        def look():
            self.events += self.bridge.events()
            return [
                e
                for e in self.events
                if isinstance(e, event) and all(getattr(e, k) == v for k, v in values.items())
            ]

        return wait_until(look, timeout_s)[0]

    def count(self, event):
        self.events += self.bridge.events()
        return sum(isinstance(e, event) for e in self.events)


def drained(bridge, n_frames, timeout_s=5.0):
    """Return the blocks of the next ``n_frames`` frames."""
    blocks = []

    def look():
        blocks.extend(bridge.drain())
        return sum(b.n_frames for b in blocks) >= n_frames

    wait_until(look, timeout_s)
    return blocks


def sequence(blocks):
    return np.concatenate([b.first_seq + np.arange(b.n_frames) for b in blocks]).tolist()


def reconstructor(rtc, name="r-1", seed=0):
    matrix = np.random.default_rng(seed).standard_normal((8, rtc.n_slopes)).astype(np.float32)
    manifest = Manifest(
        id=name,
        layout=layout_of(matrix, 64),
        alpha={
            "shift_x_subap": 0.1,
            "shift_y_subap": 0.0,
            "rotation_deg": 0.2,
            "magnification": 1.0,
        },
        sigma=None,
        im_id=None,
        parent=None,
        basis_id=rtc.basis_id,
        config_id=rtc.config_id,
        system=SYSTEM,
        created_ns=1,
    )
    return manifest, matrix


# ---------------------------------------------------------------- telemetry


def test_frames_arrive_in_order_with_their_own_values_and_times(bridge, rtc):
    for k in range(5):
        rtc.send(100 + 10 * k, dither=True)
    blocks = drained(bridge, 50)
    assert sequence(blocks) == list(range(100, 150))
    block = blocks[-1]
    last = block.first_seq + block.n_frames - 1
    header = rtc.header(last)
    assert block.slopes[-1].tolist() == [last] * rtc.n_slopes
    assert block.commands_m[-1].tolist() == [last] * rtc.n_modes
    assert block.dither_m[-1].tolist() == [last] * rtc.n_modes
    assert block.t0_ns_utc + (block.n_frames - 1) * block.dt_ns == header.t0_ns
    assert (block.session, block.cm_id) == ("s1", None)
    statistics = bridge.statistics()
    assert (statistics.frames_received, statistics.frames_lost) == (50, 0)
    assert statistics.batches_received == 5
    assert statistics.frame_age_s < 5.0


def test_a_flao_loop_at_1_khz_loses_nothing_and_is_read_within_a_millisecond(endpoint, capsys):
    with (
        Bridge(endpoint) as bridge,
        rtc_process(endpoint, "flao", n_slopes=1384, n_modes=594),
    ):
        wait_until(lambda: bridge.statistics().frames_received, 20.0)
        blocks = drained(bridge, 5000, 10.0)
        statistics = bridge.statistics()
    seq = sequence(blocks)
    assert seq == list(range(seq[0], seq[0] + len(seq)))
    assert np.concatenate([b.slopes[:, 0] for b in blocks]).tolist() == seq
    assert (statistics.frames_lost, statistics.frames_overwritten) == (0, 0)
    with capsys.disabled():
        print(f" p50 {1e3 * statistics.latency_p50_s:.3f} ms, {len(seq)} frames", end="")  # noqa: T201
    assert statistics.latency_p50_s < 1e-3 * slowness(again=True)


def test_a_missing_batch_is_lost_until_it_comes_late_and_finds_its_place(bridge, rtc):
    rtc.send(0)
    rtc.send(20)
    wait_until(lambda: bridge.statistics().frames_lost == 10)
    assert sequence(drained(bridge, 10)) == list(range(10))
    assert bridge.drain() == []
    rtc.send(10)
    (block,) = drained(bridge, 20)
    assert (block.first_seq, block.n_frames) == (10, 20)
    statistics = bridge.statistics()
    assert (statistics.frames_lost, statistics.frames_recovered) == (0, 10)


def test_a_hole_is_not_waited_for_without_a_publisher_that_remembers(endpoint):
    patient = replace(endpoint, recovery_s=1000.0)
    with Bridge(patient) as bridge, FakeRtc(endpoint.listen[0]) as rtc:
        wait_until(lambda: bridge.statistics().rtc_alive)
        rtc.send(0, plain=True)
        rtc.send(20, plain=True)
        assert sequence(drained(bridge, 20)) == [*range(10), *range(20, 30)]


def test_malformed_batches_are_counted_reported_once_and_survived(bridge, rtc):
    seen = Seen(bridge)
    payload = rtc.rows(rtc.header(0)).tobytes()
    for attachment in (None, b"", b"\xc1", b"\x81\xa1v\x02", b"x" * 5000):
        rtc.send_raw(payload, attachment)
    rtc.send(0)
    header = rtc.header(10)
    rtc.send_raw(payload[:-4], attachment=encode(header))
    rtc.send_raw(b"\0" * 4_000_004, attachment=encode(header))
    rtc.send(10)
    assert sequence(drained(bridge, 20)) == list(range(20))
    wait_until(lambda: bridge.statistics().messages_malformed.get("frames") == 7)
    assert str(seen.first(LogEvent, **MALFORMED).text).startswith("frames: ")
    assert sum(getattr(e, "name", "") == "message.malformed" for e in seen.events) == 1
    assert bridge.statistics().callback_errors == 0


def test_the_first_basis_seen_is_adopted_when_none_is_pinned(bridge, rtc):
    seen = Seen(bridge)
    rtc.send(0)
    adopted = seen.first(LogEvent, name="ids.adopted")
    assert adopted.text == "basis kl-1, configuration mask-1"
    rtc.send(10, basis_id="kl-2")
    wait_until(lambda: bridge.statistics().frames_refused == {"basis": 10})


def test_frames_of_another_system_are_not_heard(bridge, rtc, endpoint):
    with FakeRtc(endpoint.listen[0], system="other") as other:
        other.send(0)
        rtc.send(0)
        drained(bridge, 10)
        time.sleep(0.2)
    assert bridge.statistics().frames_received == 10


def test_the_consumer_is_woken_once_until_it_looks(bridge, rtc):
    rings = []
    bridge.set_wakeup(lambda: rings.append(1))
    rtc.send(0)
    rtc.send(10)
    wait_until(lambda: bridge.statistics().frames_received == 20)
    assert len(rings) == 1
    bridge.drain()
    rtc.send(20)
    wait_until(lambda: len(rings) == 2)


def test_a_fault_in_the_consumers_bell_is_counted_and_ingest_goes_on(bridge, rtc):
    bridge.set_wakeup(lambda: 1 / 0)
    rtc.send(0)
    rtc.send(10)
    assert sequence(drained(bridge, 20)) == list(range(20))
    assert bridge.statistics().callback_errors >= 1


def test_latency_is_told_only_when_the_rtc_itself_stamps_its_messages(bridge, rtc, endpoint):
    with client_session(endpoint.listen[0], stamped=False) as unstamped:
        payload, attachment = encode_frames(rtc.header(0), rtc.rows(rtc.header(0)))
        unstamped.put(rtc.keys.frames, payload, attachment=attachment)
        drained(bridge, 10)
    assert bridge.statistics().latency_p50_s is None
    rtc.send(10)
    drained(bridge, 10)
    assert 0.0 < bridge.statistics().latency_p50_s < patience(1.0)


# ---------------------------------------------------------------- sessions and liveliness


def test_a_restarted_rtc_is_a_new_session_counting_from_zero(bridge, endpoint):
    seen = Seen(bridge)
    with FakeRtc(endpoint.listen[0], session="one") as rtc:
        rtc.send(5000)
        seen.first(LogEvent, name="rtc.appeared")
        seen.first(SessionStarted, session="one")
        drained(bridge, 10)
    seen.first(RtcVanished)
    with FakeRtc(endpoint.listen[0], session="two") as rtc:
        rtc.send(0)
        seen.first(SessionStarted, session="two")
        (block,) = drained(bridge, 10)
    assert (block.session, block.first_seq) == ("two", 0)
    assert bridge.statistics().frames_lost == 0


def test_a_killed_rtc_vanishes_within_the_lease(bridge, endpoint):
    seen = Seen(bridge)
    with rtc_process(endpoint, "doomed") as process:
        seen.first(LogEvent, 20.0, name="rtc.appeared")
        assert bridge.statistics().rtc_alive
        process.kill()
        seen.first(RtcVanished, 4.0)
    assert not bridge.statistics().rtc_alive


def test_a_status_is_reported_and_a_bad_one_counted(bridge, rtc):
    seen = Seen(bridge)
    rtc.send_bytes(rtc.keys.status, b"\x80")
    rtc.send_bytes(rtc.keys.status, b"x" * 70_000)
    rtc.send_status(seq=42, magnitude=None)
    assert seen.first(Status) == rtc.status(seq=42, magnitude=None)
    assert bridge.statistics().messages_malformed == {"status": 2}
    assert "missing: key 'v'" in str(seen.first(LogEvent, **MALFORMED).text)


def tokens(session, key):
    return [str(reply.ok.key_expr) for reply in session.liveliness().get(key, timeout=1.0)]


def test_the_services_token_is_there_for_others_for_as_long_as_the_link_is_open(endpoint, rtc):
    key = rtc.keys.alive(Role.SERVICE)
    wait_until(lambda: tokens(rtc.zenoh, key))
    time.sleep(0.2)
    assert tokens(rtc.zenoh, key) == [key]


def test_the_services_token_goes_with_the_service(endpoint):
    other = Endpoint(system=SYSTEM, connect=endpoint.listen)
    key = Keys(SYSTEM).alive(Role.SERVICE)
    with Bridge(replace(endpoint, system="router")), client_session(endpoint.listen[0]) as outside:
        with Bridge(other):
            wait_until(lambda: tokens(outside, key) == [key], 3.0)
            time.sleep(0.2)
            assert tokens(outside, key) == [key]
        wait_until(lambda: tokens(outside, key) == [], 3.0)


# ---------------------------------------------------------------- several services


def drives(bridge, rtc, name):
    """Whether this service reaches the RTC with a command."""
    try:
        return asyncio.run(bridge.command(LoopRequest(id=name, leak=0.98))).accepted
    except LinkError:
        return False


def test_a_later_service_stands_by_and_takes_over_when_the_first_has_gone(endpoint):
    router = Bridge(replace(endpoint, system="router"))
    client = Endpoint(system=SYSTEM, connect=endpoint.listen)
    with router, FakeRtc(endpoint.listen[0]) as rtc:
        first, second = Bridge(client), Bridge(client)
        with second:
            second.close()
            with first:
                met = Seen(first)
                second.open()
                event = met.first(ServicesMet)
                assert event.drives
                assert len(event.others) == 1
                assert not Seen(second).first(ServicesMet).drives
                assert drives(first, rtc, "l-1")
                assert not drives(second, rtc, "l-2")
                with pytest.raises(LinkError, match="another service"):
                    asyncio.run(second.publish(*reconstructor(rtc)))
            assert Seen(second).first(ServicesMet, drives=True).others == ()
            wait_until(lambda: tokens(rtc.zenoh, rtc.keys.alive(Role.SERVICE)), 3.0)
            assert drives(second, rtc, "l-3")
        assert [command.id for command in rtc.commands] == ["l-1", "l-3"]


def test_a_service_that_opens_its_link_anew_is_there_again_and_drives(bridge, rtc):
    bridge.reopen()
    wait_until(lambda: tokens(rtc.zenoh, rtc.keys.alive(Role.SERVICE)), 5.0)
    wait_until(lambda: drives(bridge, rtc, f"l-{time.monotonic_ns()}"), 10.0)
    assert rtc.fetch(rtc.keys.current) == "nothing to offer"


def test_a_later_service_that_gives_no_name_is_known_by_its_state(bridge, rtc):
    state = StateMessage(system=SYSTEM, t_ns=1, mode="auto", alpha=None, sigma=None, in_use=None)
    rtc.send_bytes(rtc.keys.state, encode(state))
    event = Seen(bridge).first(ServicesMet)
    assert (event.drives, event.others) == (True, ("one that gives no name",))


# ---------------------------------------------------------------- reconstructors


async def test_a_published_reconstructor_is_staged_applied_and_acknowledged(bridge, rtc):
    manifest, matrix = reconstructor(rtc)
    seen = Seen(bridge)
    await bridge.publish(manifest, matrix)
    states = []
    while AckState.APPLIED not in states:
        said = await asyncio.to_thread(seen.first, Acknowledgement)
        seen.events.remove(said)
        assert said.sha256 == manifest.layout.sha256
        states.append(said.state)
    assert states == [AckState.STAGED, AckState.APPLIED]
    assert np.array_equal(rtc.applied["matrix"], matrix)
    assert bridge.statistics().acknowledgements_unknown == 0


async def test_nothing_is_committed_while_another_session_was_the_last_to_speak(bridge, rtc):
    manifest, matrix = reconstructor(rtc)
    rtc.send(0)
    wait_until(lambda: bridge.statistics().session == "s1")
    rtc.send(0, session="anew")
    wait_until(lambda: bridge.statistics().frames_refused == {"session": 10})
    with pytest.raises(LinkError, match="may have begun session anew"):
        await bridge.publish(manifest, matrix)
    assert not rtc.applied
    rtc.send(10)
    drained(bridge, 20)
    await bridge.publish(manifest, matrix)
    wait_until(lambda: rtc.applied)


async def test_a_late_rtc_fetches_the_current_reconstructor_part_by_part(bridge, endpoint, rtc):
    manifest, matrix = reconstructor(rtc)
    bridge.offer(manifest, matrix)
    assert rtc.fetch(rtc.keys.current) == "nothing to offer"
    bridge.set_current(manifest.id)
    with FakeRtc(endpoint.listen[0], session="late") as late:
        fetched, received = late.fetch_current()
    assert fetched == manifest
    assert np.array_equal(received, matrix)
    assert manifest.layout.n_chunks == 3


def test_a_query_for_what_is_not_there_is_answered_with_a_text(bridge, rtc):
    manifest, matrix = reconstructor(rtc)
    bridge.offer(manifest, matrix)
    key = rtc.keys.matrix(manifest.id)
    assert rtc.fetch(rtc.keys.matrix("unknown")) == "reconstructor unknown is not on offer"
    assert rtc.fetch(f"{key}?chunk=3") == "chunk 3 of r-1: there are 3"
    assert rtc.fetch(f"{key}?chunk=-1").startswith("range: chunk '-1'")
    assert rtc.fetch(rtc.keys.acknowledgement).startswith("id: 'ack'")


def test_an_applied_reconstructor_becomes_the_current_one(bridge, rtc):
    manifest, matrix = reconstructor(rtc)
    asyncio.run(bridge.publish(manifest, matrix))
    Seen(bridge).first(Acknowledgement)
    wait_until(lambda: rtc.fetch(rtc.keys.current) != "nothing to offer")
    fetched, _ = rtc.fetch_current()
    assert fetched.id == manifest.id


async def test_a_manifest_that_does_not_describe_its_matrix_is_not_sent(bridge, rtc):
    manifest, matrix = reconstructor(rtc)
    with pytest.raises(WireError, match="manifest r-1 says"):
        await bridge.publish(manifest, matrix + 1)


def test_only_what_is_on_offer_can_be_current(bridge):
    with pytest.raises(UnknownIdError, match="r-9 is not on offer"):
        bridge.set_current("r-9")


def test_an_acknowledgement_for_an_unknown_id_is_counted_and_reported(bridge, rtc):
    rtc.acknowledge("stranger", "0" * 64, AckState.APPLIED, frame_seq=3)
    assert Seen(bridge).first(Acknowledgement).frame_seq == 3
    assert bridge.statistics().acknowledgements_unknown == 1


async def test_the_matrix_in_use_is_fetched_from_the_rtc(bridge, rtc):
    with pytest.raises(LinkError, match="no matrix in use"):
        await bridge.fetch_applied()
    manifest, matrix = reconstructor(rtc)
    rtc.applied = {"manifest": manifest, "matrix": matrix}
    fetched, received = await bridge.fetch_applied()
    assert fetched == manifest
    assert np.array_equal(received, matrix)


def measured(rtc, matrix, **changes):
    values = {
        "id": "im-1",
        "layout": layout_of(matrix, 64),
        "reason": None,
        "modes": tuple(range(matrix.shape[1])),
        "amplitude_m": (1e-9,) * matrix.shape[1],
        "n_average": 4,
        "pattern": Pattern.PUSH_PULL_MODAL,
        "double_pass": False,
        "session": rtc.session,
        "basis_id": rtc.basis_id,
        "config_id": rtc.config_id,
        "system": SYSTEM,
        "created_ns": 5,
    }
    return MeasuredManifest(**(values | changes))


def test_a_measured_matrix_is_put_together(bridge, rtc):
    matrix = np.arange(24, dtype=np.float32).reshape(6, 4)
    manifest = measured(rtc, matrix)
    rtc.send_measured(manifest, matrix)
    event = Seen(bridge).first(MeasuredMatrix)
    assert event.manifest == manifest
    assert np.array_equal(event.matrix, matrix)


def test_a_measurement_that_failed_says_why(bridge, rtc):
    matrix = np.zeros((6, 4), np.float32)
    layout = replace(layout_of(matrix, 64), n_chunks=0, sha256="")
    manifest = measured(rtc, matrix, layout=layout, reason="no light")
    rtc.send_bytes(rtc.keys.measured_commit("im-1"), encode(manifest))
    event = Seen(bridge).first(MeasuredMatrix)
    assert event.matrix is None
    assert event.manifest.reason == "no light"


def test_a_measured_matrix_under_another_name_is_refused(bridge, rtc):
    manifest = measured(rtc, np.zeros((6, 4), np.float32))
    rtc.send_bytes(rtc.keys.measured_commit("im-2"), encode(manifest))
    event = Seen(bridge).first(LogEvent, **MALFORMED)
    assert "the manifest of im-1 of system bench came on the key of im-2" in str(event.text)


def test_a_measured_matrix_with_a_wrong_checksum_is_refused_and_the_next_one_taken(bridge, rtc):
    matrix = np.arange(24, dtype=np.float32).reshape(6, 4)
    seen = Seen(bridge)
    rtc.send_measured(measured(rtc, matrix, layout=layout_of(matrix + 1, 64)), matrix)
    assert "sha256" in str(seen.first(LogEvent, **MALFORMED).text)
    rtc.send_measured(measured(rtc, matrix), matrix)
    assert np.array_equal(seen.first(MeasuredMatrix).matrix, matrix)


# ---------------------------------------------------------------- commands and messages


async def test_a_command_is_answered_and_carried_out(bridge, rtc):
    request = DitherRequest(
        id="d-1",
        kind=DitherKind.SINE,
        modes=(3, 2),
        amplitude_m=(5e-9, 5e-9),
        frequency_hz=(250.0, 240.0),
        duration_s=5.0,
    )
    reply = await bridge.command(request)
    assert (reply.accepted, reply.start_seq) == (True, 77)
    assert rtc.commands == [request]


async def test_a_command_without_an_answer_is_repeated_with_the_same_id(bridge, rtc):
    rtc.silent = 1
    reply = await bridge.command(LoopRequest(id="l-1", leak=0.98))
    assert reply.accepted
    assert [c.id for c in rtc.commands] == ["l-1"]


async def test_a_reply_that_is_unusable_or_not_to_this_command_is_a_link_error(bridge, rtc):
    rtc.answers = [b"junk", encode(Reply(id="x", accepted=True, reason="", start_seq=1))]
    with pytest.raises(LinkError, match="reply to command l-1 is unusable: range"):
        await bridge.command(LoopRequest(id="l-1", leak=0.98))
    with pytest.raises(LinkError, match="answered command l-2 with a reply to x"):
        await bridge.command(LoopRequest(id="l-2", leak=0.98))
    assert bridge.statistics().messages_malformed == {"reply": 1}


async def test_a_matrix_of_another_system_is_not_sent(bridge, rtc):
    manifest, matrix = reconstructor(rtc)
    with pytest.raises(WireError, match="manifest r-1 is of system other, expected bench"):
        await bridge.publish(replace(manifest, system="other"), matrix)


async def test_no_rtc_at_all_is_a_link_error_within_seconds(bridge):
    begin = time.monotonic()
    with pytest.raises(LinkError, match="the RTC was not there for loop command l-1"):
        await bridge.command(LoopRequest(id="l-1", leak=0.98))
    assert time.monotonic() - begin < patience(3.0)


def test_state_gains_and_alarm_reach_those_who_listen_and_those_who_come_late(bridge, rtc):
    state = StateMessage(system=SYSTEM, t_ns=1, mode="auto", alpha=None, sigma=None, in_use="r-1")
    alarm = AlarmMessage(system=SYSTEM, t_ns=2, name="rtc.vanished", active=True, text="gone")
    bridge.publish_state(state)
    gains = GainsMessage(
        system=SYSTEM,
        t_ns=3,
        modes=(1,),
        optical_gain=np.array([0.5, 0.6], "<f4").tobytes(),
        sigma=np.array([0.1, 0.01], "<f4").tobytes(),
        reference_id=None,
        magnitude=8.0,
        frame_rate_hz=1000.0,
    )
    bridge.publish_alarm(alarm)
    bridge.publish_gains(gains)
    assert decode(StateMessage, _last_value(rtc, rtc.keys.state)) == state
    assert decode(AlarmMessage, _last_value(rtc, rtc.keys.alarm)) == alarm
    assert decode(GainsMessage, _last_value(rtc, rtc.keys.gains)) == gains


async def test_references_are_sent_put_on_their_topic_and_read_back(bridge, rtc):
    """More slopes than another command may have: 40,000, in 160 KB."""
    slopes = np.arange(40_000, dtype="<f4")
    offset = {"slopes": slopes.tobytes(), "sha256": checksum(slopes)}
    request = ReferencesRequest(
        id="q-1", reference_id="ncpa", config_id="mask-1", ramp_s=1.0, **offset
    )
    in_use = ReferencesInUse(reference_id="ncpa~", **offset)
    # Before the reply to the command, which comes the same way: then the service knows it as well.
    answer_references(rtc.zenoh, rtc.keys, lambda: in_use)
    assert (await bridge.command(request)).accepted
    assert rtc.commands == [request]
    assert decode(ReferencesRequest, _last_value(rtc, rtc.keys.references)) == request
    assert await bridge.fetch_references() == in_use


def _last_value(rtc, key):
    history = zenoh.ext.HistoryConfig(max_samples=1)
    heard = zenoh.ext.declare_advanced_subscriber(rtc.zenoh, key, history=history)
    return wait_until(heard.try_recv).payload.to_bytes()


# ---------------------------------------------------------------- opening and closing


def test_a_busy_port_is_one_clear_line(bridge, endpoint):
    with pytest.raises(LinkError) as refusal:
        Bridge(endpoint).open()
    text = str(refusal.value)
    assert endpoint.listen[0] in text
    assert "\n" not in text


def test_a_missing_router_is_one_clear_line_and_reached_once_it_is_there(endpoint):
    client = Bridge(Endpoint(system=SYSTEM, connect=endpoint.listen))
    with pytest.raises(LinkError, match="no zenoh router answers at tcp") as refusal:
        client.open()
    assert client.statistics().missing == str(refusal.value)
    with Bridge(replace(endpoint, system="router")):
        client.reopen()
        assert not client.statistics().missing
        assert client.events() == []  # no RTC has gone
        client.close()
        client.reopen()
        assert client.statistics().missing == ""
        assert client._session is None


def test_the_service_can_be_a_client_of_another_router(bridge, endpoint, rtc):
    with Bridge(Endpoint(system=SYSTEM, connect=endpoint.listen)) as client:
        seen = Seen(client)
        seen.first(LogEvent, name="rtc.appeared")
        rtc.send(0)
        assert sequence(drained(client, 10)) == list(range(10))


def test_nothing_works_before_open_and_closing_twice_is_fine(endpoint):
    bridge = Bridge(endpoint)
    with pytest.raises(LinkError, match="not open"):
        asyncio.run(bridge.fetch_applied())
    # dropped: the service goes on while its link waits for the network
    bridge.publish_state(
        StateMessage(system=SYSTEM, t_ns=1, mode="auto", alpha=None, sigma=None, in_use=None)
    )
    assert bridge.drain() == []
    bridge.open()
    with pytest.raises(LinkError, match="open already"):
        bridge.open()
    bridge.close()
    bridge.close()
    with Bridge(endpoint):
        pass


def test_a_process_that_closes_its_bridge_exits(endpoint):
    program = (
        "from service.rtc_bridge import Bridge, Endpoint\n"
        f"bridge = Bridge(Endpoint(system='bench', listen={endpoint.listen!r}))\n"
        "bridge.open()\n"
        "bridge.close()\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, timeout=patience(20.0))
