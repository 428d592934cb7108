"""Sum an RTC's telemetry as it arrives; no clock, no network."""

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
from service.estimation.loop import closed_loop, last_seq, same_loop
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

STILL: Final = 5
"""Frames in a row with the same slopes to the last bit, before they count as frozen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """One readable batch."""

    at_s: float
    header: FrameHeader
    recoverable: bool
    """Whether its publisher keeps what it has sent."""

    largest_m: float
    """Largest command of its first row, metres."""

    @property
    def stop_seq(self) -> int:
        """The frame after its last one."""
        return self.header.seq0 + self.header.n


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """One unreadable message."""

    at_s: float
    topic: Topic
    text: str


class TelemetryObserver:
    """Sums of everything an RTC has sent; the checks read them."""

    def __init__(self, endpoint: Endpoint, clock: Callable[[], float]) -> None:
        self.intake = Intake(endpoint, clock)
        self.arrivals: list[Arrival] = []
        self.statuses: list[tuple[float, Status]] = []
        self.acknowledgements: list[tuple[float, Acknowledgement]] = []
        self.measured: list[ReceivedMessage] = []
        self.refused: list[Refused] = []
        self.asked: list[tuple[float, str]] = []
        """Queries of the RTC for matrices: when, and key with part."""

        self.tokens: list[tuple[float, bool]] = []
        self.n_nonfinite = 0
        self.n_frozen = 0
        """Frames whose slopes are those of the frame before, in runs of at least ``STILL``."""

        self.block_takers: list[Callable[[FrameBlock], None]] = []
        """Are shown each block of frames of the session that counts."""

        self.loop = LoopWatch()
        self._still = 0
        self._last_slopes: NDArray[np.float32] | None = None

    def take(self, messages: list[ReceivedMessage]) -> None:
        """Add new messages."""
        for item in messages:
            try:
                self._take(item)
            except WireError as error:
                self.refused.append(Refused(at_s=item.at_s, topic=item.topic, text=str(error)))
        for block in self.intake.drain():
            self.loop.observe(block)
            for take in self.block_takers:
                take(block)

    @property
    def status(self) -> Status | None:
        """The last one."""
        return self.statuses[-1][1] if self.statuses else None

    @property
    def session(self) -> str | None:
        """The session that counts."""
        return self.intake.statistics().session

    def sessions(self) -> Counter[str]:
        """Return the batches of each session, the first one first."""
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
                self.loop.follow_status(status)
            case Topic.ACK:
                self.acknowledgements.append((item.at_s, decode(Acknowledgement, item.data)))
            case Topic.MEASURED:
                self.measured.append(item)
            case Topic.ALIVE:
                self.tokens.append((item.at_s, item.alive))
                self.intake.liveliness(alive=item.alive)
            case Topic.ASKED:
                self.asked.append((item.at_s, item.key))

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
        before = self._last_slopes
        if before is None or before.shape != slopes[0].shape:
            before = np.full_like(slopes[0], np.nan)
        same = np.all(slopes == np.concatenate([before[None], slopes[:-1]]), axis=1)
        self._last_slopes = slopes[-1].copy()
        for still in same:
            self._still = self._still + 1 if still else 0
            if self._still == STILL:
                self.n_frozen += STILL
            elif self._still > STILL:
                self.n_frozen += 1


class LoopWatch:
    """Compares commands with the loop law that the status states."""

    def __init__(self) -> None:
        self.matrix: NDArray[np.float32] | None = None
        self.cm_id: str | None = None
        self.laws: list[IdentifiedLaw] = []
        """Verdicts on leak, gain and delay, oldest first."""

        self.obediences: list[CommandResidual] = []
        """Verdicts on every mode, oldest first."""

        self._status: Status | None = None
        self._check = LoopCheck()
        self._law = ControlLawCheck()

    def use(self, cm_id: str, matrix: NDArray[np.float32]) -> None:
        """Take over the numbers of the matrix in use."""
        self.cm_id, self.matrix = cm_id, matrix

    def follow_status(self, status: Status) -> None:
        """Take a status; another loop than before begins anew."""
        before, self._status = self._status, status
        if before is None or not same_loop(before, status) or before.cm_id != status.cm_id:
            self._check = LoopCheck(from_seq=last_seq(status) + 1)
            self._law = ControlLawCheck(from_seq=last_seq(status) + 1)
            return
        terms = self._terms(status.cm_id)
        if terms is not None:
            self._judge(terms, last_seq(status))

    def observe(self, block: FrameBlock) -> None:
        """Take frames."""
        status, terms = self._status, self._terms(block.cm_id)
        if status is None or terms is None or block.session != status.session:
            return
        if block.slopes.shape[1] != terms.reconstructor.shape[1]:
            return
        self._check = loopcheck.observe(self._check, block, terms)
        self._law = control_law.follow(self._law, block, terms)

    def _terms(self, cm_id: str | None) -> ClosedLoop | None:
        status, matrix = self._status, self.matrix
        if status is None or matrix is None or cm_id is None or cm_id != self.cm_id:
            return None
        if not status.in_loop or len(matrix) > status.n_modes:
            return None
        return closed_loop(status, cm_id, matrix)

    def _judge(self, terms: ClosedLoop, seq: int) -> None:
        span = loopcheck.last_samples(self._check, seq)
        if span is not None:
            self._check, obeyed = loopcheck.command_residual(self._check, terms, *span)
            if obeyed is not None:
                self.obediences.append(obeyed)
        if self._law.cm_id != terms.cm_id:
            return
        self._law, found = control_law.judged(self._law, terms, seq)
        if found is not None:
            self.laws.append(found)


def of_session(arrivals: list[Arrival], session: str | None) -> list[Arrival]:
    """Return the batches of one session, in the order in which they came."""
    return [arrival for arrival in arrivals if arrival.header.session == session]


def in_order(arrivals: list[Arrival]) -> list[Arrival]:
    """Return batches in the order of their frames, the first of each number."""
    by_seq = {arrival.header.seq0: arrival for arrival in reversed(arrivals)}
    return [by_seq[seq0] for seq0 in sorted(by_seq)]
