"""What the measured illumination does to the model of a telescope lit unevenly.

By day on the diffractive telescope: 400 modes are measured with noise, the pupil is found in the
mean light of the four images, and the model is fitted to the matrix twice, evenly lit and lit as
the images say. Prints the residual of the matrix and the error of α both ways.
Run: ``python -m pyrcal_studies.illumination --seeds 3``.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.registered import PASSES, STROKE_M, Array, measured_by_day, registered
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.pupil import Illumination
from service.model.sensors.pyramid.light import PyramidLight, find_pupil, measure_illumination
from service.model.sensors.sensor import CannotTell

N_FRAMES = 100
"""Averaged in the flux map."""


def main() -> None:
    """Print two rows for every seed: even and measured light."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--averages", type=int, default=4, help="push-pulls per mode; 0: no noise")
    parser.add_argument("--truth", default="realistic", help="imperfections of the telescope")
    parser.add_argument("--extra", default="", help="further options of the simulator, in quotes")
    given = parser.parse_args()
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)
    sys.stdout.write(
        "| seed | light | residual | without noise | x, y / % of a subaperture | rotation / deg | "
        "magnification / % |\n| --- | --- | --- | --- | --- | --- | --- |\n"
    )
    with threadpool_limits(1):
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            words = (
                f"--plant diffractive --scene daytime --seed {seed} "
                f"--imperfections {given.truth} {given.extra}"
            )
            measured, telescope = measured_by_day(words, given.averages)
            optics = telescope.optics.at(0.0)
            rng = np.random.default_rng(seed)
            flux = telescope.detector.flux(optics.images) or b""
            light = N_FRAMES * PyramidLight(instrument=instrument).counts_of(flux)
            counts = rng.poisson(light) / N_FRAMES
            position = find_pupil(counts, instrument)
            if isinstance(position, CannotTell):
                sys.stdout.write(f"| {seed} | {position.reason} | | | | | |\n")
                continue
            start = Misregistration(shift_x_subap=position.at[0], shift_y_subap=position.at[1])
            _tell(f"{seed} | images alone", None, 0.0, start, optics.alpha)
            read = np.abs(measured).sum(axis=1) > 0.0
            noise = noise_share(measured, telescope.detector.sigma, given.averages)
            lights: dict[str, Illumination | None] = {
                "even": None,
                "measured": measure_illumination(counts, instrument, position),
            }
            for name, illumination in lights.items():
                model = InteractionModel(instrument, basis, illumination=illumination)
                fit = registered(model, measured, start, read)
                _tell(f"{seed} | {name}", fit.residual, noise, fit.alpha, optics.alpha)


def noise_share(measured: Array, sigma: NDArray[np.float32], averages: int) -> float:
    """Return the RMS noise of the matrix over its RMS; ``sigma`` ``(n_slopes,)`` of a frame."""
    if averages == 0:
        return 0.0
    slope = np.sqrt(np.mean(sigma**2))
    element = slope / (STROKE_M * PASSES * np.sqrt(2 * averages))
    return float(element / np.sqrt(np.mean(measured**2)))


def _tell(
    name: str,
    residual: float | None,
    noise: float,
    found: Misregistration,
    true: Misregistration,
) -> None:
    x, y, turn, size = (found.vector - true.vector) * BOUNDARY_SCALE
    cells = " | "
    if residual is not None:
        cells = f"{residual:.1%} | {np.sqrt(max(residual**2 - noise**2, 0.0)):.1%}"
    sys.stdout.write(
        f"| {name} | {cells} | {100 * x:+.2f}, {100 * y:+.2f} | {turn:+.4f} | {100 * size:+.3f} |\n"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
