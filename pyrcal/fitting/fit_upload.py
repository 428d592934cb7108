"""Fit an uploaded matrix, or an archive with its instrument file."""

from __future__ import annotations

import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from pyrcal.fitting.figures import numbers
from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.matrix import FitOptions
from pyrcal.fitting.recorded import check_sealed
from pyrcal.fitting.report import document
from service.errors import ConfigurationError, MatrixError, PyrcalError
from service.files import parse_alpha, parse_modes
from service.files.documents import json_text
from service.files.fit_folder import DOCUMENT, FIGURES, STAGE, STAGES, UPLOAD, FitRequest
from service.files.toml import read_toml, reference_parts
from service.instrument import load_instrument, packaged_instrument
from service.model.instrument import Instrument, instrument_sha256
from service.model.kinds import Method

MOST_FILES = 32

_ZIP_BEGINS = b"PK\x03\x04"

_DAMAGE = (zipfile.BadZipFile, zlib.error, RuntimeError, OSError, EOFError, ValueError)
"""Exceptions that a damaged or encrypted archive raises."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Upload:
    """The files of an upload, on disk."""

    reference: Path
    """The measured matrix."""

    instrument: Path | None
    """Instrument file; None if the matrix was uploaded alone."""


def open_upload(upload: Path, folder: Path, reference: str | None, max_bytes: int) -> Upload:
    """Return the files of an upload; a zip archive is unpacked into the empty ``folder``.

    Parameters
    ----------
    upload
        The uploaded file.
    folder
        Folder for the files of an archive.
    reference
        Name of the measured file in an archive; None for the only possible one.
    max_bytes
        Largest size of all files of an archive together, bytes.

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
        return Upload(reference=upload, instrument=None)
    try:
        with zipfile.ZipFile(upload) as archive:
            names = _unpack(archive, folder, max_bytes)
    except _DAMAGE as error:
        raise MatrixError(f"upload: damaged zip archive: {error}") from error
    for name in names:
        check_sealed(folder / name)
    instrument = folder / _only_toml(names)
    referred = set(_list_references(instrument))
    for name in sorted(referred - set(names)):
        raise ConfigurationError(
            f"{instrument.name}: refers to {name}, expected a file of the archive: "
            f"{', '.join(names)}"
        )
    left = [name for name in names if name not in referred and name != instrument.name]
    return Upload(
        reference=folder / _choose_measured(left, names, reference), instrument=instrument
    )


def _only_toml(names: list[str]) -> str:
    tomls = [name for name in names if name.endswith(".toml")]
    if len(tomls) != 1:
        raise MatrixError(f"upload: found {len(tomls)} .toml files in the archive, expected one")
    return tomls[0]


def _choose_measured(left: list[str], names: list[str], reference: str | None) -> str:
    """Return the name of the measured file: the requested one, or the only one in ``left``."""
    chosen = reference if reference is not None else left[0] if len(left) == 1 else None
    if chosen is None or chosen not in names:
        raise MatrixError(
            f"upload: found {reference or 'several files or none'} as the measured one, expected "
            f"?reference= and one of {', '.join(n for n in names if not n.endswith('.toml'))}"
        )
    return chosen


def _unpack(archive: zipfile.ZipFile, folder: Path, max_bytes: int) -> list[str]:
    """Write the files of an archive and return their names."""
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    # The stated sizes, before anything is written: a small archive may unpack to any size.
    size = sum(entry.file_size for entry in entries)
    if len(entries) > MOST_FILES or size > max_bytes:
        raise MatrixError(
            f"upload: found {len(entries)} files of {size / 1e6:.0f} MB in the archive, expected "
            f"at most {MOST_FILES} of {max_bytes / 1e6:.0f} MB"
        )
    names = []
    for entry in entries:
        # A name such as ../x would be written outside the folder.
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


def _list_references(instrument: Path) -> Iterator[str]:
    """Yield every file that an instrument file refers to."""
    try:
        tables = read_toml(instrument)
    except ConfigurationError:
        return  # loading the file later reports the error
    for text in _iterate_texts(tables):
        parts = reference_parts(text)
        if parts is not None:
            yield parts["path"]


def _iterate_texts(value: object) -> Iterator[str]:
    """Yield every text in a TOML file's values, at any depth."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _iterate_texts(part)


def fit_upload(folder: Path, request: FitRequest) -> None:
    """Fit the upload in the folder, and write the result there.

    Raises
    ------
    MatrixError
        If something in the upload cannot be used; the message has none of the service's own paths.
    """
    unpacked = folder / "unpacked"
    unpacked.mkdir()

    def write_stage(stage: str) -> None:
        (folder / STAGE).write_text(stage, encoding="utf-8")

    write_stage(STAGES[0])
    asked = request.asked
    try:
        upload = open_upload(folder / UPLOAD, unpacked, asked["reference"], request.max_bytes)
        instrument, remarks = _instrument_of(upload, request)
        report = fit_file(
            instrument,
            upload.reference,
            _options(asked),
            dataset=asked["dataset"],
            threads=request.threads,
            progress=write_stage,
        )
    except PyrcalError as error:
        text = str(error).replace(f"{unpacked}/", "").replace(f"{folder}/", "")
        raise MatrixError(text) from error
    write_stage(STAGES[-1])
    report = replace(report, notes=(*report.notes, *remarks))
    own = asked["instrument"] is None and upload.instrument is None and not remarks
    _write(folder / FIGURES, {"own_instrument": own, **numbers(report.fit)})
    _write(folder / DOCUMENT, document(report))


def _instrument_of(upload: Upload, request: FitRequest) -> tuple[Instrument, tuple[str, ...]]:
    """Return the instrument to fit with, and a note for the reader of the fit."""
    if request.asked["instrument"] is not None:
        return packaged_instrument(request.asked["instrument"]), ()
    if upload.instrument is not None:
        return load_instrument(upload.instrument), ()
    own = load_instrument(request.own_instrument)
    if instrument_sha256(own) == request.own_sha256:
        return own, ()
    return own, ("the instrument file has changed since the service began: read as it is now",)


def _options(asked: Mapping[str, Any]) -> FitOptions:
    return FitOptions(
        method=Method(asked["method"]),
        modes=None if asked["modes"] is None else parse_modes(asked["modes"]),
        start=None if asked["start"] is None else parse_alpha(asked["start"]),
        gain_map=asked["gain_map"],
        anamorphosis=asked["anamorphosis"],
    )


def _write(path: Path, found: Mapping[str, Any]) -> None:
    path.write_text(json_text(found), encoding="utf-8")
