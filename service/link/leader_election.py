"""Decide which RTC session counts, and which service drives it."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from service.link import session as link
from service.records.events import ServicesMet
from service.wire import Keys, Role

if TYPE_CHECKING:
    import zenoh

NAME_PATTERN: Final = re.compile(r"[0-9]{1,19}-[0-9a-f]{1,32}")
"""Start of a service, nanoseconds since the Unix epoch, and its zenoh id."""

NAMELESS_TIMEOUT_S: Final = 5.0
"""A service that gives no name is there for so long after its last word."""

TOKEN_ARRIVAL_S: Final = 0.3
"""Time for the tokens of services that started at the same time to arrive."""

ENDED_SESSION_GRACE_S: Final = 1.0
"""Messages of a session that has ended may still be on their way for this long."""

SESSION_SILENCE_S: Final = 2.0
"""Silence of the current session after which another session is accepted."""

MAX_OTHER_SESSIONS: Final = 16
"""Most other sessions that are kept apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionDecision:
    """Verdict on a message of a session."""

    accepted: bool
    """True if it belongs to the session that counts."""

    changed: bool = False
    """True if it begins a session."""

    other_session: str | None = None
    """The session that is interleaved with the one that counts: there are two RTCs."""


class SessionWatch:
    """A session counts until it falls silent; another one next to it is a second RTC."""

    __slots__ = (
        "_left",
        "_other_sessions",
        "_previous",
        "_received_s",
        "_since_s",
        "current",
        "other",
    )

    def __init__(self) -> None:
        self.current: str | None = None
        self._received_s = 0.0
        self._since_s = 0.0
        self._left = False
        self.other: str | None = None
        """Another session that spoke last: the one that counts may be over. None: it is not."""

        self._previous: str | None = None
        self._other_sessions: dict[str, float] = {}

    def admit(self, session: str, now_s: float) -> SessionDecision:
        """Judge a message by its session, and remember the session."""
        if session == self.current:
            self._received_s, self._left, self.other = now_s, False, None
            return SessionDecision(accepted=True, other_session=self._other_session(now_s))
        if self.current is None or self._left or now_s - self._received_s >= SESSION_SILENCE_S:
            return self._begun(session, now_s)
        # Messages of the session before may still arrive after the new one; that is no second RTC.
        echo = session == self._previous and now_s - self._since_s < SESSION_SILENCE_S
        if not echo:
            self.other = session
            # A faulty sender may put a new session into every message.
            if len(self._other_sessions) < MAX_OTHER_SESSIONS:
                self._other_sessions.setdefault(session, now_s)
        return SessionDecision(accepted=False)

    def leave(self) -> None:
        """Note that the RTC has announced its end: unless it speaks again, its session is over."""
        self._left = True

    def waiting(self, now_s: float) -> str | None:
        """Return the session that will count if the present one stays silent, or None."""
        quiet = now_s - self._received_s > ENDED_SESSION_GRACE_S / 2
        return next(reversed(self._other_sessions), None) if quiet else None

    def _begun(self, session: str, now_s: float) -> SessionDecision:
        self._previous, self.current = self.current, session
        self._received_s = self._since_s = now_s
        self._left, self.other = False, None
        self._other_sessions.clear()
        return SessionDecision(accepted=True, changed=True)

    def _other_session(self, now_s: float) -> str | None:
        """Return a session so old that this message is no straggler; forget it."""
        for session, first_s in self._other_sessions.items():
            if now_s - first_s > ENDED_SESSION_GRACE_S:
                del self._other_sessions[session]
                return session
        return None


class LeaderElection:
    """The order of the services that are there.

    A service takes a name that ranks after all that it finds, whatever its clock says; of two that
    come at the same time the names decide. One that holds only the token of the contract, and so
    no name, was first if it was there first. Not thread-safe.
    """

    __slots__ = ("_names", "_received_s", "contract_held", "drives", "name")

    def __init__(self) -> None:
        self._names: set[str] = set()
        self._received_s: float | None = None
        self.name = ""
        self.drives = False
        self.contract_held = False
        """True if a service holds the token of the contract; it may be this one."""

    def join(self, found: Iterable[str], own_id: str, now_ns: int) -> str:
        """Take a name after all that are there, and return it."""
        self._names = {name for name in found if NAME_PATTERN.fullmatch(name)}
        latest_ns = max((_rank(name)[0] for name in self._names), default=0)
        # The clock of this machine may be behind: the newcomer must rank last all the same.
        self.name = f"{max(now_ns, latest_ns + 1)}-{own_id}"
        return self.name

    def notice(self, name: str, *, alive: bool) -> None:
        """Note that a service has come or gone."""
        if name != self.name and NAME_PATTERN.fullmatch(name):
            (self._names.add if alive else self._names.discard)(name)

    def receive(self, now_s: float) -> None:
        """Note a word of another service, that need not have a name, while this one drives."""
        # the last word of the one that has driven before is no second service
        if self.drives:
            self._received_s = now_s

    def settle(self) -> bool:
        """Return whether this service drives from now on."""
        before = any(_rank(name) < _rank(self.name) for name in self._names)
        self.drives = not before and (self.drives or not self.contract_held)
        return self.drives

    def others(self, now_s: float) -> tuple[str, ...]:
        """Return the other services that are there, in words, the first one first."""
        names = tuple(_words(name) for name in sorted(self._names, key=_rank))
        received = self._received_s is not None and now_s - self._received_s < NAMELESS_TIMEOUT_S
        nameless = received or (self.contract_held and not self.drives)
        return names if names or not nameless else ("one that gives no name",)


class Standby:
    """Keeps this service's place among those that are there; thread-safe."""

    def __init__(
        self,
        keys: Keys,
        *,
        drive: Callable[[zenoh.Session], list[object]],
        report: Callable[[ServicesMet], None],
    ) -> None:
        """Create the standby without joining the election.

        Parameters
        ----------
        keys
            Keys of the system.
        drive
            Declares the subscribers and queryables of the driving service, and returns them.
        report
            Called when other services came or went.
        """
        self._keys = keys
        self._drive = drive
        self._report = report
        self._lock = threading.Lock()
        self._election = LeaderElection()
        self._session: zenoh.Session | None = None
        self._driving: list[object] = []
        self._met: tuple[bool, tuple[str, ...]] = (True, ())

    @property
    def drives(self) -> bool:
        """Return True if this service drives the RTC: only then it commands and publishes."""
        return self._election.drives

    def join(
        self,
        session: zenoh.Session,
        guarded: Callable[[str, Callable[[Any], None]], Callable[[Any], None]],
        *,
        wait: bool,
    ) -> list[object]:
        """Take a place, and drive the RTC unless another service was first.

        Parameters
        ----------
        session
            Open.
        guarded
            Makes a callback one that lets nothing escape.
        wait
            Whether others may come at the same time, to the same routers.

        Returns
        -------
        list
            What is to be held while the link is open.
        """
        keys, contract = self._keys, self._keys.alive(Role.SERVICE)
        # Asked without the lock: routers may take a second to answer, and whoever posts a state or
        # a token meanwhile would wait as long.
        found = [_name_of(key) for key in link.tokens(session, keys.all_ranks)]
        contract_held = bool(link.tokens(session, contract))
        with self._lock:
            self._election = LeaderElection()
            self._election.contract_held = contract_held
            name = self._election.join(found, str(session.zid()), time.time_ns())
        # Announced before the decision: of two that start together each must see the other.
        held = [
            link.announce(session, keys.rank(name)),
            link.watch(session, keys.all_ranks, guarded("alive", self._on_token)),
            link.watch(session, contract, guarded("alive", self._on_token)),
            link.subscribe(session, keys.state, guarded("state", self._on_state)),
        ]
        if wait:
            time.sleep(TOKEN_ARRIVAL_S)
        with self._lock:
            self._session = session
        self._settle()
        return held

    def leave(self) -> None:
        """Give the place up."""
        with self._lock:
            self._session = None
            # The subscribers end when the last reference to them goes.
            self._driving.clear()

    def look_again(self) -> None:
        """Check whether a service has gone without its token's end being received."""
        if self._met[1]:
            self._settle()

    def _on_token(self, token: tuple[str, bool]) -> None:
        key, alive = token
        with self._lock:
            if key == self._keys.alive(Role.SERVICE):
                self._election.contract_held = alive
            else:
                self._election.notice(_name_of(key), alive=alive)
        self._settle()

    def _on_state(self, _: zenoh.Sample) -> None:
        with self._lock:
            self._election.receive(time.monotonic())
        self._settle()

    def _settle(self) -> None:
        """Drive or go to standby according to the election, and report changes."""
        with self._lock:
            if self._session is None:
                return
            drives = self._election.settle()
            if drives and not self._driving:
                self._driving = self._drive(self._session)
            elif not drives:
                self._driving = []
            met = (drives, self._election.others(time.monotonic()))
            news, self._met = met != self._met, met
        if news:
            # Outside the lock, because the receiver takes a lock of its own.
            self._report(ServicesMet(drives=met[0], others=met[1]))


def _name_of(key: str) -> str:
    return key.rpartition("/")[2]


def _rank(name: str) -> tuple[int, str]:
    since, _, own_id = name.partition("-")
    return int(since), own_id


def _words(name: str) -> str:
    since_ns, own_id = _rank(name)
    since = datetime.fromtimestamp(since_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return f"{own_id} (there since {since})"
