"""The mirror of an import: its table of the instrument file, its arrays, its unusable actuators."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pyrcal.importers.imported import UNKNOWN, Array, in_arrays_file, orient_matrix
from pyrcal.importers.layouts import cube_of
from service.errors import MatrixError
from service.model.defects import Defect, explain_defects, find_defects


@dataclass(slots=True, kw_only=True, eq=False)
class Mirror:
    """An imported mirror, and its unusable modes."""

    n_modes: int
    n_actuators: int
    table: dict[str, Any]
    """Keys of ``[mirror]``."""

    arrays: dict[str, Array]
    per_mode: tuple[str, ...] = ()
    """Arrays with one entry for each mode along their first axis."""

    defects: dict[int, Defect] = field(default_factory=dict)
    """Unusable modes by number, with the reason."""

    @property
    def is_zonal(self) -> bool:
        """True if a mode is a single actuator."""
        return self.table.get("basis") == "zonal"

    def become_modal(self, n_modes: int) -> None:
        """Replace the actuators by modes that pyrcal computes from them."""
        del self.table["basis"]
        self.n_modes, self.per_mode, self.defects = n_modes, (), {}

    def keep(self, modes: Array) -> None:
        """Remove all but these modes of the basis."""
        for name in self.per_mode:
            values = self.arrays[name]
            # Of all these arrays only this one has a column, not a row, for each mode.
            along_columns = name == "mode_to_actuator"
            self.arrays[name] = values[:, modes] if along_columns else values[modes]
        self.n_modes = len(modes)


def read_mirror(
    source: str, arrays: Mapping[str, Array], diameter_m: float, notes: list[str]
) -> Mirror:
    """Return the mirror described by actuator positions or by a cube of shapes.

    Raises
    ------
    MatrixError
        If there is neither, or their shapes do not belong together.
    """
    strokes = arrays.get("mode_to_actuator")
    if "positions" in arrays:
        mirror = _read_positions(arrays["positions"], notes)
    elif "modes" in arrays:
        mirror = _read_shapes(arrays["modes"], diameter_m, is_basis=strokes is None, notes=notes)
    else:
        raise MatrixError(
            f"{source}: found neither modes nor positions of actuators, expected one of the two; a "
            "list of actuators does not say where they are: give positions=FILE, (n_actuators, 2)"
        )
    if strokes is not None:
        combine(mirror, strokes, notes)
    return mirror


def _read_positions(given: Array, notes: list[str]) -> Mirror:
    longer = max(np.shape(given), default=0)
    places = orient_matrix(given, longer, 2, "positions", "(n_actuators, 2)", notes)
    for number, reason in find_defects(places).items():
        # A place of zeros is no defect: it is the actuator in the middle.
        if isinstance(reason, int):
            raise MatrixError(
                f"positions: found actuator {number} where {reason} is, "
                "expected a place of its own for each"
            )
    # On a line every rotation about it fits: a registration cannot be measured.
    if np.linalg.matrix_rank(places - places.mean(axis=0), tol=1e-6 * np.ptp(places)) < 2:
        raise MatrixError(
            f"positions: found {len(places)} actuators on one line, expected their places in the "
            "plane of the mirror"
        )
    return Mirror(
        n_modes=len(places),
        n_actuators=len(places),
        table={
            "basis": "zonal",
            "layout": "positions",
            "positions": in_arrays_file("positions"),
            "influence": "gaussian",
            "coupling": UNKNOWN,
        },
        arrays={"positions": places},
        per_mode=("positions",),
    )


def _read_shapes(given: Array, diameter_m: float, *, is_basis: bool, notes: list[str]) -> Mirror:
    cube = cube_of(given, notes)
    # Not "modes": that name in matrix.h5 is of the basis index of each column.
    key, name = ("modes", "mode_shapes") if is_basis else ("influence_functions",) * 2
    return Mirror(
        n_modes=len(cube),
        n_actuators=len(cube),
        table={key: in_arrays_file(name), "modes_pitch_m": diameter_m / cube.shape[1]},
        arrays={name: cube},
        per_mode=(name,),
        defects=find_defects(cube),
    )


def combine(mirror: Mirror, strokes: Array, notes: list[str]) -> None:
    """Make the mirror's modes combinations of its actuators, without unusable ones."""
    n_actuators, shape = mirror.n_actuators, "(n_actuators, n_modes)"
    # One unusable mode must not make the others unusable: it is left out later, with its number.
    commands = orient_matrix(
        strokes, n_actuators, None, "mode_to_actuator", shape, notes, broken_entries=True
    ).astype(np.float64)
    if commands.shape[1] > n_actuators:
        raise MatrixError(
            f"mode_to_actuator: found {commands.shape[1]} modes of {n_actuators} actuators, "
            "expected no more modes than actuators"
        )
    if mirror.defects:
        # A mode is a sum over all actuators, so these are left out of every mode, not as modes.
        notes += explain_defects(mirror.defects, "influence function")
        kept = np.array([k for k in range(n_actuators) if k not in mirror.defects])
        for name in mirror.per_mode:
            mirror.arrays[name] = mirror.arrays[name][kept]
        commands = commands[kept]
    mirror.table.pop("basis", None)
    mirror.table["mode_to_actuator"] = in_arrays_file("mode_to_actuator")
    mirror.arrays["mode_to_actuator"] = commands
    mirror.per_mode = ("mode_to_actuator",)
    mirror.n_modes = commands.shape[1]
    mirror.defects = find_defects(commands.T)
