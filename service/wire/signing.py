"""Signatures of messages, which protect the mirror even if the router is not trusted.

A signed message is a msgpack map that ends with four more keys (docs/rtc.md, "Signatures"). The
last is an HMAC-SHA256 of the signer's role, the key expression, all bytes before it and, for
frames, their rows. The other three detect replayed messages: the start time of the signer, the
number of messages that it has signed and, in messages of the service, the start time of the RTC
for which they are meant.
"""

from __future__ import annotations

import hmac
import threading
import time
from collections.abc import Callable
from hashlib import sha256
from typing import Any, Final

import msgpack

from service.errors import WireError
from service.wire.codec import Map
from service.wire.keys import Role

SIGNATURE_KEYS: Final = ("signer", "signed_n", "signed_for", "mac")
"""Last keys of a signed message, in this order."""

_FIRST_KEY: Final[bytes] = msgpack.packb(SIGNATURE_KEYS[0])
_MAP_HEAD: Final = bytes([0x80 + len(SIGNATURE_KEYS)])
"""First byte of a msgpack map with these keys."""

_BIN_HEAD: Final = 0xC4
"""First byte of a msgpack ``bin`` of at most 255 bytes; its length follows."""

MAC_BYTES: Final = 32
"""Bytes of an HMAC-SHA256."""

REPLAY_WINDOW: Final[dict[Role, int]] = {Role.RTC: 4096, Role.SERVICE: 8}
"""Largest distance of a message behind the newest of its signer, in messages, by signer's role.

Frames that zenoh recovers come seconds late; of the messages of a service only a commit may be
overtaken by a few.
"""

MAX_SIGNERS: Final = 16
"""Number of services whose messages an RTC remembers; the oldest is forgotten first."""


class ReplayWindow:
    """Record of which of the last ``size`` messages of one signer have been received."""

    __slots__ = ("_newest", "_seen", "_size")

    def __init__(self, size: int) -> None:
        self._size, self._newest, self._seen = size, -1, 0

    def admit(self, n: int) -> bool:
        """Record message ``n``; return False if it is a repetition or too old."""
        # bit k of ``_seen`` stands for the message k before the newest
        ahead = n - self._newest
        if ahead > 0:
            mask = (1 << self._size) - 1
            # Limited, because a shift by a distance of up to 2**63 would exhaust the memory.
            self._seen = (self._seen << min(ahead, self._size) | 1) & mask
            self._newest = n
            return True
        if -ahead >= self._size or self._seen >> -ahead & 1:
            return False
        self._seen |= 1 << -ahead
        return True


class Signatures:
    """Signer and checker of messages for one program; without a secret it does neither.

    All methods may be called from any thread.
    """

    def __init__(
        self, secret: bytes | None, role: Role, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._signs = secret is not None
        # Copied for each message: the key is hashed once.
        self._blank = hmac.new(secret or b"", digestmod=sha256)
        self._role = role
        self._other = Role.SERVICE if role is Role.RTC else Role.RTC
        self._lock = threading.Lock()
        self._n = 0
        self._windows: dict[int, ReplayWindow] = {}
        self.signer = clock_ns()
        """Start time of this program, nanoseconds since the Unix epoch, UTC; its id as a signer."""
        self._newest = 0
        """Newest start time of an RTC received by a service; 0 on the wire until one has come."""

    def sign(self, key: str, data: bytes, rows: bytes = b"") -> bytes:
        """Return a message with its signature appended.

        Parameters
        ----------
        key
            Key expression under which the message is sent.
        data
            The message, a msgpack map. Anything else is returned as it is: the checker sends
            malformed messages on purpose.
        rows
            Payload that is sent with the message and is signed as well.
        """
        if not self._signs or not _is_map(data):
            return data
        n_keys, body = _split_map(data)
        with self._lock:
            n, meant = self._n, self._newest
            self._n += 1
        values = dict(zip(SIGNATURE_KEYS, (self.signer, n, meant, b""), strict=True))
        # The keys are appended to the packed bytes, so that the message is not packed twice. The
        # two bytes cut off are the head of the empty ``mac``.
        more = b"".join(msgpack.packb(each) for pair in values.items() for each in pair)[:-2]
        head: bytes = msgpack.Packer().pack_map_header(n_keys + len(SIGNATURE_KEYS))
        text = head + body + more + bytes([_BIN_HEAD, MAC_BYTES])
        return text + self._mac(self._role, key, text, rows)

    def check(self, key: str, data: bytes, rows: bytes = b"") -> None:
        """Check that a message was signed by the other side and is not a replay.

        Raises
        ------
        WireError
            If not; the text begins with ``signature`` and can be the ``reason`` of a reply.
        """
        if not self._signs:
            return
        signature = _read_signature(data)
        mac = self._mac(self._other, key, data[:-MAC_BYTES], rows)
        # compare_digest takes the same time for all bytes, so that it does not reveal how many of
        # a forged signature are right.
        if not hmac.compare_digest(mac, data[-MAC_BYTES:]):
            raise WireError(
                f"signature: wrong on {key}: signed with another key, or changed on its way"
            )
        # Only now: a forged message must not use up the number of a true one.
        with self._lock:
            self._admit(signature)

    def _admit(self, signature: Map) -> None:
        """Record a message whose HMAC is right; raise a ``WireError`` if it is a replay."""
        signer, n = signature["signer"], signature["signed_n"]
        if self._role is Role.RTC and signature["signed_for"] != self.signer:
            raise WireError(
                "signature: meant for another start of the RTC: sent before, or too early"
            )
        if self._role is Role.SERVICE and signer < self._newest:
            raise WireError(
                f"signature: of a start {(self._newest - signer) * 1e-9:.0f} s before the newest: "
                "sent before, or the RTC's clock was set back: then restart the service"
            )
        if signer not in self._windows:
            if self._role is Role.SERVICE:
                # A service follows one RTC: a restart makes all messages of earlier starts void.
                # An RTC hears several services, of which one drives and the others stand by.
                self._newest = signer
                self._windows.clear()
            elif len(self._windows) >= MAX_SIGNERS:
                del self._windows[min(self._windows)]
            self._windows[signer] = ReplayWindow(REPLAY_WINDOW[self._other])
        if not self._windows[signer].admit(n):
            raise WireError(f"signature: message {n} of its signer came before, or too late")

    def _mac(self, role: Role, key: str, text: bytes, rows: bytes) -> bytes:
        mac = self._blank.copy()
        # The role, so that a message cannot be sent back as the other side's; the key, so that it
        # cannot be sent elsewhere. Neither contains a NUL.
        mac.update(f"{role}\0{key}\0".encode())
        mac.update(text)
        mac.update(rows)
        return mac.digest()


UNSIGNED: Final = Signatures(None, Role.RTC)
"""Signer without a secret, which neither signs nor checks."""


def _is_map(data: bytes) -> bool:
    return data[:1] == b"\xde" or (len(data) > 0 and 0x80 <= data[0] <= 0x8F)


def _split_map(data: bytes) -> tuple[int, bytes]:
    """Return the number of keys of a packed map, and the bytes behind its head."""
    first = data[0]
    if 0x80 <= first <= 0x8F:
        return first & 0x0F, data[1:]
    return int.from_bytes(data[1:3]), data[3:]  # a map of 16 bits; no message has 65,536 keys


def _read_signature(data: bytes) -> dict[str, Any]:
    """Return the four keys of a message's signature, without parsing the rest of it."""
    # The last one: the message itself may contain these bytes.
    begin = data.rfind(_FIRST_KEY)
    try:
        signature = msgpack.unpackb(_MAP_HEAD + data[begin:]) if begin >= 0 else None
    except (ValueError, msgpack.exceptions.UnpackException):
        signature = None
    if not isinstance(signature, dict) or tuple(signature) != SIGNATURE_KEYS:
        raise WireError("signature: none, and this system requires one")
    *numbers, mac = signature.values()
    is_whole = all(type(number) is int and 0 <= number < 2**63 for number in numbers)
    if not is_whole or not isinstance(mac, bytes) or data[-MAC_BYTES:] != mac:
        raise WireError("signature: a key has another type than docs/rtc.md says")
    return signature
