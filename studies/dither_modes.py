"""Does it matter which modes are dithered? Precision of sets of four, by the model alone.

Run: ``python -m studies.dither_modes``. White noise on the slopes, a free gain for each mode, the
same amplitude on all: σ of each parameter of α, over that of the service's own four modes.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from service.config import load_instrument
from service.model.misregistration import PARAMETERS
from service.model.modes import modal_basis
from service.model.rtc import RtcInteractionModel

FIRST = (400, 500)
"""Modes from here on are not controlled."""

N_SETS = 4000

Array = NDArray[np.float64]


def main() -> None:
    """Print, for each start of the uncontrolled modes, how sets drawn at random compare."""
    information = _information()
    n_modes = len(information)
    rng = np.random.default_rng(0)
    rows = ["| uncontrolled from | parameter | best | median | worst |", "|---|---|---|---|---|"]
    for first in FIRST:
        step = min(20, (n_modes - first) // 5)
        own = tuple(first + step // 2 + step * line for line in range(4))
        sets = [rng.choice(np.arange(first, n_modes), 4, replace=False) for _ in range(N_SETS)]
        ratio = np.array([_sigma(information, s) for s in sets]) / _sigma(information, own)
        for name, column in zip(PARAMETERS, ratio.T, strict=True):
            low, middle, high = column.min(), np.median(column), column.max()
            rows.append(f"| {first} | {name} | {low:.2f} | {middle:.2f} | {high:.2f} |")
    sys.stdout.write("\n".join(rows) + "\n")


def _information() -> Array:
    """Return ``(n_modes, 4, 4)`` what one mode tells of α, its own gain left free."""
    instrument = load_instrument("flao-lbt")
    model = RtcInteractionModel(
        instrument, modal_basis(instrument), pupil_sampling=3, detector_nodes=3
    )
    linearisation = model.linearise(instrument.start)
    found = []
    for mode in range(linearisation.matrix.shape[1]):
        response = linearisation.matrix[:, mode].astype(float)
        slopes = np.asarray(linearisation.derivatives[:, :, mode], float)
        slopes = slopes - np.outer(slopes @ response, response) / (response @ response)
        found.append(slopes @ slopes.T)
    return np.array(found)


def _sigma(information: Array, modes: tuple[int, ...] | NDArray[np.int64]) -> Array:
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information[list(modes)].sum(axis=0)))))


if __name__ == "__main__":
    main()
