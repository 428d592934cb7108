"""Questions to the RTC and its answers; every call waits, so call off the event loop."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from service.errors import LinkError
from service.link.endpoint import Endpoint
from service.link.session import ask
from service.wire import (
    ChunkAssembler,
    Command,
    CommandKind,
    Encodings,
    Keys,
    Manifest,
    Reply,
    command_kind,
    decode_manifest,
    encode_command,
    encode_reply,
)

if TYPE_CHECKING:
    import zenoh

ABSENT_PAUSE_S: Final = 0.3
"""Before a command is repeated: an RTC that is not there makes a query end at once."""

OPTIONAL: Final = (CommandKind.RAMP,)
"""Commands that an RTC need not know."""

MATRIX_TIMEOUT_S: Final = 2.0
"""For the RTC to answer with a manifest or a part of its matrix."""


def send_command(session: zenoh.Session, endpoint: Endpoint, command: Command) -> bytes:
    """Return the RTC's answer to a command, repeated with the same id until there is one.

    Raises
    ------
    WireError
        If the command breaks the contract.
    LinkError
        If there is none after all attempts.
    """
    payload, kind = encode_command(command), command_kind(command)
    selector = Keys(endpoint.system).command(kind)
    for attempt in range(endpoint.command_attempts):
        if attempt:
            time.sleep(ABSENT_PAUSE_S)
        timeout_s, began_s = endpoint.command_timeout_s, time.monotonic()
        answer = ask(session, selector, timeout_s, payload, Encodings.COMMAND)
        if answer is not None:
            return answer
        # zenoh ends a query at once that nobody serves
        if kind in OPTIONAL and time.monotonic() - began_s < timeout_s / 2:
            reason = f"unsupported: the RTC offers no {kind}"
            return encode_reply(Reply(id=command.id, accepted=False, reason=reason, start_seq=None))
    raise LinkError(
        f"no answer from the RTC to {kind} command {command.id} after "
        f"{endpoint.command_attempts} attempts: whether it was carried out is unknown"
    )


def fetch_applied(session: zenoh.Session, keys: Keys) -> tuple[Manifest, NDArray[np.float32]]:
    """Return the reconstructor the RTC uses, checked against its manifest.

    Raises
    ------
    WireError
        If what comes breaks the contract or the checksum differs.
    LinkError
        If the RTC does not answer or has none.
    """
    manifest = decode_manifest(_asked(session, keys.applied))
    assembler = ChunkAssembler()
    assembler.announce(manifest.layout)
    for index in range(manifest.layout.n_chunks):
        assembler.add(index, _asked(session, f"{keys.applied}?chunk={index}"))
    return manifest, assembler.matrix()


def _asked(session: zenoh.Session, selector: str) -> bytes:
    answer = ask(session, selector, MATRIX_TIMEOUT_S)
    if answer is None:
        raise LinkError(f"no answer from the RTC on {selector} within {MATRIX_TIMEOUT_S} s")
    return answer
