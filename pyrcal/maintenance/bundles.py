"""``pyrcal bundle``: write a calibration from a service's archive as one file, and check it."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.maintenance.archive import open_archive, read_settings
from service.archive import Archive
from service.archive.serialisation import NOT_UNDERSTOOD, from_json, to_json
from service.config import Settings
from service.errors import ArchiveError, ConfigurationError, UnknownIdError, say, shown
from service.files.bundle import RECONSTRUCTOR, Bundle, read_bundle, write_bundle
from service.files.container import opened
from service.files.disk_cache import cached_basis
from service.files.documents import json_text
from service.files.whole import open_hdf5
from service.instrument import load_instrument
from service.model.instrument import Instrument, instrument_sha256
from service.model.interaction import RtcInteractionModel
from service.model.modes import ModalBasis
from service.records.products import MatrixState, ReconstructorRecord
from service.wire import checksum

IN_USE = "in-use"


def main(options: argparse.Namespace) -> int:
    """Write or check a bundle; return the exit status.

    Raises
    ------
    PyrcalError
        If it cannot be done.
    """
    if options.action == "check":
        found = _summary(options.bundle, read_bundle(options.bundle), as_json=options.json)
        print(shown(found, keep="\n"))
        return 0
    settings = read_settings(options)
    instrument = load_instrument(options.instrument or settings.service.instrument)
    bundle = _bundle_of(options, settings, instrument)
    write_bundle(options.output, bundle)
    say(f"{options.output}: {bundle.id}, {', '.join(bundle.arrays)}; sha256 {bundle.sha256}")
    return 0


def _bundle_of(options: argparse.Namespace, settings: Settings, instrument: Instrument) -> Bundle:
    archived = Path(options.source)
    if archived.suffix == ".h5" and archived.is_file():
        return _read_product(options, instrument, archived, _record_in(archived))
    with open_archive(settings) as archive:
        record = _record(archive, options.source)
        # Reading it refuses one that is damaged.
        archive.reconstructors.matrix(record.id)
        path = archive.reconstructors.path_of(record.id)
        bundle = _read_product(options, instrument, path, record)
        if record.reference_id in archive.references.stored():
            offset = archive.references.matrix(record.reference_id)
            bundle = replace(bundle, arrays={**bundle.arrays, "reference_offset": offset})
        return bundle


def _read_product(
    options: argparse.Namespace, instrument: Instrument, path: Path, record: ReconstructorRecord
) -> Bundle:
    """Return an archived product, the requested companion products, and its basis."""
    with open_hdf5(path) as file:
        names = {RECONSTRUCTOR: RECONSTRUCTOR, **_COMPANION_ARRAYS}
        # Gains and covariance are not of every product: the RTC's own matrix has none.
        arrays = {name: np.asarray(file[at][()]) for name, at in names.items() if at in file}
        provenance = {
            key: value.item() if isinstance(value, np.generic) else value
            for key, value in file["provenance"].attrs.items()
        }
    # The basis in the bundle is made from this instrument file, so it must be the right one.
    made_for = provenance.get("instrument")
    if made_for not in {None, instrument.name}:
        raise ConfigurationError(
            f"{record.id}: was made for {made_for}; found the instrument {instrument.name}: give "
            "its own with --instrument"
        )
    # The archive has no basis: it follows from the instrument, whose checksum is in the bundle.
    basis = cached_basis(instrument)
    if isinstance(basis, ModalBasis):
        arrays["mode_to_actuator"] = np.asarray(basis.mode_to_actuator)
    if options.interaction_matrix:
        arrays["interaction_matrix"] = _interaction_matrix(record, instrument, basis)
    if options.reference is not None:
        arrays["reference_slopes"] = _reference(options.reference, arrays[RECONSTRUCTOR].shape[1])
    facts = {
        "record": json.loads(to_json(record)),
        "provenance": provenance,
        "instrument": instrument.name,
        "instrument_sha256": instrument_sha256(instrument),
    }
    return Bundle(id=record.id, arrays=arrays, facts=facts)


def _record_in(path: Path) -> ReconstructorRecord:
    """Return the record in an archived product after comparing it with its matrix."""
    try:
        with open_hdf5(path) as file:
            record = from_json(file.attrs["record"], ReconstructorRecord)
            stated, found = file.attrs["sha256"], checksum(np.asarray(file[RECONSTRUCTOR][()]))
    except NOT_UNDERSTOOD as error:
        raise ArchiveError(f"{path}: no archived reconstructor: {error}") from error
    # The file may have left the archive, whose reading would have compared them.
    if found != stated:
        raise ArchiveError(f"{path}: damaged: found checksum {found}, expected {stated}")
    return record


_COMPANION_ARRAYS = {
    "optical_gain": "gains/optical_gain",
    "gain_factor": "gains/factor",
    "covariance": "covariance",
}
"""Arrays of a bundle that are stored next to a reconstructor in the archive, and their names there.
"""


def _record(archive: Archive, name: str) -> ReconstructorRecord:
    records = archive.reconstructors.records()
    # Records are in the order in which they were made: the newest one of a name counts.
    matching = (
        [one for one in records if one.state is MatrixState.APPLIED]
        if name == IN_USE
        else [one for one in records if one.id == name]
    )
    if not matching:
        what = "no reconstructor is in use" if name == IN_USE else f"{name}: no such reconstructor"
        raise UnknownIdError(f"{what} in {archive.directory}; pyrcal archive list has all")
    return matching[-1]


def _interaction_matrix(
    record: ReconstructorRecord,
    instrument: Instrument,
    basis: Any,  # noqa: ANN401 - any basis
) -> NDArray[np.float32]:
    # A matrix that was read from the RTC at its start has no known registration.
    if record.alpha is None:
        raise ArchiveError(f"{record.id}: is the RTC's own; its registration is unknown")
    model = RtcInteractionModel(instrument, basis)
    return np.asarray(model.interaction_matrix(record.alpha)[:, : record.n_modes], np.float32)


def _reference(path: Path, n_slopes: int) -> NDArray[np.float32]:
    with opened(path) as container:
        # A NumPy file has one array, without a name.
        found = next(iter(container.arrays.values())).numbers()
    if found.shape != (n_slopes,):
        raise ConfigurationError(
            f"--reference {path}: found shape {found.shape}, expected ({n_slopes},)"
        )
    return np.asarray(found, np.float32)


def _summary(path: Path, bundle: Bundle, *, as_json: bool) -> str:
    """Return the summary of a bundle."""
    if as_json:
        arrays = {name: list(values.shape) for name, values in bundle.arrays.items()}
        found = {"id": bundle.id, "sha256": bundle.sha256, "arrays": arrays, **bundle.facts}
        return json_text(found, indent=2)
    record = bundle.facts.get("record", {})
    lines = [
        f"{path}: sound; {bundle.id} of {bundle.facts.get('instrument')}",
        *(f"  {name:18} {values.shape} {values.dtype}" for name, values in bundle.arrays.items()),
    ]
    if record.get("alpha"):
        numbers = {name: value for name, value in record["alpha"].items() if value is not None}
        lines.append("  alpha " + ", ".join(f"{name} {v:.5g}" for name, v in numbers.items()))
    gate = record.get("gate")
    if gate:
        verdict = "accepted" if gate["accepted"] else "refused"
        lines.append(f"  gate  {verdict}, worst pole radius {gate['worst_pole_radius']:.3f}")
    return "\n".join([*lines, f"  sha256 {bundle.sha256}"])
