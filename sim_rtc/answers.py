"""What the RTC answers when it is asked: commands, and the reconstructor in use."""

from __future__ import annotations

import time
from collections.abc import Callable

import structlog
import zenoh

from service.errors import WireError
from service.wire import (
    CommandKind,
    Encodings,
    Keys,
    Reply,
    command_id,
    decode_command,
    encode_manifest,
    encode_reply,
    split,
)
from sim_rtc.computer import RealTimeComputer
from sim_rtc.desk import CommandDesk

_log = structlog.get_logger("sim_rtc")


class Answers:
    """The RTC's queryables; they answer on the network's threads."""

    def __init__(self, keys: Keys, computer: RealTimeComputer) -> None:
        self._keys = keys
        self._computer = computer
        self._desk = CommandDesk(computer.execute)

    def declare(self, session: zenoh.Session) -> None:
        """Let the session answer from now on."""
        for kind in CommandKind:
            session.declare_queryable(self._keys.command(kind), self._answering(kind))
        session.declare_queryable(self._keys.applied, self._answer_applied)

    def _answering(self, kind: CommandKind) -> Callable[[zenoh.Query], None]:
        def answer(query: zenoh.Query) -> None:
            with query:
                data = b"" if query.payload is None else query.payload.to_bytes()
                try:
                    reply = self._desk.handle(decode_command(kind, data), time.monotonic())
                except WireError as error:
                    reply = Reply(
                        id=command_id(data), accepted=False, reason=str(error), start_seq=None
                    )
                _log.info(
                    "command",
                    kind=str(kind),
                    id=reply.id,
                    accepted=reply.accepted,
                    reason=reply.reason,
                )
                query.reply(
                    self._keys.command(kind),
                    encode_reply(reply),
                    encoding=Encodings.REPLY,
                )

        return answer

    def _answer_applied(self, query: zenoh.Query) -> None:
        with query:
            active = self._computer.snapshot().reconstructor
            wanted = query.parameters.get("chunk")
            if wanted is None:
                query.reply(
                    self._keys.applied, encode_manifest(active.manifest), encoding=Encodings.COMMIT
                )
                return
            chunks = split(active.matrix, active.manifest.layout.chunk_bytes)
            if not wanted.isdecimal() or int(wanted) >= len(chunks):
                query.reply_err(f"range: chunk {wanted}, expected 0 to {len(chunks) - 1}")
                return
            query.reply(self._keys.applied, chunks[int(wanted)], encoding=Encodings.BYTES)
