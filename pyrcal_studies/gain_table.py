"""The gain table against the optical gains of the diffractive telescope in other seeing.

The table's shape is that of 1 arcsec. Here a loop is closed in other seeing, the optical gain of a
few modes measured free of noise around snapshots of its residual, and the table asked for all of
them from two high ones, then from a low one as well.
Run: ``python -m pyrcal_studies.gain_table --seeing 0.7 --seeing 1.4``.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.optical_gain import RUN_GAIN, closed_loop, optical_gains, telescope_of
from service.control.gains import REFERENCE_GAINS, REFERENCE_MODES, ModeGain, gain_table
from sim_rtc.options import parse_options

MODES = np.array([0, 20, 64, 150, 257, 449, 509, 545, 593])
GIVEN = ((509, 545), (20, 509, 545))
"""Modes the table is told."""

SIGMA = 0.02
"""1 sigma of each, as the table is told."""


def measured(seeing: float, n_frames: int) -> tuple[NDArray[np.float64], float]:
    """Return the optical gains of ``MODES`` and what the loop left, nm."""
    words = f"--plant diffractive --alpha 0,0,0,1 --seed 3 --mag 8 --seeing {seeing}"
    options = parse_options(words.split())
    telescope = telescope_of(options)
    gains = np.full(len(telescope.reconstructor.matrix), RUN_GAIN, np.float32)
    run = closed_loop(telescope, gains, n_frames)
    return optical_gains(run, MODES), 1e9 * run.error_m(telescope.weights)


def mode_gain(mode: int, gain: float) -> ModeGain:
    """Return one gain as the table is told it."""
    return ModeGain(mode=int(mode), gain=float(gain), sigma=SIGMA, scatter=SIGMA, t_ns_utc=0)


def row(name: str, values: NDArray[np.float64], digits: int) -> str:
    """Return one row of the table."""
    return f"| {name} | " + " | ".join(f"{value:.{digits}f}" for value in values) + " |\n"


def main() -> None:
    """Print what is measured, what the table says, and how far off it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeing", type=float, action="append", help="default 0.7 and 1.4")
    parser.add_argument("--frames", type=int, default=200, help="of each loop, after settling")
    given = parser.parse_args()
    reference = np.interp(np.log1p(MODES), np.log1p(REFERENCE_MODES), REFERENCE_GAINS)
    sys.stdout.write(row("mode", MODES.astype(float), 0) + "|---" * (len(MODES) + 1) + "|\n")
    with threadpool_limits(1):
        for seeing in given.seeing or [0.7, 1.4]:
            gains, left_nm = measured(seeing, given.frames)
            sys.stdout.write(row(f'{seeing}", {left_nm:.0f} nm left', gains, 3))
            sys.stdout.write(row("strength", np.log(gains) / np.log(reference), 2))
            for known in GIVEN:
                pairs = [pair for pair in zip(MODES, gains, strict=True) if pair[0] in known]
                table = gain_table([mode_gain(*pair) for pair in pairs], 594)
                off = table.optical_gain[MODES] / gains - 1.0
                sys.stdout.write(row(f"table from {known}, off by %", 100.0 * off, 1))
                sys.stdout.write(row("its 1 sigma, %", 100.0 * table.relative_sigma[MODES], 1))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
