"""Commands to the RTC, and its replies."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Final

from msgspec import Meta

from service.errors import WireError
from service.wire import codec
from service.wire.keys import checked_id

AVERAGE_LIMIT: Final = 10_000
RAMP_LIMIT: Final = 1_000_000
"""Most frames at one gain of a ramp."""

_Duration = Annotated[float, codec.above(0.0, 86_400.0)]
_Pair = Annotated[tuple[codec.Count, codec.Count], Meta(description="pairs of integers")]


class CommandKind(StrEnum):
    """The last word of a command's key."""

    DITHER = "dither"
    LOOP = "loop"
    MEASURE = "measure"
    RAMP = "ramp"
    OFFLOAD = "offload"


class Loop(StrEnum):
    """States of the RTC's loop."""

    OPEN = "open"
    CLOSED = "closed"
    PARTIAL = "partial"
    """Closed, with the gain of some controlled modes at 0."""


class DitherKind(StrEnum):
    """Shape of the dither in time."""

    SINE = "sine"
    """``amplitude_m * sqrt(2) * sin(2 pi f (seq - start_seq) dt)``."""

    BINARY = "binary"
    """Plus or minus ``amplitude_m`` per frame, from ``seed``."""


class Pattern(StrEnum):
    """Patterns of measuring an interaction matrix."""

    PUSH_PULL_MODAL = "push-pull-modal"
    """One mode after the other, loop open."""

    PUSH_PULL_ZONAL = "push-pull-zonal"
    """One actuator after the other, loop open."""

    HADAMARD = "hadamard"
    """All modes at once with the signs of a Hadamard matrix, loop open."""

    SYSTEM_MODES = "system-modes"
    """Push-pull of the modes that the loop's own reconstructor tells apart best, loop open
    (optional)."""

    SINE = "sine"
    """All modes at once, each at its own frequency, loop closed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Strokes:
    """Modes of the mirror that are moved, and how far."""

    id: codec.Id
    """Of the command, and of a matrix that follows: repeated with the same id it is carried out
    once."""

    modes: tuple[codec.Count, ...]
    """0-based basis indices."""

    amplitude_m: tuple[codec.Positive, ...]
    """RMS of each mode, metres OPD."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherRequest(Strokes):
    """Start a dither."""

    kind: DitherKind
    """Sines, or random signs."""

    frequency_hz: tuple[codec.Positive, ...] | None = None
    """Of each mode, below half the frame rate; None: binary."""

    duration_s: _Duration
    """It ends by itself after ``round(duration_s * frame_rate_hz)`` frames."""

    seed: codec.Count | None = None
    """Of the binary sequence; None: sine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherStop:
    """Stop the dither, whichever plays; this always succeeds."""

    id: codec.Id
    """Of this command, not of the dither that it stops."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRequest:
    """Change the loop; None leaves a value as it is, opening zeroes the integrator."""

    id: codec.Id
    """Of the command: repeated with the same id it is carried out once."""

    loop: Loop | None = None
    """Open or close it; the service never asks for partial."""

    gains: tuple[Annotated[float, codec.number(0.0)], ...] | None = None
    """One per mode of the basis, 0 where uncontrolled."""

    leak: Annotated[float, codec.number(0.0, 1.0)] | None = None
    """Per frame, 0..1; 1 forgets nothing."""

    n_controlled: codec.Count | None = None
    """Takes effect with the next reconstructor of that many rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixStrokes(Strokes):
    """Strokes that an interaction matrix is measured with."""

    frequency_hz: tuple[codec.Positive, ...] | None = None
    """Of each mode; None unless it is a sine."""

    duration_s: _Duration | None = None
    """How long it is to last; None: as long as the pattern takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureRequest(MatrixStrokes):
    """Measure an interaction matrix."""

    pattern: Pattern
    """How; the first is mandatory, the others are optional."""

    n_average: Annotated[int, codec.integer(1, AVERAGE_LIMIT)] | None = None
    """Repetitions; None: the pattern has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RampRequest:
    """Try gains on one group of modes after the other; keep those of least residual slopes.

    While a group is tried the others keep the gains they have. What was chosen is seen in the
    status' ``gains`` (Heritier et al. 2018, section 5: tip and tilt, modes to 100, to 400).
    """

    id: codec.Id
    """Of the command: repeated with the same id it is carried out once."""

    groups: tuple[_Pair, ...]
    """First and last mode of each group, 0-based basis indices, both included; none overlap."""

    gains: tuple[codec.Positive, ...]
    """Loop gains, tried in this order on every group."""

    frames_per_gain: Annotated[int, codec.integer(1, RAMP_LIMIT)]
    """Frames each gain is tried for, settling included."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OffloadRequest(codec.FourNumbers):
    """Move the mirror's image on the sensor, with a lens or a stage: so much α is to change."""

    id: codec.Id
    """Of the command: repeated with the same id it is carried out once."""


Command = DitherRequest | DitherStop | LoopRequest | MeasureRequest | RampRequest | OffloadRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """The RTC's answer to a command."""

    id: codec.Id | None
    """The command's; None when the command had none that could be read."""

    accepted: bool
    """Whether it is, or has been, carried out."""

    reason: codec.Text
    """Empty, or begins with missing, v, id, busy, range or unsupported."""

    start_seq: codec.Count | None
    """First frame whose exposure contains what was asked for; None where that means nothing."""


_KINDS: dict[type[Command], CommandKind] = {
    DitherRequest: CommandKind.DITHER,
    DitherStop: CommandKind.DITHER,
    LoopRequest: CommandKind.LOOP,
    MeasureRequest: CommandKind.MEASURE,
    RampRequest: CommandKind.RAMP,
    OffloadRequest: CommandKind.OFFLOAD,
}
_STARTING = {kind: command for command, kind in _KINDS.items() if command is not DitherStop}
_START, _STOP = "start", "stop"


def command_kind(command: Command) -> CommandKind:
    """Return which key a command goes to."""
    return _KINDS[type(command)]


def command_id(data: bytes) -> str | None:
    """Return the id of a command, for the reply that refuses the rest of it; None: unreadable."""
    try:
        return checked_id(codec.unpack(data, "a command").get("id"), "a command")
    except WireError:
        return None


def decode_command(kind: CommandKind, data: bytes) -> Command:
    """Return the command a query on ``cmd/rtc/{kind}`` carries.

    What depends on the RTC (number of modes, strokes, rates) is for the RTC to check.

    Raises
    ------
    WireError
        If a key is missing or out of range; the text is fit for the reply's ``reason``.
    """
    dither = kind is CommandKind.DITHER
    if dither and codec.unpack(data, "a dither command").get("action") == _STOP:
        return codec.decode(DitherStop, data)
    return codec.decode(_STARTING[kind], data)


def _starts(values: codec.Map, where: str) -> codec.Map:
    if codec.get(values, "action", where) != _START:
        raise codec.refusal("action", values["action"], f"{_START} or {_STOP}", where)
    return values


def _check_dither(command: DitherRequest, where: str) -> None:
    sine = command.kind is DitherKind.SINE
    codec.applicable(command, where, frequency_hz=sine, seed=not sine)
    _check_modes(command, where)


def _check_measurement(command: MeasureRequest, where: str) -> None:
    sine = command.pattern is Pattern.SINE
    codec.applicable(command, where, n_average=not sine, frequency_hz=sine, duration_s=sine)
    _check_modes(command, where)


def _check_modes(command: Strokes, where: str) -> None:
    """Refuse missing or repeated modes, and lists that have not one value for each."""
    modes = command.modes
    if not modes or len(set(modes)) != len(modes):
        raise codec.refusal("modes", modes, "at least one mode, none twice", where)
    for key in ("amplitude_m", "frequency_hz"):
        values = getattr(command, key)
        if values is not None and len(values) != len(modes):
            raise codec.refusal(key, values, f"one for each of {len(modes)} modes", where)


def _check_ramp(command: RampRequest, where: str) -> None:
    groups = sorted(command.groups)
    apart = all(before[1] < after[0] for before, after in pairwise(groups))
    if not groups or not apart or any(first > last for first, last in groups):
        expected = "one or more [first, last], first <= last, none overlapping another"
        raise codec.refusal("groups", groups, expected, where)
    if not command.gains:
        raise codec.refusal("gains", command.gains, "one or more gains to try", where)


codec.travels(
    DitherRequest,
    "a dither command",
    first=("id", "kind"),
    keys=lambda keys: {**keys, "action": _START},
    fields=_starts,
    check=_check_dither,
)
codec.travels(DitherStop, "a dither command", keys=lambda keys: {**keys, "action": _STOP})
codec.travels(LoopRequest, "a loop command")
codec.travels(
    MeasureRequest,
    "a measure command",
    first=("id", "pattern", "modes", "amplitude_m", "n_average"),
    check=_check_measurement,
)
codec.travels(RampRequest, "a ramp command", check=_check_ramp)
codec.travels(OffloadRequest, "an offload command")
codec.travels(Reply, "a reply", fields=codec.reason_or_none)
