"""From a loop of cacao's: its FITS cubes ``CMmodesDM`` and ``CMmodesWFS``, and its masks.

The cubes carry no units: strokes are unknown, and only shapes are compared.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pyrcal.offline.importers.files import Reported, from_arrays
from pyrcal.offline.importers.imported import Array, Imported
from service.errors import MatrixError
from service.files.container import opened

NAMES = {"modesWFS": "matrix", "modesDM": "modes", "wfsmask": "valid", "dmmask": "actuators"}
"""What the names of its files contain, and what those are for."""


def from_cacao(folder: Path, reported: Reported) -> Imported:
    """Return the modes and the response of a folder ``conf`` of cacao's.

    Raises
    ------
    MatrixError
        If a file is missing or there are several, or shapes do not belong together.
    """
    found = {role: _read(folder, part) for part, role in NAMES.items() if part != "wfsmask"}
    if any(folder.rglob("*wfsmask*.fits")):
        found["valid"] = _read(folder, "wfsmask")
    modes, actuators = np.asarray(found.pop("modes")), np.asarray(found.pop("actuators")) > 0
    if modes.shape[1:] != actuators.shape:
        raise MatrixError(
            f"{folder}: found modesDM {modes.shape} and dmmask {actuators.shape}, expected "
            "(n_modes, ny, nx) and (ny, nx)"
        )
    row, column = np.nonzero(actuators)
    across = max(actuators.shape)
    pitch_m = reported.diameter_m / (across - 1)
    middle = (np.array(actuators.shape[::-1]) - 1) / 2
    found["positions"] = (np.column_stack([column, row]) - middle) * pitch_m
    found["mode_to_actuator"] = modes[:, actuators].T
    return from_arrays(f"cacao, {folder}", found, reported).noted(
        f"the pitch of the actuators is unknown: {pitch_m:.4g} m, so that {across} of them span "
        "diameter_m; the magnification that a fit finds tells"
    )


def _read(folder: Path, part: str) -> Array:
    paths = sorted(folder.rglob(f"*{part}*.fits"))
    if len(paths) != 1:
        raise MatrixError(f"{folder}: found {len(paths)} files *{part}*.fits, expected one")
    with opened(paths[0]) as container:
        if len(container.arrays) != 1:
            raise MatrixError(f"{paths[0]}: found {container.listing()}, expected one array")
        (stored,) = container.arrays.values()
        values = stored.numbers()
        return values[0] if values.ndim == 3 and len(values) == 1 else values
