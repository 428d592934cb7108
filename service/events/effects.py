"""What is to be done about it."""

from __future__ import annotations

from dataclasses import dataclass

from service.state import DitherView, MeasurementRecord, NoisyRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class MakeMatrix:
    """Compute a reconstructor for the current α and judge it."""

    n_modes: int
    why: str
    gains: tuple[float, ...] | None = None
    """``(n_modes of the basis,)`` gains it is to run with; None: those in force."""

    fewer: tuple[int, ...] = ()
    """Tried instead, largest first, where the gate refuses ``n_modes``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CopyMatrix:
    """Judge an earlier reconstructor at the current α and offer it under a new id."""

    source: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeMatrix:
    """Judge the matrix in use at the current α."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeProposal:
    """Judge a reconstructor that is to be sent, at the current α and with these gains."""

    id: str
    gains: tuple[float, ...]
    """Of the modes it commands."""

    wanted: bool = True
    """Somebody asked for it to be sent; False: the service would by itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SendMatrix:
    """Publish a reconstructor; first tell the RTC how many modes it commands."""

    id: str
    n_modes: int
    gains: tuple[float, ...] | None
    """``(n_modes of the basis,)`` gains to go with it; None: those in force."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchMatrix:
    """Ask the RTC for the matrix it uses."""

    id: str | None
    """By its status; None: its status does not say."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskDither:
    """Ask the RTC for a dither."""

    dither: DitherView


@dataclass(frozen=True, slots=True, kw_only=True)
class AskNoDither:
    """Ask the RTC to stop its dither."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskMeasurement:
    """Ask the RTC to measure an interaction matrix."""

    record: MeasurementRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class AskLoop:
    """Ask the RTC to change its loop; None leaves a value as it is."""

    id: str
    closed: bool | None = None
    gains: tuple[float, ...] | None = None
    """One for each mode of the basis."""

    leak: float | None = None
    n_controlled: int | None = None
    judged: bool = False
    """Only if the gate lets the matrix in use run with these gains."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskRamp:
    """Ask the RTC to try gains on groups of modes."""

    id: str
    groups: tuple[tuple[int, int], ...]
    """First and last mode of each, both included."""

    gains: tuple[float, ...]
    frames_per_gain: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishNoisy:
    """Fit and archive what has been summed of a noisy interaction matrix."""

    record: NoisyRecord


Effect = (
    MakeMatrix
    | CopyMatrix
    | JudgeMatrix
    | JudgeProposal
    | SendMatrix
    | FetchMatrix
    | AskDither
    | AskNoDither
    | AskMeasurement
    | AskLoop
    | AskRamp
    | FinishNoisy
)
