"""The only module that calls zenoh.

The advanced publisher and subscriber are marked unstable by zenoh; their version is pinned to the
minor and their use is confined to this page.
"""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import zenoh
import zenoh.ext
from numpy.typing import NDArray

from service import wire
from service.errors import ConfigurationError, LinkError, WireError
from service.wire.access import NO_SECURITY, LinkSecurity
from service.wire.signing import Signatures

FETCHED_HISTORY_S = 0.5
"""Telemetry requested when the service starts late. Requesting all of an RTC's cache stalled its
sender for seconds."""

RX_BUFFER_BYTES = 16 * 65_535
"""Buffers that a link reads into, used again and again: with the usual one alone zenoh makes and
clears another for almost every 64 kB that come."""

MAX_MESSAGE_BYTES = 2 * max(wire.CHUNK_LIMIT, wire.BATCH_LIMIT)
"""Longest message that a link assembles: twice the longest of the contract, in which a matrix of
any size travels in parts. zenoh's own limit is 1 GB for each sender, and that memory is kept."""

CONNECT_TIMEOUT_MS = 2000
"""Longest attempt to reach a router, which without this waits 10 s for one that is silent. The
service has to notice at once that the router has come, and to end in time."""

TOKENS_TIMEOUT_S = 1.0
"""Time for the routers to report which tokens exist; they answer within milliseconds."""

RETRY_OPTIONS = {"period_init_ms": 200, "period_increase_factor": 1.5, "period_max_ms": 1000}
"""Back-off of a client that lost its router; zenoh's own is 3 s at the first loss."""

ABSENT_PAUSE_S: Final = 0.3
"""Pause before a command is repeated: a query to an absent RTC ends at once."""

OPTIONAL_COMMANDS: Final = (wire.CommandKind.RAMP, wire.CommandKind.REFERENCES)
"""Commands that an RTC need not know."""

MATRIX_TIMEOUT_S: Final = 2.0
"""Time for the RTC to answer with a manifest or a chunk of its matrix."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoint:
    """Settings of the link; nothing is opened by making one."""

    system: str
    """The ``{system}`` of every key."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints of the embedded router; not used when ``connect`` is given."""

    connect: tuple[str, ...] = ()
    """Endpoints of an observatory's own routers, of which the service becomes a client."""

    security: LinkSecurity = NO_SECURITY
    """Certificates, users and access."""

    lease_s: float = 2.0
    """Silence after which the other side counts as gone."""

    ring_seconds: float = 5.0
    """Telemetry kept until it is drained; then the oldest is overwritten and counted."""

    ring_bytes: int = 512_000_000
    """Most memory for it."""

    recovery_s: float = 0.5
    """Time for which frames after a gap wait until zenoh has recovered the missing ones."""

    reorder_s: float = 0.02
    """The same when the RTC's publisher keeps no history, so that only order may differ."""

    command_timeout_s: float = 1.0
    """The RTC answers a command within this."""

    command_attempts: int = 3
    """Times a command without an answer is sent, with the same id."""

    offer_s: float = 60.0
    """Time for which a published reconstructor can be requested; the current one always can."""


def open_session(endpoint: Endpoint) -> zenoh.Session:
    """Return an open session: the embedded router, or a client of other routers.

    Raises
    ------
    ConfigurationError
        If zenoh does not understand an endpoint.
    LinkError
        If the network is not there yet: an address, a name, a free port, or a router.
    """
    config = zenoh.Config()
    client = bool(endpoint.connect)
    settings: dict[str, object] = {
        "mode": "client" if client else "router",
        "listen/endpoints": [] if client else list(endpoint.listen),
        "connect/endpoints": list(endpoint.connect),
        "connect/retry": RETRY_OPTIONS,
        "connect/timeout_ms": CONNECT_TIMEOUT_MS,
        # Only the configured endpoints count: scouting would connect any zenoh program of the
        # network.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,
        "transport/link/tx/lease": round(1000 * endpoint.lease_s),
        "transport/link/rx/buffer_size": RX_BUFFER_BYTES,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # Silent connections must not keep an RTC out that restarts: by default a hundred may wait
        # for 10 s each.
        "transport/unicast/accept_pending": 2000,
        "transport/unicast/accept_timeout": 3000,
        "transport/shared_memory/enabled": False,
        **endpoint.security.zenoh,
    }
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        found = ", ".join(map(repr, endpoint.connect if client else endpoint.listen))
        raise ConfigurationError(
            f"zenoh.{'connect' if client else 'listen'}: found {found}, expected endpoints like "
            "tcp/127.0.0.1:7447"
        ) from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise LinkError(_complaint(endpoint, str(error))) from error


def _complaint(endpoint: Endpoint, text: str) -> str:
    if endpoint.connect:
        return (
            f"no zenoh router answers at {', '.join(endpoint.connect)}: start it, and see that its "
            "name resolves and its port can be reached from here"
        )
    text = re.split(r"[.!]?\s+at /", text)[0]  # where in zenoh's own source that was
    where = ", ".join(endpoint.listen)
    if "already in use" in text:
        return (
            f"cannot listen on {where}: the address is already in use; stop the other "
            "program (another pyrcal?) or set another listen endpoint"
        )
    return f"cannot listen on {where}: {text:.160}"


def subscribe_frames(
    session: zenoh.Session, key: str, callback: Callable[[zenoh.Sample], None]
) -> object:
    """Call ``callback``, on zenoh's own thread, for each batch; missed ones are recovered."""
    return zenoh.ext.declare_advanced_subscriber(
        session,
        key,
        # indirect=False calls on zenoh's own thread, without a queue and a switch of threads for
        # each batch.
        zenoh.handlers.Callback(callback, indirect=False),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_age=FETCHED_HISTORY_S),
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )


def subscribe(session: zenoh.Session, key: str, callback: Callable[[zenoh.Sample], None]) -> object:
    """Call ``callback``, on a thread of its own, for each message that is not this session's."""
    return session.declare_subscriber(key, callback, allowed_origin=zenoh.Locality.REMOTE)


def tokens(session: zenoh.Session, key: str) -> list[str]:
    """Return the keys of the liveliness tokens that are there."""
    replies = session.liveliness().get(key, timeout=TOKENS_TIMEOUT_S)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def watch(session: zenoh.Session, key: str, callback: Callable[[tuple[str, bool]], None]) -> object:
    """Call ``callback`` with key and presence of liveliness tokens, now and at each change."""

    def changed(sample: zenoh.Sample) -> None:
        callback((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    return session.liveliness().declare_subscriber(key, changed, history=True)


def watch_links(session: zenoh.Session, callback: Callable[[zenoh.LinkEvent], None]) -> object:
    """Call ``callback`` for each connection that there is, that is made and that ends."""
    return session.info.declare_link_events_listener(callback, history=True)


def serve(session: zenoh.Session, key: str, callback: Callable[[zenoh.Query], None]) -> object:
    """Call ``callback``, on a thread of its own, for each query."""
    return session.declare_queryable(key, callback, complete=True)


def announce(session: zenoh.Session, key: str) -> object:
    """Return a liveliness token, there for as long as it is held and the session is open."""
    return session.liveliness().declare_token(key)


def last_value(session: zenoh.Session, key: str) -> zenoh.ext.AdvancedPublisher:
    """Return a publisher whose last message a late subscriber still gets."""
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        # A slow viewer must not hold up the service; the next message replaces this one.
        congestion_control=zenoh.CongestionControl.DROP,
        cache=zenoh.ext.CacheConfig(1),
    )


def put_last(publisher: zenoh.ext.AdvancedPublisher, data: bytes, encoding: str) -> None:
    """Publish the latest value; it is dropped if another thread closes the link meanwhile."""
    with contextlib.suppress(zenoh.ZError):
        publisher.put(data, encoding=encoding)


def put(session: zenoh.Session, key: str, data: bytes, encoding: str, *, urgent: bool) -> None:
    """Send what must arrive: waits while the link is full.

    Raises
    ------
    LinkError
        If the session is closed.
    """
    priority = zenoh.Priority.DATA_HIGH if urgent else zenoh.Priority.DATA_LOW
    try:
        session.put(
            key,
            data,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=priority,
        )
    except zenoh.ZError as error:
        raise LinkError(f"cannot send on {key}: {error!s:.160}") from error


def ask(
    session: zenoh.Session,
    selector: str,
    timeout_s: float,
    payload: bytes | None = None,
    encoding: str | None = None,
) -> bytes | None:
    """Return the first answer to a query, None when there is none in time.

    Raises
    ------
    LinkError
        If the answer is an error, or the session is closed.
    """
    try:
        replies = session.get(
            selector,
            payload=payload,
            encoding=encoding,
            timeout=timeout_s,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            text = (
                ""
                if reply.err is None
                else reply.err.payload.to_bytes()[:160].decode(errors="replace")
            )
            # zenoh reports a timeout as an error reply with this text.
            if text == "Timeout":
                return None
            raise LinkError(f"{selector} was refused: {text}")
    except zenoh.ZError as error:
        raise LinkError(f"cannot ask {selector}: {error!s:.160}") from error
    return None


def bytes_of(data: zenoh.ZBytes, limit: int, what: str) -> bytes:
    """Return the bytes of a message.

    Raises
    ------
    WireError
        If it is longer than ``limit``: then it is not read.
    """
    # The length is checked before the bytes are copied into Python.
    if len(data) > limit:
        raise WireError(f"range: {what} has {len(data)} bytes, expected at most {limit}")
    return data.to_bytes()


def latency_s(session: zenoh.Session, sample: zenoh.Sample, now_ns: int) -> float | None:
    """Return put-to-now of a message its publisher stamped; a router's own stamp says nothing."""
    stamp = sample.timestamp
    # This session's router stamps what arrives without a timestamp: that would be no latency.
    if stamp is None or str(stamp.get_id()) == str(session.zid()):
        return None
    return (now_ns - stamp.get_time_as_ntp64().as_nanos()) * 1e-9


def send_command(
    session: zenoh.Session, endpoint: Endpoint, command: wire.Command, signatures: Signatures
) -> bytes:
    """Return the RTC's reply to a command, repeated with the same id until there is one.

    zenoh ends a query without a queryable at once. An optional command counts as not offered only
    if the RTC's liveliness token was there at each attempt: an RTC that has just lost its link has
    no queryables for a moment, either.

    Raises
    ------
    WireError
        If the command breaks the contract.
    LinkError
        If there is none after all attempts, or its signature is missing or wrong.
    """
    payload, kind = wire.encode(command), wire.command_kind(command)
    keys = wire.Keys(endpoint.system)
    selector, n_unserved, n_present = keys.command(kind), 0, 0
    for attempt in range(endpoint.command_attempts):
        # A query to an absent RTC ends at once; without a pause all attempts would fail in
        # milliseconds.
        if attempt:
            time.sleep(ABSENT_PAUSE_S)
        timeout_s, began_s = endpoint.command_timeout_s, time.monotonic()
        # Signed anew each time: the RTC takes a repeated signature for a replay.
        signed = signatures.sign(selector, payload)
        answer = ask(session, selector, timeout_s, signed, wire.Encodings.COMMAND)
        if answer is not None:
            return _verify(answer, selector, command, signatures)
        # zenoh ended the query early, so no queryable was there.
        if time.monotonic() - began_s < timeout_s / 2:
            n_unserved += 1
            n_present += bool(tokens(session, keys.alive(wire.Role.RTC)))
    # The RTC was there each time and does not offer the command.
    if kind in OPTIONAL_COMMANDS and n_present == endpoint.command_attempts:
        reason = f"unsupported: the RTC offers no {kind}"
        return wire.encode(wire.Reply(id=command.id, accepted=False, reason=reason, start_seq=None))
    if n_unserved == endpoint.command_attempts:
        raise LinkError(
            f"the RTC was not there for {kind} command {command.id}, which was not carried out: "
            "its link has been lost; give the command again when the RTC is back"
        )
    raise LinkError(
        f"no answer from the RTC to {kind} command {command.id} after "
        f"{endpoint.command_attempts} attempts: whether it was carried out is unknown"
    )


def _verify(answer: bytes, selector: str, command: wire.Command, signatures: Signatures) -> bytes:
    try:
        signatures.check(selector, answer)
    except WireError as error:
        raise LinkError(f"the reply to command {command.id} is unusable: {error}") from error
    return answer


def fetch_applied(
    session: zenoh.Session, keys: wire.Keys, signatures: Signatures
) -> tuple[wire.Manifest, NDArray[np.float32]]:
    """Return the reconstructor the RTC uses, checked against its manifest.

    Raises
    ------
    WireError
        If what comes breaks the contract, is not signed as it must be or the checksum differs.
    LinkError
        If the RTC does not answer or has none.
    """
    reply = _request(session, keys.applied)
    signatures.check(keys.applied, reply)
    manifest = wire.decode(wire.Manifest, reply)
    assembler = wire.ChunkAssembler()
    assembler.announce(manifest.layout)
    for index in range(manifest.layout.n_chunks):
        assembler.add(index, _request(session, f"{keys.applied}?chunk={index}"))
    return manifest, assembler.matrix()


def fetch_references(
    session: zenoh.Session, keys: wire.Keys, signatures: Signatures
) -> wire.ReferencesInUse:
    """Return the offset that the RTC subtracts from its slopes now.

    Raises
    ------
    WireError
        If what comes breaks the contract, or is not signed as it must be.
    LinkError
        If the RTC does not answer.
    """
    reply = _request(session, keys.references_in_use)
    signatures.check(keys.references_in_use, reply)
    return wire.decode(wire.ReferencesInUse, reply)


def _request(session: zenoh.Session, selector: str) -> bytes:
    answer = ask(session, selector, MATRIX_TIMEOUT_S)
    if answer is None:
        raise LinkError(f"no answer from the RTC on {selector} within {MATRIX_TIMEOUT_S} s")
    return answer
