"""Which RTC session is the one that counts."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

GRACE_S: Final = 1.0
"""Messages of the previous session may still be on their way for this long."""

SILENCE_S: Final = 2.0
"""A session that has been silent for this long can be taken over by an earlier one."""

REMEMBERED: Final = 16
"""Past sessions that are recognised when they speak again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Admission:
    """What to do with a message of some session."""

    accepted: bool
    """Whether it belongs to the session that counts."""

    previous: str | None = None
    """The session it replaces."""

    changed: bool = False
    """Whether it starts a session."""

    second: bool = False
    """Whether two sessions are interleaved: there are two RTCs."""


class SessionWatch:
    """The newest session counts; one that has been replaced and still speaks is a second RTC."""

    __slots__ = ("_heard_s", "_retired", "current")

    def __init__(self) -> None:
        self.current: str | None = None
        self._heard_s = 0.0
        self._retired: OrderedDict[str, float] = OrderedDict()

    def admit(self, session: str, now_s: float) -> Admission:
        """Judge a message by its session, and remember that it was heard."""
        if session == self.current:
            self._heard_s = now_s
            return Admission(accepted=True)
        retired_s = self._retired.get(session)
        if retired_s is not None and now_s - self._heard_s < SILENCE_S:
            return Admission(accepted=False, second=now_s - retired_s > GRACE_S)
        previous, self.current, self._heard_s = self.current, session, now_s
        self._retired.pop(session, None)
        if previous is not None:
            self._retired[previous] = now_s
            if len(self._retired) > REMEMBERED:
                self._retired.popitem(last=False)
        return Admission(accepted=True, previous=previous, changed=True)
