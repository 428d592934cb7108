"""Commands of the service to the RTC, and the RTC's replies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Final, TypeVar

from service.errors import WireError
from service.wire.fields import Fields, pack

DURATION_LIMIT_S: Final = 86_400.0
AVERAGE_LIMIT: Final = 10_000
RAMP_LIMIT: Final = 1_000_000
"""Most frames at one gain of a ramp."""

_T = TypeVar("_T")


class CommandKind(StrEnum):
    """The last word of a command's key."""

    DITHER = "dither"
    LOOP = "loop"
    MEASURE = "measure"
    RAMP = "ramp"


class Loop(StrEnum):
    """What the RTC's loop does."""

    OPEN = "open"
    CLOSED = "closed"
    PARTIAL = "partial"
    """Closed, with the gain of some controlled modes at 0."""


class DitherAction(StrEnum):
    """What to do with the dither."""

    START = "start"
    STOP = "stop"


class DitherKind(StrEnum):
    """Shape of the dither in time."""

    SINE = "sine"
    """``amplitude_m * sqrt(2) * sin(2 pi f (seq - start_seq) dt)``."""

    BINARY = "binary"
    """Plus or minus ``amplitude_m`` per frame, from ``seed``."""


class Pattern(StrEnum):
    """How an interaction matrix is measured."""

    PUSH_PULL_MODAL = "push-pull-modal"
    PUSH_PULL_ZONAL = "push-pull-zonal"
    HADAMARD = "hadamard"
    SYSTEM_MODES = "system-modes"
    """Push-pull of the modes that the loop's own reconstructor tells apart best (optional)."""

    SINE = "sine"


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherRequest:
    """Start or stop a dither; stopping needs nothing but the id and always succeeds."""

    id: str
    """Of the command: repeated with the same id it is carried out once."""

    action: DitherAction
    kind: DitherKind | None = None
    modes: tuple[int, ...] | None = None
    """0-based basis indices."""

    amplitude_m: tuple[float, ...] | None = None
    """RMS of each mode, metres OPD."""

    frequency_hz: tuple[float, ...] | None = None
    """Of each mode, below half the frame rate; None: binary."""

    duration_s: float | None = None
    seed: int | None = None
    """Of the binary sequence; None: sine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRequest:
    """Change the loop; None leaves a value as it is, opening zeroes the integrator."""

    id: str
    loop: Loop | None = None
    gains: tuple[float, ...] | None = None
    """One per mode of the basis, 0 where uncontrolled."""

    leak: float | None = None
    """Per frame, 0..1; 1 forgets nothing."""

    n_controlled: int | None = None
    """Takes effect with the next reconstructor of that many rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureRequest:
    """Measure an interaction matrix."""

    id: str
    """Of the command, and of the matrix that follows."""

    pattern: Pattern
    modes: tuple[int, ...]
    """0-based basis indices."""

    amplitude_m: tuple[float, ...]
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None = None
    """Repetitions; None: the pattern has none."""

    frequency_hz: tuple[float, ...] | None = None
    """Of each mode; None unless the pattern is a sine."""

    duration_s: float | None = None
    """None unless the pattern is a sine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RampRequest:
    """Try gains on one group of modes after the other; keep those of least residual slopes.

    While a group is tried the others keep the gains they have. What was chosen is seen in the
    status' ``gains`` (Heritier et al. 2018: tip and tilt, then modes to 100, then to 400).
    """

    id: str
    groups: tuple[tuple[int, int], ...]
    """First and last mode of each group, 0-based basis indices, both included; none overlap."""

    gains: tuple[float, ...]
    """Loop gains, tried in this order on every group."""

    frames_per_gain: int
    """Frames each gain is tried for, settling included."""


Command = DitherRequest | LoopRequest | MeasureRequest | RampRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """The RTC's answer to a command."""

    id: str | None
    """The command's; None when the command had none that could be read."""

    accepted: bool
    reason: str
    """Empty, or begins with missing, v, id, busy, range or unsupported."""

    start_seq: int | None
    """First frame whose exposure contains what was asked for; None where that means nothing."""


def command_kind(command: Command) -> CommandKind:
    """Return which key a command goes to."""
    match command:
        case DitherRequest():
            return CommandKind.DITHER
        case LoopRequest():
            return CommandKind.LOOP
        case MeasureRequest():
            return CommandKind.MEASURE
        case RampRequest():
            return CommandKind.RAMP


def command_id(data: bytes) -> str | None:
    """Return the id of a command, for the reply that refuses the rest of it; None: unreadable."""
    try:
        return Fields.unpack(data, "a command").identifier("id")
    except WireError:
        return None


def encode_command(command: Command) -> bytes:
    """Return the payload of a command's query.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    data = pack(command)
    decode_command(command_kind(command), data)
    return data


def decode_command(kind: CommandKind, data: bytes) -> Command:
    """Return the command a query on ``cmd/rtc/{kind}`` carries.

    What depends on the RTC (number of modes, strokes, rates) is for the RTC to check.

    Raises
    ------
    WireError
        If a key is missing or out of range; the text is fit for the reply's ``reason``.
    """
    message = Fields.unpack(data, f"a {kind} command").of_this_version()
    match kind:
        case CommandKind.DITHER:
            return read_dither(message)
        case CommandKind.LOOP:
            return _read_loop(message)
        case CommandKind.MEASURE:
            return _read_measure(message)
        case CommandKind.RAMP:
            return _read_ramp(message)


def read_dither(message: Fields) -> DitherRequest:
    """Return the dither request a map holds.

    Raises
    ------
    WireError
        If a key is missing or out of range.
    """
    command = message.identifier("id")
    action = message.choice("action", DitherAction)
    if action is DitherAction.STOP:
        return DitherRequest(id=command, action=action)
    kind = message.choice("kind", DitherKind)
    sine = kind is DitherKind.SINE
    modes = _modes(message)
    return DitherRequest(
        id=command,
        action=action,
        kind=kind,
        modes=modes,
        amplitude_m=_each(message, "amplitude_m", modes),
        frequency_hz=_where(sine, message, "frequency_hz", lambda key: _each(message, key, modes)),
        duration_s=_duration(message, "duration_s"),
        seed=_where(not sine, message, "seed", message.integer),
    )


def _read_loop(message: Fields) -> LoopRequest:
    return LoopRequest(
        id=message.identifier("id"),
        loop=message.optional("loop", lambda key: message.choice(key, Loop)),
        gains=message.optional("gains", lambda key: message.numbers(key, low=0.0)),
        leak=message.optional("leak", lambda key: message.number(key, 0.0, 1.0)),
        n_controlled=message.optional("n_controlled", message.integer),
    )


def _read_measure(message: Fields) -> MeasureRequest:
    modes = _modes(message)
    pattern = message.choice("pattern", Pattern)
    sine = pattern is Pattern.SINE
    return MeasureRequest(
        id=message.identifier("id"),
        pattern=pattern,
        modes=modes,
        amplitude_m=_each(message, "amplitude_m", modes),
        n_average=_where(
            not sine, message, "n_average", lambda key: message.integer(key, 1, AVERAGE_LIMIT)
        ),
        frequency_hz=_where(sine, message, "frequency_hz", lambda key: _each(message, key, modes)),
        duration_s=_where(sine, message, "duration_s", lambda key: _duration(message, key)),
    )


def _read_ramp(message: Fields) -> RampRequest:
    groups, gains = message.pairs("groups"), message.numbers("gains", above=0.0)
    ordered = sorted(groups)
    apart = all(before[1] < after[0] for before, after in pairwise(ordered))
    if not groups or not apart or any(a > b for a, b in groups):
        expected = "one or more [first, last], first <= last, none overlapping another"
        raise message.refusal("groups", list(groups), expected)
    if not gains:
        raise message.refusal("gains", list(gains), "one or more gains to try")
    return RampRequest(
        id=message.identifier("id"),
        groups=groups,
        gains=gains,
        frames_per_gain=message.integer("frames_per_gain", 1, RAMP_LIMIT),
    )


def _where(applies: bool, message: Fields, key: str, read: Callable[[str], _T]) -> _T | None:
    """Return what ``read`` makes of a key where it applies; elsewhere it must be nil."""
    if applies:
        return read(key)
    value = message.get(key)
    if value is not None:
        raise message.refusal(key, value, "nil, it does not apply")
    return None


def _duration(message: Fields, key: str) -> float:
    return message.number(key, high=DURATION_LIMIT_S, above=0.0)


def _modes(message: Fields) -> tuple[int, ...]:
    modes = message.integers("modes")
    if not modes or len(set(modes)) != len(modes):
        raise message.refusal("modes", list(modes), "at least one mode, none twice")
    return modes


def _each(message: Fields, key: str, modes: tuple[int, ...]) -> tuple[float, ...]:
    values = message.numbers(key, above=0.0)
    if len(values) != len(modes):
        raise message.refusal(key, list(values), f"one for each of {len(modes)} modes")
    return values


def encode_reply(reply: Reply) -> bytes:
    """Return the payload of the reply to a command.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    data = pack(reply)
    decode_reply(data)
    return data


def decode_reply(data: bytes) -> Reply:
    """Return the RTC's answer to a command.

    Raises
    ------
    WireError
        If a key is missing or out of range.
    """
    message = Fields.unpack(data, "a reply").of_this_version()
    return Reply(
        id=message.optional("id", message.identifier),
        accepted=message.flag("accepted"),
        reason=message.optional("reason", message.text) or "",
        start_seq=message.optional("start_seq", message.integer),
    )
