"""What leaves the computer: batches of frames, and what it says of itself."""

from __future__ import annotations

import uuid
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.wire import DitherStatus, Loop
from sim_rtc.dither import DitherLimits
from sim_rtc.plant import TelescopeOptics
from sim_rtc.reconstructors import Reconstructor

Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """How the loop is run; replaced as a whole."""

    frame_rate_hz: float
    delay_frames: int
    """Frames from an exposure to the first command that answers it."""

    gains: tuple[float, ...]
    """One per mode of the basis; the controlled ones are used."""

    leak: float
    """Per frame; 1 forgets nothing."""

    closed: bool = True
    n_controlled_next: int
    """What a command has asked for; takes effect with the next matrix of that many rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Names the telemetry carries."""

    system: str
    basis_id: str
    config_id: str
    double_pass: bool = False
    """Whether the light sees the mirror twice, as with a retro-reflector by day."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """One batch of frames as it leaves the loop, and what only the simulator knows of it."""

    session: str
    seq0: int
    slopes: Array32
    """``(n_frames, n_slopes)``."""

    commands_m: Array32
    """``(n_frames, n_modes)``, dither included, after clipping."""

    dither_m: Array32 | None
    """``(n_frames, n_modes)``; None without dither."""

    cm_id: str
    """The matrix that multiplied these slopes."""

    n_clipped: int
    """Commands that met the stroke limit."""

    closed: bool
    n_controlled: int
    optics: TelescopeOptics
    """The truth: never on the wire."""

    phase_m: Array32
    """``(n_points,)`` turbulence OPD during the first frame: never on the wire."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """What the computer says about itself."""

    session: str
    seq: int
    """Last frame processed; -1 before the first."""

    settings: LoopSettings
    loop: Loop
    gains: tuple[float, ...]
    """One per mode, 0 where uncontrolled."""

    reconstructor: Reconstructor
    dither: DitherStatus | None
    limits: DitherLimits
    images: NDArray[np.float64]
    """``(2, n, 2, n)`` share of the light in every pixel."""


def new_session() -> str:
    """Return a name no other session has."""
    return uuid.uuid4().hex[:16]
