"""What the three estimators have in common: telemetry in, an estimate that knows its limits out.

Each cuts telemetry into windows, or forgets the old of it, in constant memory; its fit says what it
found of α, how sure it is by the scatter of the data themselves, how well the model explains them,
and which of the four parameters it can tell at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import PARAMETERS, Misregistration

MODEL_ERROR = 15.0
"""Variance of α per unit of misfit above 1, over that of its scatter: what the model leaves over is
smooth across the pupil and pulls at α more than noise of the same power. From campaigns on the
diffractive telescope, two truths and two models (docs/results/night.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Determines:
    """Which of the four parameters a kind of estimate can tell."""

    parameters: tuple[str, ...]
    """Names, as of ``PARAMETERS``."""

    text: str
    """What an operator should know of the others, and of what it costs."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of those it cannot tell, or not as well as a registration needs."""
        return tuple(name for name in PARAMETERS if name not in self.parameters)


LOCK_IN = Determines(
    parameters=PARAMETERS,
    text="sines on a few modes: all four, whatever the wind; lines must be clear of vibrations, "
    "and the reconstructor in use must be known",
)

RANDOM = Determines(
    parameters=PARAMETERS,
    text="random signs on chosen modes or on all: all four, and the noisy interaction matrix; "
    "robust to lines and gaps, needs no reconstructor, refused when the mirror answers a frame "
    "late",
)

PASSIVE = Determines(
    parameters=("rotation_deg", "magnification"),
    text="no dither: rotation and magnification; shifts carry the wind's bias, 10 % of a "
    "subaperture or more unless a dither has taught it; needs a closed loop, a delay of two frames "
    "or more, and telemetry with few gaps",
)


class Window(Protocol):
    """A finished window of dithered telemetry, ready to be fitted."""

    @property
    def session(self) -> str:
        """The RTC's session."""

    @property
    def cm_id(self) -> str | None:
        """The reconstructor in use; None: the RTC did not know."""

    @property
    def first_seq(self) -> int:
        """Its first frame."""

    @property
    def t_end_ns_utc(self) -> int:
        """End of exposure of its last frame."""

    @property
    def n_missing(self) -> int:
        """Frames that never came."""


class Estimate(Protocol):
    """What telemetry says of the registration, whichever way it was looked at."""

    @property
    def alpha(self) -> Misregistration:
        """The registration."""

    @property
    def covariance(self) -> NDArray[Any]:
        """``(4, 4)`` numeric units, from the scatter of the data; no model error in it."""

    @property
    def optical_gain(self) -> NDArray[Any]:
        """Gain of the sensor on each mode looked at, against the model; complex with a lag."""

    @property
    def misfit(self) -> float:
        """Residual power over what noise explains; 1: the model explains the data."""

    @property
    def step(self) -> NDArray[Any]:
        """``(4,)`` distance from the linearisation to the estimate, numeric units."""

    @property
    def determines(self) -> Determines:
        """Which of the four parameters it can tell."""


class DitheredEstimate(Estimate, Protocol):
    """One window's estimate, which may enter the registration."""

    @property
    def modes(self) -> tuple[int, ...]:
        """0-based basis index of each gain; empty: not known."""

    @property
    def gain_sigma(self) -> NDArray[Any] | None:
        """1 σ of the modulus of each mode's gain; None: not known."""

    @property
    def lag_frames(self) -> NDArray[Any]:
        """How far slopes lag commands; 0 when the columns are aligned as the wire demands."""

    @property
    def t_ns_utc(self) -> int:
        """End of the window."""

    @property
    def cm_id(self) -> str | None:
        """The reconstructor in use."""

    @property
    def session(self) -> str:
        """The RTC's session."""


def model_error(covariance: NDArray[Any], misfit: float) -> NDArray[Any]:
    """Return ``(4,)`` the 1 σ by which the model leads a window astray, numeric units.

    As much as it leaves unexplained: bright stars show what a faint one's noise hides, and neither
    needs to be told which telescope it is. It does not average down, for the next window has the
    same.
    """
    return np.sqrt(MODEL_ERROR * max(misfit - 1.0, 0.0) * np.diag(covariance))
