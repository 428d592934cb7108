"""One acquisition, under way or over: how far finding α from nothing has come."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration


class AcquisitionStage(StrEnum):
    """How far an acquisition has come."""

    IDLE = "idle"
    """None has been asked for, or needed."""

    OPENING = "opening"
    """The RTC has been asked to open the loop."""

    COARSE = "coarse"
    """Smooth modes are dithered with the loop open, to find α from afar."""

    CONFIRMING = "confirming"
    """Other modes are dithered, which must say the same."""

    PARTIAL = "partial"
    """A reconstructor for a part of the modes is made, judged and sent; then the loop closes."""

    WIDENING = "widening"
    """The loop is closed: α sharpens, and more modes are controlled."""

    TRACKING = "tracking"
    """Done: α is known and the loop closed on it."""

    FAILED = "failed"
    """Given up; the text says why, and what to do."""

    ABORTED = "aborted"
    """An operator ended it."""

    INTERRUPTED = "interrupted"
    """The service ended, or the RTC vanished, in the middle of it; the text says what is done."""


UNDER_WAY = frozenset(
    {
        AcquisitionStage.OPENING,
        AcquisitionStage.COARSE,
        AcquisitionStage.CONFIRMING,
        AcquisitionStage.PARTIAL,
        AcquisitionStage.WIDENING,
    }
)
"""Stages in which the loop is the acquisition's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFound:
    """The loop before anything was done to it."""

    closed: bool
    gains: tuple[float, ...]
    """One per mode of the basis, as it will be closed again."""

    n_controlled: int
    """Modes to come back to."""

    leak: float
    """Per frame."""

    held: bool
    """Whether it was closed and no alarm said that it did not hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interruption:
    """What an acquisition was at when it was cut off: the service ended, or the RTC vanished."""

    doing: str
    """Stage, and the text of it."""

    session: str | None
    """The RTC's; None: none was there. An open loop in the same session is the one it left."""

    cause: str = "the service ended"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Acquisition:
    """One acquisition, under way or over."""

    stage: AcquisitionStage = AcquisitionStage.IDLE
    text: str = "none was needed"
    """What it does, or how it ended and what to do."""

    started_ns_utc: int = 0
    since_ns_utc: int = 0
    """Since when it is in this stage."""

    commanded: bool = False
    """An operator asked for it: that allows its publications in every mode."""

    attempt: int = 0
    """How often the loop has been opened for it."""

    misses: int = 0
    """Windows in a row, of this stage or before a start, that led nowhere."""

    found: LoopFound | None = None
    """None: idle."""

    alpha: Misregistration | None = None
    """Found with the loop open; None: not yet."""

    covariance: NDArray[np.float64] | None = None
    """``(4, 4)`` of it, the open loop's model error included, numeric units."""

    n_modes: int = 0
    """Modes of the reconstructor that is made, sent or in use."""

    max_modes: int | None = None
    """More than so many were refused by the gate, or have slipped; None: not yet."""

    command: str | None = None
    """Id of the change of the loop that was asked for in this stage; None: none was."""

    matrix: str | None = None
    """Id of the reconstructor sent for it last; None: none was in this attempt."""

    applied: str | None = None
    """Id of the last one that was applied with the loop closed."""

    sent: bool = False
    """Whether anything was sent: the RTC's own matrix is then no longer in use."""

    windows: int = 0
    """Windows that had been accepted when the reconstructor in use was applied, or it was over."""

    held_off: bool = False
    """An operator ended it: none begins by itself until windows agree in a closed loop, an operator
    sets the mode, or asks for one."""

    interruption: Interruption | None = None
    """How it was left by the service before this one, or at a gap in the link; None: it was not."""

    cause: str = ""
    """Id of the order or event that has begun it; empty: the service before this one did."""

    @property
    def uses_wide_capture(self) -> bool:
        """Whether windows are of the open loop, from which α is found."""
        return self.stage in {AcquisitionStage.COARSE, AcquisitionStage.CONFIRMING}

    @property
    def under_way(self) -> bool:
        """Whether it is neither over nor idle."""
        return self.stage in UNDER_WAY
