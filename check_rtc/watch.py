"""Observation of an RTC's telemetry: what has come, and whether it follows the loop's law.

No clock and no network are used, so tests can feed messages at any times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.connection import ReceivedMessage, Topic
from service.errors import WireError
from service.estimation import control_law, loopcheck
from service.estimation.control_law import ControlLawCheck, IdentifiedLaw
from service.estimation.frames import FrameBlock
from service.estimation.loop import build_loop, last_seq, same_loop
from service.estimation.loopcheck import CommandResidual, LoopCheck
from service.estimation.windows import ClosedLoop
from service.link.intake import Intake
from service.link.session import Endpoint
from service.wire import (
    Acknowledgement,
    FrameBatch,
    FrameHeader,
    Status,
    decode,
    decode_frames,
)

MIN_FROZEN_FRAMES: Final = 5
"""Number of consecutive frames with identical slopes from which they count as frozen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """Batch of frames that was readable."""

    at_s: float
    """Time of arrival on a monotonic clock, seconds."""

    header: FrameHeader
    recoverable: bool
    """True if its publisher has a cache from which lost messages can be recovered."""

    largest_m: float
    """Largest absolute command in its first row, metres OPD."""

    @property
    def stop_seq(self) -> int:
        """Sequence number after that of its last frame."""
        return self.header.seq0 + self.header.n


@dataclass(frozen=True, slots=True, kw_only=True)
class RefusedMessage:
    """Message that broke the contract, with the reason in ``text``."""

    at_s: float
    topic: Topic
    text: str


class TelemetryObserver:
    """Record of everything that an RTC has sent, from which the checks judge."""

    def __init__(self, endpoint: Endpoint, clock: Callable[[], float]) -> None:
        self.intake = Intake(endpoint, clock)
        self.arrivals: list[Arrival] = []
        self.statuses: list[tuple[float, Status]] = []
        self.acknowledgements: list[tuple[float, Acknowledgement]] = []
        self.measured: list[ReceivedMessage] = []
        self.refused: list[RefusedMessage] = []
        self.queries: list[tuple[float, str]] = []
        """Queries of the RTC for matrices: time, and key with chunk."""

        self.tokens: list[tuple[float, bool]] = []
        self.n_nonfinite = 0
        self.n_frozen = 0
        """Number of frames in runs of at least ``MIN_FROZEN_FRAMES`` with identical slopes."""

        self.block_callbacks: list[Callable[[FrameBlock], None]] = []
        """Callbacks for each block of frames of the current session."""

        self.loop = LoopObserver()
        self._n_equal = 0
        self._last_slopes: NDArray[np.float32] | None = None

    def take(self, messages: list[ReceivedMessage]) -> None:
        """Add new messages."""
        for item in messages:
            try:
                self._take(item)
            except WireError as error:
                self.refused.append(
                    RefusedMessage(at_s=item.at_s, topic=item.topic, text=str(error))
                )
        # The intake is that of the service, so sessions and lost frames are judged by its rules.
        for block in self.intake.drain():
            self.loop.observe(block)
            for take in self.block_callbacks:
                take(block)

    @property
    def status(self) -> Status | None:
        """Last status; None before the first."""
        return self.statuses[-1][1] if self.statuses else None

    @property
    def session(self) -> str | None:
        """Current session by the rules of the service; None before the first frame."""
        return self.intake.statistics().session

    def sessions(self) -> Counter[str]:
        """Return the number of batches of each session, in order of appearance."""
        return Counter(arrival.header.session for arrival in self.arrivals)

    def _take(self, item: ReceivedMessage) -> None:
        if item.refused:
            raise WireError(item.refused)
        match item.topic:
            case Topic.FRAMES:
                self._frames(item, decode_frames(item.data, item.attachment))
            case Topic.STATUS:
                status = decode(Status, item.data)
                self.statuses.append((item.at_s, status))
                self.intake.status(item.data)
                self.loop.take_status(status)
            case Topic.ACK:
                self.acknowledgements.append((item.at_s, decode(Acknowledgement, item.data)))
            case Topic.MEASURED:
                self.measured.append(item)
            case Topic.ALIVE:
                self.tokens.append((item.at_s, item.alive))
                self.intake.liveliness(alive=item.alive)
            case Topic.QUERY:
                self.queries.append((item.at_s, item.key))

    def _frames(self, item: ReceivedMessage, batch: FrameBatch) -> None:
        self.arrivals.append(
            Arrival(
                at_s=item.at_s,
                header=batch.header,
                recoverable=item.recoverable,
                largest_m=float(np.abs(batch.commands_m[0]).max()),
            )
        )
        finite = np.isfinite(batch.rows).all(axis=1)
        self.n_nonfinite += int(np.count_nonzero(~finite))
        self._count_frozen(batch.slopes)
        self.intake.frames(item.data, item.attachment, recoverable=item.recoverable)

    def _count_frozen(self, slopes: NDArray[np.float32]) -> None:
        """Count frames with the slopes of the frame before: photon noise never repeats exactly."""
        before = self._last_slopes
        if before is None or before.shape != slopes[0].shape:
            # NaN equals nothing, so that the first frame is never a repetition.
            before = np.full_like(slopes[0], np.nan)
        same = np.all(slopes == np.concatenate([before[None], slopes[:-1]]), axis=1)
        self._last_slopes = slopes[-1].copy()
        for still in same:
            self._n_equal = self._n_equal + 1 if still else 0
            if self._n_equal == MIN_FROZEN_FRAMES:
                self.n_frozen += MIN_FROZEN_FRAMES
            elif self._n_equal > MIN_FROZEN_FRAMES:
                self.n_frozen += 1


class LoopObserver:
    """Comparison of the commands with the control law that the status reports."""

    def __init__(self) -> None:
        self.matrix: NDArray[np.float32] | None = None
        self.cm_id: str | None = None
        self.laws: list[IdentifiedLaw] = []
        """Results for leak, gain and delay, oldest first."""

        self.obediences: list[CommandResidual] = []
        """Results for the residual of each mode, oldest first."""

        self._status: Status | None = None
        self._check = LoopCheck()
        self._law = ControlLawCheck()

    def use(self, cm_id: str, matrix: NDArray[np.float32]) -> None:
        """Set id and numbers of the matrix in use."""
        self.cm_id, self.matrix = cm_id, matrix

    def take_status(self, status: Status) -> None:
        """Add a status; a change of the loop or its matrix resets the comparison."""
        before, self._status = self._status, status
        # Frames across a change have commands of two laws. Only those after it are compared.
        if before is None or not same_loop(before, status) or before.cm_id != status.cm_id:
            self._check = LoopCheck(from_seq=last_seq(status) + 1)
            self._law = ControlLawCheck(from_seq=last_seq(status) + 1)
            return
        terms = self._terms(status.cm_id)
        if terms is not None:
            self._judge(terms, last_seq(status))

    def observe(self, block: FrameBlock) -> None:
        """Add a block of frames."""
        status, terms = self._status, self._terms(block.cm_id)
        if status is None or terms is None or block.session != status.session:
            return
        if block.slopes.shape[1] != terms.reconstructor.shape[1]:
            return
        self._check = loopcheck.observe(self._check, block, terms)
        self._law = control_law.follow(self._law, block, terms)

    def _terms(self, cm_id: str | None) -> ClosedLoop | None:
        """Return the loop with this matrix; None if it is open or the matrix is unknown."""
        status, matrix = self._status, self.matrix
        if status is None or matrix is None or cm_id is None or cm_id != self.cm_id:
            return None
        if not status.in_loop or len(matrix) > status.n_modes:
            return None
        return build_loop(status, cm_id, matrix)

    def _judge(self, terms: ClosedLoop, seq: int) -> None:
        """Add results for the frames up to ``seq``, which this and the last status enclose."""
        span = loopcheck.last_samples(self._check, seq)
        if span is not None:
            self._check, obeyed = loopcheck.command_residual(self._check, terms, *span)
            if obeyed is not None:
                self.obediences.append(obeyed)
        if self._law.cm_id != terms.cm_id:
            return
        self._law, found = control_law.judge_frames(self._law, terms, seq)
        if found is not None:
            self.laws.append(found)


def select_session(arrivals: list[Arrival], session: str | None) -> list[Arrival]:
    """Return the batches of one session in order of arrival."""
    return [arrival for arrival in arrivals if arrival.header.session == session]


def sort_by_frame(arrivals: list[Arrival]) -> list[Arrival]:
    """Return batches in the order of their frames, without repetitions."""
    # Reversed, so that the first of two batches with the same number stays.
    by_seq = {arrival.header.seq0: arrival for arrival in reversed(arrivals)}
    return [by_seq[seq0] for seq0 in sorted(by_seq)]
