"""Commands of operators and the observatory, with their limits.

REST reads JSON straight into these. What no state of the service could make sense of is refused
when a command is made; what needs something of the present state, where it is carried out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Len, MaxLen
from typing_extensions import override

from service.errors import shown
from service.records.alarms import Severity
from service.records.products import Frame, ModeSet, ShapeKind
from service.records.state import Mode
from service.wire import DitherKind, Pattern

MAX_SINES = 64
MAX_GROUPS = 1000
MAX_NOISY_MEASUREMENT_S = 3600.0
MAX_MUTE_S = 43_200.0
MAX_VALUE_LIFETIME_S = 86_400.0
MAX_TEXT_LENGTH = 200

MAX_MODES = 100_000
"""Largest number of modes that an order may list."""

MAX_SHAPE_VALUES = 65_536
"""A map of 256 x 256, or the pixels of a large sensor: the shape is saved with every α."""

SHAPE_RANGE_M = (1e-11, 5e-6)
"""Smallest and largest RMS of a shape, metres OPD: beyond them its unit is another one."""

UNITS_M = {"m": 1.0, "um": 1e-6, "nm": 1e-9}
"""Metres in each unit of a shape."""

Value = bool | float | str
"""Type of a value that operators' own alarm rules compare."""

Positive = Annotated[float, Gt(0.0)]
Count = Annotated[int, Ge(1)]
BasisMode = Annotated[int, Ge(0)]
BasisModes = Annotated[tuple[BasisMode, ...], Len(1, MAX_MODES)]
Lines = Annotated[tuple[Positive, ...], Len(1, MAX_MODES)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Instruction:
    """Fields that every command may have."""

    __pydantic_config__: ClassVar[dict[str, object]] = {
        "extra": "forbid",
        "strict": True,
        "allow_inf_nan": False,
    }

    reason: Annotated[str, MaxLen(500)] = ""
    """Reason of the order, for the audit trail."""

    by: Annotated[str, MaxLen(100)] = ""
    """Name of the person who gives the order; empty if only the address is known."""

    def __post_init__(self) -> None:
        """Refuse what would act on the terminal it is shown on.

        Raises
        ------
        ValueError
            If it makes no sense in any state.
        """
        for name, text in (("reason", self.reason), ("by", self.by)):
            unseen = next((char for char in text if shown(char) != char), None)
            if unseen is not None:
                raise ValueError(f"found {unseen!r} in {name}, expected printable characters")

    @property
    def signed(self) -> str:
        """Return name and reason of the order, for the log."""
        why = f" ({self.reason})" if self.reason else ""
        return f"by {self.by or 'an operator'}{why}"

    def as_fields(self) -> dict[str, Any]:
        """Return the fields by name, for a command that says the same and more."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, slots=True, kw_only=True)
class SetMode(Instruction):
    """Set the mode: how much the service may do by itself."""

    mode: Mode
    """"auto", "propose" or "hold"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refit(Instruction):
    """Compute a reconstructor for the current α now; it still passes the gate and the mode."""

    n_modes: Count | None = None
    """Modes to control; None: as many as now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSigns(Instruction):
    """Amplitude and duration of random signs on many modes at once."""

    total_amplitude_m: Positive | None = None
    """RMS of all modes of random signs together, metres OPD."""

    over_budget: bool = False
    """More than the budget of the settings is meant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StartDither(RandomSigns):
    """Start a dither; what is left out, the service chooses."""

    action: Literal["start"] = "start"
    kind: DitherKind = DitherKind.SINE
    """"sine", or "binary": random signs, on hundreds of modes if need be."""

    modes: BasisModes | ModeSet | None = None
    """0-based basis indices, none twice; of random signs also "controlled" or "all"."""

    amplitude_m: Positive | None = None
    """RMS of each mode of a sine, metres OPD."""

    frequency_hz: Lines | None = None
    """One for each mode of a sine."""

    duration_s: Positive | None = None

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        n_modes = _each_once(self.modes)
        if self.kind is DitherKind.BINARY:
            if self.amplitude_m is not None or self.frequency_hz is not None:
                raise ValueError(
                    "no amplitude_m and no frequency_hz with binary: total_amplitude_m"
                )
            return
        if isinstance(self.modes, ModeSet) or n_modes > MAX_SINES:
            raise ValueError(f"at most {MAX_SINES} modes with sine")
        if self.total_amplitude_m is not None:
            raise ValueError("no total_amplitude_m with sine: amplitude_m of each mode")
        _a_line_each(self.frequency_hz, n_modes)


@dataclass(frozen=True, slots=True, kw_only=True)
class StopDither(Instruction):
    """Stop the dither and start no other until ordered to."""

    action: Literal["stop"] = "stop"


@dataclass(frozen=True, slots=True, kw_only=True)
class OfMatrix(Instruction):
    """The matrix that an order is about."""

    id: str
    """Id of the matrix. A new one must never have been used before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Approve(OfMatrix):
    """Publish a proposed reconstructor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reject(OfMatrix):
    """Discard a proposed reconstructor; the reason is kept with it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Publish(OfMatrix):
    """Send a known reconstructor again, under a new id, if the gate accepts it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollback(Instruction):
    """Go back to the reconstructor that was in use before the present one."""

    anyway: bool = False
    """Send it though the gate refuses it for the α of now: α may be what is wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadShape(Instruction):
    """Load a shape that the loop is to hold; references for it are made and offered from now on."""

    kind: ShapeKind
    """"modes", "zernike", "map" or "slopes"."""

    frame: Frame
    """"mirror" for modes; "instrument" for all others, which are fixed on the pupil."""

    values: Annotated[tuple[float, ...], Len(1, MAX_SHAPE_VALUES)]
    """Modes from mode 0 on, Zernike coefficients from Noll index 1 on (both RMS of OPD), a square
    map of OPD over the pupil row by row, or slopes measured at optical gain 1."""

    unit: Literal["m", "um", "nm"] | None = None
    """Unit of the values; null for slopes, which have none."""

    basis_id: str | None = None
    """Modal basis of the modes, if known: another one than the RTC's is refused."""

    config_id: str | None = None
    """Sensor configuration of the slopes, if known: another one than the RTC's is refused."""

    source: Annotated[str, MaxLen(MAX_TEXT_LENGTH)] = ""
    """File or measurement that it came from."""

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        if self.frame is not self.kind.frame:
            raise ValueError(f"frame {self.kind.frame} with {self.kind}: found {self.frame}")
        slopes = self.kind is ShapeKind.SLOPES
        if slopes is not (self.unit is None):
            raise ValueError("no unit with slopes" if slopes else "a unit: m, um or nm")
        if self.kind is ShapeKind.MAP and round(len(self.values) ** 0.5) ** 2 != len(self.values):
            raise ValueError(f"a square map: found {len(self.values)} values")
        least, most = SHAPE_RANGE_M
        if not slopes and not least <= self.rms_m <= most:
            raise ValueError(
                f"a shape of {least:g} to {most:g} m RMS: found {self.rms_m:.3g} m, is the unit "
                f"{self.unit}? (pyrcal references clear ends the shape)"
            )
        if slopes and not any(self.values):
            raise ValueError("slopes that are not all 0")

    @property
    def values_m(self) -> tuple[float, ...]:
        """Return the values in metres; those of slopes as they are."""
        metres = UNITS_M[self.unit or "m"]
        return tuple(metres * value for value in self.values)

    @property
    def rms_m(self) -> float:
        """RMS of the shape, metres OPD; piston does not count."""
        values = np.array(self.values_m)
        if self.kind is ShapeKind.MAP:
            return float(values.std())
        return float(np.linalg.norm(values[1:] if self.kind is ShapeKind.ZERNIKE else values))


@dataclass(frozen=True, slots=True, kw_only=True)
class ClearShape(Instruction):
    """Hold no shape any more: the RTC returns to its own references."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ApproveReferences(OfMatrix):
    """Send proposed references."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectReferences(OfMatrix):
    """Discard proposed references; no others are made before a shape is loaded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RollBackReferences(Instruction):
    """Go back to the references in use before; no others are made before a shape is loaded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureChoice(Instruction):
    """Parameters of a measurement by the RTC; the service chooses those left out.

    All patterns but "sine" open the loop meanwhile.
    """

    pattern: Pattern = Pattern.PUSH_PULL_MODAL
    modes: BasisModes | None = None
    """0-based basis indices, none twice; None: the controlled ones."""

    amplitude_m: Positive | None = None
    """RMS of each mode's stroke, metres OPD."""

    n_average: Annotated[int, Ge(1), Le(10_000)] | None = None
    """Pushes, and as many pulls, of each shape; None for a sine."""

    frequency_hz: Lines | None = None
    """One for each of ``modes``; only of a sine."""

    duration_s: Positive | None = None
    """Only of a sine."""

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        n_modes = _each_once(self.modes)
        if self.pattern is Pattern.SINE and self.n_average is not None:
            raise ValueError("no n_average with a sine: its duration_s does the averaging")
        given = self.frequency_hz is not None or self.duration_s is not None
        if self.pattern is not Pattern.SINE and given:
            raise ValueError(f"no frequency_hz and no duration_s with {self.pattern}")
        _a_line_each(self.frequency_hz, n_modes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure(MeasureChoice):
    """Have the RTC measure an interaction matrix."""

    id: str
    """Id of the future matrix; must never have been used before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GiveUp(OfMatrix):
    """Wait no longer for an interaction matrix.

    The wire has no way to stop the RTC's work; a noisy one ends, and its dither.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisyChoice(RandomSigns):
    """Parameters of a noisy matrix; the service chooses those left out.

    The loop stays closed: random signs on all its modes at once, a few nanometres altogether.
    """

    modes: BasisModes | ModeSet = ModeSet.CONTROLLED
    """0-based basis indices, none twice, or "controlled" or "all"."""

    duration_s: Annotated[float, Gt(0.0), Le(MAX_NOISY_MEASUREMENT_S)] | None = None
    """Duration of telemetry by the RTC's time, seconds."""

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        _each_once(self.modes)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureNoisy(NoisyChoice):
    """Measure a noisy interaction matrix, loop closed."""

    id: str
    """Id of the future matrix and of its dither; must never have been used before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPointing(Instruction):
    """Report where the telescope points."""

    elevation_deg: Annotated[float, Ge(-90.0), Le(90.0)]
    """Above the horizon, degrees."""

    azimuth_deg: Annotated[float, Ge(-720.0), Le(720.0)]
    """From north over east, degrees; only differences count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportedValue(Instruction):
    """A value of the observatory for operators' own rules."""

    value: Value
    """A number, a text, or true or false, as the rule compares it."""

    for_s: Annotated[float, Gt(0.0), Le(MAX_VALUE_LIFETIME_S)] = 60.0
    """Duration for which the value is valid, seconds. Afterwards it is unknown until it is reported
    again."""

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        if isinstance(self.value, str) and len(self.value) > MAX_TEXT_LENGTH:
            raise ValueError(f"a text of at most {MAX_TEXT_LENGTH} characters")


@dataclass(frozen=True, slots=True, kw_only=True)
class SetValue(ReportedValue):
    """Report a value for operators' own rules."""

    name: str
    """Name of the value in the rules."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeGroup:
    """A range of modes."""

    first: BasisMode
    """0-based basis index of the first mode."""

    last: BasisMode
    """Last mode of the group; it belongs to the group."""

    def __post_init__(self) -> None:
        """Refuse a range that ends before it begins."""
        if self.last < self.first:
            raise ValueError(f"first <= last: first {self.first}, last {self.last}")


@dataclass(frozen=True, slots=True, kw_only=True)
class GainGroup(ModeGroup):
    """One gain for a range of modes."""

    gain: Annotated[float, Ge(0.0)]
    """Loop gain; 0 leaves these modes alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains(Instruction):
    """Loop gains: of groups of modes, or such that they act alike on all."""

    gains: Annotated[tuple[GainGroup, ...], Len(1, MAX_GROUPS)] | None = None
    """Groups of modes, none twice; modes in no group keep their gain."""

    effective_gain: Annotated[float, Gt(0.0), Le(2.0)] | None = None
    """Gains that act as this on every mode, by the table of optical gains (``GET /v1/gains``);
    the gate must accept the reconstructor in use with them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetLoop(Gains):
    """Change the loop; what is left out stays as it is."""

    loop: Literal["open", "closed"] | None = None
    """Opening zeroes the integrator, and the RTC begins a new session."""

    leak: Annotated[float, Ge(0.0), Le(1.0)] | None = None
    """Per frame; 1 forgets nothing."""

    n_controlled: Count | None = None
    """Takes effect with the next reconstructor of that many modes."""

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        changes = (self.loop, self.gains, self.leak, self.n_controlled, self.effective_gain)
        if all(change is None for change in changes):
            raise ValueError("at least one of loop, gains, leak, n_controlled, effective_gain")
        if self.gains is not None and self.effective_gain is not None:
            raise ValueError("gains or effective_gain, not both")
        _none_twice(self.gains or ())


@dataclass(frozen=True, slots=True, kw_only=True)
class Ramp(Instruction):
    """Have the RTC try gains on one group of modes after the other.

    What is left out, the service chooses.
    """

    groups: Annotated[tuple[ModeGroup, ...], Len(1, MAX_GROUPS)] | None = None
    """Groups in the order in which they are tuned. None for tip and tilt, then modes up to 99, then
    the other controlled ones."""

    gains: Annotated[tuple[Positive, ...], Len(1, 100)] | None = None
    """Tried in this order on every group; None: 0.1 to 0.6."""

    step_s: Annotated[float, Gt(0.0), Le(60.0)] | None = None
    """Duration of each gain value at the nominal frame rate, settling included, seconds. None for 1
    s."""

    @override
    def __post_init__(self) -> None:
        Instruction.__post_init__(self)
        _none_twice(self.groups or ())


@dataclass(frozen=True, slots=True, kw_only=True)
class Acquire(Instruction):
    """Find the registration from nothing: open the loop, dither, close it step by step.

    Its reconstructors need no further approval, in any mode.
    """

    action: Literal["start"] = "start"


@dataclass(frozen=True, slots=True, kw_only=True)
class AbortAcquisition(Instruction):
    """End an acquisition under way.

    The loop is left as it was found if that held, else open or closed on a matrix that has passed
    the gate.
    """

    action: Literal["abort"] = "abort"


@dataclass(frozen=True, slots=True, kw_only=True)
class StopEverything(Instruction):
    """Stop everything: end what runs, dither, make and send nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Resume(Instruction):
    """End the stop: mode and dither are as ordered before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenAlarm(Instruction):
    """Fields of an acknowledgement."""

    severity: Severity | None = None
    """The worst that was seen of it: refused where it has been worse; None: however bad it was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AcknowledgeAlarm(SeenAlarm):
    """Say that an alarm is known of; it stays for as long as it lasts."""

    name: str
    """Name of the alarm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MuteTime(Instruction):
    """Duration for which an alarm is muted."""

    for_s: Annotated[float, Gt(0.0), Le(MAX_MUTE_S)]
    """Seconds, at most twelve hours."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MuteAlarm(MuteTime):
    """Hide an alarm for a time; it is still counted."""

    name: str
    """Name of the alarm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnmuteAlarm(Instruction):
    """Show an alarm again."""

    name: str
    """Name of the alarm."""


GuardCommand = StopEverything | Resume | AcknowledgeAlarm | MuteAlarm | UnmuteAlarm
OperationCommand = Acquire | AbortAcquisition | SetMode | Refit | StartDither | StopDither
MatrixCommand = Approve | Reject | Publish | Rollback | Measure | GiveUp | MeasureNoisy
SetCommand = SetLoop | SetPointing | SetValue | Ramp
ShapeCommand = LoadShape | ClearShape | ApproveReferences | RejectReferences | RollBackReferences
Command = GuardCommand | OperationCommand | MatrixCommand | SetCommand | ShapeCommand


def _each_once(modes: tuple[int, ...] | ModeSet | None) -> int:
    """Return how many modes are listed, each of them once."""
    if modes is None or isinstance(modes, ModeSet):
        return 0
    if len(set(modes)) < len(modes):
        raise ValueError("modes without any of them twice")
    return len(modes)


def _a_line_each(lines_hz: tuple[float, ...] | None, n_modes: int) -> None:
    if lines_hz is not None and len(lines_hz) != n_modes:
        raise ValueError(f"one frequency_hz for each of modes: {len(lines_hz)} given for {n_modes}")


def _none_twice(groups: tuple[ModeGroup, ...]) -> None:
    for before, after in pairwise(sorted((group.first, group.last) for group in groups)):
        if after[0] <= before[1]:
            raise ValueError(f"no mode in two groups: mode {after[0]} is")


def makes_safer(command: Command, gains: tuple[float, ...] = ()) -> bool:
    """Return True if an order ends something, takes it back, or lowers gains of the loop.

    It must not wait for the disk. ``gains`` are those of the RTC, one per mode.
    """
    if isinstance(command, SetLoop):
        changes = (command.loop, command.leak, command.n_controlled, command.effective_gain)
        lowers = changes == (None,) * len(changes) and all(
            group.gain <= min(gains[group.first : group.last + 1], default=0.0)
            for group in command.gains or ()
        )
        return command.loop == "open" or lowers
    if isinstance(command, SetMode):
        return command.mode is Mode.HOLD
    enders = StopEverything | StopDither | Rollback | AbortAcquisition | GiveUp | Reject
    enders |= ClearShape | RejectReferences | RollBackReferences
    return isinstance(command, enders)
