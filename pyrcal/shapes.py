"""``pyrcal references load``: read a shape from a file, and have a running service hold it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from pyrcal.client import ask
from service.errors import ConfigurationError
from service.files.container import opened

UNITS = {"meter": "m", "micron": "um", "nanometer": "nm"}
"""Other names of units in FITS files."""

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
    attributes or keywords (``BUNIT`` for the unit). Options replace what the file says.

    Raises
    ------
    ConfigurationError
        If the file holds no shape, or neither it nor an option says what its numbers are.
    MatrixError
        If it is damaged.
    """
    path: Path = options.file
    found = _read_json(path) if path.suffix.lower() == ".json" else _read_array(path)
    found |= {name: getattr(options, name) for name in _SAID if getattr(options, name)}
    values = np.asarray(found["values"], dtype=np.float64)
    if values.ndim == 2:
        found.setdefault("kind", "map")
    needed = _SAID[: 2 if found.get("kind") == "slopes" else 3]
    missing = [name for name in needed if not found.get(name)]
    if missing:
        text = f"found no {' and no '.join(missing)}: give --{' --'.join(missing)}"
        raise ConfigurationError(f"{path}: {text}")
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
        if len(container.arrays) != 1:
            raise ConfigurationError(f"{path}: found {container.listing()}, expected one array")
        (array,) = container.arrays.values()
        facts = {name: container.facts[name] for name in _DESCRIBED if name in container.facts}
        unit = str(container.facts.get("bunit", facts.get("unit", ""))).strip().lower()
        said = {"unit": UNITS.get(unit, unit)} if unit else {}
        return {"values": array.numbers(), **facts, **said}
