"""Replay a recorded night as the RTC it was.

Session, sequence numbers and timestamps are the recorded ones: what depends on them (where a window
begins, when it ends) comes out as it did that night, and so do the estimates. Nothing that the
service asks for is carried out.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Final

import structlog
import zenoh
import zenoh.ext

from pyrcal.rtc.matrices import acknowledge
from pyrcal.rtc.replies import answer_applied, answer_commands
from pyrcal.rtc.session import (
    Token,
    frames_publisher,
    open_session,
    status_publisher,
)
from service.config.link_tables import Router
from service.errors import WireError
from service.files.recording import Message, RecordedKind, Recording
from service.wire import (
    Acknowledgement,
    AckState,
    CommandKind,
    Keys,
    Manifest,
    Reply,
    Status,
    command_id,
    decode,
    encode,
)

_log = structlog.get_logger("sim_rtc")

REFUSAL: Final = "unsupported: a replay"
SERVICE_WITHIN_S: Final = 20.0
"""Time to wait for a service that reports its state: before, it could fit nothing."""

_RETRY_S = 0.2
_BATCHES_PER_S = 100.0
_LINGER_S = 0.5
"""Time for the last messages to leave."""


class Replay:
    """Plays a recording once."""

    def __init__(self, recording: Recording, *, router: Router, speed: float) -> None:
        """Take the recording; ``speed`` is recorded time over wall-clock time, 0: no waiting."""
        self._recording = recording
        self._router = router
        self._speed = speed
        self._keys = Keys(recording.system)
        self._matrix: Message | None = None
        self._status: Status | None = None
        self._service = threading.Event()
        self._refused: deque[tuple[str, str]] = deque(maxlen=64)

    def run(self, stopped: threading.Event) -> None:
        """Play until the end or until ``stopped``."""
        session = open_session(self._router, stopped)
        if session is None:
            return
        with session:
            answer_commands(session, self._keys, _refuse)
            answer_applied(session, self._keys, self._find_last_matrix)
            session.declare_subscriber(self._keys.all_commits, self._on_commit)
            zenoh.ext.declare_advanced_subscriber(
                session,
                self._keys.state,
                lambda _: self._service.set(),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            )
            self._await_service(stopped)
            _log.info("replay.start", system=self._keys.system, speed=self._speed)
            n_messages = self._play(session, stopped)
            stopped.wait(_LINGER_S)
            _log.info("replay.end", messages=n_messages)

    def _await_service(self, stopped: threading.Event) -> None:
        deadline_s = time.monotonic() + SERVICE_WITHIN_S
        while not self._service.wait(_RETRY_S) and time.monotonic() < deadline_s:
            if stopped.is_set():
                return

    def _play(self, session: zenoh.Session, stopped: threading.Event) -> int:
        frames = frames_publisher(session, self._keys, _BATCHES_PER_S)
        status = status_publisher(session, self._keys)
        n_messages = 0
        with Token(session, self._keys, None) as token:
            for message in self._wait_for_messages(stopped):
                n_messages += 1
                self._acknowledge_refusals(session)
                match message.kind:
                    case RecordedKind.FRAMES:
                        frames.put(message.payload, attachment=message.attachment)
                    case RecordedKind.STATUS:
                        self._status = decode(Status, message.payload)
                        status.put(message.payload)
                    case RecordedKind.ACKNOWLEDGEMENT:
                        acknowledge(session, self._keys, message.payload)
                    case RecordedKind.LIVELINESS:
                        token.show(visible=message.payload != b"\x00")
                    case RecordedKind.MATRIX:
                        self._matrix = message
        return n_messages

    def _wait_for_messages(self, stopped: threading.Event) -> Iterator[Message]:
        """Yield the messages, each when it is due."""
        start_s, first_s = time.monotonic(), None
        for message in self._recording.messages():
            first_s = message.time_s if first_s is None else first_s
            if self._speed > 0.0:
                due_s = start_s + (message.time_s - first_s) / self._speed
                stopped.wait(max(0.0, due_s - time.monotonic()))
            if stopped.is_set():
                return
            yield message

    def _find_last_matrix(self) -> tuple[bytes, list[bytes]] | None:
        """Return manifest and chunks of the matrix that was played last."""
        matrix = self._matrix
        if matrix is None:
            return None
        size = decode(Manifest, matrix.attachment).layout.chunk_bytes
        starts = range(0, len(matrix.payload), size)
        return matrix.attachment, [matrix.payload[start : start + size] for start in starts]

    def _on_commit(self, sample: zenoh.Sample) -> None:
        try:
            manifest = decode(Manifest, sample.payload.to_bytes())
        except WireError as error:
            _log.warning("reconstructor.refused", reason=str(error))
            return
        self._refused.append((manifest.id, manifest.layout.sha256))

    def _acknowledge_refusals(self, session: zenoh.Session) -> None:
        """Reject the service's matrices in the name of the session being played."""
        while self._refused and self._status is not None:
            matrix_id, sha256 = self._refused.popleft()
            refused = Acknowledgement(
                # The service accepts acknowledgements of the session that it follows only.
                session=self._status.session,
                id=matrix_id,
                sha256=sha256,
                state=AckState.REJECTED,
                reason=REFUSAL,
                frame_seq=None,
            )
            acknowledge(session, self._keys, encode(refused))


def _refuse(_kind: CommandKind, data: bytes) -> Reply:
    return Reply(id=command_id(data), accepted=False, reason=REFUSAL, start_seq=None)
