"""A closed loop of 90 modes in NumPy, for the figures of the manual.

The telescope is that of ``tests/system/small.toml``: 3 m, 12 subapertures, a pyramid. The plant is
the model's own D at the true registration, so these loops show effects and not accuracy. The
turbulence is autoregressive, 300 nm RMS in 90 modes, with a correlation time of 0.1 s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

import pyrcal
from service.control.expected_gain import compute_radial_orders
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]
BENCH = "tests/system/small.toml"
N_MODES = 90
TURBULENCE_M = 300e-9
CORRELATION = 0.99
"""Correlation of the turbulence from one frame to the next."""

SLOPE_NOISE = 0.01
"""1 σ of one slope in one frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A loop to run."""

    alpha: Misregistration
    """True registration."""

    matrix: Misregistration
    """Registration for which the reconstructor was computed."""

    n_modes: int
    gain: float = 0.5
    leak: float = 0.999
    rate_hz: float = 1000.0
    n_frames: int = 3000
    matrix_noise: float = 0.0
    """Noise of a measured matrix, over the norm of each column."""

    dither_nm: float = 0.0
    dither_modes: tuple[int, ...] = (66, 72, 79, 85)
    dither_hz: tuple[float, ...] = (211.0, 239.0, 283.0, 331.0)
    swaps: Mapping[int, Misregistration] = field(default_factory=dict)
    """Frame at which a reconstructor for another registration is swapped in."""

    moving: Callable[[float], Misregistration] | None = None
    """True registration at a time in seconds, instead of ``alpha``."""

    seed: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """What a loop left behind."""

    slopes: Array
    """``(n_frames, n_slopes)``"""

    commands_m: Array
    """``(n_frames, 90)`` total command on the mirror, dither included."""

    dither_m: Array
    residual_m: Array
    """``(n_frames, 90)`` turbulence plus mirror."""

    response: Array
    """True D at the last frame."""

    reconstructor: Array

    def wavefront_nm(self) -> float:
        """Return the RMS of the residual over all modes, without the first half second."""
        settled = self.residual_m[500:]
        return float(1e9 * np.sqrt((settled**2).sum(axis=1).mean()))


@cache
def _model() -> tuple[Instrument, pyrcal.RtcInteractionModel]:
    instrument = pyrcal.load_instrument(BENCH)
    return instrument, pyrcal.RtcInteractionModel(instrument, pyrcal.modal_basis(instrument))


def _inverse(alpha: Misregistration, case: Case, rng: np.random.Generator) -> Array:
    matrix = np.asarray(_model()[1].interaction_matrix(alpha), dtype=float)
    if case.matrix_noise:
        noise = rng.normal(size=matrix.shape)
        noise *= case.matrix_noise * np.linalg.norm(matrix, axis=0) / np.linalg.norm(noise, axis=0)
        matrix = matrix + noise
    options = pyrcal.InversionOptions(n_modes=case.n_modes)
    return np.asarray(pyrcal.reconstruct(matrix, options).matrix, dtype=float)


def run(case: Case) -> Loop:
    """Run a loop with a delay of two frames."""
    rng = np.random.default_rng(case.seed)
    model = _model()[1]
    reconstructor = _inverse(case.matrix, case, rng)
    response = np.asarray(model.interaction_matrix(case.alpha), dtype=float)
    n, n_slopes = case.n_frames, len(response)
    share = compute_radial_orders(N_MODES) ** (-11.0 / 6.0)
    share *= TURBULENCE_M / np.linalg.norm(share)
    time = np.arange(n) / case.rate_hz
    dither = np.zeros((n, N_MODES))
    for mode, f_hz in zip(case.dither_modes, case.dither_hz, strict=True):
        wave = np.sin(2.0 * np.pi * f_hz * time)
        dither[:, mode] = np.sqrt(2.0) * 1e-9 * case.dither_nm * wave
    commands = np.zeros((n + 2, N_MODES))
    slopes, residual = np.zeros((n, n_slopes)), np.zeros((n, N_MODES))
    sky = share * rng.normal(size=N_MODES)
    for k in range(n):
        if k in case.swaps:
            reconstructor = _inverse(case.swaps[k], case, rng)
        if case.moving is not None and k % 1000 == 0:
            response = np.asarray(model.interaction_matrix(case.moving(time[k])), dtype=float)
        kick = np.sqrt(1.0 - CORRELATION**2) * share * rng.normal(size=N_MODES)
        sky = CORRELATION * sky + kick
        residual[k] = sky + commands[k] + dither[k]
        slopes[k] = response @ residual[k] + SLOPE_NOISE * rng.normal(size=n_slopes)
        commands[k + 2] = case.leak * commands[k + 1]
        commands[k + 2, : case.n_modes] -= case.gain * (reconstructor @ slopes[k])
        np.clip(commands[k + 2], -5e-6, 5e-6, out=commands[k + 2])
    return Loop(
        slopes=slopes,
        commands_m=commands[:n] + dither,
        dither_m=dither,
        residual_m=residual,
        response=response,
        reconstructor=reconstructor,
    )


def write_telemetry(path: Path, case: Case, loop: Loop) -> None:
    """Write a loop as the file that ``pyrcal track`` reads."""
    gains = np.zeros(N_MODES)
    gains[: case.n_modes] = case.gain
    np.savez(
        path,
        slopes=loop.slopes.astype(np.float32),
        commands_m=loop.commands_m.astype(np.float32),
        reconstructor=loop.reconstructor.astype(np.float32),
        dither_m=loop.dither_m.astype(np.float32),
        dither_modes=np.array(case.dither_modes),
        dither_frequencies_hz=np.array(case.dither_hz),
        dither_amplitude_m=np.full(len(case.dither_modes), case.dither_nm * 1e-9),
        gains=gains,
        frame_rate_hz=case.rate_hz,
        delay_frames=2.0,
        leak=case.leak,
    )


def moving_mirror(time_s: float) -> Misregistration:
    """Return a registration that drifts, and jumps after 25 s."""
    jump = 1.0 if time_s >= 25.0 else 0.0
    return Misregistration(
        shift_x_subap=0.02 + 0.001 * time_s + 0.12 * jump,
        shift_y_subap=-0.03 - 0.05 * jump,
        rotation_rad=np.deg2rad(0.05 + 0.002 * time_s),
        magnification=1.001,
    )


def tracked_night(seconds: float = 45.0) -> tuple[Array, pyrcal.Track]:
    """Return the truth ``(n, 5)``, time and α in degrees, and what ``pyrcal.track`` finds."""
    case = Case(
        alpha=moving_mirror(0.0),
        matrix=moving_mirror(0.0),
        n_modes=45,
        gain=0.4,
        dither_nm=10.0,
        n_frames=int(seconds * 1000),
        moving=moving_mirror,
    )
    loop = run(case)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "night.npz"
        write_telemetry(path, case, loop)
        track = pyrcal.track(path, BENCH)
    times = np.arange(0.0, seconds, 0.1)
    truth = np.array([[t, *moving_mirror(t).to_boundary().values()] for t in times])
    return truth[:, :5], track
