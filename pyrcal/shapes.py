"""``pyrcal references load``: read a shape from a file, and have a running service hold it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from pyrcal.client import ask
from service.errors import ConfigurationError
from service.files.container import StoredArray, opened

UNITS = {"meter": "m", "micron": "um", "nanometer": "nm"}
"""Other names of units in FITS files."""

NUMBERED = {"noll": ("zernike", 1), "mode": ("modes", 0)}
"""Kind and first number of the shape in a FITS table, by the name of its column of integers."""

MAX_NUMBER = 65_535

OBSCURED = 0.35
"""Radius within which a map may have no values: no central obscuration is larger."""

_SAID = ("kind", "frame", "unit")
_DESCRIBED = (*_SAID, "basis_id", "config_id")


def main(options: argparse.Namespace) -> int:
    """Read the file, then load its shape; return the exit status.

    Raises
    ------
    PyrcalError
        As :func:`read_shape`, and where the command line is wrong.
    """
    options.content = read_shape(options)
    return ask.main(options)


def read_shape(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of the order that loads a shape.

    A JSON file is an object with ``values``, and kind, frame, unit, ``basis_id`` and ``config_id``
    where it has them; others are HDF5, FITS or NumPy files with one array, and the same words as
    attributes or keywords (``BUNIT`` for the unit). A FITS table has a column of coefficients and
    may have one of their numbers, ``noll`` or ``mode``. Options replace what the file says. A map
    may have NaN where no light falls.

    Raises
    ------
    ConfigurationError
        If the file holds no shape, or neither it nor an option says what its numbers are.
    MatrixError
        If it is damaged.
    """
    path: Path = options.file
    found = _read_json(path) if path.suffix.lower() == ".json" else _read_array(path)
    if options.kind not in {None, (numbered := found.pop("numbered", None)) or options.kind}:
        raise ConfigurationError(f"{path}: found --kind {options.kind}, expected {numbered}")
    found |= {name: getattr(options, name) for name in _SAID if getattr(options, name)}
    values = np.asarray(found["values"], dtype=np.float64)
    if values.ndim == 2:
        found.setdefault("kind", "map")
    needed = _SAID[: 2 if found.get("kind") == "slopes" else 3]
    missing = [name for name in needed if not found.get(name)]
    if missing:
        text = f"found no {' and no '.join(missing)}: give --{' --'.join(missing)}"
        raise ConfigurationError(f"{path}: {text}")
    if found.get("kind") == "map":
        values = _fill_dark(values)
    if not np.isfinite(values).all():
        n_bad = int(np.sum(~np.isfinite(values)))
        raise ConfigurationError(f"{path}: found {n_bad} values that are not finite, expected none")
    # Seven digits, as the float32 that is sent to the RTC: a request has at most 1 MB.
    rounded = [float(f"{value:.7g}") for value in values.ravel().tolist()]
    return {**found, "values": rounded, "source": path.name}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        np.asarray(document["values"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"{path}: found {error!r}, expected a JSON object with a list of numbers, values"
        ) from error
    return {name: document[name] for name in ("values", *_DESCRIBED) if name in document}


def _read_array(path: Path) -> dict[str, Any]:
    with opened(path) as container:
        facts = {name: container.facts[name] for name in _DESCRIBED if name in container.facts}
        columns = {} if container.arrays else container.columns()
        if columns:
            array, values, kind = _read_table(path, columns)
        elif len(container.arrays) == 1:
            (array,) = container.arrays.values()
            values, kind = array.numbers(), {}
        else:
            raise ConfigurationError(f"{path}: found {container.listing()}, expected one array")
        unit = (array.unit or str(container.facts.get("bunit", facts.get("unit", "")))).strip()
        said = {"unit": UNITS.get(unit.lower(), unit.lower())} if unit else {}
        return {"values": values, **facts, **kind, **said}


def _read_table(
    path: Path, columns: Mapping[str, StoredArray]
) -> tuple[StoredArray, NDArray[np.float64], dict[str, Any]]:
    """Return the column of coefficients, the shape, and its kind if a column of numbers says so."""
    numbers = [name for name in columns if name in NUMBERED]
    found = [name for name in columns if name not in NUMBERED]
    if len(numbers) > 1 or len(found) != 1:
        raise ConfigurationError(
            f"{path}: found the columns {', '.join(columns)}, expected one of coefficients and at "
            "most one of their numbers, noll (from 1 on) or mode (from 0 on)"
        )
    array = columns[found[0]]
    if not numbers:
        return array, array.numbers(), {}
    kind, first = NUMBERED[numbers[0]]
    places = columns[numbers[0]].numbers()
    if not np.all((places >= first) & (places <= MAX_NUMBER) & (places % 1 == 0)):
        raise ConfigurationError(f"{path}: found a {numbers[0]} beyond {first} to {MAX_NUMBER}")
    if len(np.unique(places)) != len(places):
        raise ConfigurationError(f"{path}: found a {numbers[0]} twice, expected each once")
    values = np.zeros(int(places.max(initial=first)) - first + 1)
    values[places.astype(int) - first] = array.numbers()
    return array, values, {"kind": kind, "numbered": kind}


def _fill_dark(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a map with the nearest values in place of NaN beyond the pupil and in its middle."""
    n = len(values)
    if values.ndim != 2 or not np.isfinite(values).any():
        return values
    places = (np.indices(values.shape) + 0.5) * 2.0 / n - 1.0
    radius = np.hypot(*places)
    # A pixel at the rim may have been left out for the part of it that is dark.
    dark = np.isnan(values) & ((radius > 1.0 - 2.0 / n) | (radius < OBSCURED))
    nearest = scipy.ndimage.distance_transform_edt(
        np.isnan(values), return_distances=False, return_indices=True
    )
    return np.where(dark, values[tuple(nearest)], values)
