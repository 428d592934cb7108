"""Answers to the service's queries: commands, and the matrix in use.

A command is executed once, even if it is sent several times.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import structlog
import zenoh
from numpy.typing import NDArray

from pyrcal.rtc.identity import Identity, Reconstructor
from pyrcal.rtc.staging import Terms
from service import wire
from service.errors import WireError
from service.wire.signing import UNSIGNED, Signatures

_log = structlog.get_logger("rtc")


class FinishedMeasurement(Protocol):
    """A measured interaction matrix that is ready to be sent."""

    def product(
        self, identity: Identity, created_ns: int
    ) -> tuple[wire.MeasuredManifest, NDArray[np.float32] | None]:
        """Return the manifest and the matrix; None in place of the matrix if there is none."""


class Computer(Protocol):
    """Interface of an RTC program to the link: a program implements these methods."""

    identity: Identity
    """Names that the telemetry carries."""

    @property
    def session(self) -> str:
        """Session of the frames to come."""

    @property
    def reconstructor(self) -> Reconstructor:
        """The control matrix in use."""

    @property
    def largest_matrix_bytes(self) -> int:
        """Size of a control matrix for all modes."""

    def terms(self) -> Terms:
        """Return what a new reconstructor must agree with at present."""

    def stage(self, reconstructor: Reconstructor) -> None:
        """Accept a checked matrix; swap it in between two frames."""

    def take_swaps(self) -> list[tuple[str, int]]:
        """Return id and first frame of each matrix swapped in since the last call."""

    def take_measured(self) -> Sequence[FinishedMeasurement]:
        """Return the measurements that were finished since the last call."""

    def execute(self, command: wire.Command) -> wire.Reply:
        """Execute a command and return the reply; a refusal carries its reason."""


@runtime_checkable
class HoldsReferences(Protocol):
    """A :class:`Computer` that subtracts the reference offset that the service requests."""

    def references_in_use(self) -> wire.ReferencesInUse:
        """Return the offset that is subtracted now."""


class Replies:
    """Queryables of the RTC. They answer in zenoh's threads."""

    def __init__(
        self, keys: wire.Keys, computer: Computer, signatures: Signatures = UNSIGNED
    ) -> None:
        self._keys = keys
        self._signatures = signatures
        self._computer = computer
        self._cache = ReplyCache(computer.execute)

    def declare(self, session: zenoh.Session) -> None:
        """Declare the queryables in a session."""
        answer_commands(session, self._keys, self._reply, self._signatures)
        answer_applied(session, self._keys, self._applied, self._signatures)
        if isinstance(self._computer, HoldsReferences):
            in_use = self._computer.references_in_use
            answer_references(session, self._keys, in_use, self._signatures)

    def _reply(self, kind: wire.CommandKind, data: bytes) -> wire.Reply:
        try:
            self._signatures.check(self._keys.command(kind), data)
            reply = self._cache.handle(wire.decode_command(kind, data), time.monotonic())
        except WireError as error:
            # The command could not be decoded, so its id is taken from the data if it is readable.
            reply = wire.Reply(
                id=wire.command_id(data), accepted=False, reason=str(error), start_seq=None
            )
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
        chunks = wire.split(active.matrix, active.manifest.layout.chunk_bytes)
        return wire.encode(active.manifest), chunks


def answer_commands(
    session: zenoh.Session,
    keys: wire.Keys,
    reply: Callable[[wire.CommandKind, bytes], wire.Reply],
    signatures: Signatures = UNSIGNED,
) -> None:
    """Declare one queryable for each kind of command, answered by ``reply``."""

    def answer(kind: wire.CommandKind, query: zenoh.Query) -> None:
        with query:
            data = b"" if query.payload is None else query.payload.to_bytes()
            reply_bytes = signatures.sign(keys.command(kind), wire.encode(reply(kind, data)))
            query.reply(keys.command(kind), reply_bytes, encoding=wire.Encodings.REPLY)

    for kind in wire.CommandKind:
        session.declare_queryable(keys.command(kind), partial(answer, kind))


def answer_applied(
    session: zenoh.Session,
    keys: wire.Keys,
    applied: Callable[[], tuple[bytes, list[bytes]] | None],
    signatures: Signatures = UNSIGNED,
) -> None:
    """Declare the queryable of the matrix in use, which returns its manifest or one chunk."""

    def answer(query: zenoh.Query) -> None:
        with query:
            found, wanted = applied(), query.parameters.get("chunk")
            if found is None:
                query.reply_err("missing: no matrix has been played yet")
                return
            manifest, chunks = found
            if wanted is None:
                signed = signatures.sign(keys.applied, manifest)
                query.reply(keys.applied, signed, encoding=wire.Encodings.COMMIT)
            elif wanted.isdecimal() and int(wanted) < len(chunks):
                query.reply(keys.applied, chunks[int(wanted)], encoding=wire.Encodings.BYTES)
            else:
                query.reply_err(f"range: chunk {wanted}, expected 0 to {len(chunks) - 1}")

    session.declare_queryable(keys.applied, answer)


def answer_references(
    session: zenoh.Session,
    keys: wire.Keys,
    in_use: Callable[[], wire.ReferencesInUse],
    signatures: Signatures = UNSIGNED,
) -> None:
    """Declare the queryable of the reference offset in use."""

    def answer(query: zenoh.Query) -> None:
        with query:
            signed = signatures.sign(keys.references_in_use, wire.encode(in_use()))
            query.reply(keys.references_in_use, signed, encoding=wire.Encodings.REFERENCES)

    session.declare_queryable(keys.references_in_use, answer)


_REPLY_LIFETIME_S = 600.0
"""Time for which the reply to a command is repeated if the command arrives again."""


class _Answered(NamedTuple):
    time_s: float
    command: wire.Command
    reply: wire.Reply


class ReplyCache:
    """Repeats the reply to a command that arrives again within ten minutes."""

    def __init__(self, execute: Callable[[wire.Command], wire.Reply]) -> None:
        self._execute = execute
        self._lock = threading.Lock()
        self._answered: dict[str, _Answered] = {}

    def handle(self, command: wire.Command, now_s: float) -> wire.Reply:
        """Return the reply to a command. ``now_s`` is a monotonic time in seconds."""
        # Held while the command is executed: a repetition that comes meanwhile waits for the same
        # reply.
        with self._lock:
            self._answered = {
                key: answered
                for key, answered in self._answered.items()
                if now_s - answered.time_s <= _REPLY_LIFETIME_S
            }
            known = self._answered.get(command.id)
            if known is None:
                reply = self._execute(command)
                self._answered[command.id] = _Answered(now_s, command, reply)
                return reply
            if known.command == command:
                return known.reply
        reason = f"id: {command.id} was used for another command, expected a new id"
        return wire.Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
