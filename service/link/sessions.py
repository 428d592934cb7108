"""Which RTC session is the one that counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

GRACE_S: Final = 1.0
"""Messages of a session that has ended may still be on their way for this long."""

SILENCE_S: Final = 2.0
"""Another session is believed once the one that counts has been silent for this long."""

REMEMBERED: Final = 16
"""Most other sessions that are kept apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Admission:
    """What to do with a message of some session."""

    accepted: bool
    """Whether it belongs to the session that counts."""

    previous: str | None = None
    """The session it replaces."""

    changed: bool = False
    """Whether it starts a session."""

    rival: str | None = None
    """The session that is interleaved with the one that counts: there are two RTCs."""


class SessionWatch:
    """A session counts until it falls silent; one that speaks beside it is a second RTC."""

    __slots__ = ("_heard_s", "_left", "_previous", "_rivals", "_since_s", "current")

    def __init__(self) -> None:
        self.current: str | None = None
        self._heard_s = 0.0
        self._since_s = 0.0
        self._left = False
        self._previous: str | None = None
        self._rivals: dict[str, float] = {}

    def admit(self, session: str, now_s: float) -> Admission:
        """Judge a message by its session, and remember that it was heard."""
        if session == self.current:
            self._heard_s, self._left = now_s, False
            return Admission(accepted=True, rival=self._rival(now_s))
        if self.current is None or self._left or now_s - self._heard_s >= SILENCE_S:
            return self._begun(session, now_s)
        echo = session == self._previous and now_s - self._since_s < SILENCE_S
        if not echo and len(self._rivals) < REMEMBERED:
            self._rivals.setdefault(session, now_s)
        return Admission(accepted=False)

    def leave(self) -> None:
        """Note that the RTC has said goodbye: unless it speaks again, its session is over."""
        self._left = True

    def waiting(self, now_s: float) -> str | None:
        """Return the session that will count if the present one stays silent, or None."""
        quiet = now_s - self._heard_s > GRACE_S / 2
        return next(reversed(self._rivals), None) if quiet else None

    def _begun(self, session: str, now_s: float) -> Admission:
        self._previous, self.current = self.current, session
        self._heard_s = self._since_s = now_s
        self._left = False
        self._rivals.clear()
        return Admission(accepted=True, previous=self._previous, changed=True)

    def _rival(self, now_s: float) -> str | None:
        """Return a session heard so long ago that this message is no straggler; forget it."""
        for session, first_s in self._rivals.items():
            if now_s - first_s > GRACE_S:
                del self._rivals[session]
                return session
        return None
