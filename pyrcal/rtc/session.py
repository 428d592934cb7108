"""The zenoh session of an RTC: configuration, publishers, liveliness token."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable

import structlog
import zenoh
import zenoh.ext

from service.config.link_tables import Router
from service.wire import Encodings, Keys, Role

_log = structlog.get_logger("rtc")

_RETRY_S = 0.2
"""Pause between two attempts to reach the service's router."""

_OPEN_TIMEOUT_MS = 1000
_LEASE_MS = 2000
_WAIT_BEFORE_DROP_US = 20_000
"""Time that a full queue may hold up the publisher before a message is dropped."""

_QUEUED_MESSAGES = 16
_RETRY = {
    "period_init_ms": round(1000 * _RETRY_S),
    "period_increase_factor": 1.5,
    "period_max_ms": 1000,
}
_CACHE_S = 5.0
"""Telemetry kept by the publisher, so that the service can request missed frames."""

_HEARTBEAT_S = 0.2
"""Period in which the publisher reports its last message, so that a lost one is noticed."""


def open_session(router: Router, stopped: threading.Event) -> zenoh.Session | None:
    """Open a session with the service's router, waiting for it if necessary.

    Returns
    -------
    The session, or None if ``stopped`` was set before the router could be reached.
    """
    waiting = False
    while not stopped.is_set():
        try:
            return zenoh.open(client_config(router))
        except zenoh.ZError:
            if not waiting:
                _log.warning("link.waiting", endpoint=router.endpoint)
            waiting = True
            stopped.wait(_RETRY_S)
    return None


def client_config(router: Router) -> zenoh.Config:
    """Return the zenoh configuration that the contract requires of a client."""
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [router.endpoint],
        "connect/timeout_ms": _OPEN_TIMEOUT_MS,
        "connect/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/tx/queue/size/data": _QUEUED_MESSAGES,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _WAIT_BEFORE_DROP_US,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
        **router.security,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def frames_publisher(
    session: zenoh.Session, keys: Keys, batches_per_s: float
) -> zenoh.ext.AdvancedPublisher:
    """Return the publisher of telemetry; the service can request missed frames from it."""
    return zenoh.ext.declare_advanced_publisher(
        session,
        keys.frames,
        encoding=Encodings.FRAMES,
        # The loop must not wait for a slow network: the service requests what is dropped from the
        # cache.
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA,
        cache=zenoh.ext.CacheConfig(math.ceil(_CACHE_S * batches_per_s)),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(
            heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
        ),
        # A service that has subscribed before notices the publisher and requests what it has
        # missed.
        publisher_detection=True,
    )


def status_publisher(session: zenoh.Session, keys: Keys) -> zenoh.Publisher:
    """Return the publisher of status messages."""
    return session.declare_publisher(
        keys.status,
        encoding=Encodings.STATUS,
        congestion_control=zenoh.CongestionControl.DROP,
    )


class Token:
    """Liveliness token of the RTC, declared for the duration of a ``with`` block.

    Parameters
    ----------
    session, keys
        Open zenoh session, and the keys of the system.
    on_change
        Called with True when the token is declared and with False when it is withdrawn.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, on_change: Callable[[bool], None] | None = None
    ) -> None:
        self._session = session
        self._key = keys.alive(Role.RTC)
        self._on_change = on_change
        self._token: zenoh.LivelinessToken | None = None

    def __enter__(self) -> Token:
        self.show(visible=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.show(visible=False)

    def show(self, *, visible: bool) -> None:
        """Declare or withdraw the token. Repeated calls have no effect."""
        if visible is (self._token is not None):
            return
        if self._on_change is not None:
            self._on_change(visible)
        if self._token is None:
            self._token = self._session.liveliness().declare_token(self._key)
        else:
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._token = None
