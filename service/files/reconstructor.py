"""A reconstructor as an HDF5 file, with everything it was made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from service import __version__
from service.control.recipe import Provenance
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reconstructor:
    """What is written."""

    matrix: NDArray[np.float32]
    """``(n_modes, n_slopes)`` metres OPD per slope, slopes as the RTC lists them."""

    interaction_matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` what it inverts, slopes as the RTC lists them."""

    provenance: Provenance
    """How it was made."""

    circumstances: Mapping[str, str | int | float | bool]
    """Instrument, model, orientation: further attributes."""


def fill_reconstructor(file: h5py.File, made: Reconstructor) -> None:
    """Write a reconstructor into an open, empty HDF5 file."""
    file["reconstructor"] = np.ascontiguousarray(made.matrix, dtype="<f4")
    file["reconstructor"].attrs["description"] = (
        "(n_modes, n_slopes), metres OPD per slope, slopes as the RTC lists them, single pass"
    )
    file["interaction_matrix"] = np.ascontiguousarray(made.interaction_matrix, dtype="<f4")
    file["interaction_matrix"].attrs["description"] = (
        "(n_slopes, n_modes), slope per metre OPD, slopes as the RTC lists them, single pass"
    )
    covariance = made.provenance.covariance
    if covariance is not None:
        file["covariance"] = covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
        file["covariance"].attrs["parameters"] = PARAMETERS
    gains = made.provenance.gains
    if gains is not None:
        n_modes = made.provenance.recipe.n_modes
        file["calibration_gains"] = gains.values[:n_modes]
        file["calibration_gains"].attrs["measured"] = gains.measured[:n_modes]
    attributes: dict[str, Any] = {
        **made.circumstances,
        **made.provenance.attributes(),
        "software": f"pyrcal {__version__}",
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    file.attrs.update(attributes)
