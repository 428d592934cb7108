"""What windows cut between pixels cost: full frames of the diffractive pyramid, fitted.

``python -m pyrcal_studies.frame_windows`` takes frames of a pyramid whose four pupil images lie up
to 3.4 pixels off a rectangle, cuts four windows of one pixel per subaperture, and fits the slopes;
beside it the same light on pixels that need no cutting.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.matrix import fit_matrix
from service.estimation.reference import Reference
from service.instrument.mirrors import grid
from service.model.instrument import Instrument, Mirror
from service.model.kinds import KarhunenLoeve, Normalisation, Stop
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation
from service.model.modes import modal_basis
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows, Pyramid, pyramid_in
from service.model.sensors.pyramid.detector_windows import (
    frame_windows,
    slopes_from_frames,
    slopes_per_unit,
)
from service.model.slopes import SlopeRecipe
from sim_rtc.telescope.diffractive import DiffractivePyramid, centred_pupil

Array = NDArray[np.float64]

OFFSETS_PX = np.array([[0.0, 0.0], [1.37, -3.4], [-2.21, 0.49], [3.08, 2.65]])
"""Of the four images from a rectangle, rows and columns."""

TRUTH = Misregistration(
    shift_x_subap=0.21, shift_y_subap=-0.13, rotation_rad=np.deg2rad(0.6), magnification=1.005
)
STROKE_M = 2e-9
SAMPLING = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """A mean frame and the changes that modes make."""

    rest: Array
    """``(2, n, 2, n)``."""

    change: Array
    """``(n_modes, 2, n, 2, n)`` per metre."""


def bench(diameter_px: float) -> Instrument:
    """Return a bench with an ALPAO-like mirror of 97 actuators and one pixel per subaperture."""
    n = int(np.ceil(diameter_px)) + 2
    separation = n + 12
    return Instrument(
        name="bench",
        diameter_m=8.0,
        stop=Stop.TELESCOPE,
        wfs=Pyramid(
            n_subapertures=n,
            wavelength_m=750e-9,
            modulation_lambda_over_d=3.0,
            pupil_separation_subap=float(separation),
            pupil_diameter_subap=diameter_px,
        ),
        mirror=Mirror(positions_m=grid(11, 0.8, 8.8), pitch_m=0.8),
        modes=KarhunenLoeve(n_modes=80),
        frames=FrameWindows(centres_px=centres_px(separation)),
    )


def centres_px(separation_px: int) -> Array:
    """Return where the images lie, ``(4, 2)`` row and column."""
    side = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    return np.asarray(separation_px * (side + 0.5) + OFFSETS_PX - 0.5)


def exposed(instrument: Instrument, n: int, offsets_px: Array, modes: NDArray[np.intp]) -> Light:
    """Return the light on windows of ``n`` pixels, each image moved by its own offset."""
    pupil = centred_pupil(instrument, SAMPLING)
    sensor = DiffractivePyramid(replace(pyramid_in(instrument), n_subapertures=n), pupil)
    sensors = [sensor.at((column, row)) for row, column in offsets_px]

    def images(opd_m: Array) -> Array:
        found = np.empty((2, n, 2, n))
        for place, moved in enumerate(sensors):
            y, x = divmod(place, 2)
            found[y, :, x] = moved.images(opd_m)[y, :, x]
        return found

    moved = (pupil.points - TRUTH.vector[:2]) @ rotation(TRUTH.rotation_rad) / TRUTH.magnification
    shapes = STROKE_M * modal_basis(instrument).subset(modes).render(moved).T
    change = [(images(shape) - images(-shape)) / (2 * STROKE_M) for shape in shapes]
    return Light(rest=images(np.zeros(len(moved))), change=np.array(change))


def main() -> None:
    """Print the error of the slopes and of α, with and without cutting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--diameter-px", type=float, default=40.0)
    parser.add_argument("--every", type=int, default=2, help="of 80 modes fit every so many")
    options = parser.parse_args()
    instrument = bench(options.diameter_px)
    modes = np.union1d(np.arange(10), np.arange(0, 80, options.every))
    n, separation = (
        instrument.wfs.n_subapertures,
        int(pyramid_in(instrument).image_separation_subap),
    )
    with threadpool_limits(1), ThreadPoolExecutor(2) as threads:
        frames = exposed(instrument, separation, OFFSETS_PX, modes)
        direct = exposed(instrument, n, np.zeros((4, 2)), modes)
        side = 2 * separation
        flux_frame = frames.rest.reshape(side, side)
        blind = replace(instrument, frames=FrameWindows())
        found = frame_windows(blind, flux_frame).centres_px.reshape(4, 2)
        off_px = np.abs(found - centres_px(separation)).max()
        print(f"images found in the light within {off_px:.2f} px")
        for normalisation in Normalisation:
            recipe = SlopeRecipe(normalisation=normalisation)
            user = replace(instrument, slopes=recipe)
            cut = slopes_from_frames(user, frames.change.reshape(-1, side, side), flux_frame)
            valid = rtc_valid_subapertures(user)
            whole = slopes_per_unit(direct.rest, direct.change, valid, recipe)
            error = np.linalg.norm(cut - whole, axis=0) / np.linalg.norm(whole, axis=0)
            print(
                f"{normalisation}: slopes of a mode off by {error.min():.2%} to {error.max():.2%}"
            )
            for name, matrix in (("cut between pixels", cut), ("pixels in place", whole)):
                reference = Reference(matrix=matrix, modes=modes)
                fit = fit_matrix(user, reference, mapper=threads.map)
                off = (fit.alpha.vector - TRUTH.vector) * BOUNDARY_SCALE
                print(
                    f"  {name:19s} shift {100 * off[0]:6.3f}, {100 * off[1]:6.3f} % of a "
                    f"subaperture, {off[2]:7.4f} deg, {100 * off[3]:7.4f} %; {fit.verdict}"
                )


if __name__ == "__main__":
    main()
