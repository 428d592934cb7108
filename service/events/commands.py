"""What an operator can ask."""

from __future__ import annotations

from dataclasses import dataclass

from service.state import DitherKind, MeasurePattern, Mode, ModeSet, Pointing


@dataclass(frozen=True, slots=True, kw_only=True)
class SetMode:
    """An operator chooses how much the service may do by itself."""

    mode: Mode


@dataclass(frozen=True, slots=True, kw_only=True)
class Refit:
    """Compute a reconstructor for the current α now; it still passes the gate and the mode."""

    n_modes: int | None = None
    """Modes to control; None: as many as now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StartDither:
    """Start a dither; None: the service's own choice."""

    kind: DitherKind = DitherKind.SINE
    modes: tuple[int, ...] | ModeSet | None = None
    """0-based basis indices, or which they are: as many as that only with random signs."""

    amplitude_m: float | None = None
    """RMS of each mode of a sine, metres OPD."""

    total_m: float | None = None
    """RMS of all modes of random signs together, metres OPD."""

    frequency_hz: tuple[float, ...] | None = None
    """One for each mode."""

    duration_s: float | None = None
    over_budget: bool = False
    """More than the budget of the settings is meant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StopDither:
    """Stop the dither and do not start another until told to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Approve:
    """Publish a proposed reconstructor."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reject:
    """Discard a proposed reconstructor."""

    id: str
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Publish:
    """Send a known reconstructor again, under a new id, unless the gate refuses it now."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollback:
    """Go back to the reconstructor that was in use before the present one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """Have the RTC measure an interaction matrix; None: the service's own choice."""

    id: str
    """Of the matrix to come; never used before."""

    pattern: MeasurePattern
    modes: tuple[int, ...] | None = None
    """0-based basis indices."""

    amplitude_m: float | None = None
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None = None
    """Repetitions; None for a sine."""

    frequency_hz: tuple[float, ...] | None = None
    """One for each mode of a sine."""

    duration_s: float | None = None
    """Of a sine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GiveUp:
    """Wait no longer for an interaction matrix; the wire has no way to stop the RTC's work."""

    id: str
    """Of the measurement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPointing:
    """The observatory says where the telescope looks."""

    pointing: Pointing


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureNoisy:
    """Measure a noisy interaction matrix, loop closed; None: the service's own choice."""

    id: str
    """Of the matrix to come, and of its dither; never used before."""

    modes: tuple[int, ...] | ModeSet = ModeSet.CONTROLLED
    """0-based basis indices, or which they are."""

    total_m: float | None = None
    """RMS of all modes together, metres OPD."""

    duration_s: float | None = None
    """Of telemetry."""

    over_budget: bool = False
    """Whether it may be more than the budget of the dither."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GiveUpNoisy:
    """End a noisy interaction matrix under way, and its dither; nothing of it is kept."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class GainGroup:
    """One gain for a range of modes."""

    first: int
    last: int
    """0-based basis indices, both included."""

    gain: float
    """Loop gain; 0 leaves these modes alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetLoop:
    """Change the loop; what is None stays as it is."""

    closed: bool | None = None
    """False: open it."""

    gains: tuple[GainGroup, ...] | None = None
    """Modes in no group keep their gain."""

    leak: float | None = None
    """Per frame; 1 forgets nothing."""

    n_controlled: int | None = None
    """Takes effect with the next reconstructor of that many modes."""

    effective_gain: float | None = None
    """Gains that act as this on every mode, by the table of optical gains, if the gate agrees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ramp:
    """Have the RTC try gains on groups of modes; None: the service's own choice."""

    groups: tuple[tuple[int, int], ...] | None = None
    """First and last mode of each, both included."""

    gains: tuple[float, ...] | None = None
    """Tried in this order."""

    step_s: float | None = None
    """How long each is tried, settling included."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Acquire:
    """Find the registration from nothing: open the loop, look, and close it step by step.

    Its reconstructors need no further approval, in any mode.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class AbortAcquisition:
    """End an acquisition under way; the loop is left safe."""


Command = (
    Acquire
    | AbortAcquisition
    | SetMode
    | Refit
    | StartDither
    | StopDither
    | Approve
    | Reject
    | Publish
    | Rollback
    | Measure
    | GiveUp
    | MeasureNoisy
    | GiveUpNoisy
    | SetLoop
    | SetPointing
    | Ramp
)
