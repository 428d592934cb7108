"""Reply to the service's queries.

A command is carried out once, however often it is sent.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

import structlog
import zenoh

from service.errors import WireError
from service.wire import (
    Command,
    CommandKind,
    Encodings,
    Keys,
    Reply,
    command_id,
    decode_command,
    encode,
    split,
)
from service.wire.signing import UNSIGNED, Signatures
from sim_rtc.computer.measure import Measurement
from sim_rtc.computer.reconstructors import Terms
from sim_rtc.computer.telemetry import Identity, Reconstructor

_log = structlog.get_logger("sim_rtc")


class Computer(Protocol):
    """An RTC as the link needs it, simulated or another program."""

    identity: Identity
    """Names the telemetry carries."""

    @property
    def session(self) -> str:
        """Session of the frames to come."""

    @property
    def reconstructor(self) -> Reconstructor:
        """The matrix that multiplies the slopes now."""

    @property
    def largest_matrix_bytes(self) -> int:
        """Bytes of a matrix for all modes."""

    def terms(self) -> Terms:
        """Return what a new reconstructor must fit at present."""

    def stage(self, reconstructor: Reconstructor) -> None:
        """Take a checked matrix, to be swapped in."""

    def take_swaps(self) -> list[tuple[str, int]]:
        """Return ids and first frames of the matrices swapped in since the last call."""

    def take_measured(self) -> list[Measurement]:
        """Return the measurements that have ended since the last call."""

    def execute(self, command: Command) -> Reply:
        """Carry out a command, or say why not."""


class Replies:
    """The RTC's queryables; they answer on the network's threads."""

    def __init__(self, keys: Keys, computer: Computer, signatures: Signatures = UNSIGNED) -> None:
        self._keys = keys
        self._signatures = signatures
        self._computer = computer
        self._cache = ReplyCache(computer.execute)

    def declare(self, session: zenoh.Session) -> None:
        """Let the session answer from now on."""
        answer_commands(session, self._keys, self._reply, self._signatures)
        answer_applied(session, self._keys, self._applied, self._signatures)

    def _reply(self, kind: CommandKind, data: bytes) -> Reply:
        try:
            self._signatures.check(self._keys.command(kind), data)
            reply = self._cache.handle(decode_command(kind, data), time.monotonic())
        except WireError as error:
            reply = Reply(id=command_id(data), accepted=False, reason=str(error), start_seq=None)
        _log.info(
            "command",
            kind=str(kind),
            id=reply.id,
            accepted=reply.accepted,
            reason=reply.reason,
        )
        return reply

    def _applied(self) -> tuple[bytes, list[bytes]]:
        active = self._computer.reconstructor
        chunks = split(active.matrix, active.manifest.layout.chunk_bytes)
        return encode(active.manifest), chunks


def answer_commands(
    session: zenoh.Session,
    keys: Keys,
    reply: Callable[[CommandKind, bytes], Reply],
    signatures: Signatures = UNSIGNED,
) -> None:
    """Let a session answer commands of every kind by ``reply``."""

    def answering(kind: CommandKind) -> Callable[[zenoh.Query], None]:
        def answer(query: zenoh.Query) -> None:
            with query:
                data = b"" if query.payload is None else query.payload.to_bytes()
                reply_bytes = signatures.sign(keys.command(kind), encode(reply(kind, data)))
                query.reply(keys.command(kind), reply_bytes, encoding=Encodings.REPLY)

        return answer

    for kind in CommandKind:
        session.declare_queryable(keys.command(kind), answering(kind))


def answer_applied(
    session: zenoh.Session,
    keys: Keys,
    applied: Callable[[], tuple[bytes, list[bytes]] | None],
    signatures: Signatures = UNSIGNED,
) -> None:
    """Let a session serve the matrix in use: its manifest, or one chunk."""

    def answer(query: zenoh.Query) -> None:
        with query:
            found, wanted = applied(), query.parameters.get("chunk")
            if found is None:
                query.reply_err("missing: no matrix has been played yet")
                return
            manifest, chunks = found
            if wanted is None:
                signed = signatures.sign(keys.applied, manifest)
                query.reply(keys.applied, signed, encoding=Encodings.COMMIT)
            elif wanted.isdecimal() and int(wanted) < len(chunks):
                query.reply(keys.applied, chunks[int(wanted)], encoding=Encodings.BYTES)
            else:
                query.reply_err(f"range: chunk {wanted}, expected 0 to {len(chunks) - 1}")

    session.declare_queryable(keys.applied, answer)


def acknowledge(session: zenoh.Session, keys: Keys, data: bytes) -> None:
    """Send an acknowledgement."""
    session.put(
        keys.acknowledgement,
        data,
        encoding=Encodings.ACKNOWLEDGEMENT,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.DATA_HIGH,
    )


_REMEMBERED_S = 600.0


class _Answered(NamedTuple):
    time_s: float
    command: Command
    reply: Reply


class ReplyCache:
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
