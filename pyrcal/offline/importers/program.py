"""``pyrcal import``: write an instrument file and a matrix, and say what to do with them."""

from __future__ import annotations

import argparse
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

from pyrcal.offline.importers import oopao
from pyrcal.offline.importers.aot import from_aot
from pyrcal.offline.importers.cacao import from_cacao
from pyrcal.offline.importers.files import Reported, from_arrays
from pyrcal.offline.importers.imported import Array, Imported
from pyrcal.offline.importers.layouts import by_role
from pyrcal.offline.importers.pyrtc import RECORD, calibration_of
from pyrcal.offline.importers.saved import read_npz
from pyrcal.offline.importers.specula import UNIT, from_specula
from service.errors import MatrixError
from service.files.container import opened


def _oopao(options: argparse.Namespace) -> Imported:
    return oopao.from_saved(read_npz(options.file), str(options.file))


def _specula(options: argparse.Namespace) -> Imported:
    reported, source = _reported(options), options.source
    return from_specula([path for _, path in options.files], reported, source)


def _arrays(options: argparse.Namespace) -> Imported:
    """Import arrays by their names, or by the roles that are reported."""
    found: dict[str, Array] = {}
    for role, path in options.files:
        arrays = _read(path)
        if role is not None:
            arrays = {role: _only(arrays, str(path))}
        elif options.source == "pyrtc":
            arrays = dict([calibration_of(arrays, str(path))])
        else:
            arrays = by_role(arrays, str(path))
        twice = found.keys() & arrays.keys()
        if twice:
            raise MatrixError(f"{path}: found a second {min(twice)}, expected one")
        found |= arrays
    return from_arrays(" ".join(str(path) for _, path in options.files), found, _reported(options))


def _read(path: Path) -> dict[str, Array]:
    """Return the arrays of a file by name."""
    if zipfile.is_zipfile(path):
        return read_npz(path)
    with opened(path) as container:
        return {name: stored.read() for name, stored in container.arrays.items()}


def _only(arrays: Mapping[str, Array], where: str) -> Array:
    """Return the one array of a file; the record of pyRTC 2 is none."""
    values = [array for name, array in arrays.items() if name != RECORD]
    if len(values) != 1:
        raise MatrixError(f"{where}: found {', '.join(arrays)}, expected one array")
    return values[0]


def _cacao(options: argparse.Namespace) -> Imported:
    return from_cacao(options.folder, _reported(options), options.response)


def _aot(options: argparse.Namespace) -> Imported:
    return from_aot(options.file, _reported(options))


def _reported(options: argparse.Namespace) -> Reported:
    return Reported(
        diameter_m=options.diameter_m,
        sensor=options.sensor,
        stop=options.stop,
        obscuration_ratio=options.obscuration,
        wavelength_m=options.wavelength_m,
        modulation_lambda_over_d=options.modulation,
        pupil_diameter_subap=options.pupil_subap,
        pixels_per_subaperture=options.pixels_per_subap,
        centroid="gradient" if options.source == "synim" else None,
        unit=getattr(options, "unit", UNIT if options.source in {"specula", "synim"} else None),
    )


IMPORTERS: Mapping[str, Callable[[argparse.Namespace], Imported]] = {
    "oopao": _oopao,
    "specula": _specula,
    "synim": _specula,
    "cacao": _cacao,
    "pyrtc": _arrays,
    "aot": _aot,
    "npz": _arrays,
}
"""By the word that names them."""


def main(options: argparse.Namespace) -> int:
    """Import, write, and say what was found.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    imported = IMPORTERS[options.source](options)
    saved = imported.save(options.output)
    for line in imported.inventory:
        print(line)
    print(f"{saved.instrument}: {imported.source}")
    shapes = ", ".join(f"{name} {values.shape}" for name, values in imported.arrays.items())
    print(f"{saved.matrix}: {shapes}")
    for note in imported.notes:
        print(f"note: {note}")
    print(f"next: pyrcal fit {saved.instrument} {saved.matrix}")
    return 0
