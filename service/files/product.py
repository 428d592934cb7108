"""Fits and reconstructors as HDF5 files: all that was found, with what it was made of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from service import __version__
from service.control.reconstructor import Provenance
from service.errors import MatrixError
from service.files.report import FitReport, document
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.model.slopes import Orientation, SlopeOrder

_DESCRIPTIONS = {
    "covariance": "(4, 4) of the parameters, in the units of their names",
    "subset_scatter": "(4,) 1 sigma scatter of disjoint sets of modes, in the same units",
    "modes": "(n_used,) basis index of each column",
    "gains": "(n_used,) measured column over the model's, passes divided out",
    "residual_by_mode": "(n_used,) rms left over, as a fraction of the mode's own",
    "residual_map": "(2, n, n) [x or y, row, column] rms left over, as a fraction of the measured",
    "synthetic": "(n_slopes, n_used) the model, slope per metre OPD, axes of conventions",
    "measured": "(n_slopes, n_used) the reference in the same axes and unit",
    "valid": "(n, n) [row, column] subapertures the slopes belong to",
    "gain_map": "(n, n) gain over the pupil common to all modes",
    "anamorphosis": "(2,) half the stretch of x over y, and of 45 deg over 135 deg",
}


def fill_fit(file: h5py.File, report: FitReport) -> None:
    """Write a fit into an open, empty HDF5 file.

    The JSON document is the attribute ``document``; arrays that JSON cannot hold are datasets.
    """
    fit = report.fit
    arrays = {name: getattr(fit, name) for name in _DESCRIPTIONS}
    arrays["covariance"] = fit.covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
    arrays["subset_scatter"] = fit.subset_scatter * BOUNDARY_SCALE
    for name, values in arrays.items():
        if values is not None:
            _put(file, name, values, _DESCRIPTIONS[name])
    file["covariance"].attrs["parameters"] = PARAMETERS
    for step, scan in enumerate(fit.paper_table or ()):
        group = file.create_group(f"paper_table/{step:02d}")
        group.attrs.update(parameter=scan.parameter, step=scan.step, minimum=scan.minimum)
        group["samples"], group["chi"] = scan.samples, scan.chi
    file.attrs.update(fit.alpha.to_boundary())
    file.attrs.update(_provenance(report))
    file.attrs["document"] = json.dumps(document(report), allow_nan=False)


def _provenance(report: FitReport) -> dict[str, Any]:
    """Return where a fit comes from, as HDF5 attributes."""
    return {
        "instrument": report.instrument,
        "instrument_sha256": report.instrument_sha256,
        "reference": report.reference,
        "reference_sha256": report.reference_sha256,
        "double_pass": report.double_pass,
        "method": str(report.method),
        "verdict": report.fit.verdict,
        "accepted": report.fit.accepted,
        "notes": "\n".join(report.notes),
        **_made_now(),
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownFit:
    """What a reconstructor needs of an earlier fit."""

    alpha: Misregistration
    """The registration."""

    covariance: NDArray[np.float64] | None = None
    """``(4, 4)`` of ``alpha.vector``; None: only α is known."""

    modes: NDArray[np.intp] | None = None
    """``(n_used,)`` basis indices that ``gains`` belong to; None: not in the file."""

    gains: NDArray[np.float64] | None = None
    """``(n_used,)`` calibration gains."""

    orientation: Orientation | None = None
    """Of the slopes, as the fit found it; None: not in the file."""

    order: SlopeOrder | None = None
    """Of the components."""

    double_pass: bool | None = None
    """Whether light met the mirror twice in the measured matrix; None: not in the file."""

    accepted: bool | None = None
    """The verdict; None: α was given by hand."""

    origin: str = "given by hand"
    """Where this comes from."""

    instrument_sha256: str | None = None
    """Of the instrument it was fitted for; None: not in the file."""

    reference_sha256: str | None = None
    """Of the measured file; None: not in the file."""


def read_fit(path: Path) -> KnownFit:
    """Return the fit in a file that ``pyrcal fit`` wrote: its JSON document, or its product.

    Raises
    ------
    MatrixError
        If it is neither.
    """
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path, "r", locking=False) as file:
                return _of_product(file, path)
        return _of_document(json.loads(path.read_text(encoding="utf-8")), path)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise MatrixError(
            f"{path}: {error!r}; expected what pyrcal fit wrote with --json or --output"
        ) from error


def _of_document(values: dict[str, Any], path: Path) -> KnownFit:
    words = values["orientation"]
    sign = words["sign"]
    sign_x, sign_y = sign if isinstance(sign, list) else (sign, sign)
    scale = np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
    return KnownFit(
        alpha=Misregistration.from_boundary(values),
        covariance=np.array(values["covariance"], dtype=np.float64) / scale,
        orientation=Orientation(
            swap_xy=words["swap_xy"],
            flip_x=words["flip_x"],
            flip_y=words["flip_y"],
            sign_x=sign_x,
            sign_y=sign_y,
        ),
        order=SlopeOrder(words["order"]),
        accepted=str(values["verdict"]).startswith("accepted"),
        origin=str(path),
    )


def _of_product(file: h5py.File, path: Path) -> KnownFit:
    known = _of_document(json.loads(file.attrs["document"]), path)
    return replace(
        known,
        modes=np.asarray(file["modes"][()], dtype=np.intp),
        gains=np.asarray(file["gains"][()], dtype=np.float64),
        double_pass=bool(file.attrs["double_pass"]),
        accepted=bool(file.attrs["accepted"]),
        instrument_sha256=str(file.attrs["instrument_sha256"]),
        reference_sha256=str(file.attrs["reference_sha256"]),
    )


def fill_reconstructor(
    file: h5py.File,
    reconstructor: NDArray[np.float32],
    interaction_matrix: NDArray[np.float32],
    provenance: Provenance,
    circumstances: Mapping[str, str | int | float | bool],
) -> None:
    """Write a reconstructor, and what it is made of, into an open, empty HDF5 file.

    Parameters
    ----------
    file
        To be filled.
    reconstructor
        ``(n_modes, n_slopes)`` metres OPD per slope, slopes as the RTC lists them.
    interaction_matrix
        ``(n_slopes, n_modes)`` what it inverts, slopes as the RTC lists them.
    provenance
        How it was made.
    circumstances
        Instrument, model, orientation: further attributes.
    """
    described = "slopes as the RTC lists them, single pass"
    for name, values, shape in (
        ("reconstructor", reconstructor, "(n_modes, n_slopes), metres OPD per slope"),
        ("interaction_matrix", interaction_matrix, "(n_slopes, n_modes), slope per metre OPD"),
    ):
        _put(file, name, np.ascontiguousarray(values, dtype="<f4"), f"{shape}, {described}")
    if provenance.covariance is not None:
        file["covariance"] = provenance.covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
        file["covariance"].attrs["parameters"] = PARAMETERS
    if provenance.gains is not None:
        n_modes = provenance.recipe.n_modes
        file["calibration_gains"] = provenance.gains.values[:n_modes]
        file["calibration_gains"].attrs["measured"] = provenance.gains.measured[:n_modes]
    file.attrs.update({**circumstances, **provenance.attributes(), **_made_now()})


def _put(file: h5py.File, name: str, values: NDArray[Any], description: str) -> None:
    file[name] = values
    file[name].attrs["description"] = description


def _made_now() -> dict[str, str]:
    return {
        "software": f"pyrcal {__version__}",
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def instrument_sha256(instrument: Instrument) -> str:
    """Return the SHA-256 of every field of an instrument, arrays included, as hex.

    Two files that describe the same instrument, one with the defaults spelt out, are the same.
    """
    digest = hashlib.sha256()
    _add(digest, replace(instrument, remarks=()))
    return digest.hexdigest()


def _add(digest: hashlib._Hash, value: object) -> None:
    if is_dataclass(value):
        digest.update(f"{type(value).__name__}(".encode())
        for part in fields(value):
            digest.update(f"{part.name}=".encode())
            _add(digest, getattr(value, part.name))
        digest.update(b")")
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple):
        for item in value:
            _add(digest, item)
        digest.update(f"{len(value)};".encode())
    else:
        digest.update(f"{value!r};".encode())
