"""Signatures of messages: by hand, and all that must be refused."""

import hashlib
import hmac

import msgpack
import pytest

from service.errors import WireError
from service.wire import FrameHeader, Keys, Role, decode, encode
from service.wire.signing import ReplayWindow, Signatures
from tests.support.repository import ROOT

SECRET = b"the same on both sides, 32 bytes"
KEYS = Keys("bench")
STATUS = msgpack.packb({"v": 1, "session": "s1"})
ORDER = KEYS.command("loop")


def rtc(start=1000, secret=SECRET):
    return Signatures(secret, Role.RTC, lambda: start)


def service(start=2000, secret=SECRET):
    return Signatures(secret, Role.SERVICE, lambda: start)


@pytest.fixture
def pair():
    """A service that has heard the RTC."""
    ours, theirs = service(), rtc()
    ours.check(KEYS.status, theirs.sign(KEYS.status, STATUS))
    return ours, theirs


def refused(signatures, *message):
    with pytest.raises(WireError) as caught:
        signatures.check(*message)
    return str(caught.value)


def test_a_signature_as_the_page_says_it_by_hand():
    signed = rtc(start=7).sign(KEYS.status, STATUS)
    said = msgpack.unpackb(signed)
    assert list(said)[-4:] == ["signer", "signed_n", "signed_for", "mac"]
    assert (said["signer"], said["signed_n"], said["signed_for"]) == (7, 0, 0)
    text = b"rtc\0ao/v1/bench/tel/status\0" + signed[:-32]
    assert said["mac"] == hmac.new(SECRET, text, hashlib.sha256).digest() == signed[-32:]


def test_the_mac_that_the_page_gives_to_test_against_is_right():
    page = (ROOT / "docs" / "rtc" / "README.md").read_text(encoding="utf-8")
    signed = rtc(start=7, secret=b"0123456789abcdef" * 2).sign(KEYS.status, STATUS)
    assert f"`{signed[-32:].hex()}`" in page


def test_what_is_signed_is_still_the_message():
    said = msgpack.unpackb(rtc().sign(KEYS.status, STATUS))
    assert said.items() >= {"v": 1, "session": "s1"}.items()
    header = FrameHeader(
        **{"session": "s", "seq0": 0, "n": 1, "t0_ns": 1, "dt_ns": 1, "n_slopes": 2, "n_modes": 1},
        **{"dither": False, "cm_id": None, "basis_id": "b", "config_id": "c"},
    )
    assert decode(FrameHeader, rtc().sign(KEYS.frames, encode(header))) == header


@pytest.mark.parametrize("n_keys", [0, 11, 12, 15, 16, 300])
def test_maps_of_any_size_can_be_signed(n_keys):
    data = msgpack.packb({f"k{k}": k for k in range(n_keys)})
    signed = rtc().sign("a", data)
    assert len(msgpack.unpackb(signed)) == n_keys + 4
    service().check("a", signed)


def test_each_side_takes_what_the_other_signs(pair):
    ours, theirs = pair
    theirs.check(ORDER, ours.sign(ORDER, STATUS))
    ours.check(ORDER, theirs.sign(ORDER, STATUS))


def test_the_rows_of_a_batch_are_signed_too(pair):
    ours, theirs = pair
    signed = theirs.sign(KEYS.frames, STATUS, b"rows")
    assert "wrong on" in refused(ours, KEYS.frames, signed, b"rowz")
    ours.check(KEYS.frames, signed, b"rows")


def test_what_has_no_signature_is_refused_and_named(pair):
    ours, _ = pair
    for data in (STATUS, b"", b"\xc1", msgpack.packb([1]), msgpack.packb(7)):
        assert refused(ours, KEYS.status, data).startswith("signature: none")


def test_without_a_secret_nothing_is_signed_and_nothing_checked():
    ours = service(secret=None)
    assert ours.sign(KEYS.status, STATUS) == STATUS
    ours.check(KEYS.status, b"anything")
    ours.check(KEYS.status, rtc().sign(KEYS.status, STATUS))


def test_another_secret_is_refused(pair):
    ours, _ = pair
    other = rtc(secret=b"another secret of 32 bytes......")
    assert "another key" in refused(ours, KEYS.status, other.sign(KEYS.status, STATUS))


def test_every_byte_counts(pair):
    ours, theirs = pair
    signed = theirs.sign(KEYS.status, STATUS)
    for k in range(len(signed)):
        changed = signed[:k] + bytes([signed[k] ^ 1]) + signed[k + 1 :]
        assert "signature: " in refused(ours, KEYS.status, changed)
    ours.check(KEYS.status, signed)


def test_a_message_under_another_key_is_refused(pair):
    ours, theirs = pair
    signed = ours.sign(KEYS.commit("a"), STATUS)
    assert "wrong on" in refused(theirs, KEYS.commit("b"), signed)


def test_what_a_side_has_signed_itself_is_not_taken_from_the_other(pair):
    """A router could send the service its own command as the reply to it."""
    ours, _ = pair
    assert "wrong on" in refused(ours, ORDER, ours.sign(ORDER, STATUS))


def test_a_message_counts_once(pair):
    ours, theirs = pair
    signed, order = theirs.sign(KEYS.status, STATUS), ours.sign(ORDER, STATUS)
    ours.check(KEYS.status, signed)
    theirs.check(ORDER, order)
    assert "came before, or too late" in refused(ours, KEYS.status, signed)
    assert "came before, or too late" in refused(theirs, ORDER, order)


def test_frames_that_come_late_are_taken_once():
    ours, theirs = service(), rtc()
    signed = [theirs.sign(KEYS.frames, STATUS) for _ in range(600)]
    for message in (*signed[300:], *signed[:300]):
        ours.check(KEYS.frames, message)
    assert "came before" in refused(ours, KEYS.frames, signed[299])


def test_an_order_held_back_while_others_went_on_is_refused(pair):
    ours, theirs = pair
    held, *later = [ours.sign(ORDER, STATUS) for _ in range(9)]
    for message in later:
        theirs.check(ORDER, message)
    assert "too late" in refused(theirs, ORDER, held)


def test_an_order_of_before_the_rtcs_restart_is_refused(pair):
    ours, _ = pair
    order = ours.sign(ORDER, STATUS)
    restarted = rtc(start=3000)
    assert "another start of the RTC" in refused(restarted, ORDER, order)
    ours.check(KEYS.status, restarted.sign(KEYS.status, STATUS))
    restarted.check(ORDER, ours.sign(ORDER, STATUS))


def test_a_service_that_has_heard_nothing_cannot_command():
    assert "too early" in refused(rtc(), ORDER, service().sign(ORDER, STATUS))


def test_telemetry_of_an_rtc_of_before_is_refused(pair):
    ours, theirs = pair
    old = theirs.sign(KEYS.status, STATUS)
    ours.check(KEYS.status, rtc(start=3_000_001_000).sign(KEYS.status, STATUS))
    assert "of a start 3 s before the newest" in refused(ours, KEYS.status, old)


def test_two_services_may_command_in_turn_and_many_take_no_memory(pair):
    first, theirs = pair
    second = service(start=5000)
    second.check(KEYS.status, theirs.sign(KEYS.status, STATUS))
    for ours in (first, second, first):
        theirs.check(ORDER, ours.sign(ORDER, STATUS))
    for k in range(100):
        another = service(start=6000 + k)
        another.check(KEYS.status, theirs.sign(KEYS.status, STATUS))
        theirs.check(ORDER, another.sign(ORDER, STATUS))
    assert len(theirs._windows) == 16


@pytest.mark.parametrize("key", ["signer", "signed_n", "signed_for", "mac"])
@pytest.mark.parametrize("value", [-1, 2**63, "a", None, 1.5, True, b"", bytes(32)])
def test_keys_of_another_form_are_refused(pair, key, value):
    ours, theirs = pair
    said = msgpack.unpackb(theirs.sign(KEYS.status, STATUS)) | {key: value}
    assert "signature: " in refused(ours, KEYS.status, msgpack.packb(said))


def test_a_window_takes_each_number_once_within_its_size():
    window = ReplayWindow(4)
    assert [window.admit(n) for n in (5, 7, 6, 6, 4, 3, 5, 100, 7)] == [
        *(True, True, True, False, True, False, False, True, False)
    ]
