"""Where and how the service meets the RTC."""

from __future__ import annotations

from dataclasses import dataclass

from service.wire import CHUNK_LIMIT


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoint:
    """Settings of the link; nothing is opened by making one."""

    system: str
    """The ``{system}`` of every key."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints of the embedded router; not used when ``connect`` is given."""

    connect: tuple[str, ...] = ()
    """Endpoints of an observatory's own routers, of which the service becomes a client."""

    chunk_bytes: int = CHUNK_LIMIT
    """Size of the parts of a reconstructor: a default zenoh-pico drops more than 4096."""

    lease_s: float = 2.0
    """Silence after which the other side counts as gone."""

    ring_seconds: float = 5.0
    """Telemetry kept until it is drained; then the oldest is overwritten and counted."""

    ring_bytes: int = 512_000_000
    """Most memory for it."""

    recovery_s: float = 0.5
    """How long frames behind a hole wait for zenoh to recover what is missing."""

    reorder_s: float = 0.02
    """The same when the RTC's publisher keeps no history, so that only order may differ."""

    command_timeout_s: float = 1.0
    """The RTC answers a command within this."""

    command_attempts: int = 3
    """Times a command without an answer is sent, with the same id."""

    offer_s: float = 60.0
    """A published reconstructor can be asked for at least this long; the current one always."""
