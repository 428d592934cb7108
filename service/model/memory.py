"""Memory and work that an instrument's matrices take, estimated before anything is computed."""

from __future__ import annotations

import numpy as np

from service.model.far_field import SERIES_DEGREE
from service.model.far_field import TILE_SUBAP as PLATE_TILE_SUBAP
from service.model.instrument import Instrument, Mirror
from service.model.karhunen_loeve import WHOLE_BYTES
from service.model.local import TILE_SUBAP
from service.model.pupil import PupilGrid
from service.model.sensors.sensor import Sensor, Work
from service.model.surface import Gaussian, mirror_surface

GB = 1e9

PROGRAM_BYTES = 0.13e9
"""Python with its libraries."""

_N_MATRICES = 5
"""D and its four derivatives."""

_STATISTICS_COPIES = 7.5
"""Squares of the actuators, float64, while KL modes are made of functions known tile by tile."""


def work_of(
    instrument: Instrument, sensor: Sensor, pupil: PupilGrid, *, n_matrices: int = _N_MATRICES
) -> Work:
    """Return what the modes, and then D with its four derivatives, take at their largest.

    All in one thread, the program included; its libraries may keep a little more. ``n_matrices`` is
    1 where D is wanted alone.
    """
    n_points, n_modes = float(pupil.lit.sum()), instrument.modes.n_modes
    kept, making = _of_modes(instrument)
    n_functions, near = _functions(instrument)
    by_tiles = n_points * near + float(n_functions * n_modes)
    product = 2.0 * sensor.n_signals * min(by_tiles, n_points * n_modes)
    # Without a kept gradient all shapes are measured at once, and have to exist at once.
    together = 1 if sensor.keeps_gradient else n_matrices
    if by_tiles < n_points * n_modes:
        shapes = 4.0 * n_functions * n_modes + 12.0 * together * n_points * near
    else:
        shapes = 20.0 * n_points * n_modes
    results = n_matrices * 4.0 * sensor.n_signals * n_modes
    response = sensor.work(0)
    linearising = kept + results + max(response.memory_bytes + shapes, results)
    return Work(
        memory_bytes=PROGRAM_BYTES + max(making, linearising),
        flop=response.flop + n_matrices * product,
    )


def _of_modes(instrument: Instrument) -> tuple[float, float]:
    """Return bytes of the modes as they are kept, and while they are made."""
    mirror = instrument.mirror
    if not isinstance(mirror, Mirror):
        if mirror.cube is not None:
            return 2.0 * mirror.cube.nbytes, 3.0 * mirror.cube.nbytes
        n_functions, _ = _functions(instrument)
        kept = 12.0 * n_functions * instrument.modes.n_modes
        return kept, kept + _STATISTICS_COPIES * 8.0 * n_functions**2
    n_actuators = float(len(mirror.positions_m))
    surface = mirror_surface(mirror, instrument.subaperture_m)
    local = isinstance(surface, Gaussian)
    kept = (1.0 if local else 2.0) * 8.0 * n_actuators * instrument.modes.n_modes
    area = np.pi / 4 * instrument.wfs.pupil_diameter**2
    if not local:
        kept += (
            8.0 * 4 * (SERIES_DEGREE + 1) * instrument.modes.n_modes * area / PLATE_TILE_SUBAP**2
        )
    n_points = 9.0 * area
    whole = 8.0 * n_points * n_actuators
    if local and whole >= WHOLE_BYTES:
        return kept, kept + _STATISTICS_COPIES * 8.0 * n_actuators**2
    n_modes = instrument.modes.n_modes
    tables = max(3.3 * n_actuators, 3.0 * (4 / 3) ** 2 * n_modes)
    return kept, kept + 8.0 * (n_points * tables + 3.0 * n_actuators**2)


def _functions(instrument: Instrument) -> tuple[int, float]:
    """Return how many functions the modes are made of, and how many reach a tile, about."""
    mirror = instrument.mirror
    if isinstance(mirror, Mirror):
        surface = mirror_surface(mirror, instrument.subaperture_m)
        n_functions = len(mirror.positions_m)
        near = float(n_functions)
        if isinstance(surface, Gaussian):
            near = _area_within(surface.reach) / surface.pitch**2
    elif mirror.local is None:
        n_functions, near = instrument.modes.n_modes, float(instrument.modes.n_modes)
    else:
        step = mirror.pitch_m / instrument.subaperture_m
        n_functions, n_samples = mirror.local.n_functions, len(mirror.local.heights)
        reach = step * (float(np.sqrt(n_samples / n_functions / np.pi)) + 4.0)
        near = _area_within(reach) / (np.pi / 4 * instrument.wfs.pupil_diameter**2 / n_functions)
    return n_functions, float(min(n_functions, near))


def _area_within(reach: float) -> float:
    """Return the area within this distance of a tile, subapertures."""
    return float(TILE_SUBAP**2 + 4 * TILE_SUBAP * reach + np.pi * reach**2)
