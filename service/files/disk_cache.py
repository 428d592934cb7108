"""Cache on disk what takes seconds: modes, a linearisation.

A file is found by a digest of all that its numbers depend on, the code of the model included, so
that none is ever out of date; one that is damaged is made again. Several processes may share the
folder, and it may be deleted at any time. Where it cannot be written nothing is kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model import instrument as model_code
from service.model.instrument import Instrument, Mirror, instrument_sha256
from service.model.modes import Basis, ModalBasis, in_subapertures, modal_basis
from service.model.surface import mirror_surface

Arrays = Mapping[str, NDArray[Any]]

MAX_BYTES = 1_000_000_000
"""All files together; the ones used least recently go first."""

VARIABLE = "PYRCAL_SERVICE__CACHE_DIR"
"""Environment variable of the folder; that of the setting ``service.cache_dir``."""

_SUFFIX = ".npz"
_ABANDONED_S = 3600.0
"""A file that has been under way for so long belongs to a process that died."""


def usual_folder(environment: Mapping[str, str]) -> Path:
    """Return the default cache folder."""
    configured = environment.get(VARIABLE)
    if configured:
        return Path(configured)
    home = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "pyrcal"


def cached_basis(instrument: Instrument) -> Basis:
    """Return the modes of an instrument, from this user's cache folder where they are in it."""
    return DiskCache(usual_folder(os.environ)).basis(instrument)


class DiskCache:
    """A folder of results; without one everything is computed."""

    def __init__(self, folder: Path | None, *, max_bytes: int = MAX_BYTES) -> None:
        self._folder = folder
        self._max_bytes = max_bytes

    def basis(self, instrument: Instrument) -> Basis:
        """Return the modes of this instrument, as ``modal_basis`` does.

        Only modes of analytic mirrors are cached: the statistics of turbulence take seconds even if
        the strokes are given. A table of shapes is ready within milliseconds. Modes are computed
        for the finest sensor mode, because a binned one could not distinguish them.
        """
        return in_subapertures(self._found(instrument.finest), instrument)

    def _found(self, instrument: Instrument) -> Basis:
        mirror = instrument.mirror
        if not isinstance(mirror, Mirror):
            return modal_basis(instrument)

        def computed() -> Arrays:
            basis = modal_basis(instrument)
            if not isinstance(basis, ModalBasis):
                raise TypeError(f"found {type(basis).__name__} for an analytic mirror")
            strokes, coefficients = basis.mode_to_actuator, basis.coefficients
            found = {"mode_to_actuator": strokes, "variance_m2": basis.variance_m2}
            # of Gaussians they are the strokes themselves, hundreds of megabytes for an ELT
            return found if coefficients is strokes else found | {"coefficients": coefficients}

        kept = self.arrays(instrument, ("modes", "with coefficients"), computed)
        return ModalBasis(
            surface=mirror_surface(mirror, instrument.subaperture_m),
            mode_to_actuator=kept["mode_to_actuator"],
            coefficients=kept.get("coefficients", kept["mode_to_actuator"]),
            variance_m2=kept["variance_m2"],
            y_sign=mirror.y_sign,
        )

    def arrays(
        self, instrument: Instrument, what: tuple[object, ...], compute: Callable[[], Arrays]
    ) -> Arrays:
        """Return named arrays of an instrument, from disk or from ``compute``.

        ``what`` is everything else that they depend on, identified by its ``repr``.
        """
        if self._folder is None:
            return compute()
        code = code_sha256(Path(model_code.__file__).parent)
        facts = (instrument_sha256(instrument), code, np.__version__, scipy.__version__)
        digest = hashlib.sha256(repr((facts, what)).encode()).hexdigest()
        path = self._folder / f"{instrument.name}-{what[0]}-{digest[:32]}{_SUFFIX}"
        found = _read(path)
        if found is None:
            found = compute()
            # a full disk or a folder of somebody else's only costs the time once more
            with contextlib.suppress(OSError):
                self._write(path, found)
        return found

    def _write(self, path: Path, arrays: Arrays) -> None:
        if sum(array.nbytes for array in arrays.values()) > self._max_bytes:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        # In the same folder, because a file can only be renamed within its file system.
        number, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=_SUFFIX)
        try:
            with os.fdopen(number, "wb") as file:
                np.savez(file, allow_pickle=False, **arrays)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        self._tidy(path)

    def _tidy(self, newest: Path) -> None:
        """Remove the oldest until all fit, and what dead processes have left."""
        files = []
        for path in newest.parent.glob(f"*{_SUFFIX}"):
            with contextlib.suppress(OSError):  # another process tidies, too
                status = path.stat()
                files.append((status.st_mtime, status.st_size, path))
        room = self._max_bytes
        for modified_s, n_bytes, path in sorted(files, reverse=True):
            waiting = path.name.startswith(".")
            room -= n_bytes
            old = time.time() - modified_s > _ABANDONED_S if waiting else room < 0
            if old and path != newest:
                path.unlink(missing_ok=True)


def _read(path: Path) -> Arrays | None:
    """Return what a file holds, and mark it as used; None: there is none, or it is damaged."""
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}  # read whole: the sums are checked
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    with contextlib.suppress(OSError):
        # The time of modification is that of the last use: _tidy removes the oldest.
        os.utime(path)
    return arrays


@cache
def code_sha256(*folders: Path) -> str:
    """Return a digest of the code in folders: another version computes other numbers."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()
