"""Import SPECULA's FITS files, which SynIM also writes, and export to them.

Files are recognised by their contents. Neither program is imported. The layouts were read from
SPECULA 1.1.0 and SynIM 2.0.0:

- ``Intmat`` is ``[slopes, modes]``, in older files ``[modes, slopes]``; the number of subapertures
  distinguishes them. Slopes are all x, then all y, unless the file has ``INTRLVD``.
- Subapertures are in the order of ``PupData.ind_pup`` or ``SubapData.idxs``, which may differ from
  that of the mask's rows.
- Commands are nanometres, and ``sign = -1`` of its mirrors is one sign of all slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pyrcal.fitting.specula import Subapertures, read_subapertures
from pyrcal.importers.files import Reported, from_arrays
from pyrcal.importers.imported import Array, Imported, orient_matrix
from service.errors import MatrixError
from service.files.container import Container, opened

UNIT = "nm"
"""Unit of SPECULA's commands."""

LENSLETS = (
    "slopes of lenslets are shares of half their field, which these files do not give: the strokes "
    "are taken as unknown"
)


def from_specula(
    paths: Sequence[str | Path], reported: Reported, source: str = "SPECULA"
) -> Imported:
    """Import an ``Intmat``, its ``PupData`` or ``SubapData``, and an ``IFunc``.

    Without a unit in ``reported`` commands are nanometres, as SPECULA's are. With an ``M2C`` among
    the files, modes are combined from the influence functions.

    Raises
    ------
    MatrixError
        If one of them is missing or present twice, or a file is something else.
    """
    reported = replace(reported, unit=reported.unit or UNIT)
    found: dict[str, Array] = {}
    places: Subapertures | None = None
    kind = reported.kind
    interleaved, notes = False, list[str]()
    for path in map(Path, paths):
        with opened(path) as container:
            if "fsizex" in container.facts or "np_sub" in container.facts:
                # Only PupData has FSIZEX, only SubapData NP_SUB.
                places = read_subapertures(container)
                kind = "shack-hartmann" if "np_sub" in container.facts else "pyramid"
                continue
            role, values = _role_of(container, notes)
            if role in found:
                raise MatrixError(f"{path}: found a second {role}, expected one")
            found[role] = values
            interleaved |= bool(container.facts.get("intrlvd", False))
    if places is None or "matrix" not in found:
        missing = "PupData or SubapData" if places is None else "Intmat"
        raise MatrixError(f"{source}: found no {missing}, expected one among the files")
    # Older files are transposed: only the number of subapertures says which axis is which.
    matrix = orient_matrix(
        found["matrix"], 2 * len(places.rows), None, "Intmat", "(n_slopes, n_modes)", notes
    )
    n_modes = matrix.shape[1]
    both = (
        np.moveaxis(matrix.reshape(-1, 2, n_modes), 1, 0)
        if interleaved
        else matrix.reshape(2, -1, n_modes)
    )
    found["matrix"] = both[:, places.by_rows].reshape(matrix.shape)
    found["valid"] = places.mask
    if reported.sensor not in {None, kind}:
        raise MatrixError(
            f"{source}: found the subapertures of a {kind}, expected those of a {reported.sensor}, "
            "as --sensor says"
        )
    # SPECULA's pyramid counts x along the rows of its mask.
    order = "yx" if kind == "pyramid" else "xy"
    if kind != "pyramid" and reported.unit is not None:
        notes.append(LENSLETS)
        reported = replace(reported, unit=None)
    imported = from_arrays(source, found, replace(reported, order=order, sensor=kind))
    if not np.array_equal(places.by_rows, np.arange(len(places.rows))):
        notes.append("subapertures were not listed row by row: sorted")
    return imported.with_notes(*notes)


def from_synim(paths: Sequence[str | Path], reported: Reported) -> Imported:
    """Import the same files as SynIM writes them: its slopes of lenslets are mean gradients.

    Raises
    ------
    MatrixError
        As ``from_specula``.
    """
    return from_specula(paths, replace(reported, centroid="gradient"), "synim")


def _role_of(container: Container, notes: list[str]) -> tuple[str, Array]:
    """Return the role of a file's array, and its numbers."""
    matrix, functions = container.find("INTMAT"), container.find("INFLUENCE_FUNCTION")
    if matrix is not None:
        return "matrix", matrix.numbers()
    if functions is not None:
        return "modes", _cube(container, functions.numbers(), notes)
    # An M2C has no name of its own in the file.
    arrays = [stored for stored in container.arrays.values() if len(stored.shape) == 2]
    if len(arrays) != 1:
        raise MatrixError(
            f"{container.path}: found {container.listing()}, expected SPECULA's Intmat, PupData, "
            "SubapData, IFunc or M2C"
        )
    return "mode_to_actuator", arrays[0].numbers()


def _cube(container: Container, functions: Array, notes: list[str]) -> Array:
    """Return an ``IFunc`` as maps with NaN outside its mask: it holds only the points inside."""
    stored = container.find("MASK_INF_FUNC")
    if stored is None:
        raise MatrixError(
            f"{container.path}: found INFLUENCE_FUNCTION without MASK_INF_FUNC, expected both"
        )
    inside = stored.numbers() > 0.0
    shape = "(n_points, n_functions)"
    values = orient_matrix(functions, int(inside.sum()), None, "INFLUENCE_FUNCTION", shape, notes)
    cube = np.full((values.shape[1], *inside.shape), np.nan, dtype=np.float32)
    cube[:, inside] = values.T
    return cube
