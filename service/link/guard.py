"""Programs on a secured link, refusals, and certificates that are about to expire.

zenoh reports each connection that is made, with the name of its certificate; a name without a role
is counted as refused. What zenoh itself refuses (a TLS handshake, a message that the role does not
allow) it reports only in its trace log, with a line for each message: that log is not read here. A
separate router can write it (docs/operate/link.md). Connections that were closed before a handshake
are counted in the kernel's table of sockets: zenoh processes about ten of them a second, one after
the other, and admits no others meanwhile.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import structlog
import zenoh

from service.link.statistics import EndingCertificate, Refusal
from service.records.messages import Message, compose
from service.wire.access import DAY_S, LinkSecurity

REFUSAL_REPORT_DURATION_S: Final = 60.0
"""Time for which a refusal is reported."""

LOG_INTERVAL_S: Final = 60.0
"""Least time between two lines of the log on the same."""

MAX_LISTED_REFUSALS: Final = 64
"""Largest number of refusals that are listed separately; the others are counted together."""

OTHER_REFUSALS: Final = ("others", "several things", "")

HANDSHAKE_FAILURES_HZ: Final = 10.0
"""Failed TLS handshakes that zenoh deals with in a second: after each it waits for 0.1 s."""

MIN_ALARM_CONNECTIONS: Final = 20
"""Closed connections from which on an alarm is raised: the next program waits for 2 s."""

_SOCKET_TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_CLOSE_WAIT: Final = "08"
"""State in the kernel's table of a connection that only the other side has closed."""


class LinkGuard:
    """Notes who comes and what is refused; its methods may be called from any thread."""

    def __init__(self, security: LinkSecurity) -> None:
        self._security = security
        self._lock = threading.Lock()
        self._refused: dict[tuple[str, str, str], list[float]] = {}
        """Number, time of the last, and of the last line of the log, by who, what and where."""
        self._log = structlog.get_logger()

    def on_link(self, event: zenoh.LinkEvent) -> None:
        """Note a connection that was made or ended."""
        link, roles = event.link, self._security.roles
        name, address = link.auth_identifier or "", str(link.dst)
        made = event.kind == zenoh.SampleKind.PUT
        role = roles.get(name, "none" if name else "as its user")
        self._log.info(
            "link.connected" if made else "link.disconnected",
            who=name or "no certificate",
            role=role,
            address=address,
            zenoh_id=str(link.zid),
        )
        if made and role == "none":
            host = address.rpartition(":")[0]  # each connection has another port
            self.refused(name, "anything", f"it has no role in [zenoh.access], {host}")

    def refused(self, who: str, what: str, where: str) -> None:
        """Note something that was refused, and log it unless that was done a moment ago."""
        now_s, key = time.monotonic(), (who, what, where)
        with self._lock:
            # A stranger can choose names and keys without end: the table must not grow with them.
            if key not in self._refused and len(self._refused) >= MAX_LISTED_REFUSALS:
                self._forget(now_s)
            if key not in self._refused and len(self._refused) >= MAX_LISTED_REFUSALS:
                key = OTHER_REFUSALS
            # monotonic() may be less than the interval after a boot: the first refusal is logged
            # all the same.
            entry = self._refused.setdefault(key, [0, 0.0, -LOG_INTERVAL_S])
            entry[0] += 1
            entry[1] = now_s
            is_due = now_s - entry[2] >= LOG_INTERVAL_S
            if is_due:
                entry[2] = now_s
        if is_due:
            who, what, where = key
            self._log.warning("link.refused", who=who, what=what, where=where, n=int(entry[0]))

    def refusals(self) -> tuple[Refusal, ...]:
        """Return what was refused of late, the last first."""
        now_s = time.monotonic()
        with self._lock:
            self._forget(now_s)
            found = [
                Refusal(who=who, what=what, where=where, n=int(n), age_s=now_s - last_s)
                for (who, what, where), (n, last_s, _) in self._refused.items()
            ]
        return tuple(sorted(found, key=lambda refusal: refusal.age_s))

    def ending(self) -> tuple[EndingCertificate, ...]:
        """Return the certificates that end soon or have ended, the first to end first."""
        now_s = time.time()
        found = [
            EndingCertificate(name=one.name, path=one.path, remaining_s=one.ends_s - now_s)
            for one in self._security.certificates
            if one.ends_s - now_s < self._security.warn_s
        ]
        return tuple(sorted(found, key=lambda one: one.remaining_s))

    def _forget(self, now_s: float) -> None:
        self._refused = {
            key: entry
            for key, entry in self._refused.items()
            if now_s - entry[1] < REFUSAL_REPORT_DURATION_S
        }


def count_waiting(listen: Sequence[str], tables: Sequence[Path] = _SOCKET_TABLES) -> dict[int, int]:
    """Return by TLS port how many connections were closed and are not dealt with yet.

    Only ports that have such connections are listed; none is where the kernel has no such table.
    """
    addresses = (re.split("[?#]", one)[0] for one in listen if one.startswith("tls/"))
    ports = {int(one.rpartition(":")[2]) for one in addresses if one[-1:].isdecimal()}
    found: dict[int, int] = {}
    for table in tables if ports else ():
        try:
            # The first line is the heading.
            lines = table.read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            _, local, _, state, *_ = line.split()
            # The kernel writes addresses and ports in hexadecimal.
            port = int(local.rpartition(":")[2], 16)
            if state == _CLOSE_WAIT and port in ports:
                found[port] = found.get(port, 0) + 1
    return found


def describe_flood(waiting: Mapping[int, int]) -> Message | None:
    """Return which port keeps programs out, and for how long, or None."""
    flooded = [port for port, n in sorted(waiting.items()) if n >= MIN_ALARM_CONNECTIONS]
    text = "; ".join(
        f"{n} connections to port {port} were closed before a handshake. A program that connects "
        f"there, an RTC that restarts among them, is let in after about "
        f"{n / HANDSHAKE_FAILURES_HZ:.0f} s, or when they end. Let the firewall admit few new "
        "connections of each address, or give the RTC a port of its own"
        for port, n in ((port, waiting[port]) for port in flooded)
    )
    return compose("link.flooded", _join(flooded), text=text) if flooded else None


def describe_refusals(refusals: Sequence[Refusal]) -> Message | None:
    """Return the recent refusals in words, or None."""
    if not refusals:
        return None
    details = "; ".join(
        f"{one.who}: {one.what} ({one.where}), {one.n} times" for one in refusals[:3]
    )
    more = len(refusals) - 3
    text = f"{details}{f'; and {more} more' if more > 0 else ''}"
    return compose("link.refused", _join(sorted({one.who for one in refusals})), text=text)


def describe_expiry(certificates: Sequence[EndingCertificate]) -> Message | None:
    """Return which certificates end soon or have ended, or None."""
    if not certificates:
        return None
    text = "; ".join(
        f"the certificate of {one.name} ({one.path}) "
        + ("has ended" if one.remaining_s <= 0.0 else f"ends in {one.remaining_s / DAY_S:.0f} days")
        for one in certificates
    )
    return compose("link.certificates", _join(one.path for one in certificates), text=text)


def _join(items: Iterable[object]) -> str:
    return ", ".join(map(str, items))
