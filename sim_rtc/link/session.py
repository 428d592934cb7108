"""An RTC's zenoh session: publishers, queryables, token."""

from __future__ import annotations

import json
import math
import threading

import structlog
import zenoh
import zenoh.ext

from service.config.link_tables import Router
from service.files.recording import RecordedKind, RecordingWriter
from service.wire import Encodings, Keys, Role

_log = structlog.get_logger("sim_rtc")

_RETRY_S = 0.2
"""Between two attempts to find the service's router."""

_CUT_OFF_S = 5.0
"""Without a router, until a session is given up: zenoh itself reconnects within 1.6 s."""

_OPEN_TIMEOUT_MS = 1000
_LEASE_MS = 2000
_WAIT_BEFORE_DROP_US = 20_000
_QUEUED_MESSAGES = 16
_RETRY = {
    "period_init_ms": round(1000 * _RETRY_S),
    "period_increase_factor": 1.5,
    "period_max_ms": 1000,
}
_CACHE_S = 5.0
_HEARTBEAT_S = 0.2


def open_session(router: Router, stopped: threading.Event) -> zenoh.Session | None:
    """Open a session, waiting for the service's router until ``stopped``: then None."""
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
    """Return the settings of a zenoh client of the service's router, as the wire page asks."""
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
    """Return the publisher of telemetry; the service can ask it for missed frames."""
    return zenoh.ext.declare_advanced_publisher(
        session,
        keys.frames,
        encoding=Encodings.FRAMES,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA,
        cache=zenoh.ext.CacheConfig(math.ceil(_CACHE_S * batches_per_s)),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(
            heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
        ),
        publisher_detection=True,
    )


def status_publisher(session: zenoh.Session, keys: Keys) -> zenoh.Publisher:
    """Return the publisher of status messages."""
    return session.declare_publisher(
        keys.status,
        encoding=Encodings.STATUS,
        congestion_control=zenoh.CongestionControl.DROP,
    )


class Lifeline:
    """Whether a session still has a router.

    When both ends have stood still for longer than the lease, zenoh's client may connect twice at
    once. One of the connections stays open and unused, and the router takes no second one of the
    same session (``MAX_LINKS``): its token is there, and nothing that it publishes arrives, for
    ever. Only a new session, under a new name, ends that.
    """

    text = f"no router for {_CUT_OFF_S:.0f} s: the session is closed and opened anew"

    def __init__(self, now_s: float) -> None:
        self._seen_s = now_s

    def cut(self, session: zenoh.Session, now_s: float) -> bool:
        """Return whether the session has been without a router for so long that it is given up."""
        if session.info.routers_zid():
            self._seen_s = now_s
        return now_s - self._seen_s > _CUT_OFF_S


class Token:
    """The RTC's liveliness token, which may go and come back while the ``with`` block lasts."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, recorder: RecordingWriter | None
    ) -> None:
        self._session = session
        self._key = keys.alive(Role.RTC)
        self._recorder = recorder
        self._token: zenoh.LivelinessToken | None = None

    def __enter__(self) -> Token:
        self.show(visible=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.show(visible=False)

    def show(self, *, visible: bool) -> None:
        """Declare or withdraw the token, unless that is done already."""
        if visible is (self._token is not None):
            return
        if self._recorder is not None:
            self._recorder.put(RecordedKind.LIVELINESS, bytes([visible]))
        if self._token is None:
            self._token = self._session.liveliness().declare_token(self._key)
        else:
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._token = None
