"""Measure the interaction matrix of the tiny bench on the diffractive simulator, as by day.

Push-pull of 10 nm RMS with photon noise, the light meeting the mirror twice, and the slopes listed
as an RTC might. Run: ``python -m tests.data.tiny.make``; it writes ``tiny.h5`` beside itself.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.pupil import valid_subapertures
from service.model.slopes import Orientation, SlopeRecipe, rtc_mask, to_rtc
from sim_rtc.telescope.diffractive import DiffractivePlant

HERE = Path(__file__).parent
ALPHA = {
    "shift_x_subap": -0.31,
    "shift_y_subap": 0.17,
    "rotation_deg": 64.2,
    "magnification": 0.985,
}
ORIENTATION = Orientation(flip_y=True)
N_MODES = 40
STROKE_M = 10e-9
NOISE = 1e-4
"""RMS of a slope averaged over all pushes or pulls of a mode."""

SEED = 4


def push_pull(
    instrument: Instrument, alpha: Misregistration, n_modes: int, noise: float, seed: int
) -> NDArray[np.float64]:
    """Return the matrix of single pass ``(n_slopes, n_modes)``, axes of conventions.md."""
    plant_rng, rng = np.random.default_rng(seed).spawn(2)
    plant = DiffractivePlant(instrument, karhunen_loeve_basis(instrument), rng=plant_rng)
    optics = plant.optics(alpha)
    columns = []
    for mode in range(n_modes):
        command = np.zeros(optics.opd_per_command.shape[1], dtype=np.float32)
        command[mode] = STROKE_M
        push, pull = (
            optics.slopes(optics.mirror_opd_m(sign * command), None, rng).astype(np.float64)
            + noise * rng.normal(size=optics.n_slopes)
            for sign in (1.0, -1.0)
        )
        columns.append((push - pull) / (2.0 * STROKE_M))
    return np.column_stack(columns)


def main() -> None:
    """Write the file."""
    instrument = load_instrument(HERE / "tiny.toml")
    alpha = Misregistration.from_boundary(ALPHA)
    once = push_pull(instrument, alpha, N_MODES, NOISE / 2.0, SEED)
    mask = rtc_mask(valid_subapertures(instrument), ORIENTATION)
    matrix = to_rtc(2.0 * once, SlopeRecipe(order=SlopeOrder.YX, orientation=ORIENTATION), mask)
    with h5py.File(HERE / "tiny.h5", "w") as file:
        file["interaction_matrix"] = matrix.astype("<f4")
        file["interaction_matrix"].attrs["description"] = "(n_slopes, n_modes), slope per metre OPD"
        file.attrs.update({f"true_{name}": value for name, value in ALPHA.items()})


if __name__ == "__main__":
    main()
