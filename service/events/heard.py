"""What can happen to the service."""

from __future__ import annotations

from dataclasses import dataclass

from service.control.expected_gain import ExpectedGain
from service.control.gate import GateVerdict
from service.events.commands import Command
from service.events.effects import Effect
from service.model.misregistration import Misregistration
from service.state import (
    Judged,
    Level,
    MatrixState,
    MeasurementRecord,
    NoisyRecord,
    ReconstructorRecord,
    RtcView,
)
from service.telemetry.faraway import FarEstimate
from service.telemetry.instrumental import WindowEstimate
from service.telemetry.lockin import WindowRefused
from service.telemetry.noisymatrix import RandomEstimate
from service.telemetry.passive import PassiveEstimate


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Time has passed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusSeen:
    """The RTC said how it is."""

    rtc: RtcView


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionStarted:
    """The RTC started anew: its windows, commands and staged matrices are void."""

    session: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcVanished:
    """The RTC's liveliness token went away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServicesMet:
    """Other services of this system came or went."""

    drives: bool
    """Whether this service drives the RTC; otherwise it stands by."""

    others: tuple[str, ...]
    """In words, the first one first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trouble:
    """A condition that must be seen while it lasts."""

    name: str
    text: str
    over: bool = False
    """The condition has ended."""

    t_ns_utc: int = 0
    """End of the telemetry that told, the RTC's clock; 0: it was not telemetry."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Noted:
    """Something happened that changes nothing but should be on record."""

    name: str
    text: str
    level: Level = Level.INFO


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowFitted:
    """The worker estimated α from one window."""

    estimate: WindowEstimate | RandomEstimate
    began_ns_utc: int = 0
    """Begin of the window, the RTC's clock; 0: not told."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FarFitted:
    """The worker found α from afar, in a window with the loop open."""

    found: FarEstimate
    began_ns_utc: int = 0
    """Begin of the window, the RTC's clock; 0: not told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowLost:
    """A window gave no estimate."""

    refused: WindowRefused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watched:
    """The watchdog estimated α from ordinary telemetry."""

    estimate: PassiveEstimate
    t_ns_utc: int
    """End of the telemetry it is of."""

    began_ns_utc: int = 0
    """Begin of it, the RTC's clock; 0: not told."""

    loop: tuple[float, ...] = ()
    """``RtcView.loop_numbers`` of the loop it is of; empty: not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Unwatched:
    """The watchdog cannot estimate α from ordinary telemetry as it is."""

    text: str
    """Why, and what it would need."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixMade:
    """A reconstructor has been computed, or copied, and judged."""

    record: ReconstructorRecord
    wanted: bool
    """An operator asked for this very matrix: no further approval is needed."""

    asked_modes: int | None = None
    """Modes it should have had; None: nobody asked for a number."""

    why_fewer: str = ""
    """Why it has fewer than were asked for: the gate's words."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixFetched:
    """The matrix the RTC uses, which the service did not make, is known now."""

    record: ReconstructorRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class MarginJudged:
    """The gate's verdict on the matrix in use, at the current α."""

    id: str
    verdict: GateVerdict
    alpha: Misregistration | None = None
    """The registration it was judged at; None: not told."""

    expected: ExpectedGain | None = None
    """What a new one would win; None: not computed."""

    judged: Judged | None = None
    """What the verdict is of; None: not told."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProposalJudged:
    """The gate's verdict on a reconstructor that is to be sent."""

    id: str
    verdict: GateVerdict
    judged: Judged
    wanted: bool = True
    """As it was in what asked for the verdict."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledged:
    """The RTC answered to a reconstructor."""

    id: str | None
    """None: it could not read which one it rejects."""

    sha256: str | None = None
    """Of the matrix it means; None: not told."""

    session: str | None = None
    """Of the RTC that answers; None: not known."""

    state: MatrixState
    reason: str
    frame_seq: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherAnswered:
    """The RTC accepted or refused a dither."""

    id: str
    accepted: bool
    reason: str
    start_seq: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherSilent:
    """A dither should be on the mirror, and the frames hold none of it."""

    id: str
    silent_s: float
    """By the frames' own time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherMeasured:
    """What the frames hold of a dither is otherwise than it was asked for, or is so no more."""

    id: str
    found_m: float
    """RMS of all modes together, metres OPD."""

    asked_m: float
    text: str
    """What is otherwise; empty: nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vibrations:
    """The vibration lines in the slopes are others than before."""

    lines_hz: tuple[float, ...]
    """Lowest first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopAnswered:
    """The RTC accepted or refused a change of its loop, or a gain ramp."""

    id: str
    accepted: bool
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixMeasured:
    """A measured interaction matrix is one step further: begun, refused, failed or stored."""

    record: MeasurementRecord


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyMade:
    """A noisy interaction matrix has been archived."""

    record: NoisyRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class JobFailed:
    """Something that was to be done could not be."""

    effect: Effect
    text: str


Event = (
    Command
    | Tick
    | StatusSeen
    | SessionStarted
    | RtcVanished
    | ServicesMet
    | Trouble
    | Noted
    | WindowFitted
    | FarFitted
    | WindowLost
    | Watched
    | Unwatched
    | MatrixMade
    | MatrixFetched
    | MarginJudged
    | ProposalJudged
    | Acknowledged
    | DitherAnswered
    | DitherSilent
    | DitherMeasured
    | Vibrations
    | LoopAnswered
    | MatrixMeasured
    | NoisyMade
    | JobFailed
)
