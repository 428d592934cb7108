"""What the worker is told, and what it says of the model and of a reconstructor."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.control.gate import GateVerdict
from service.control.reconstructor import MAX_CONDITION, Method
from service.model.misregistration import Misregistration
from service.telemetry.health import Actuators


@dataclass(frozen=True, slots=True, kw_only=True)
class Compute:
    """What the worker may use and how finely it samples the optics."""

    threads: int = 2
    """Threads that share the rows of a product; BLAS itself keeps to one."""

    nice: int = 10
    pupil_sampling: int = 3
    detector_nodes: int = 3
    working_point_modes: int | None = None
    """Telemetry is compared with the response of a loop that controls this many modes at the
    instrument's r0; None: with that of a flat wavefront."""

    method: Method = Method.SVD
    """How interaction matrices are inverted."""

    max_condition: float = MAX_CONDITION
    """Of a truncated SVD."""

    slope_noise: float = 0.05
    """1 σ of one slope in one frame: of a MAP inversion, and of a star of unknown magnitude."""

    wind_m_s: float = 15.0
    """At which the expected loss of a reconstructor is computed."""

    cache: Path | None = None
    """Folder of what is prepared once; None: it is computed every time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """What the service must know of the model to check telemetry against it."""

    n_slopes: int
    n_modes: int
    mode_variance_m2: NDArray[np.float64]
    """``(n_modes,)`` expected variance of each mode under the instrument's turbulence."""

    actuators: Actuators | None = None
    """None: the modes are measured surfaces, and nobody knows the actuators behind them."""

    mode_information: NDArray[np.float64] | None = None
    """``(n_modes, 4, 4)`` what a dither of each mode tells of α; None: not worked out."""

    start: Misregistration = field(default_factory=Misregistration)
    """Where a fit starts while nothing is known of α: the mirror's nominal rotation."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Made:
    """A reconstructor and the gate's verdict on it."""

    matrix: NDArray[np.float32]
    """``(n_modes, n_slopes)`` metres per slope."""

    condition_number: float
    gate: GateVerdict
    why_fewer: str = ""
    """What the gate said of more modes, where it has fewer than were asked for."""
