"""Read what a bench has: find the importer of its files, and the grid that has made its matrix."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pyrcal.importers.imported import UNKNOWN, Array, Imported
from pyrcal.importers.layouts import role_of_name
from pyrcal.importers.oopao import SAVED, from_saved
from pyrcal.importers.program import (
    ARRAY_FILES,
    import_arrays,
    import_files,
    modes_of_name,
    read_arrays,
)
from pyrcal.importers.simulated import find_fft_grid
from service.errors import ConfigurationError, MatrixError
from service.files.container import DATASET
from service.files.toml import read_toml
from service.instrument import instrument_path

_OOPAO = {
    "".join(filter(str.isalnum, f"{owner}{name}")).lower(): f"{owner}.{name}"
    for owner, names in (*SAVED.items(), ("calib", ("D",)))
    for name in names
}
"""OOPAO's attributes by their names in small letters without dots: MATLAB allows none."""

_OOPAO_ONLY = {"tel.D", "tel.resolution", "wfs.nSubap", "wfs.tag"}
"""Attributes that show that the files are OOPAO's objects."""

_PARTS = (
    ("mode_to_actuator", ("m2c", "modetoactuator", "modestoactuator")),
    ("matrix", ("interaction", "intmat", "imat", "calibd")),
    ("modes", ("influ", "ifunc", "dmmodes", "modeshapes")),
    ("positions", ("coordinates", "positions")),
    ("sky_pupil", ("skypupil", "pupilsky")),
    ("spot", ("spot", "modulationpicture", "modulatedpsf")),
    ("pupil", ("pupil",)),
    ("valid", ("valid",)),
    ("light", ("meanframe", "flux", "light", "reference")),
)
"""Parts of names by role, the more specific ones first; for names that are no role's own."""

MIN_AXES_RATIO = 1.03
"""Smallest ratio of the axes of a modulated spot's path that is taken for an ellipse."""

_SPOT_THRESHOLD = 0.2
"""Light on the path of the spot over its brightest part."""


class _Named(NamedTuple):
    """An array, its name or that of its file, and its file."""

    name: str
    values: Array
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """The files of a bench as instrument and matrix."""

    imported: tuple[Imported, ...]
    """Instrument and matrix; a second time with the FFT grid of a simulated bench if the files
    allow it."""

    stated: frozenset[str]
    """Keys of the instrument file that options or attributes of another code state."""

    sky_pupil: Array | None = None
    """``(n, n)`` pupil on the sky; None if there is only one pupil."""

    inventory: tuple[str, ...] = ()
    """Use that was made of each file, one sentence each."""


def read_bench(options: argparse.Namespace) -> Bench:
    """Return what the files of a bench describe.

    Raises
    ------
    ConfigurationError
        If a value that no file contains is missing.
    MatrixError
        If files do not belong together: it names them with their shapes.
    """
    paths = [path for role, path in options.files if role is None]
    cacao = [path for path in paths if any(path.glob("**/cacaovars*"))]
    if cacao:
        options.source, options.folder, options.response = "cacao", cacao[0], None
        return _import_other(options)
    named = tuple(_read_files(options.files))
    saved = {_OOPAO.get(_squeeze(one.name), one.name): one for one in named}
    if _OOPAO_ONLY & saved.keys():
        where = ", ".join(str(path) for _, path in options.files)
        imported = from_saved({name: one.values for name, one in saved.items()}, where)
        stated = frozenset(key for table in imported.tables.values() for key in table)
        inventory = tuple(f"{name}: {one.path}" for name, one in saved.items())
        return Bench(imported=(imported,), stated=stated, inventory=inventory)
    if "INTMAT" in saved:
        options.source = "specula"
        options.files = [(None, path) for path in dict.fromkeys(one.path for one in named)]
        return _import_other(options)
    options.source = "files"
    found, inventory = _sort_by_role(named, options)
    try:
        imported = import_arrays(options, found, inventory)
    except MatrixError as error:
        raise MatrixError(f"{error}; {'; '.join(inventory)}") from error
    _check_modes(imported, options)
    if "spot" in found:
        imported = _use_spot(imported, found["spot"])
    sampled = find_fft_grid(imported, options)
    return Bench(
        imported=(imported,) if sampled is None else (sampled, imported),
        stated=_state(options, imported),
        sky_pupil=found.get("sky_pupil"),
        inventory=inventory,
    )


def _import_other(options: argparse.Namespace) -> Bench:
    """Return what the files of another code describe."""
    imported = import_files(options)
    return Bench(
        imported=(imported,), stated=_state(options, imported), inventory=imported.inventory
    )


def _state(options: argparse.Namespace, imported: Imported) -> frozenset[str]:
    """Return the keys of the instrument file that the options give."""
    keys = {
        "diameter_m": options.diameter_m,
        "kind": options.sensor,
        "obscuration_ratio": options.obscuration,
        "wavelength_m": options.wavelength_m,
        "modulation_lambda_over_d": options.modulation,
        "pupil_diameter_subap": options.pupil_subap,
        "pixels_per_subaperture": options.pixels_per_subap,
        "unit": options.unit,
    }
    stated = {key for key, value in keys.items() if value is not None}
    if options.instrument is not None:
        tables = read_toml(instrument_path(options.instrument))
        # What the arrays show takes the place of what the file says.
        stated |= {
            key
            for name, table in imported.tables.items()
            for key, value in table.items()
            if key in tables.get(name, {}) and tables[name][key] == value
        }
    return frozenset(stated)


def _squeeze(name: str) -> str:
    """Return a name in small letters without anything but letters and digits."""
    return "".join(filter(str.isalnum, name)).lower()


def _read_files(given: list[tuple[str | None, Path]]) -> Iterator[_Named]:
    """Yield the arrays of files and of the files in folders; a given role is their name."""
    with_role = {path.resolve() for role, path in given if role is not None}
    # A file with a stated role comes first, also if its folder is given as well.
    for role, path in sorted(given, key=lambda one: one[0] is None):
        for one in sorted(path.iterdir()) if path.is_dir() else [path]:
            is_array = one.name.lower().endswith(ARRAY_FILES) and one.resolve() not in with_role
            if path.is_dir() and not is_array:
                continue
            arrays = read_arrays(one, [])
            if role is not None and len(arrays) != 1:
                raise MatrixError(f"{one}: found {', '.join(arrays)}, expected one array")
            for name, values in arrays.items():
                # The array of a NumPy or FITS file has no name of its own.
                is_unnamed = name == DATASET or name.isdigit()
                ends = [end for end in ARRAY_FILES if one.name.lower().endswith(end)]
                own = one.name[: -len(max(ends, default="", key=len)) or None]
                own = own if is_unnamed else name
                yield _Named(role or own, values, one)


def _sort_by_role(
    named: tuple[_Named, ...], options: argparse.Namespace
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Return the arrays by role, and the use that was made of each."""
    found: dict[str, Array] = {}
    inventory: list[str] = []
    unknown: list[_Named] = []
    for one in named:
        role = _find_role(one.name)
        if role is None:
            unknown.append(one)
            continue
        if role in found:
            if role in dict(options.files):
                continue  # the other one was stated
            raise MatrixError(f"{one.path}: found a second {role}, expected one; say ROLE=FILE")
        found[role] = one.values
        inventory.append(f"{role}: {one.path} {one.values.shape}")
        if role == "matrix" and options.modes is None:
            options.modes = modes_of_name(one.path, one.values, inventory)
    for one in unknown:
        role = _guess_mask(one.values, np.shape(found.get("matrix", ())))
        role = role or _guess_functions(one.values, np.shape(found.get("mode_to_actuator", ())))
        if role is None or role in found:
            inventory.append(
                f"not used: {one.path} {one.values.shape} ({one.name}): give ROLE=FILE"
            )
        else:
            found[role] = one.values
            inventory.append(f"{role}, by its shape: {one.path} {one.values.shape}")
    return found, tuple(inventory)


def _find_role(name: str) -> str | None:
    """Return the role for a name, for a part of it, or for one of its words; None if unknown."""
    squeezed = _squeeze(name)
    words = "".join(one if one.isalnum() else " " for one in name).split()
    return (
        role_of_name(name)
        or next((role for role, parts in _PARTS if any(part in squeezed for part in parts)), None)
        or next(filter(None, (role_of_name(word) for word in words if len(word) > 1)), None)
    )


def _guess_mask(values: Array, shape: tuple[int, ...]) -> str | None:
    """Return the role of a square map of 0 and 1: ``valid`` if the matrix has its rows."""
    is_map = values.ndim == 2 and values.shape[0] == values.shape[1]
    if not is_map or values.dtype.kind not in "biuf" or not np.isin(values, (0, 1)).all():
        return None
    n_lit = int(np.count_nonzero(values))
    return "valid" if {values.size, n_lit, 2 * n_lit} & set(shape) else "pupil"


def _guess_functions(values: Array, strokes: tuple[int, ...]) -> str | None:
    """Return ``modes`` for square maps of as many actuators as the modes' commands have."""
    if values.ndim != 2 or not strokes:
        return None
    n_actuators = max(strokes)
    n_points = values.size // n_actuators
    is_square = math.isqrt(n_points) ** 2 == n_points > n_actuators
    return "modes" if is_square and n_actuators in values.shape else None


def _check_modes(imported: Imported, options: argparse.Namespace) -> None:
    """Refuse a matrix of fewer modes than the basis has, if nothing says of which.

    Raises
    ------
    ConfigurationError
        With both shapes.
    """
    strokes, numbers = (imported.arrays.get(key) for key in ("mode_to_actuator", "modes"))
    if options.modes is not None or strokes is None or numbers is None:
        return
    if len(numbers) < strokes.shape[1] and np.array_equal(numbers, np.arange(len(numbers))):
        raise ConfigurationError(
            f"{imported.source}: found a matrix of {len(numbers)} columns and mode_to_actuator "
            f"{strokes.shape}, and nothing says which of the {strokes.shape[1]} modes they are; "
            "expected --modes, like 0:100 or 3,5,9"
        )


def _use_spot(imported: Imported, picture: Array) -> Imported:
    """Return the bench with an elliptic modulation to be fitted, if the spot's path is no circle.

    The scale and the axes of the picture's camera are not known: the fit finds axes and angle.
    """
    ratio, angle_deg = measure_spot(picture)
    imported = imported.with_notes(
        f"picture of the modulated spot: axes of ratio {ratio:.3f}, the longer one at "
        f"{angle_deg:.0f} deg of its camera"
    )
    if ratio < MIN_AXES_RATIO or "modulation_lambda_over_d" not in imported.tables["wfs"]:
        return imported
    # The radius, stated or unknown, is the start of the fit.
    wfs = {**imported.tables["wfs"], "modulation_ellipse": UNKNOWN}
    return replace(imported, tables={**imported.tables, "wfs": wfs})


def measure_spot(picture: Array) -> tuple[float, float]:
    """Return the ratio of the axes of a modulated spot's path, and the longer one's angle, degrees.

    The spot dwells where it is slow, so that weighted by light the mean square along an axis is
    half that of the axis. The threshold removes the background.
    """
    light = picture - np.median(picture)
    path = light > _SPOT_THRESHOLD * np.percentile(light, 99.5)
    rows, columns = np.nonzero(path)
    squares, axes = np.linalg.eigh(np.cov(columns, rows, aweights=light[path]))
    angle = np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])) % 180.0
    return float(np.sqrt(squares[1] / squares[0])), float(angle)
