"""Signatures: what reaches mirror or service vouches for itself, whoever runs the router.

A signed message is a msgpack map that ends with four more keys; the last is an HMAC of the signer's
role, the key it travels under, all bytes before, and of a batch its rows. What is replayed is known
by the signer's start, by the count of what it has signed and, of what a service signs, by the start
of the RTC that it is for.
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

KEYS: Final = ("signer", "signed_n", "signed_for", "mac")
"""Last in a signed message, in this order."""

_FIRST_KEY: Final[bytes] = msgpack.packb(KEYS[0])
_FOUR_KEYS: Final = bytes([0x80 + len(KEYS)])
"""The head of a map of so many."""

MAC_BYTES: Final = 32

REMEMBERED: Final[dict[Role, int]] = {Role.RTC: 4096, Role.SERVICE: 8}
"""How far a message may be behind the newest of its signer, by the signer's role: frames that zenoh
recovers come late, and of what a service sends a swap may overtake."""

SIGNERS: Final = 16
"""Services that an RTC remembers."""


class Window:
    """Which of a signer's messages have come."""

    __slots__ = ("_came", "_newest", "_size")

    def __init__(self, size: int) -> None:
        self._size, self._newest, self._came = size, -1, 0

    def admit(self, n: int) -> bool:
        """Return whether a message comes for the first time and not too late."""
        ahead = n - self._newest
        if ahead > 0:
            mask = (1 << self._size) - 1
            self._came = (self._came << min(ahead, self._size) | 1) & mask
            self._newest = n
            return True
        if -ahead >= self._size or self._came >> -ahead & 1:
            return False
        self._came |= 1 << -ahead
        return True


class Signatures:
    """Signs what a program sends and checks what it is sent; without a secret, neither."""

    def __init__(
        self, secret: bytes | None, role: Role, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._signs = secret is not None
        self._blank = hmac.new(secret or b"", digestmod=sha256)
        self._role = role
        self._other = Role.SERVICE if role is Role.RTC else Role.RTC
        self._lock = threading.Lock()
        self._n = 0
        self._windows: dict[int, Window] = {}
        self.signer = clock_ns()
        """This program's start, nanoseconds since the Unix epoch, UTC: its name as a signer."""
        self._newest = 0
        """Of an RTC's starts: what a service's messages are for; 0: it has none heard."""

    def sign(self, key: str, data: bytes, rows: bytes = b"") -> bytes:
        """Return a message with its signature; ``rows`` travel beside it.

        What is no map cannot be signed, and no message.
        """
        if not self._signs or not _is_map(data):
            return data
        n_keys, body = _opened(data)
        with self._lock:
            n, meant = self._n, self._newest
            self._n += 1
        values = dict(zip(KEYS, (self.signer, n, meant, b""), strict=True))
        more = b"".join(msgpack.packb(each) for pair in values.items() for each in pair)[:-2]
        head: bytes = msgpack.Packer().pack_map_header(n_keys + len(KEYS))
        text = head + body + more + bytes([0xC4, MAC_BYTES])
        return text + self._mac(self._role, key, text, rows)

    def check(self, key: str, data: bytes, rows: bytes = b"") -> None:
        """Refuse a message that is not signed by the other side, or was sent before.

        Raises
        ------
        WireError
            With what was found; the text is fit for the ``reason`` of a reply.
        """
        if not self._signs:
            return
        said = _signature(data)
        mac = self._mac(self._other, key, data[:-MAC_BYTES], rows)
        if not hmac.compare_digest(mac, data[-MAC_BYTES:]):
            raise WireError(
                f"signature: wrong on {key}: signed with another key, or changed on its way"
            )
        with self._lock:
            self._admit(said)

    def _admit(self, said: Map) -> None:
        signer, n = said["signer"], said["signed_n"]
        if self._role is Role.RTC and said["signed_for"] != self.signer:
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
                self._newest = signer
                self._windows.clear()
            elif len(self._windows) >= SIGNERS:
                del self._windows[min(self._windows)]
            self._windows[signer] = Window(REMEMBERED[self._other])
        if not self._windows[signer].admit(n):
            raise WireError(f"signature: message {n} of its signer came before, or too late")

    def _mac(self, role: Role, key: str, text: bytes, rows: bytes) -> bytes:
        mac = self._blank.copy()
        mac.update(f"{role}\0{key}\0".encode())
        mac.update(text)
        mac.update(rows)
        return mac.digest()


UNSIGNED: Final = Signatures(None, Role.RTC)
"""Neither signs nor checks."""


def _is_map(data: bytes) -> bool:
    return data[:1] == b"\xde" or (len(data) > 0 and 0x80 <= data[0] <= 0x8F)


def _opened(data: bytes) -> tuple[int, bytes]:
    """Return how many keys a map has, and all behind its head."""
    first = data[0]
    if 0x80 <= first <= 0x8F:
        return first & 0x0F, data[1:]
    return int.from_bytes(data[1:3]), data[3:]  # no message has 65,536 keys


def _signature(data: bytes) -> dict[str, Any]:
    """Return the keys of a message's signature; the rest is read by whoever uses it."""
    begin = data.rfind(_FIRST_KEY)
    try:
        said = msgpack.unpackb(_FOUR_KEYS + data[begin:]) if begin >= 0 else None
    except (ValueError, msgpack.exceptions.UnpackException):
        said = None
    if not isinstance(said, dict) or tuple(said) != KEYS:
        raise WireError("signature: none, and one is asked for")
    *numbers, mac = said.values()
    is_whole = all(type(number) is int and 0 <= number < 2**63 for number in numbers)
    if not is_whole or not isinstance(mac, bytes) or data[-MAC_BYTES:] != mac:
        raise WireError("signature: not of the form that docs/rtc.md has")
    return said
