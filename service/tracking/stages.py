"""How far an acquisition has come, and what the service makes of its own dither."""

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

    most_modes: int | None = None
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

    @property
    def looks_afar(self) -> bool:
        """Whether windows are of the open loop, from which α is found."""
        return self.stage in {AcquisitionStage.COARSE, AcquisitionStage.CONFIRMING}

    @property
    def under_way(self) -> bool:
        """Whether it is neither over nor idle."""
        return self.stage in UNDER_WAY


class DitherPhase(StrEnum):
    """How the service dithers."""

    OFF = "off"
    """None is wanted, or none can be had."""

    ACQUIRE = "acquire"
    """α is not known, or something asks to see it again: the whole budget, without pause."""

    FOLLOW = "follow"
    """Without pause, for the flexure leaves no time for one; as weak as that allows."""

    SPARSE = "sparse"
    """A sitting of a few windows now and then, off in between."""

    OPERATOR = "operator"
    """An operator's own, or one somebody else started."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Precision:
    """How precise windows are, learnt from those accepted; kept from star to star."""

    ratio: NDArray[np.float64]
    """``(4,)`` measured κ of ``σ = κ / (A sqrt(T))`` over that of the table for the magnitude."""

    n_windows: int
    """Windows it was learnt from."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherPlan:
    """The dither that is wanted in the present state."""

    total_m: float
    """RMS of all lines together on the mirror, metres OPD."""

    window_s: float
    """Telemetry in one estimate, seconds."""

    interval_s: float
    """From one sitting to the next, seconds; ``window_s``: no pause."""

    sigma: NDArray[np.float64]
    """``(4,)`` 1 σ of α that is to be expected just before each sitting, numeric units."""

    sufficient: bool
    """Whether that is what was asked for."""

    mean_cost_m: float
    """Quadratic mean of it over time, pauses included, metres OPD."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dithering:
    """The dither policy's memory, and its account to the operator."""

    phase: DitherPhase = DitherPhase.OFF
    reason: str = "nothing has been decided yet"
    """Why it is on or off."""

    budget_m: float = 0.0
    """Largest RMS of all lines together that settings and RTC allow, metres OPD."""

    plan: DitherPlan | None = None
    """None: none could be made yet."""

    next_ns_utc: int | None = None
    """When the next sitting is due; None: now, or never."""

    precision: Precision | None = None
    """None: no window has been accepted yet."""

    avoided_hz: tuple[float, ...] = ()
    """Vibrations the lines keep clear of."""

    lines_hz: tuple[float, ...] = ()
    """Of the last dither asked for: they stay where they are while they can."""

    passive_ns_utc: int | None = None
    """When the estimate was last renewed without a dithered window."""

    results_due: int = 0
    """Windows accepted in all, once the last dither has told what it was asked for."""

    ended_ns_utc: int | None = None
    """When the last of the service's own dithers ended by itself; None: one runs, or it was
    stopped."""

    stopped_id: str | None = None
    """The last dither that the service asked the RTC to stop by itself."""

    stopped_ns_utc: int = 0
    """When it did."""

    unwanted_id: str | None = None
    """A dither the RTC plays and should not; None: none."""

    unwanted_since_ns_utc: int = 0
    """Since when the service knows of it."""

    told_ns_utc: int = 0
    """When the RTC was last told to stop one that nobody wants."""

    loud_id: str | None = None
    """The last dither the RTC played stronger than was asked for, and than the budget."""

    loud_ns_utc: int = 0
    """When one that was too strong was last told to stop; 0: none ever was."""

    loud_text: str = ""
    """What the frames held of that one; empty: its status told."""

    amiss_id: str | None = None
    """The last dither of which the frames held something else than was asked for."""

    amiss_m: float = 0.0
    """RMS of all of it, metres OPD."""

    mean_square_m2: float = 0.0
    """Mean square of what has been on the mirror, over ten minutes, metres OPD squared."""

    seen_ns_utc: int | None = None
    """Up to when that mean was taken."""

    @property
    def mean_cost_m(self) -> float:
        """Quadratic mean of what has been on the mirror, over ten minutes, metres OPD."""
        return float(np.sqrt(self.mean_square_m2))

    @property
    def n_windows_learnt(self) -> int:
        """Windows that the precision was learnt from."""
        return 0 if self.precision is None else self.precision.n_windows
