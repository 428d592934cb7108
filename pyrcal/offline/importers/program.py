"""``pyrcal import``: write an instrument file and a matrix, and say what to do with them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping

from pyrcal.offline.importers import oopao
from pyrcal.offline.importers.imported import Imported
from pyrcal.offline.importers.saved import read_npz


def _oopao(options: argparse.Namespace) -> Imported:
    return oopao.from_saved(read_npz(options.file), str(options.file))


IMPORTERS: Mapping[str, Callable[[argparse.Namespace], Imported]] = {"oopao": _oopao}
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
    print(f"{saved.instrument}: {imported.source}")
    shapes = ", ".join(f"{name} {values.shape}" for name, values in imported.arrays.items())
    print(f"{saved.matrix}: {shapes}")
    for note in imported.notes:
        print(f"note: {note}")
    print(f"next: pyrcal fit {saved.instrument} {saved.matrix}")
    return 0
