"""Commands from the service to the RTC, and the replies of the RTC.

Every command is a frozen record; :func:`decode_command` returns one from received bytes after the
checks that do not depend on the RTC. docs/rtc.md lists the keys.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from hashlib import sha256
from itertools import pairwise
from typing import Annotated, Final

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from service.errors import WireError
from service.wire import codec
from service.wire.keys import validate_id

AVERAGE_LIMIT: Final = 10_000
"""Largest number of repetitions in the measurement of an interaction matrix."""

RAMP_LIMIT: Final = 1_000_000
"""Largest number of frames at one gain of a ramp."""

REFERENCES_LIMIT: Final = 4_100_000
"""Largest message with reference slopes, in bytes: as many slopes as a row of frames may have."""

_Duration = Annotated[float, codec.above(0.0, 86_400.0)]
_Pair = Annotated[tuple[codec.Count, codec.Count], Meta(description="pairs of integers")]


class CommandKind(StrEnum):
    """Kinds of commands: the last part of a command's key."""

    DITHER = "dither"
    LOOP = "loop"
    MEASURE = "measure"
    RAMP = "ramp"
    OFFLOAD = "offload"
    REFERENCES = "references"


class Loop(StrEnum):
    """States of the RTC's loop."""

    OPEN = "open"
    CLOSED = "closed"
    PARTIAL = "partial"
    """Closed, but the gain of some controlled modes is 0."""


class DitherKind(StrEnum):
    """Shape of the dither in time."""

    SINE = "sine"
    """``amplitude_m * sqrt(2) * sin(2 pi f (seq - start_seq) dt)``."""

    BINARY = "binary"
    """Plus or minus ``amplitude_m`` in each frame, a sequence generated from ``seed``."""


class Pattern(StrEnum):
    """Patterns of mirror commands with which an interaction matrix is measured."""

    PUSH_PULL_MODAL = "push-pull-modal"
    """Push and pull of one mode after the other, loop open."""

    PUSH_PULL_ZONAL = "push-pull-zonal"
    """Push and pull of one actuator after the other, loop open."""

    HADAMARD = "hadamard"
    """All modes at once with the signs of a Hadamard matrix, loop open."""

    SYSTEM_MODES = "system-modes"
    """Push and pull of the singular modes of the RTC's own reconstructor, loop open."""

    SINE = "sine"
    """All modes at once, each at its own frequency, loop closed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Strokes:
    """Modes to be moved on the mirror, and their amplitudes."""

    id: codec.Id
    """Id of the command, and of the measured matrix."""

    modes: tuple[codec.Count, ...]
    """0-based indices in the modal basis."""

    amplitude_m: tuple[codec.Positive, ...]
    """RMS amplitude of each mode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherRequest(Strokes):
    """Command to start a dither."""

    kind: DitherKind
    """Shape in time: sines, or random signs."""

    frequency_hz: tuple[codec.Positive, ...] | None = None
    """Frequency of each mode, below half the frame rate; None if binary."""

    duration_s: _Duration
    """Duration, after which the dither ends by itself."""

    seed: codec.Count | None = None
    """Seed of the binary sequence; None if sine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherStop:
    """Command to stop the dither, whichever is running; it always succeeds."""

    id: codec.Id
    """Id of this command, not of the dither that it stops."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRequest:
    """Command to change the loop. None leaves a value unchanged; opening zeroes the integrator."""

    id: codec.Id
    """Id of the command."""

    loop: Loop | None = None
    """New state of the loop; the service never sends ``partial``."""

    gains: tuple[Annotated[float, codec.number(0.0)], ...] | None = None
    """Integrator gain of each mode of the basis."""

    leak: Annotated[float, codec.number(0.0, 1.0)] | None = None
    """Leak factor per frame; 1: pure integrator."""

    n_controlled: codec.Count | None = None
    """Number of controlled modes, from the next reconstructor of that many rows on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixStrokes(Strokes):
    """Strokes for the measurement of an interaction matrix."""

    frequency_hz: tuple[codec.Positive, ...] | None = None
    """Frequency of each mode; for ``sine`` only."""

    duration_s: _Duration | None = None
    """Duration; for ``sine`` only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureRequest(MatrixStrokes):
    """Command to measure an interaction matrix."""

    pattern: Pattern
    """Pattern of mirror commands."""

    n_average: Annotated[int, codec.integer(1, AVERAGE_LIMIT)] | None = None
    """Number of repetitions; None for ``sine``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RampRequest:
    """Command to optimise the loop gains of one group of modes after the other.

    The RTC runs each gain for ``frames_per_gain`` frames, while the other groups keep theirs, and
    keeps the gain with the smallest residual slopes. The result appears in the status' ``gains``.
    Heritier et al. 2018, section 5, ramp tip and tilt, then the modes up to 100, then up to 400.
    """

    id: codec.Id
    """Id of the command."""

    groups: tuple[_Pair, ...]
    """First and last mode of each group, both included; no overlap."""

    gains: tuple[codec.Positive, ...]
    """Loop gains in the order of the trials."""

    frames_per_gain: Annotated[int, codec.integer(1, RAMP_LIMIT)]
    """Frames at each gain, settling included."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OffloadRequest(codec.RegistrationNumbers):
    """Command to move the mirror's image on the sensor with a lens or a stage.

    The four numbers are the change of the registration α.
    """

    id: codec.Id
    """Id of the command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeOffset:
    """Slopes that are subtracted beyond the RTC's own reference slopes."""

    slopes: bytes = field(repr=False)
    """Offset of the slopes, little-endian float32, ``n_slopes`` numbers."""

    sha256: codec.Sha256
    """SHA-256 of ``slopes``."""

    @property
    def offset(self) -> NDArray[np.float32]:
        """The offset as a read-only array ``(n_slopes,)``, dimensionless."""
        return np.frombuffer(self.slopes, dtype="<f4")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencesRequest(SlopeOffset):
    """Command to subtract another offset from the slopes, in place of an earlier one.

    The offset is added to the RTC's own reference slopes, those that it started with; all zeros
    return to them. It holds a shape on the mirror, for example against non-common-path aberrations.
    """

    id: codec.Id
    """Id of the command."""

    reference_id: codec.Id
    """Name of the reference slopes from the end of the ramp on; before, with ``~`` appended."""

    config_id: codec.Opaque
    """Sensor configuration whose slopes these are."""

    ramp_s: Annotated[float, codec.number(0.0, 60.0)]
    """Duration of the linear ramp from what is subtracted at present."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencesInUse(SlopeOffset):
    """Offset that the RTC subtracts now, read back from it."""

    reference_id: codec.Opaque
    """Name of the reference slopes in frames and status."""


Command = (
    DitherRequest
    | DitherStop
    | LoopRequest
    | MeasureRequest
    | RampRequest
    | OffloadRequest
    | ReferencesRequest
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """Reply of the RTC to a command."""

    id: codec.Id | None
    """Id of the command; None if unreadable."""

    accepted: bool
    """True if the command is or was carried out."""

    reason: codec.Text
    """Code and reason of a refusal; else empty."""

    start_seq: codec.Count | None
    """First frame whose exposure contains the effect; None if there is none."""

    @property
    def is_unsupported(self) -> bool:
        """True if the RTC never carries out such a command, by the code of its refusal."""
        return not self.accepted and self.reason.partition(":")[0] == "unsupported"


_KINDS: dict[type[Command], CommandKind] = {
    DitherRequest: CommandKind.DITHER,
    DitherStop: CommandKind.DITHER,
    LoopRequest: CommandKind.LOOP,
    MeasureRequest: CommandKind.MEASURE,
    RampRequest: CommandKind.RAMP,
    OffloadRequest: CommandKind.OFFLOAD,
    ReferencesRequest: CommandKind.REFERENCES,
}
# Two commands share the key of the dither: its "action" tells them apart.
_STARTING = {kind: command for command, kind in _KINDS.items() if command is not DitherStop}
_START, _STOP = "start", "stop"


def command_kind(command: Command) -> CommandKind:
    """Return the kind of a command, which is the last part of its key."""
    return _KINDS[type(command)]


def command_id(data: bytes) -> str | None:
    """Return the id in the bytes of a command, for a reply that refuses it; None if unreadable."""
    try:
        return validate_id(_unpack_references(data, "a command").get("id"), "a command")
    except WireError:
        return None


def decode_command(kind: CommandKind, data: bytes) -> Command:
    """Return the command in the bytes of a query on ``cmd/rtc/{kind}``.

    Limits that depend on the RTC (number of modes, strokes, rates) are left for the RTC to check.

    Raises
    ------
    WireError
        If a key is missing or out of range; the text can be the ``reason`` of a reply.
    """
    dither = kind is CommandKind.DITHER
    if dither and codec.unpack(data, "a dither command").get("action") == _STOP:
        return codec.decode(DitherStop, data)
    return codec.decode(_STARTING[kind], data)


def _check_start(values: codec.Map, where: str) -> codec.Map:
    if codec.require(values, "action", where) != _START:
        raise codec.refusal("action", values["action"], f"{_START} or {_STOP}", where)
    return values


def _check_dither(command: DitherRequest, where: str) -> None:
    sine = command.kind is DitherKind.SINE
    codec.check_applicability(command, where, frequency_hz=sine, seed=not sine)
    _check_modes(command, where)


def _check_measurement(command: MeasureRequest, where: str) -> None:
    sine = command.pattern is Pattern.SINE
    codec.check_applicability(
        command, where, n_average=not sine, frequency_hz=sine, duration_s=sine
    )
    _check_modes(command, where)


def _check_modes(command: Strokes, where: str) -> None:
    """Raise a ``WireError`` for no modes, repeated modes, or lists of another length."""
    modes = command.modes
    if not modes or len(set(modes)) != len(modes):
        raise codec.refusal("modes", modes, "at least one mode, none twice", where)
    for key in ("amplitude_m", "frequency_hz"):
        values = getattr(command, key)
        if values is not None and len(values) != len(modes):
            raise codec.refusal(key, values, f"one for each of {len(modes)} modes", where)


def _check_ramp(command: RampRequest, where: str) -> None:
    groups = sorted(command.groups)
    # Both ends belong to a group, so that equal ends overlap.
    apart = all(before[1] < after[0] for before, after in pairwise(groups))
    if not groups or not apart or any(first > last for first, last in groups):
        expected = "one or more [first, last], first <= last, none overlapping another"
        raise codec.refusal("groups", groups, expected, where)
    if not command.gains:
        raise codec.refusal("gains", command.gains, "one or more gains to try", where)


def _unpack_references(data: bytes, where: str) -> codec.Map:
    return codec.unpack(data, where, REFERENCES_LIMIT)


def _check_offset(record: SlopeOffset, where: str) -> None:
    """Raise a ``WireError`` for a wrong length or checksum, or numbers that are not finite."""
    n_bytes, found = len(record.slopes), sha256(record.slopes).hexdigest()
    if not n_bytes or n_bytes % 4:
        raise codec.refusal("slopes", record.slopes, "one float32 of 4 bytes or more", where)
    if found != record.sha256:
        raise codec.refusal("sha256", record.sha256, f"{found}, that of slopes", where)
    # A checksum does not exclude NaN, which would reach all actuators within one frame.
    n_bad = int(np.sum(~np.isfinite(record.offset)))
    if n_bad:
        raise WireError(f"range: {n_bad} slopes in {where} are not finite, expected none")


codec.register(
    DitherRequest,
    "a dither command",
    first=("id", "kind"),
    keys=lambda keys: {**keys, "action": _START},
    fields=_check_start,
    check=_check_dither,
)
codec.register(DitherStop, "a dither command", keys=lambda keys: {**keys, "action": _STOP})
codec.register(LoopRequest, "a loop command")
codec.register(
    MeasureRequest,
    "a measure command",
    first=("id", "pattern", "modes", "amplitude_m", "n_average"),
    check=_check_measurement,
)
codec.register(RampRequest, "a ramp command", check=_check_ramp)
codec.register(OffloadRequest, "an offload command")
codec.register(
    ReferencesRequest,
    "a references command",
    first=("id", "reference_id", "config_id"),
    unpack=_unpack_references,
    check=_check_offset,
)
codec.register(
    ReferencesInUse,
    "the references in use",
    first=("reference_id",),
    unpack=_unpack_references,
    check=_check_offset,
)
codec.register(Reply, "a reply", fields=codec.nil_reason_to_text)
