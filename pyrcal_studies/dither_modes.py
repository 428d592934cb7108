"""Does it matter which modes are dithered? Precision of sets of four, by the model alone.

Run: ``python -m pyrcal_studies.dither_modes``. White noise on the slopes, a free gain for each
mode, the same amplitude on all: σ of each parameter of α, over that of the four the service
chooses.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from service.config import load_instrument
from service.config.policy import policy_of
from service.config.settings import Settings
from service.control.dither import N_MODES_ABOVE_LOOP, compute_information, select_informative_modes
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import PARAMETERS
from service.model.modes import modal_basis

FIRST = (400, 500)
"""Modes from here on are not controlled."""

N_LINES = 4
N_SETS = 4000

Array = NDArray[np.float64]


def main() -> None:
    """Print, for each start of the uncontrolled modes, how other sets of four compare."""
    instrument = load_instrument("flao-lbt")
    basis = modal_basis(instrument)
    model = RtcInteractionModel(instrument, basis, pupil_sampling=3, detector_nodes=3)
    known = compute_information(model.linearise(instrument.start))
    wanted = policy_of(Settings()).dither_sigma
    rng = np.random.default_rng(0)
    rows = [
        "| uncontrolled from | chosen | parameter | evenly spread | best | median | worst |",
        "|---|---|---|---|---|---|---|",
    ]
    for first in FIRST:
        above = np.arange(first, min(first + N_MODES_ABOVE_LOOP, len(known)))
        own = select_informative_modes(known, range(first, int(above[-1]) + 1), N_LINES, wanted)
        spread = above[np.linspace(0, len(above) - 1, 2 * N_LINES + 1)[1::2].astype(int)]
        sets = [rng.choice(above, N_LINES, replace=False) for _ in range(N_SETS)]
        chosen = _sigma(known, np.array(own))
        ratio = np.array([_sigma(known, modes) for modes in sets]) / chosen
        even = _sigma(known, spread) / chosen
        for name, spaced, column in zip(PARAMETERS, even, ratio.T, strict=True):
            low, middle, high = column.min(), np.median(column), column.max()
            rows.append(
                f"| {first} | {own} | {name} | {spaced:.2f} | {low:.2f} | {middle:.2f} "
                f"| {high:.2f} |"
            )
    sys.stdout.write("\n".join(rows) + "\n")


def _sigma(known: Array, modes: NDArray[np.int64]) -> Array:
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(known[modes].sum(axis=0)))))


if __name__ == "__main__":
    main()
