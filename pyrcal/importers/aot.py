"""Import an AOT file: telescope, sensor and mirror of a loop, its interaction matrix, and α.

This needs ``aotpy``, the extra ``aot``. AOT has no unit of commands, so strokes are unknown.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from pyrcal.importers.files import Reported, from_arrays
from pyrcal.importers.imported import Array, Imported
from pyrcal.importers.registration import Aot, Registrations, registrations_of
from service.errors import ConfigurationError, MatrixError
from service.files.container import opened

SENSORS = {"Pyramid": "pyramid", "ShackHartmann": "shack-hartmann"}
"""Kinds of sensors by AOT's class names."""

_HEADER_BYTES = 20 * 2880
"""Number of leading bytes that must contain the version."""


def import_aotpy() -> Aot:
    """Return the module of the standard.

    Raises
    ------
    ConfigurationError
        If it is not installed.
    """
    try:
        import aotpy
    except ImportError as error:
        raise ConfigurationError(
            "AOT files need aotpy, which is not installed: pip install 'pyrcal[aot]'"
        ) from error
    return aotpy


def read_system(path: Path) -> Aot:
    """Return aotpy's system of a file.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed.
    MatrixError
        If it is no AOT file.
    """
    aotpy = import_aotpy()
    _check(path)
    try:
        with warnings.catch_warnings():
            # aotpy warns of whatever a file leaves empty.
            warnings.simplefilter("ignore")
            system = aotpy.AOSystem.read_from_file(path)
    # aotpy does not export the class of its errors.
    except Exception as error:
        raise MatrixError(f"{path}: found {error}, expected an AOT file") from error
    for part in (*system.wavefront_sensors, *system.wavefront_correctors, *system.loops):
        for name, value in vars(part).items():
            if isinstance(value, aotpy.Image) and value.data is None:
                # An image without data says as little as none.
                setattr(part, name, None)
    return system


def _check(path: Path) -> None:
    """Raise if a file is not an AOT file.

    aotpy's own message suggests unusable options, and it reads the parts of some damaged files
    without end.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(_HEADER_BYTES)
    except OSError as error:
        raise MatrixError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not begins.startswith(b"SIMPLE"):
        raise MatrixError(f"{path}: found no FITS, expected an AOT file")
    if b"AOT-VERS" not in begins:
        raise MatrixError(f"{path}: found FITS without AOT-VERS, expected an AOT file")
    # Opening refuses a damaged file.
    with opened(path):
        pass


def from_aot(
    path: Path, reported: Reported, loop: str | None = None, positions: Array | None = None
) -> Imported:
    """Return the telescope, the sensor, the mirror and the matrix of one loop of an AOT file.

    Parameters
    ----------
    path
        The file.
    reported
        What it does not say.
    loop
        Number of the loop, from 1, or its uid; None if only one has an interaction matrix.
    positions
        ``(n_actuators, 2)`` of a mirror without coordinates and influence functions, metres.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed.
    MatrixError
        If the file cannot be read, or has no such loop with an interaction matrix.
    """
    system = read_system(path)
    chosen = _choose_loop(path, system, loop)
    sensor, mirror = chosen.input_sensor, chosen.commanded_corrector
    kind = SENSORS.get(type(sensor).__name__)
    if kind is None or sensor.subaperture_mask is None:
        raise MatrixError(
            f"{path}: loop {chosen.uid}: found a {type(sensor).__name__}, expected "
            f"{' or '.join(SENSORS)} with its subaperture_mask"
        )
    places = np.asarray(sensor.subaperture_mask.data)
    matrix = _by_rows(chosen.interaction_matrix.data, places, str(path))
    notes: list[str] = []
    arrays = {
        "matrix": matrix,
        "valid": places >= 0,
        **_mirror(mirror, chosen, matrix.shape[1], notes),
    }
    if positions is not None:
        arrays["positions"] = positions
        arrays.pop("modes", None)
    elif "modes" not in arrays and "positions" not in arrays:
        raise MatrixError(
            f"{path}: found no coordinates and no influence functions of the mirror {mirror.uid}, "
            f"which has {mirror.n_valid_actuators} actuators; give --positions FILE, x and y in "
            "metres"
        )
    # What the file says is preferred to what was given: it cannot be mistyped.
    telescope = system.main_telescope
    diameter_m = telescope.enclosing_diameter or reported.diameter_m
    dated = registrations_between(mirror, sensor, diameter_m / max(places.shape), str(path))
    imported = from_arrays(
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
    ).with_notes(*notes)
    if dated is None:
        return imported
    return replace(
        imported,
        tables={**imported.tables, "mirror": {**imported.tables["mirror"], **dated.mirror}},
        arrays={**imported.arrays, **dated.arrays},
    ).with_notes(dated.text)


def _choose_loop(path: Path, system: Aot, wanted: str | None) -> Aot:
    """Return the requested loop, or the only one with an interaction matrix."""
    loops = list(enumerate(system.loops, start=1))
    listed = "; ".join(f"{k} {one.uid} ({_describe_loop(one)})" for k, one in loops) or "none"
    if wanted is not None:
        # The first one only: the uid of one loop may be the number of another.
        loops = [(k, one) for k, one in loops if wanted in {str(k), one.uid}][:1]
        if not loops:
            raise MatrixError(f"{path}: --loop: found {wanted}, expected one of {listed}")
    measured = [one for _, one in loops if getattr(one, "interaction_matrix", None) is not None]
    if len(measured) != 1:
        what = f"{len(measured)} loops" if measured else "no loop"
        raise MatrixError(
            f"{path}: found {what} with an interaction matrix, expected one: choose with --loop: "
            f"{listed}"
        )
    return measured[0]


def _describe_loop(loop: Aot) -> str:
    """Return the contents of a loop as text."""
    matrix = getattr(loop, "interaction_matrix", None)
    sensor = loop.input_sensor
    about = "no interaction matrix" if matrix is None else f"matrix {np.shape(matrix.data)}"
    return f"{type(sensor).__name__} {sensor.uid}, {about}"


def registrations_between(
    mirror: Aot, sensor: Aot, subaperture_m: float, where: str
) -> Registrations | None:
    """Return α of a mirror on a sensor over time; None if the file has none.

    Raises
    ------
    MatrixError
        If it cannot be read, or the sensor is moved as well.
    """
    if mirror.transformation_matrix is None:
        return None
    # α is the mirror on the sensor: a sensor that is moved as well would be counted twice.
    own = sensor.transformation_matrix
    if own is not None and not np.allclose(
        np.moveaxis(np.reshape(own.data, (3, 3, -1)), -1, 0), np.eye(3), rtol=0.0, atol=1e-6
    ):
        raise MatrixError(
            f"{where}: found a transformation_matrix of the sensor, too; expected the mirror's "
            "alone, from its coordinates to the sensor"
        )
    return registrations_of(mirror.transformation_matrix, subaperture_m, where)


def _mirror(mirror: Aot, loop: Aot, n_columns: int, notes: list[str]) -> dict[str, Array]:
    found: dict[str, Array] = {}
    if mirror.influence_function is not None:
        found["modes"] = np.asarray(mirror.influence_function.data)
    elif mirror.actuator_coordinates:
        found["positions"] = np.array([[at.x, at.y] for at in mirror.actuator_coordinates])
    if loop.modes_to_commands is not None:
        strokes = np.asarray(loop.modes_to_commands.data)
        # The standard defines the matrix for actuators; some files have one for modes.
        if strokes.ndim == 2 and n_columns == len(strokes) != strokes.shape[1]:
            notes.append("the matrix is of actuators, as the standard has it: modes are left out")
        else:
            found["mode_to_actuator"] = strokes
    return found


def _by_rows(values: Aot, places: Array, where: str) -> Array:
    """Return AOT's matrix in two dimensions, all x first, subapertures row by row.

    The standard defines ``(n_valid, 2, n)``; ``(2, n_valid, n)`` and two-dimensional ones are
    accepted, too. The mask gives the order of the subapertures.
    """
    listed = places_of(places, where)
    n_valid = len(listed)
    matrix = np.asarray(values)
    if matrix.ndim == 3 and matrix.shape[:2] == (n_valid, 2):
        matrix = np.moveaxis(matrix, 1, 0)
    elif matrix.ndim == 2 and len(matrix) == 2 * n_valid:
        matrix = matrix.reshape(2, n_valid, -1)
    if matrix.ndim != 3 or matrix.shape[:2] != (2, n_valid):
        raise MatrixError(
            f"{where}: interaction_matrix: found shape {matrix.shape}, expected ({n_valid}, 2, n)"
        )
    return matrix[:, listed].reshape(2 * n_valid, -1)


def places_of(places: Array, where: str) -> Array:
    """Return the position of each valid subaperture in AOT's list, row by row.

    Raises
    ------
    MatrixError
        If they are not each of 0 to ``n_valid - 1`` once.
    """
    # In the order of the mask's rows, which is that of pyrcal's slopes.
    listed = places[places >= 0].ravel()
    n_valid = len(listed)
    if n_valid and listed.min() == 1:
        # Some writers count from 1.
        listed = listed - 1
    if places.ndim != 2 or not np.array_equal(np.sort(listed), np.arange(n_valid)):
        raise MatrixError(
            f"{where}: subaperture_mask: expected -1 or the place of each valid subaperture, 0 to "
            f"{n_valid - 1}, once"
        )
    return listed.astype(int)
