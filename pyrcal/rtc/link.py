"""The RTC's side of the link: one object for telemetry, status, commands and matrices."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import structlog
import zenoh
from numpy.typing import NDArray

from pyrcal.rtc.matrices import Matrices
from pyrcal.rtc.replies import Computer, Replies
from pyrcal.rtc.session import Token, frames_publisher, open_session, status_publisher
from service.config.link_tables import Router
from service.wire import FrameHeader, Keys, Role, Status, encode, encode_frames
from service.wire.signing import Signatures

_log = structlog.get_logger("rtc")

STATUS_PERIOD_S = 0.2
"""Period in which an RTC publishes its status."""


_MAX_TIME_WITHOUT_ROUTER_S = 5.0
"""A session without a router is closed after this time. zenoh itself reconnects within 1.6 s."""


class RtcLink:
    """One open session with the service. Made by :meth:`RtcConnection.open`."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        signatures: Signatures,
        matrices: Matrices,
        token: Token,
        *,
        batches_per_s: float,
    ) -> None:
        self._session = session
        self._keys = keys
        self._signatures = signatures
        self._frames = frames_publisher(session, keys, batches_per_s)
        self._status = status_publisher(session, keys)
        self._routed_s = time.monotonic()
        self._matrices = matrices
        self.token = token
        """Liveliness token; a program may withdraw it while it has nothing to send."""

    def publish_frames(self, header: FrameHeader, rows: NDArray[np.float32]) -> None:
        """Publish consecutive frames.

        Parameters
        ----------
        header
            Session, sequence number and time of the first frame, ids, shapes.
        rows
            ``(n, n_slopes + n_modes)`` slopes and commands in metres of OPD, with ``n_modes`` more
            columns for the dither if the header says so.
        """
        self.publish_encoded_frames(*encode_frames(header, rows))

    def publish_encoded_frames(self, payload: bytes, attachment: bytes) -> None:
        """Publish frames that are already encoded."""
        signed = self._signatures.sign(self._keys.frames, attachment, payload)
        self._frames.put(payload, attachment=signed)

    def publish_status(self, status: Status) -> None:
        """Publish the status; due every ``STATUS_PERIOD_S`` and whenever the session changes."""
        self.publish_encoded_status(encode(status))

    def publish_encoded_status(self, data: bytes) -> None:
        """Publish a status that is already encoded."""
        self._status.put(self._signatures.sign(self._keys.status, data))

    def report_matrices(self) -> None:
        """Acknowledge swaps and send measured matrices now; call it after a swap."""
        self._matrices.report()

    def is_lost(self) -> bool:
        """Return True if the connection must be closed and opened again."""
        # After both ends were suspended for longer than the lease, a zenoh client may connect twice
        # at the same time. One connection stays open and unused, and the router accepts no second
        # one of the same session (MAX_LINKS). The token is then visible, but nothing that the
        # session publishes arrives. Only a new session resolves this (eclipse-zenoh/zenoh#1886).
        now_s = time.monotonic()
        if self._session.info.routers_zid():
            self._routed_s = now_s
        if now_s - self._routed_s <= _MAX_TIME_WITHOUT_ROUTER_S:
            return False
        _log.warning(
            "link.cut-off",
            text=f"no router for {_MAX_TIME_WITHOUT_ROUTER_S:.0f} s: closing the session to open a "
            "new one",
        )
        return True


class RtcConnection:
    """Connects an RTC with the service, as often as the connection is lost.

    While a session is open, commands are answered, matrices are received and acknowledged, and the
    service sees the RTC. The program itself publishes frames and status.

    Parameters
    ----------
    computer
        The RTC.
    router
        Endpoint and security of the service's router. It may start later than the RTC.
    batches_per_s
        Messages with frames per second; sets how many of them are kept for the service to request.
    matrices
        :class:`Matrices`, or a subclass with its other arguments bound, for programs that change
        the exchange of matrices.
    on_token
        Called when the liveliness token is declared (True) or withdrawn (False).

    Examples
    --------
    >>> connection = RtcConnection(computer, router, batches_per_s=50.0)  # doctest: +SKIP
    >>> with connection.open() as link:  # doctest: +SKIP
    ...     link.publish_status(status)
    ...     link.publish_frames(header, rows)
    """

    def __init__(
        self,
        computer: Computer,
        router: Router,
        *,
        batches_per_s: float,
        matrices: Callable[..., Matrices] = Matrices,
        on_token: Callable[[bool], None] | None = None,
    ) -> None:
        self._computer = computer
        self._router = router
        self._batches_per_s = batches_per_s
        self._matrices = matrices
        self._on_token = on_token
        self._keys = Keys(computer.identity.system)
        self._signatures = Signatures(router.secret, Role.RTC)
        # Replies are kept from one session to the next: a command that is sent again after a lost
        # connection must not be executed twice.
        self._replies = Replies(self._keys, computer, self._signatures)

    @contextmanager
    def open(self, stopped: threading.Event | None = None) -> Iterator[RtcLink | None]:
        """Open a session for the duration of a ``with`` block, waiting for the router.

        Yields
        ------
        The link, or None if ``stopped`` was set before a router could be reached.
        """
        session = open_session(self._router, threading.Event() if stopped is None else stopped)
        if session is None:
            yield None
            return
        with session:
            self._replies.declare(session)
            matrices = self._matrices(
                session, self._keys, self._computer, signatures=self._signatures
            )
            with matrices, Token(session, self._keys, self._on_token) as token:
                yield RtcLink(
                    session,
                    self._keys,
                    self._signatures,
                    matrices,
                    token,
                    batches_per_s=self._batches_per_s,
                )
