"""Noisy interaction matrices, measured on sky by a random dither: how, and how far each is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration


class ModeSet(StrEnum):
    """Modes by what they are, instead of by index."""

    CONTROLLED = "controlled"
    """Those in the loop."""

    ALL = "all"
    """Those of the basis."""


class NoisyState(StrEnum):
    """Where a noisy interaction matrix is."""

    WAITING = "waiting"
    """The service's own dither has to end first."""

    ASKED = "asked"
    """The RTC has not answered yet."""

    RUNNING = "running"
    """The dither plays, its windows are being summed."""

    FINISHING = "finishing"
    """The dither is over; the matrix is being fitted and archived."""

    STORED = "stored"
    """It is in the archive."""

    FAILED = "failed"
    """There is none; the reason says why."""

    GIVEN_UP = "given-up"
    """An operator did not want it any more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyFinding:
    """What came of one."""

    n_slopes: int
    n_frames: int
    """Frames that entered it."""

    n_missing: int
    """Frames of its windows that never came."""

    snr: float
    """RMS signal of an element over its noise: about 1 on a bright star, less on a faint one."""

    alpha: Misregistration | None
    """The registration fitted to it; None: none could be."""

    covariance: NDArray[np.float64] | None
    """``(4, 4)`` of that, numeric units, from the data alone; None as above."""

    optical_gain: float | None
    """Mean gain of the modes against the model; None as above."""

    misfit: float | None
    """Residual power over what noise explains; None as above."""

    cm_id: str | None
    """The reconstructor in use at its end."""

    session: str
    created_ns_utc: int
    """End of its last frame, the RTC's clock."""

    sha256: str
    """Of the matrix as C-ordered little-endian float32."""

    @property
    def sigma(self) -> NDArray[np.float64] | None:
        """``(4,)`` 1 σ of the registration, numeric units, from the data alone; None as above."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyRecord:
    """All that is known of one noisy interaction matrix but its numbers.

    Nothing of it can become a reconstructor: it is a measurement to fit a model to.
    """

    id: str
    """Never reused; also that of its dither."""

    state: NoisyState
    modes: tuple[int, ...]
    """0-based basis indices, one for each column."""

    total_m: float
    """RMS of all modes together, metres OPD."""

    duration_s: float
    """Of telemetry asked for."""

    window_s: float
    """Of the windows it is summed from."""

    seed: int
    """Of the dither's signs."""

    asked_ns_utc: int
    basis_id: str
    config_id: str
    reason: str = ""
    """Why there is none, or what is missing."""

    finding: NoisyFinding | None = None
    """None: not finished."""

    @property
    def n_modes(self) -> int:
        """Columns."""
        return len(self.modes)

    @property
    def amplitude_m(self) -> float:
        """RMS of each mode, metres OPD."""
        return float(self.total_m / np.sqrt(len(self.modes)))

    @property
    def under_way(self) -> bool:
        """Whether the service still works on it."""
        return self.state in {
            NoisyState.WAITING,
            NoisyState.ASKED,
            NoisyState.RUNNING,
            NoisyState.FINISHING,
        }
