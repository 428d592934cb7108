"""A small instrument whose model takes milliseconds, the full one, and a linear closed loop."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.control.reconstructor import invert
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockInPlan
from service.estimation.windows import ClosedLoop
from service.files.disk_cache import DiskCache, usual_folder
from service.instrument.mirrors import rings
from service.instrument.reader import load_instrument
from service.model.instrument import Instrument, Mirror
from service.model.interaction import InteractionModel, Linearisation
from service.model.kinds import Influence, InfluenceShape, KarhunenLoeve, Stop
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.model.sensors.pyramid.description import Pyramid

Array = NDArray[Any]

FRAME_RATE_HZ = 1000.0
DT_NS = 1_000_000
T0_NS = 1_700_000_000_000_000_000

N_MODES = 40
N_CONTROLLED = 30
"""Of the small instrument; the ten others are free for the dither."""

SOMEWHERE = Misregistration(
    shift_x_subap=0.11, shift_y_subap=-0.07, rotation_rad=np.deg2rad(0.4), magnification=1.004
)
"""A registration with nothing in common with a grid point, a symmetry or α = 0."""


def small_instrument(
    positions_m: Array | None = None,
    *,
    stop: Stop = Stop.MIRROR,
    influence: Influence = Influence.THIN_PLATE,
    n_modes: int = N_MODES,
    pupil_diameter_subap: float | None = None,
    obscuration_ratio: float = 0.1,
    turbulence: KarhunenLoeve | None = None,
) -> Instrument:
    """An 8 m telescope with 12 subapertures and, unless told otherwise, 105 actuators on rings."""
    return Instrument(
        name="small",
        diameter_m=8.0,
        obscuration_ratio=obscuration_ratio,
        stop=stop,
        wfs=Pyramid(
            n_subapertures=12,
            wavelength_m=750e-9,
            modulation_lambda_over_d=3.0,
            pupil_separation_subap=15.0,
            pupil_diameter_subap=pupil_diameter_subap,
        ),
        mirror=Mirror(
            positions_m=rings(1, 5, 0.8) if positions_m is None else positions_m,
            pitch_m=0.8,
            shape=InfluenceShape(influence=influence),
        ),
        modes=replace(turbulence or KarhunenLoeve(), n_modes=n_modes),
    )


@cache
def small_basis() -> ModalBasis:
    return karhunen_loeve_basis(small_instrument())


@cache
def small_model(
    stop: Stop = Stop.MIRROR, *, nodes: int = 3, double: bool = False
) -> InteractionModel:
    """The small instrument's model; ``double``: in float64, for derivative checks."""
    return InteractionModel(
        small_instrument(stop=stop),
        small_basis(),
        detector_nodes=nodes,
        dtype=np.float64 if double else np.float32,
    )


@cache
def small_linearisation() -> Linearisation:
    """The small instrument's D and derivatives at α = 0."""
    return small_model().linearise(Misregistration())


@cache
def flao_basis() -> ModalBasis:
    """Seconds of work, kept on disk for whatever process asks next."""
    basis = DiskCache(usual_folder(os.environ)).basis(load_instrument("flao-lbt"))
    assert isinstance(basis, ModalBasis)
    return basis


@cache
def flao_model() -> InteractionModel:
    return InteractionModel(load_instrument("flao-lbt"), flao_basis())


@cache
def flao_matrix() -> Array:
    """D of the full instrument at α = 0, ``(1408, 594)``."""
    return flao_model().interaction_matrix(Misregistration())


def block_of(
    slopes: Array, commands: Array, dither: Array | None, first_seq: int = 0
) -> FrameBlock:
    """Frames as the bridge would deliver them."""
    return FrameBlock(
        session="night-1",
        first_seq=first_seq,
        t0_ns_utc=T0_NS + first_seq * DT_NS,
        dt_ns=DT_NS,
        slopes=slopes.astype(np.float32),
        commands_m=commands.astype(np.float32),
        dither_m=None if dither is None else dither.astype(np.float32),
        cm_id="cm-1",
    )


def part(block: FrameBlock, start: int, stop: int) -> FrameBlock:
    """Rows ``start`` to ``stop`` as a block of their own."""
    rows = slice(start, stop)
    return replace(
        block,
        first_seq=block.first_seq + start,
        t0_ns_utc=block.t0_ns_utc + start * block.dt_ns,
        slopes=block.slopes[rows],
        commands_m=block.commands_m[rows],
        dither_m=None if block.dither_m is None else block.dither_m[rows],
    )


def sines(plan: LockInPlan, n_frames: int, n_modes: int = N_MODES) -> Array:
    """The plan's dither ``(n_frames, n_modes)``, as the wire defines it."""
    frames = np.arange(n_frames)
    dither = np.zeros((n_frames, n_modes))
    for mode, frequency, amplitude in zip(
        plan.modes, plan.frequencies_hz, plan.amplitude_m, strict=True
    ):
        turns = frequency / plan.frame_rate_hz * frames
        dither[:, mode] += amplitude * np.sqrt(2.0) * np.sin(2 * np.pi * turns)
    return dither


@dataclass(frozen=True, slots=True, kw_only=True)
class Sky:
    """What the small loop looks at."""

    alpha: Misregistration = SOMEWHERE
    """Where the mirror really is."""

    optical_gain: float = 0.7
    noise: float = 2e-3
    """RMS of each slope."""

    turbulence: float = 0.03
    """Of the amplitude of the instrument's 1 arcsec seeing."""

    memory: float = 0.9
    """Correlation of the turbulence from one frame to the next."""

    seed: int = 1


@cache
def small_matrix(alpha: Misregistration) -> Array:
    """D of the small instrument there, ``(n_slopes, 40)``."""
    return _kept(small_model().interaction_matrix(alpha))


@cache
def small_reconstructor(alpha: Misregistration) -> Array:
    """What was computed for ``alpha``."""
    return _kept(invert(small_matrix(alpha), N_CONTROLLED).matrix)


def _kept(matrix: Array) -> Array:
    """The same, for all who ask."""
    matrix.flags.writeable = False
    return matrix


def small_loop(
    *, gain: float = 0.3, leak: float = 0.999, alpha: Misregistration | None = None
) -> ClosedLoop:
    """A loop whose reconstructor was computed for ``alpha``, by default perfect registration."""
    gains = np.zeros(N_MODES)
    gains[:N_CONTROLLED] = gain
    return ClosedLoop(
        reconstructor=small_reconstructor(alpha or Misregistration()),
        gains=gains,
        leak=leak,
        delay_frames=2.0,
        frame_rate_hz=FRAME_RATE_HZ,
    )


def closed_loop(loop: ClosedLoop, sky: Sky, dither: Array) -> FrameBlock:
    """Run ``c[k+2] = leak c[k+1] - gain R s[k]`` on AR(1) turbulence, with the dither added.

    The first 200 frames, in which the loop closes, are run before the block begins.
    """
    settling = 200
    rng = np.random.default_rng(sky.seed)
    n_frames = len(dither) + settling
    added = np.vstack([np.zeros((settling, N_MODES)), dither])
    sensor = sky.optical_gain * small_matrix(sky.alpha).astype(float)
    fresh = np.sqrt(1 - sky.memory**2) * rng.normal(size=(n_frames, N_MODES))
    wave = scipy.signal.lfilter([1.0], [1.0, -sky.memory], fresh, axis=0)
    wave *= sky.turbulence * np.sqrt(small_basis().variance_m2)
    outside = wave @ sensor.T + sky.noise * rng.normal(size=(n_frames, len(sensor)))
    back = -loop.gains[:N_CONTROLLED, None] * loop.reconstructor.astype(float)
    # what the loop adds to its command by itself, and by what it has done: slopes come all at once
    given = (outside + added @ sensor.T) @ back.T
    own = back @ sensor[:, :N_CONTROLLED]
    controlled = np.zeros((n_frames + 2, N_CONTROLLED))
    for k in range(n_frames):
        controlled[k + 2] = loop.leak * controlled[k + 1] + given[k] + own @ controlled[k]
    commands = added.copy()
    commands[:, :N_CONTROLLED] += controlled[:n_frames]
    slopes = outside + commands @ sensor.T
    return block_of(slopes[settling:], commands[settling:], dither)
