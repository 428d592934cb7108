"""Protocols of streaming estimators and detectors.

An estimator is an immutable record whose ``update`` returns the next record. The bank that feeds
all estimators (``service.runtime.estimator_bank``) knows none of them by name: each declares which
changes reset it, which frames it skips, and what it reports about a block to those that follow it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Flag, auto
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from service.estimation.description import ActuatorWatch, Description, EdgeWatch
from service.estimation.frames import FrameBlock
from service.estimation.loop import build_loop
from service.estimation.windows import ClosedLoop, ExpectedDither, Telemetry
from service.records.messages import Message
from service.wire import Status


class Change(Flag):
    """Changes of the telemetry since the previous block or status."""

    GONE = auto()
    """There is no RTC, or it is not known whose telemetry this is."""

    SESSION = auto()
    RATE = auto()
    """The frame rate, or the first RTC has come."""

    LOOP = auto()
    """The loop differs from the one with which the open window and all sums began."""

    STATUS = auto()
    """The loop differs from that of the previous status: slowly drifting gains are found only in
    comparison with the sums."""

    DITHER = auto()
    OPEN = auto()
    """No mode is in the loop; reported for every block."""

    MATRIX = auto()
    """Another matrix multiplied the slopes of this block than those of the one before."""

    REFERENCES = auto()
    """Other reference slopes were subtracted from this block than from the one before."""

    STANDSTILL = auto()
    """The slopes are frozen. Set for every such block; the frames before it are not used either."""


class Mark(Flag):
    """Property of a block that one estimator reports to the next ones."""

    STANDS = auto()
    """The slopes are no measurement."""

    ABSURD = auto()
    """The commands are in another unit."""

    WINDOWS = auto()
    """Windows of a dither are being cut."""


NOTHING = Change(0)
UNMARKED = Mark(0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopContext:
    """The loop whose telemetry the estimators receive."""

    description: Description
    rtc: Status | None = None
    """Last status of the RTC."""

    in_loop: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """Modes it moves by itself; empty: it is open."""

    still: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """Controlled modes that have no gain."""

    edge: EdgeWatch | None = None
    """Parameters for watching the outer ring; None if too few modes are controlled."""

    actuators: ActuatorWatch | None = None
    """Parameters for watching all actuators; None if too few modes are controlled."""

    matrices: tuple[tuple[str, NDArray[np.float32]], ...] = ()
    """Reconstructors by id, oldest first, bounded."""

    dither: ExpectedDither | None = None
    """The one whose windows are under way, or cannot be; None: none plays."""

    received_ns_utc: int = 0
    """End of the last frame that came, the RTC's clock; 0: none has."""

    cm_id: str | None = None
    """The matrix of the last block."""

    reference_name: str | None = None
    """The reference slopes of the last block."""

    from_seq: int = 0
    """Frames before this one may have been made by another loop, or by no measurement."""

    settled_seq: int = 0
    """Frame from which the loop has settled after that change."""

    def terms(self, cm_id: str | None) -> ClosedLoop | None:
        """Return the loop that a matrix closes; None: it is open, not known, or another's."""
        rtc = self.rtc
        matrix = next((matrix for known, matrix in self.matrices if known == cm_id), None)
        if rtc is None or rtc.loop == "open" or cm_id is None or matrix is None:
            return None
        # A matrix of another session or sensor mode may have other sizes under a known id.
        if matrix.shape[1] != rtc.n_slopes or len(matrix) > rtc.n_modes:
            return None
        return build_loop(rtc, cm_id, matrix)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameContext:
    """A block of telemetry, and what all estimators need of it."""

    block: FrameBlock
    loop: LoopContext
    rtc: Status
    terms: ClosedLoop | None
    """The loop closed by the block's matrix; None if it is open or unknown."""

    lines_hz: tuple[float, ...]
    """Lines of the present dither, which are neither vibrations nor noise."""

    marks: Mark = UNMARKED
    """Marks set by the estimators before this one."""

    @property
    def moving(self) -> FrameBlock:
        """Return the block without the constant part of controlled modes that have no gain.

        An integrator without leak keeps it for ever, and a mode that never moves contains no
        information.
        """
        block, still = self.block, self.loop.still
        if not len(still):
            return block
        commands = block.commands_m.copy()
        # A dither on such a mode is kept: it moves.
        commands[:, still] = 0.0 if block.dither_m is None else block.dither_m[:, still]
        return replace(block, commands_m=commands)


class Streaming:
    """An estimator of α or a detector, fed with ``update`` block by block.

    What it has found is read off the record: ``conditions`` that must be seen while they last,
    windows that ``ended``, or sums.
    """

    __slots__ = ()

    ended: Sequence[Any] = ()
    """Windows that ended in the last block, as the worker fits them, or why they cannot be."""

    resets: ClassVar[Change] = NOTHING
    """Changes that reset the estimator; all others leave it as it is."""

    unless: ClassVar[Mark] = UNMARKED
    """Blocks that are marked so are not for it."""

    only_closed: ClassVar[bool] = False
    """Blocks of an open loop are not for it."""

    @classmethod
    def begin(cls, loop: LoopContext) -> Self:
        """Return one that has seen nothing of this loop."""
        return cls()

    def restart(self, loop: LoopContext, why: Change) -> Self:
        """Return it after changes that it has declared: with nothing, unless some of it lasts."""
        return self.begin(loop)

    def on_status(self, loop: LoopContext, *, fresh: bool) -> Self:
        """Return it once the status is known: what was seen up to there may be judged.

        Asked again while frames up to the status may still come; ``fresh``: for the first time.
        """
        return self

    def update(self, frames: FrameContext) -> Self:
        """Return it after one more block."""
        raise NotImplementedError

    @property
    def marks(self) -> Mark:
        """Return its marks on the last block."""
        return UNMARKED

    @property
    def conditions(self) -> tuple[str | None, ...]:
        """Return for each of its alarms what is wrong and what to do, or None."""
        return ()

    def vet(self, window: Telemetry, loop: LoopContext) -> tuple[Self, Message | None]:
        """Return why a window that has ended must not be used; None: it may."""
        return self, None
