"""``pyrcal import``: write an instrument file and a matrix, and print the next steps."""

from __future__ import annotations

import argparse
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pyrcal.importers.aot import from_aot
from pyrcal.importers.cacao import from_cacao
from pyrcal.importers.described import from_described
from pyrcal.importers.files import RECORD, Reported, calibration_of, from_arrays
from pyrcal.importers.imported import Array, Imported
from pyrcal.importers.layouts import by_role, numbers_of_name, role_of_name
from pyrcal.importers.oopao import from_saved
from pyrcal.importers.saved import read_npz
from pyrcal.importers.simulated import find_fft_grid
from pyrcal.importers.specula import from_specula, from_synim
from service.errors import ConfigurationError, MatrixError
from service.files.container import opened
from service.instrument import load_instrument
from service.model.aperture import check_mask


def import_files(options: argparse.Namespace) -> Imported:
    """Return what the files of the source that was named describe.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    match options.source:
        case "oopao":
            return from_saved(read_arrays(options.file, []), str(options.file))
        case "specula" | "synim":
            paths = [path for _, path in options.files]
            read = from_synim if options.source == "synim" else from_specula
            return read(paths, make_reported(options))
        case "cacao":
            return from_cacao(options.folder, make_reported(options), options.response)
        case "aot":
            places = None if options.positions is None else _positions(options.positions)
            return from_aot(options.file, make_reported(options), options.loop, places)
        case _:
            imported = import_arrays(options, *_gather_arrays(options))
            return find_fft_grid(imported, options, certain=True) or imported


def import_arrays(
    options: argparse.Namespace, found: Mapping[str, Array], inventory: tuple[str, ...]
) -> Imported:
    """Return what arrays by role describe, with the options; ``inventory`` is kept."""
    source = " ".join(str(path) for _, path in options.files)
    if options.instrument is not None:
        imported = from_described(source, found, options.instrument, options.unit, options.modes)
    else:
        imported = from_arrays(source, found, make_reported(options))
    return replace(imported, inventory=inventory)


def _gather_arrays(options: argparse.Namespace) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Return the arrays of the files by role, and the use that was made of each file."""
    found: dict[str, Array] = {}
    inventory: list[str] = []
    for role, path in _files(options.files):
        arrays = _by_role(role, path, options.source, inventory)
        if not arrays:
            inventory.append(f"ignored {path}: no name of a role, see docs/howto/importing.md")
        # Modes of the command line are preferred to those in a file's name.
        if "matrix" in arrays and options.modes is None:
            options.modes = modes_of_name(path, arrays["matrix"], inventory)
        twice = found.keys() & arrays.keys()
        if twice:
            raise MatrixError(f"{path}: found a second {min(twice)}, expected one")
        inventory += [f"took {path} {np.shape(a)}: {name}" for name, a in arrays.items()]
        found |= arrays
    return found, tuple(inventory)


def _files(given: Sequence[tuple[str | None, Path]]) -> Iterator[tuple[str | None, Path]]:
    """Yield the given files, and for a folder the files in it."""
    for role, path in given:
        if role is None and path.is_dir():
            for one in sorted(path.iterdir()):
                name = one.name.lower()
                # Arrays of a MATLAB file have names, whatever that of the file is.
                known = _role_of(one) is not None or name.endswith(".mat")
                if one.is_file() and name.endswith(ARRAY_FILES) and known:
                    yield None, one
        else:
            yield role, path


def _by_role(role: str | None, path: Path, source: str, inventory: list[str]) -> dict[str, Array]:
    """Return the arrays of a file by role, from their names or the file's name."""
    arrays = read_arrays(path, inventory)
    if role is not None:
        return {role: _only(arrays, str(path))}
    if source == "pyrtc":
        return dict([calibration_of(arrays, str(path))])
    if len(arrays) == 1:
        # The array of a NumPy file has no name, so the file's own is taken.
        named = _role_of(path)
        if named is not None:
            return {named: next(iter(arrays.values()))}
    return by_role(arrays, str(path))


def modes_of_name(path: Path, matrix: Array, inventory: list[str]) -> Array | None:
    """Return the modes that the name of a file lists, one for each column of its matrix."""
    numbers = numbers_of_name(path.name.partition(".")[0])
    if len(numbers) not in np.shape(matrix) or len(set(numbers)) < len(numbers):
        return None
    listed = ",".join(str(number) for number in numbers)
    inventory.append(f"took the modes of the columns from the name of {path.name}: {listed}")
    return np.array(numbers)


def _role_of(path: Path) -> str | None:
    """Return the role for a file's name; None if the name is unknown."""
    return role_of_name(path.name.partition(".")[0])


def read_arrays(path: Path, inventory: list[str]) -> dict[str, Array]:
    """Return the arrays of a file by name; remarks on them are appended to ``inventory``."""
    if zipfile.is_zipfile(path):
        return read_npz(path)
    with opened(path) as container:
        inventory += filter(None, (stored.remark for stored in container.arrays.values()))
        return {name: stored.read() for name, stored in container.arrays.items()}


def _only(arrays: Mapping[str, Array], where: str) -> Array:
    """Return the only array of a file, ignoring the record of pyRTC 2."""
    values = [array for name, array in arrays.items() if name != RECORD]
    if len(values) != 1:
        raise MatrixError(f"{where}: found {', '.join(arrays)}, expected one array")
    return values[0]


def _positions(path: Path) -> Array:
    """Return positions ``(n_actuators, 2)`` of an array file, or of a text file of two columns."""
    if path.suffix.lower() not in {".txt", ".csv", ".dat"}:
        return _only(read_arrays(path, []), str(path))
    delimiter = "," if path.suffix.lower() == ".csv" else None
    try:
        return np.loadtxt(path, delimiter=delimiter, ndmin=2)
    except (OSError, ValueError) as error:
        raise MatrixError(f"{path}: found {error}, expected x and y in a row") from error


def make_reported(options: argparse.Namespace) -> Reported:
    """Return the values that the options give.

    Raises
    ------
    ConfigurationError
        If they give no diameter.
    """
    if options.diameter_m is None:
        other = (
            ", or --instrument with a packaged name or a file" if "instrument" in options else ""
        )
        raise ConfigurationError(
            f"--diameter-m: found none, expected the diameter of the pupil in metres{other}"
        )
    return Reported(
        diameter_m=options.diameter_m,
        sensor=options.sensor,
        stop=options.stop,
        obscuration_ratio=options.obscuration,
        wavelength_m=options.wavelength_m,
        modulation_lambda_over_d=options.modulation,
        pupil_diameter_subap=options.pupil_subap,
        pixels_per_subaperture=options.pixels_per_subap,
        columns=options.modes,
        basis=getattr(options, "basis", None),
        unit=getattr(options, "unit", None),
    )


ARRAY_FILES = (".npy", ".fits", ".fits.gz", ".fits.fz", ".npz", ".h5", ".mat")
"""Suffixes of files that are read from a folder."""


def main(options: argparse.Namespace) -> int:
    """Import, write both files, and print the notes.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    imported = import_files(options)
    saved = imported.save(options.output)
    for line in imported.inventory:
        print(line)
    print(f"{saved.instrument}: {imported.source}")
    shapes = ", ".join(f"{name} {values.shape}" for name, values in imported.arrays.items())
    print(f"{saved.matrix}: {shapes}")
    mask = check_mask(load_instrument(saved.instrument))
    for note in (*imported.notes, *([] if mask is None else [mask])):
        print(f"note: {note}")
    print(f"next: pyrcal fit {saved.instrument} {saved.matrix}")
    return 0
