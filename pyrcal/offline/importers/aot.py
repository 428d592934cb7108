"""From an AOT file: telescope, the first sensor, and the loop that has an interaction matrix.

Reading one needs ``aotpy``, the extra ``aot``. AOT has no unit of commands: strokes are unknown.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pyrcal.offline.importers.files import Reported, from_arrays
from pyrcal.offline.importers.imported import Array, Imported
from service.errors import ConfigurationError, MatrixError

SENSORS = {"Pyramid": "pyramid", "ShackHartmann": "shack-hartmann"}
"""AOT's classes, and kinds of sensors."""


def from_aot(path: Path, reported: Reported) -> Imported:
    """Return what an AOT file says of its system.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed.
    MatrixError
        If the file cannot be read, or has no loop with an interaction matrix.
    """
    try:
        import aotpy
    except ImportError as error:
        raise ConfigurationError(
            f"{path}: AOT files need aotpy: pip install 'pyrcal[aot]'"
        ) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # aotpy warns of whatever a file leaves empty
            system = aotpy.AOSystem.read_from_file(path)
    except Exception as error:  # aotpy does not export its own class
        raise MatrixError(f"{path}: found {error}, expected an AOT file") from error
    loops = [loop for loop in system.loops if getattr(loop, "interaction_matrix", None)]
    if len(loops) != 1:
        raise MatrixError(
            f"{path}: found {len(loops)} loops with an interaction matrix, expected one"
        )
    (loop,) = loops
    sensor, mirror = loop.input_sensor, loop.commanded_corrector
    kind = SENSORS.get(type(sensor).__name__)
    if kind is None or sensor.subaperture_mask is None:
        raise MatrixError(
            f"{path}: found a {type(sensor).__name__}, expected {' or '.join(SENSORS)} with its "
            "subaperture_mask"
        )
    arrays = {
        "matrix": _whole(loop.interaction_matrix.data),
        "valid": np.asarray(sensor.subaperture_mask.data) >= 0,
        **_mirror(mirror, loop),
    }
    telescope = system.main_telescope
    diameter_m = telescope.enclosing_diameter or reported.diameter_m
    return from_arrays(
        f"AOT, {path}",
        arrays,
        replace(
            reported,
            sensor=kind,
            diameter_m=diameter_m,
            obscuration_ratio=(telescope.obstruction_diameter or 0.0) / diameter_m
            or reported.obscuration_ratio,
            wavelength_m=sensor.wavelength or reported.wavelength_m,
        ),
    )


def _mirror(mirror: Any, loop: Any) -> dict[str, Array]:  # noqa: ANN401 - aotpy's own classes
    found: dict[str, Array] = {}
    if mirror.influence_function is not None:
        found["modes"] = np.asarray(mirror.influence_function.data)
    elif mirror.actuator_coordinates:
        found["positions"] = np.array([[at.x, at.y] for at in mirror.actuator_coordinates])
    if loop.modes_to_commands is not None:
        found["mode_to_actuator"] = np.asarray(loop.modes_to_commands.data)
    return found


def _whole(values: Any) -> Array:  # noqa: ANN401 - aotpy has no types
    """Return AOT's matrix ``(2, n_valid, n_modes)`` or flat with all x first."""
    matrix = np.asarray(values)
    return matrix.reshape(-1, matrix.shape[-1]) if matrix.ndim == 3 else matrix
