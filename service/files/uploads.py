"""Fits of uploads: what may be asked, what came, and the fit in a process of its own."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import Any

from service.errors import ConfigurationError, MatrixError, PyrcalError
from service.files.container import check_sealed
from service.files.figures import numbers
from service.files.report import document
from service.files.run import fit_file
from service.fit.matrix import FitOptions
from service.model.instrument import Instrument

MOST_FILES = 32

_ZIP_BEGINS = b"PK\x03\x04"

_REFERENCE = re.compile(r"(.+?\.(?:fits|fit|fts)(?:\.gz)?)(?::.*)?|(.+):/.+", re.IGNORECASE)
"""``file.fits``, ``file.fits:EXTNAME`` or ``file.h5:/dataset``, as an instrument file says it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Parcel:
    """What was uploaded, on disk."""

    reference: Path
    """The measured matrix."""

    instrument: Path | None
    """The instrument file; None: it came alone."""


def opened_parcel(upload: Path, folder: Path, reference: str | None, most_bytes: int) -> Parcel:
    """Return what an upload consists of; a zip archive is unpacked into the empty ``folder``.

    Parameters
    ----------
    upload
        The file as it came.
    folder
        Where files of an archive go.
    reference
        Name of the measured file in an archive; None: the only one that can be it.
    most_bytes
        Of all files of an archive together.

    Raises
    ------
    MatrixError, ConfigurationError
        If an archive is damaged, too large, has other folders than one, or leaves open which file
        is what; if its instrument file refers to files that are not in it; or if an HDF5 file
        reaches beyond itself.
    """
    with upload.open("rb") as file:
        packed = file.read(4) == _ZIP_BEGINS
    if not packed:
        check_sealed(upload)
        return Parcel(reference=upload, instrument=None)
    try:
        with zipfile.ZipFile(upload) as archive:
            names = _unpack(archive, folder, most_bytes)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError) as error:
        raise MatrixError(f"upload: damaged zip archive: {error}") from error
    for name in names:
        check_sealed(folder / name)
    instrument = folder / _only_toml(names)
    referred = set(_referred(instrument))
    for name in sorted(referred - set(names)):
        raise ConfigurationError(
            f"{instrument.name}: refers to {name}, expected a file of the archive: "
            f"{', '.join(names)}"
        )
    left = [name for name in names if name not in referred and name != instrument.name]
    return Parcel(reference=folder / _measured(left, names, reference), instrument=instrument)


def _only_toml(names: list[str]) -> str:
    tomls = [name for name in names if name.endswith(".toml")]
    if len(tomls) != 1:
        raise MatrixError(f"upload: found {len(tomls)} .toml files in the archive, expected one")
    return tomls[0]


def _measured(left: list[str], names: list[str], reference: str | None) -> str:
    """Return the name of the measured file: the one asked for, or the only one ``left``."""
    chosen = reference if reference is not None else left[0] if len(left) == 1 else None
    if chosen is None or chosen not in names:
        raise MatrixError(
            f"upload: found {reference or 'several files or none'} as the measured one, expected "
            f"?reference= and one of {', '.join(n for n in names if not n.endswith('.toml'))}"
        )
    return chosen


def _unpack(archive: zipfile.ZipFile, folder: Path, most_bytes: int) -> list[str]:
    """Write the files of an archive and return their names."""
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    size = sum(entry.file_size for entry in entries)
    if len(entries) > MOST_FILES or size > most_bytes:
        raise MatrixError(
            f"upload: found {len(entries)} files of {size / 1e6:.0f} MB in the archive, expected "
            f"at most {MOST_FILES} of {most_bytes / 1e6:.0f} MB"
        )
    names = []
    for entry in entries:
        name = PurePosixPath(entry.filename).name
        if name in names or name != entry.filename:
            raise MatrixError(
                f"upload: found {entry.filename} in the archive, expected files without folders, "
                "as zip -j packs them"
            )
        with archive.open(entry) as source, (folder / name).open("wb") as target:
            shutil.copyfileobj(source, target)
        names.append(name)
    return names


def _referred(instrument: Path) -> Iterator[str]:
    """Yield the file of everything in an instrument file that refers to one."""
    try:
        tables = tomllib.loads(instrument.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return  # whoever loads it says what is wrong
    for text in _texts(tables):
        match = _REFERENCE.fullmatch(text)
        if match is not None:
            yield match[1] or match[2]


def _texts(value: object) -> Iterator[str]:
    """Yield every text in a TOML file's values, however deep."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


UPLOAD = "upload"
"""Name of what was uploaded, in the folder of its fit."""

STAGE, FIGURES = "stage", "figures.json"
"""In the same folder: what the fit is at, in a word, and what its figures are drawn from."""

STAGES = ("reading", "modes", "orientation", "fit", "verdict", "figures")
"""What a fit does, in this order."""


class FitState(StrEnum):
    """How far a fit is."""

    RECEIVING = "receiving"
    """The upload is on its way."""

    WAITING = "waiting"
    """It stands in the queue."""

    RUNNING = "running"
    DONE = "done"
    """There is a document; its verdict may be a refusal."""

    FAILED = "failed"
    """There is none; the reason says why."""

    GIVEN_UP = "given-up"
    """There is none: somebody has ended it."""


UNFINISHED = frozenset({FitState.RECEIVING, FitState.WAITING, FitState.RUNNING})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitAsked:
    """What was asked for, besides the measured matrix itself."""

    options: FitOptions
    """As for any fit."""

    dataset: str | None = None
    """Name of the matrix in its file; None: the usual one."""

    instrument: str | None = None
    """A packaged instrument; None: the service's own, or the one that was uploaded."""

    reference: str | None = None
    """The measured file in an upload of several; None: the only one that can be it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitJob:
    """One fit the service was asked for."""

    id: str
    """Never reused while the service runs."""

    state: FitState
    """How far it is."""

    asked_ns_utc: int
    """When it was asked for, the service's clock."""

    name: str = ""
    """Of the measured matrix, or the file, as whoever asked calls it."""

    n_bytes: int = 0
    """Of the upload so far."""

    sha256: str = ""
    """Of the upload; empty until it is whole."""

    reason: str = ""
    """Why it failed."""

    stage: str = ""
    """What it is at while it runs: reading, modes, orientation, fit, verdict, figures."""

    document: Mapping[str, Any] | None = None
    """What was found, as ``service.files.report.document`` says it."""

    figures: bytes | None = None
    """What its figures are drawn from, JSON of ``service.files.figures.numbers``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UploadFitter:
    """Fits what was uploaded into a folder; can be pickled."""

    own: Instrument
    load_instrument: Callable[[Path], Instrument]
    """Reads that of an upload."""

    packaged_instrument: Callable[[str], Instrument]
    """Reads a packaged one; a name is never a file of this machine."""

    most_bytes: int
    """Of the files of an archive together."""

    threads: int
    """That share the work."""

    def __call__(self, folder: Path, asked: FitAsked) -> dict[str, Any]:
        """Return the document of the fit.

        Raises
        ------
        MatrixError
            If something in the upload cannot be used, said without the service's own paths.
        """
        unpacked = folder / "unpacked"
        unpacked.mkdir()

        def tell(stage: str) -> None:
            (folder / STAGE).write_text(stage, encoding="utf-8")

        tell(STAGES[0])
        try:
            parcel = opened_parcel(folder / UPLOAD, unpacked, asked.reference, self.most_bytes)
            if asked.instrument is not None:
                instrument = self.packaged_instrument(asked.instrument)
            elif parcel.instrument is not None:
                instrument = self.load_instrument(parcel.instrument)
            else:
                instrument = self.own
            report = fit_file(
                instrument,
                parcel.reference,
                asked.options,
                dataset=asked.dataset,
                threads=self.threads,
                progress=tell,
            )
        except PyrcalError as error:
            said = str(error).replace(f"{unpacked}/", "").replace(f"{folder}/", "")
            raise MatrixError(said) from error
        tell(STAGES[-1])
        drawn = {"own_instrument": instrument is self.own, **numbers(report.fit)}
        (folder / FIGURES).write_text(json.dumps(drawn), encoding="utf-8")
        return document(report)
