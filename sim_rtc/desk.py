"""Where commands are handed in: each is carried out once, however often it is sent."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

from service.wire import Command, Reply

_REMEMBERED_S = 600.0


class _Answered(NamedTuple):
    time_s: float
    command: Command
    reply: Reply


class CommandDesk:
    """Gives the same id the same reply for ten minutes."""

    def __init__(self, execute: Callable[[Command], Reply]) -> None:
        self._execute = execute
        self._lock = threading.Lock()
        self._answered: dict[str, _Answered] = {}

    def handle(self, command: Command, now_s: float) -> Reply:
        """Return the reply; ``now_s`` is any clock that never goes back."""
        with self._lock:
            self._answered = {
                key: answered
                for key, answered in self._answered.items()
                if now_s - answered.time_s <= _REMEMBERED_S
            }
            known = self._answered.get(command.id)
            if known is None:
                reply = self._execute(command)
                self._answered[command.id] = _Answered(now_s, command, reply)
                return reply
            if known.command == command:
                return known.reply
        reason = f"id: {command.id} was used for another command, expected a new id"
        return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
