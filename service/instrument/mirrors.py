"""The mirror and modes of an instrument file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.files.toml import refuse
from service.instrument.crops import local_functions, modes_of_crops, remarks_on_crops
from service.instrument.schema import MirrorTable, Section
from service.model.defects import NOT_FINITE, ZERO, Defect, explain_defects, find_defects
from service.model.instrument import Mirror, TabulatedModes
from service.model.kinds import BasisKind, Influence, InfluenceShape
from service.model.misregistration import rotation, unit_like
from service.model.surface import segment_of
from service.model.tabulated import (
    ENOUGH_POINTS_PER_SUBAPERTURE,
    MIN_POINTS_PER_SUBAPERTURE,
    known_samples,
)

_KINDS = ("layout", "modes", "influence_functions")

_LAYOUT_KEYS = {
    "rings": {"first_ring", "last_ring", "pitch_m", "ring_actuators", "ring_radii_m"},
    "grid": {"n_across", "pitch_m", "diameter_m"},
    "hexagonal": {"pitch_m", "diameter_m", "hole_m"},
    "positions": {"positions", "pitch_m"},
}

_CROPPED = {"influence_origin", "influence_table"}
_MEASURED = {"modes_pitch_m"} | _CROPPED
_GAUSSIAN = {"coupling", "segments_deg"}
_ANALYTIC = set().union(*_LAYOUT_KEYS.values()) | {"influence", "position_error_pitch"} | _GAUSSIAN

_FOREIGN = {
    "layout": _MEASURED,
    "modes": _ANALYTIC | _CROPPED | {"mode_to_actuator", "basis"},
    "influence_functions": _ANALYTIC,
}
"""Keys that mean nothing to a mirror of each kind."""

_ON_A_GAP = 1e-9
"""Distance from a gap, as a fraction of the mirror's half width, within which an actuator is on it.
"""

_BROKEN_SHARE = 0.1
"""Share of a table that a broken function lacks beyond what the others lack, as outside a pupil."""

_CHUNK = 256
"""Actuators compared with all others at once."""

_UNIT_DECADES = 1.0
"""Powers of ten around a unit that are still recognised as it."""

_LARGEST_TABLE = 5.0
"""Width of a table in pupil diameters, beyond which its pitch is in another unit."""


MirrorSection = Section[MirrorTable]


class Pupil(NamedTuple):
    """Grid and stop of the pupil for a mirror."""

    diameter_m: float
    subaperture_m: float
    """Width of a subaperture in the pupil plane."""

    is_simulated: bool = False
    """True if the matrix is of a simulation, which has few points in a subaperture itself."""


def read_mirror(
    file: MirrorSection, pupil: Pupil
) -> tuple[Mirror | TabulatedModes, tuple[str, ...]]:
    """Return the mirror of a pupil, and notes for its owner.

    Raises
    ------
    ConfigurationError
        One line: a key that contradicts another, is missing, or whose array cannot be used.
    """
    _check_keys(file)
    if file.table.layout is not None:
        mirror, notes = _analytic(file)
        _check_width(file, mirror.positions_m, pupil)
        return mirror, (*notes, *_about_segments(file, mirror))
    return _read_table(file, pupil)


def _read(file: MirrorSection, key: str) -> NDArray[np.floating]:
    """Return the array a key refers to, as float32 where it is no finer, else float64."""
    values = file.array(key)
    # Never finer than the file: double precision of a large table only doubles the memory.
    single = values.dtype.kind == "f" and values.dtype.itemsize <= 4
    return values.astype(np.float32 if single else np.float64, copy=False)


def own_modes(mirror: Mirror | TabulatedModes) -> int | None:
    """Return how many modes the user's own basis has; None where ``[modes]`` decides."""
    if isinstance(mirror, TabulatedModes):
        return mirror.n_modes
    if mirror.mode_to_actuator is not None:
        return int(mirror.mode_to_actuator.shape[1])
    return len(mirror.positions_m) if mirror.basis is BasisKind.ZONAL else None


def _check_keys(file: MirrorSection) -> None:
    table, given = file.table, file.given
    # One source of the surface: two would contradict each other.
    kinds = [kind for kind in _KINDS if getattr(table, kind) is not None]
    if len(kinds) != 1:
        expected = f"one of {', '.join(_KINDS)}"
        refuse(f"{file.path}: mirror", " and ".join(kinds) or "none of them", expected)
    file.refuse_useless(_FOREIGN[kinds[0]], f"together with mirror.{kinds[0]}")
    if table.mode_to_actuator is not None and "basis" in given:
        file.refuse("basis", "it together with mirror.mode_to_actuator", "only one of the two")
    if "modes_kind" in given and table.layout is not None and table.mode_to_actuator is None:
        file.refuse("modes_kind", "it", "it only with own modes")


def _mount(table: MirrorTable) -> dict[str, Any]:
    degrees = table.nominal_rotation_deg
    return {
        "nominal_rotation_rad": None if degrees is None else float(np.deg2rad(degrees)),
        "nominal_anamorphosis": table.nominal_anamorphosis,
        "parity": table.parity,
        "stroke_known": table.stroke == "known",
    }


def _opd(file: MirrorSection, heights: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return what a wavefront sees of these heights: twice a surface."""
    return heights * heights.dtype.type(2) if file.table.modes_kind == "surface" else heights


# --- analytic


def _analytic(file: MirrorSection) -> tuple[Mirror, tuple[str, ...]]:
    table = file.table
    _check_layout_keys(file)
    positions = _LAYOUTS[str(table.layout)](file)
    if len(positions) < 4:
        where = file.where("positions") if table.layout == "positions" else f"{file.path}: mirror"
        expected = "at least 4: tip, tilt and something to correct"
        refuse(where, f"{len(positions)} actuators", expected)
    pair = coincident(positions)
    if pair is not None:
        refuse(
            f"{file.path}: mirror",
            f"actuators {pair[0]} and {pair[1]} in the same place",
            "every actuator in a place of its own",
        )
    strokes, notes = _mode_to_actuator(file, len(positions))
    mirror = Mirror(
        positions_m=positions,
        pitch_m=table.pitch_m or typical_pitch(positions),
        shape=InfluenceShape(influence=table.influence, coupling=table.coupling),
        segments_deg=_segments(file, positions),
        basis=table.basis,
        position_error_pitch=table.position_error_pitch,
        mode_to_actuator=None if strokes is None else _opd(file, strokes).astype(np.float64),
        **_mount(table),
    )
    return mirror, notes


def _about_segments(file: MirrorSection, mirror: Mirror) -> tuple[str, ...]:
    """Return remarks on the modes of a segmented mirror."""
    if not mirror.segments_deg or own_modes(mirror) is not None:
        return ()
    return (
        f"{file.where('segments_deg')}: no mode has a mean step across any of the "
        f"{len(mirror.segments_deg)} gaps: a pyramid hardly sees the segments' differential "
        "pistons, which are neither fitted nor controlled",
    )


def _check_width(file: MirrorSection, positions_m: NDArray[np.float64], pupil: Pupil) -> None:
    """Refuse actuators that cannot be in metres of the pupil plane."""
    # A file in millimetres or in subapertures is off by powers of ten.
    width = float(np.ptp(positions_m, axis=0).max()) / pupil.diameter_m
    if 1.0 / _LARGEST_TABLE < width < _LARGEST_TABLE:
        return
    unit = unit_like(width, _UNIT_DECADES)
    hint = f": they look like {unit}" if unit else ""
    key = "positions" if file.table.layout == "positions" else "pitch_m"
    file.refuse(
        key,
        f"actuators over {width * pupil.diameter_m:.3g} m, {width:.3g} pupil diameters{hint}",
        f"metres in the pupil plane: about diameter_m = {pupil.diameter_m:g}",
    )


def _check_layout_keys(file: MirrorSection) -> None:
    table = file.table
    foreign = set().union(*_LAYOUT_KEYS.values()) - _LAYOUT_KEYS[str(table.layout)]
    for key in sorted(foreign & file.given):
        owners = [f'"{name}"' for name, keys in _LAYOUT_KEYS.items() if key in keys]
        raise ConfigurationError(
            f"{file.where(key)}: belongs to layout = {' or '.join(owners)}, "
            f'found layout = "{table.layout}"'
        )
    if table.influence is not Influence.GAUSSIAN:
        for key in sorted(_GAUSSIAN & file.given):
            raise ConfigurationError(
                f"{file.where(key)}: belongs to influence = "
                f'"gaussian", found influence = "{table.influence}"'
            )


def _segments(file: MirrorSection, positions_m: NDArray[np.float64]) -> tuple[float, ...]:
    """Return where the gaps between segments are, in order; refuse a segment without actuators."""
    # Ascending, because the segment of a point is found by bisection.
    gaps_deg = tuple(sorted(angle % 360.0 for angle in file.table.segments_deg))
    if not gaps_deg:
        return ()
    n_in_each = np.unique(segment_of(positions_m, gaps_deg), return_counts=True)[1]
    if len(gaps_deg) < 2 or len(n_in_each) < len(gaps_deg):
        file.refuse(
            "segments_deg",
            f"gaps at {list(file.table.segments_deg)}, actuators in {len(n_in_each)} segments",
            "at least two gaps, each in a place of its own, and actuators between them",
        )
    return gaps_deg


def _rings(file: MirrorSection) -> NDArray[np.float64]:
    table = file.table
    if table.ring_actuators is not None or table.ring_radii_m is not None:
        return _read_rings(file)
    if table.last_ring < table.first_ring:
        file.refuse("last_ring", str(table.last_ring), f"at least first_ring = {table.first_ring}")
    return rings(table.first_ring, table.last_ring, table.pitch_m or 0.30)


def _read_rings(file: MirrorSection) -> NDArray[np.float64]:
    numbers, radii_m = _mandatory(file, ("ring_actuators", "ring_radii_m"))
    if len(numbers) != len(radii_m):
        file.refuse(
            "ring_radii_m",
            f"{len(radii_m)} radii",
            f"one for each of the {len(numbers)} rings of ring_actuators",
        )
    file.refuse_useless(("first_ring", "last_ring"), "together with mirror.ring_actuators")
    return np.concatenate([ring_of(n, radius) for n, radius in zip(numbers, radii_m, strict=True)])


def _grid(file: MirrorSection) -> NDArray[np.float64]:
    n_across, pitch_m, diameter_m = _mandatory(file, ("n_across", "pitch_m", "diameter_m"))
    return _avoid_gaps(file, grid(n_across, pitch_m, diameter_m))


def _hexagonal(file: MirrorSection) -> NDArray[np.float64]:
    pitch_m, diameter_m = _mandatory(file, ("pitch_m", "diameter_m"))
    return _avoid_gaps(file, hexagonal(pitch_m, diameter_m, file.table.hole_m or 0.0))


def _avoid_gaps(file: MirrorSection, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points of a grid that are not on a gap between segments."""
    kept = np.ones(len(positions_m), dtype=np.bool_)
    for angle in np.deg2rad(file.table.segments_deg):
        along, across = (positions_m @ rotation(angle)).T
        # A gap is a ray from the centre: the opposite half of its line is not one.
        kept &= (np.abs(across) > _ON_A_GAP * np.abs(positions_m).max()) | (along < 0.0)
    return positions_m[kept]


def _read_positions(file: MirrorSection) -> NDArray[np.float64]:
    where = file.where("positions")
    _mandatory(file, ("positions",))
    values = _read(file, "positions")
    if values.ndim != 2 or values.shape[1] != 2:
        turned = " (it looks transposed)" if values.ndim == 2 and len(values) == 2 else ""
        refuse(where, f"shape {values.shape}{turned}", "(n_actuators, 2), x and y in metres")
    if not np.isfinite(values).all():
        refuse(where, "a position that is not finite", "metres in the pupil plane")
    return values.astype(np.float64)


_LAYOUTS: dict[str, Callable[[MirrorSection], NDArray[np.float64]]] = {
    "rings": _rings,
    "grid": _grid,
    "hexagonal": _hexagonal,
    "positions": _read_positions,
}


def _mandatory(file: MirrorSection, keys: tuple[str, ...]) -> tuple[Any, ...]:
    table = file.table
    for key in keys:
        if getattr(table, key) is None:
            raise ConfigurationError(
                f'{file.where(key)}: missing, layout = "{table.layout}" needs {", ".join(keys)}'
            )
    return tuple(getattr(table, key) for key in keys)


def _mode_to_actuator(
    file: MirrorSection, n_actuators: int
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return strokes ``(n_actuators, n_modes)``, those of unusable modes 0, and notes of them."""
    if file.table.mode_to_actuator is None:
        return None, ()
    where = file.where("mode_to_actuator")
    values = _read(file, "mode_to_actuator")
    expected = f"({n_actuators} actuators, n_modes)"
    if values.ndim != 2 or len(values) != n_actuators:
        turned = values.ndim == 2 and values.shape[1] == n_actuators
        hint = " (it looks transposed)" if turned else ""
        refuse(where, f"shape {values.shape}{hint}", expected)
    columns = np.array(values.T, dtype=np.float64)
    # an actuator without a number would be one in all modes
    if not np.isfinite(columns).any(axis=0).all() or not len(columns):
        refuse(where, "no mode, or strokes that are not finite", f"{expected} finite strokes")
    with np.errstate(invalid="ignore"):  # one number that is not finite spoils its whole mode
        defects = find_defects(columns + 0.0 * columns.sum(axis=1, keepdims=True))
    columns[list(defects)] = 0.0
    if not columns.any():
        refuse(where, "no mode that moves an actuator", expected)
    notes = tuple(f"{where}: {note}" for note in explain_defects(defects, "mode"))
    return columns.T, notes


# --- where actuators are


def rings(first_ring: int, last_ring: int, pitch_m: float) -> NDArray[np.float64]:
    """Return actuators on concentric rings, ``(n_actuators, 2)``, x and y in metres.

    Ring k has 6k + 3 actuators at radius (k - 1/2) pitch, the first of each on +x: the layout is
    its own mirror image under y -> -y, so that the modes come out even or odd.
    """
    each = range(first_ring, last_ring + 1)
    return np.concatenate([ring_of(6 * k + 3, (k - 0.5) * pitch_m) for k in each])


def ring_of(n_actuators: int, radius_m: float) -> NDArray[np.float64]:
    """Return actuators evenly spaced on a circle, the first of them on +x, ``(n_actuators, 2)``."""
    angle = 2.0 * np.pi * np.arange(n_actuators) / n_actuators
    return np.asarray(radius_m * np.column_stack([np.cos(angle), np.sin(angle)]))


def grid(n_across: int, pitch_m: float, diameter_m: float) -> NDArray[np.float64]:
    """Return the points of a centred square grid inside a circle, ``(n_actuators, 2)``, metres.

    Rows run along +x, from the lowest y up, as ``[y, x]`` arrays do.
    """
    line = (np.arange(n_across) - (n_across - 1) / 2) * pitch_m
    y, x = np.meshgrid(line, line, indexing="ij")
    return _inside(x, y, diameter_m)


def hexagonal(pitch_m: float, diameter_m: float, hole_m: float = 0.0) -> NDArray[np.float64]:
    """Return the points of a triangular lattice inside a circle, ``(n_actuators, 2)``, metres.

    Each has six neighbours at ``pitch_m``. One is at the centre, rows are along +x, from the lowest
    y upwards: the layout is its own mirror image under y -> -y. Points closer to the centre than
    half of ``hole_m`` are excluded.
    """
    # The small number keeps a row exactly on the rim.
    rows = int(diameter_m / 2 / (pitch_m * np.sqrt(0.75)) + 1e-9)
    row = np.arange(-rows, rows + 1)
    columns = int(diameter_m / 2 / pitch_m) + 1
    along = np.arange(-columns, columns + 1) + 0.5 * (row % 2)[:, None]
    y = np.broadcast_to((row * pitch_m * np.sqrt(0.75))[:, None], along.shape)
    points = _inside(along * pitch_m, y, diameter_m)
    return np.asarray(points[np.linalg.norm(points, axis=1) >= hole_m / 2])


def _inside(
    x_m: NDArray[np.float64], y_m: NDArray[np.float64], diameter_m: float
) -> NDArray[np.float64]:
    """Return the points in or on a circle, ``(n, 2)``, row by row."""
    points = np.column_stack([x_m.ravel(), y_m.ravel()])
    # Actuators exactly on the circle belong to the mirror.
    rounding = 1.0 + 1e-9
    inside = np.linalg.norm(points, axis=1) <= diameter_m / 2 * rounding
    return np.asarray(points[inside])


def typical_pitch(positions_m: NDArray[np.float64]) -> float:
    """Return the median distance to the nearest neighbour, metres."""
    return float(np.median(_nearest(positions_m)[0]))


def coincident(positions_m: NDArray[np.float64]) -> tuple[int, int] | None:
    """Return the indices of two actuators in the same place, or None."""
    distances, neighbours = _nearest(positions_m)
    # Two actuators in one place make the system of the influence functions singular.
    same = np.flatnonzero(distances <= 1e-6 * np.ptp(positions_m))
    if same.size == 0:
        return None
    first, second = sorted((int(same[0]), int(neighbours[same[0]])))
    return first, second


def _nearest(positions_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return how far every point's nearest neighbour is, and which it is.

    By brute force: a tree would take longer to import than this takes for a few thousand points.
    """
    n = len(positions_m)
    distances, neighbours = np.full(n, np.inf), np.zeros(n, dtype=np.intp)
    if n < 2:
        return distances, neighbours
    for start in range(0, n, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, n))
        apart = np.hypot(*(positions_m[rows, None] - positions_m).transpose(2, 0, 1))
        apart[np.arange(len(rows)), rows] = np.inf
        neighbours[rows] = apart.argmin(axis=1)
        distances[rows] = apart.min(axis=1)
    return distances, neighbours


# --- measured


def _read_table(file: MirrorSection, pupil: Pupil) -> tuple[TabulatedModes, tuple[str, ...]]:
    key = "modes" if file.table.modes is not None else "influence_functions"
    if file.table.modes_pitch_m is None:
        raise ConfigurationError(
            f"{file.where('modes_pitch_m')}: missing, mirror.{key} needs the step of its grid"
        )
    cube = _read(file, key)
    if cube.ndim != 3 or min(cube.shape) < 1:
        file.refuse(key, f"shape {cube.shape}", "(n, ny, nx), one table for each")
    of_functions = key == "influence_functions"
    strokes, of_strokes = _strokes(file, len(cube)) if of_functions else (None, ())
    # Kept with the modes: whether crops were cut too close is judged before they are combined.
    crops, broken = _without_defects(file, key, cube)
    cube, local = crops, None
    whole = None if file.table.influence_origin is not None else known_samples(cube)
    ending = local_functions(file, _opd(file, cube), strokes, whole) if of_functions else None
    if ending is not None:
        local, known = ending
    elif whole is None:
        cube, known = modes_of_crops(file, cube, strokes)
    else:
        known = whole
        cube = np.where(known, cube, cube.dtype.type(0))
        if strokes is not None:
            cube = np.tensordot(strokes.T.astype(cube.dtype), cube, axes=1)
    remarks = (
        *of_strokes,
        *broken,
        *_check_table(file, pupil, key, known, file.table.modes_pitch_m),
        *remarks_on_crops(file, crops),
    )
    modes = TabulatedModes(
        cube=None if local is not None else _opd(file, cube),
        local=local,
        pitch_m=file.table.modes_pitch_m,
        known=known,
        **_mount(file.table),
    )
    return modes, remarks


def _without_defects(
    file: MirrorSection, key: str, cube: NDArray[np.floating]
) -> tuple[NDArray[np.floating], tuple[str, ...]]:
    """Return a cube whose unusable entries are 0, and notes that name them.

    An entry is unusable if it has far more undefined points than the others (it would make the
    surface unknown for all of them), if it is zero, or if it equals an earlier one. Equal crops are
    not copies, because they have different positions.
    """
    # Outside the pupil all functions are undefined: only more than that is a fault.
    unknown = np.mean(~np.isfinite(cube), axis=(1, 2))
    broken = unknown > np.median(unknown) + _BROKEN_SHARE
    defects: dict[int, Defect] = {int(number): NOT_FINITE for number in np.flatnonzero(broken)}
    usable = np.flatnonzero(~broken)
    for place, reason in find_defects(cube[usable] if broken.any() else cube).items():
        if reason == ZERO:
            defects[int(usable[place])] = ZERO
        elif isinstance(reason, int) and file.table.influence_origin is None:
            defects[int(usable[place])] = int(usable[reason])
    if not defects:
        return cube, ()
    mended = np.array(cube)
    mended[list(defects)] = 0.0
    what = "mode" if key == "modes" else "function"
    return mended, tuple(f"{file.where(key)}: {note}" for note in explain_defects(defects, what))


def _strokes(
    file: MirrorSection, n_actuators: int
) -> tuple[NDArray[np.floating] | None, tuple[str, ...]]:
    """Return strokes ``(n_actuators, n_modes)`` of modes made of influence functions, and notes.

    None: each makes a mode by itself.
    """
    if file.table.basis is BasisKind.ZONAL:
        return None, ()
    strokes, notes = _mode_to_actuator(file, n_actuators)
    if strokes is None:
        raise ConfigurationError(
            f"{file.where('mode_to_actuator')}: missing, mirror.influence_functions needs it, or "
            'basis = "zonal" for the actuators themselves'
        )
    return strokes, notes


def _check_table(
    file: MirrorSection, pupil: Pupil, key: str, known: NDArray[np.bool_], pitch_m: float
) -> tuple[str, ...]:
    """Refuse a table that cannot be of this pupil; return notes on one that is poor."""
    density = pupil.subaperture_m / pitch_m
    if density < MIN_POINTS_PER_SUBAPERTURE:
        file.refuse(
            "modes_pitch_m",
            f"{pitch_m:g} m, {density:.2g} table points per subaperture",
            f"at least {MIN_POINTS_PER_SUBAPERTURE:g}, {ENOUGH_POINTS_PER_SUBAPERTURE:g} for 0.5 %",
        )
    width = max(known.shape) * pitch_m / pupil.diameter_m
    if width > _LARGEST_TABLE:
        file.refuse(
            "modes_pitch_m",
            f"{pitch_m:g} m, a table of {width:.3g} pupil diameters",
            f"at most {_LARGEST_TABLE:g}: is it in metres of the pupil plane?",
        )
    # Slopes near unknown surface are left out of fits: with less than half nothing is left to fit.
    covered = known.sum() * pitch_m**2 / (np.pi / 4 * pupil.diameter_m**2)
    if covered < 0.5:
        file.refuse(
            key,
            f"a surface known over {covered:.0%} of the pupil's area "
            f"(table of {known.shape[0]} x {known.shape[1]} points, {pitch_m:g} m apart)",
            "at least half of it",
        )
    remarks = []
    if density < ENOUGH_POINTS_PER_SUBAPERTURE and not pupil.is_simulated:
        remarks.append(
            f"{file.where('modes_pitch_m')}: {density:.2g} table points per subaperture; below "
            f"{ENOUGH_POINTS_PER_SUBAPERTURE:g} the high modes come out wrong by per cents"
        )
    if not known.all():
        remarks.append(
            f"{file.where(key)}: {1 - known.mean():.0%} of the table is zero in every mode or not "
            "finite: taken as unknown; slopes within one subaperture of it are left out"
        )
    return tuple(remarks)
