"""The files that a user of a peer would have: its matrix, its mask, an instrument file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.peers_cases import N_MODES, Case, basis, bench
from pyrcal_studies.peers_pushpull import Measured
from service.model.kinds import Influence, Stop

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Listing:
    """How the peer lists its slopes, and what its user would say of that."""

    order: str
    """``xy`` or ``interleaved``, as its user would say."""

    normalisation: str
    """``global`` or ``local``."""

    rows_first: bool = False
    """Whether what the peer lists first, and calls x, is the slope along the rows of its mask."""


LISTINGS = {
    "oopao": Listing(order="xy", normalisation="global"),
    "hcipy": Listing(order="xy", normalisation="local"),
    "specula": Listing(order="xy", normalisation="global", rows_first=True),
}


def write_reference(path: Path, measured: Measured, cube: Array | None) -> None:
    """Write the matrix and whatever the instrument file refers to."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = measured.matrix
        file["valid_subapertures"] = measured.valid
        if cube is not None:
            file["influence_functions"] = cube
            file["mode_to_actuator"] = basis(Influence.GAUSSIAN).mode_to_actuator


def write_instrument(
    path: Path, reference: Path, case: Case, measured: Measured, listing: Listing, stop: Stop
) -> None:
    """Write the instrument file; ``stop`` need not be the peer's, the rest is."""
    told = bench(case)
    mirror = f'layout = "rings"\n\n[modes]\nn_modes = {N_MODES}\n'
    if case.own_mirror:
        mirror = (
            f'influence_functions = "{reference.name}:/influence_functions"\n'
            f'mode_to_actuator = "{reference.name}:/mode_to_actuator"\n'
            f"modes_pitch_m = {told.diameter_m / told.n_pupil!r}\n"
        )
    path.write_text(
        f'[instrument]\nname = "{case.peer}"\ndiameter_m = {told.diameter_m}\n'
        f'obscuration_ratio = {told.obscuration_ratio}\nstop = "{stop}"\n\n'
        f'[wfs]\nkind = "pyramid"\nn_subapertures = {told.n_subapertures}\n'
        f"pupil_separation_subap = {told.pupil_separation_subap}\n"
        f"wavelength_m = {measured.wavelength_m!r}\n"
        f"modulation_lambda_over_d = {told.modulation_lambda_over_d}\n"
        f'valid_subapertures = "{reference.name}:/valid_subapertures"\n\n'
        f"[mirror]\n{mirror}\n"
        f'[slopes]\norder = "{listing.order}"\norientation = "auto"\n'
        f'normalisation = "{listing.normalisation}"\n'
    )


def turned(measured: Measured, listing: Listing) -> Measured:
    """Return the same matrix as a bench with other habits lists it: interleaved, x first.

    The detector is mirrored on its diagonal, its rows are counted from the other end while Sy
    keeps its sign, and every slope has the other sign.
    """
    n_modes = measured.matrix.shape[1]
    maps = np.zeros((2, *measured.valid.shape, n_modes))
    maps[:, measured.valid] = measured.matrix.reshape(2, -1, n_modes)
    # The slope along the rows runs along the columns once the detector is mirrored.
    by_columns = maps if listing.rows_first else maps[::-1]
    maps = -by_columns.transpose(0, 2, 1, 3)[:, ::-1]
    valid = np.ascontiguousarray(measured.valid.T[::-1])
    interleaved = maps[:, valid].transpose(1, 0, 2).reshape(-1, n_modes)
    return replace(measured, matrix=interleaved, valid=valid)
