"""Interaction matrices the RTC measures: how, and how far each is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class MeasurePattern(StrEnum):
    """How the RTC measures an interaction matrix."""

    PUSH_PULL_MODAL = "push-pull-modal"
    """One mode after the other, loop open."""

    PUSH_PULL_ZONAL = "push-pull-zonal"
    """One actuator after the other, loop open."""

    HADAMARD = "hadamard"
    """All modes at once with the signs of a Hadamard matrix, loop open."""

    SYSTEM_MODES = "system-modes"
    """One eigenmode of the reconstructor in use after the other, loop open."""

    SINE = "sine"
    """All modes at once, each at its own frequency, loop closed."""


class MeasureState(StrEnum):
    """Where a measurement of an interaction matrix is."""

    ASKED = "asked"
    """The RTC has not answered yet."""

    RUNNING = "running"
    """The RTC measures."""

    REFUSED = "refused"
    """The RTC would not; the reason is the RTC's."""

    FAILED = "failed"
    """There is no matrix; the reason says why."""

    STORED = "stored"
    """The matrix is in the archive."""

    GIVEN_UP = "given-up"
    """An operator waits for it no longer; the RTC may go on, what it sends is ignored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementRecord:
    """All that is known of one measured interaction matrix but its numbers."""

    id: str
    """Never reused."""

    state: MeasureState
    pattern: MeasurePattern
    modes: tuple[int, ...]
    """0-based basis indices, one for each column."""

    amplitude_m: tuple[float, ...]
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None
    """Repetitions averaged; None: the pattern has none."""

    frequency_hz: tuple[float, ...] | None = None
    """Of each mode; None: not a sine, or asked for by somebody else."""

    duration_s: float | None = None
    """Of a sine; None as above."""

    asked_ns_utc: int | None = None
    """When the service asked for it; None: it did not."""

    start_seq: int | None = None
    """First frame that contained a stroke; None: not known."""

    closed_before: bool = False
    """Whether the loop was closed when it was asked for."""

    overdue_since_ns_utc: int | None = None
    """Since when everything looks as if it were over, but no matrix has come."""

    reason: str = ""
    """Why there is no matrix."""

    created_ns_utc: int | None = None
    """When it was measured, by the RTC's clock; None: it was not, or not yet."""

    n_slopes: int | None = None
    double_pass: bool | None = None
    """Whether the light saw the mirror twice: the matrix is then twice as large."""

    session: str | None = None
    """The RTC's session."""

    basis_id: str | None = None
    config_id: str | None = None
    sha256: str = ""
    """Of the matrix as it travels, 64 lower-case hex digits."""

    @property
    def opens_loop(self) -> bool:
        """Whether the loop is open while it is measured."""
        return self.pattern is not MeasurePattern.SINE

    @property
    def under_way(self) -> bool:
        """Whether the service waits for the matrix."""
        return self.state in {MeasureState.ASKED, MeasureState.RUNNING}
