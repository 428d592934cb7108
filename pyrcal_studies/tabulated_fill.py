"""What the end of a table of modes does to the registration, and what leaving slopes out cures.

``python -m pyrcal_studies.tabulated_fill`` samples the modes of the full telescope on a grid, cuts
the table at the pupil or at its box, fills what is missing in several ways, and fits the exact
matrix with it: once with all slopes, once without those within one subaperture of unknown surface.
At the end the service's own fit does the same, orientation and all, with the fill it has.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from threadpoolctl import threadpool_limits

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import fit_matrix
from pyrcal_studies.registered import against, step_of
from service.estimation.reference import Reference
from service.instrument.reader import load_instrument
from service.model.instrument import Instrument, TabulatedModes
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import modal_basis
from service.model.sensors.sensor import Mapper
from service.model.tabulated import filled

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Modes = NDArray[np.intp]

TRUTHS = {
    "aligned": Misregistration(),
    "0.3 subap, 0.5 deg, 1 %": Misregistration(
        shift_x_subap=0.3, shift_y_subap=-0.2, rotation_rad=np.deg2rad(0.5), magnification=0.99
    ),
    "0.9 subap": Misregistration(shift_x_subap=0.9, shift_y_subap=-0.35),
}

N_STEPS = 5


def _nearest(cube: Array, known: Mask) -> Array:
    place = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(cube[:, place[0], place[1]])


def _odd(cube: Array, known: Mask) -> Array:
    return np.asarray(filled(cube, known, (0, 0)).T.reshape(cube.shape), dtype=np.float64)


FILLS: dict[str, Callable[[Array, Mask], Array]] = {
    "zeros": lambda cube, known: np.where(known, cube, 0.0),
    "nearest sample": _nearest,
    "odd about the edge": _odd,
}
"""The last one is the service's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The modes on a grid that ends somewhere."""

    cube: Array
    """``(n_modes, ny, nx)``, also beyond the end: the truth."""

    radius: Array
    """``(ny, nx)`` distance from the centre, subapertures."""

    offset: Array
    """``(ny, nx)`` the larger distance along an axis, subapertures."""


def sampled(instrument: Instrument, modes: Modes, points_per_subaperture: float) -> Table:
    """Return the instrument's modes, sampled well beyond the pupil."""
    half = int(18 * points_per_subaperture)
    line = np.arange(-half, half + 1) / points_per_subaperture
    x, y = np.meshgrid(line, line)
    basis = modal_basis(instrument).subset(modes)
    points = np.column_stack([x.ravel(), y.ravel()])
    rows = [basis.render(part) for part in np.array_split(points, 40)]
    cube = np.concatenate(rows).T.reshape(len(modes), len(line), len(line))
    return Table(cube=cube, radius=np.hypot(x, y), offset=np.maximum(abs(x), abs(y)))


def registered(
    model: InteractionModel, measured: Array, knowing: InteractionModel | None
) -> Misregistration:
    """Return α by Gauss-Newton from perfect registration, with a free gain for every mode.

    Slopes near surface that ``knowing`` does not know at the present α are left out.
    """
    alpha = Misregistration()
    for _ in range(N_STEPS):
        read = None if knowing is None else ~knowing.unknown_rows(alpha)
        step = step_of(against(model.linearise(alpha), measured, read=read))
        alpha = Misregistration.from_vector(alpha.vector + step)
    return alpha


def cases(
    instrument: Instrument, table: Table, pitch_m: float, mapper: Mapper
) -> Iterator[tuple[str, str, InteractionModel, InteractionModel]]:
    """Yield end and fill of every table, its model, and the one that knows where it ends."""
    radius = instrument.wfs.pupil_diameter / 2

    def model(cube: Array, known: Mask) -> InteractionModel:
        modes = TabulatedModes(cube=cube, pitch_m=pitch_m, known=known)
        tabulated = replace(instrument, mirror=modes)
        return InteractionModel(tabulated, modal_basis(tabulated), mapper=mapper)

    ends = {"at the pupil": table.radius <= radius, "at its box": table.offset <= radius}
    for end, known in ends.items():
        knowing = model(np.where(known, table.cube, 0.0), known)
        for fill, complete in FILLS.items():
            yield end, fill, model(complete(table.cube, known), np.ones_like(known)), knowing


def by_the_service(
    instrument: Instrument, table: Table, pitch_m: float, measured: Array, mapper: Mapper
) -> Iterator[tuple[str, Fit]]:
    """Yield end of the table and what ``pyrcal fit`` makes of the matrix with it."""
    radius = instrument.wfs.pupil_diameter / 2
    ends = {"at the pupil": table.radius <= radius, "at its box": table.offset <= radius}
    for end, known in ends.items():
        cube = np.where(known, table.cube, 0.0)
        modes = TabulatedModes(cube=cube, pitch_m=pitch_m, known=known)
        tabulated = replace(instrument, mirror=modes)
        yield end, fit_matrix(tabulated, Reference(matrix=measured), mapper=mapper)


def main() -> None:
    """Print the error of α for every end, fill and truth, with and without the rule."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stop", choices=[s.value for s in Stop], default=Stop.TELESCOPE.value)
    parser.add_argument("--every", type=int, default=4, help="of 400 modes fit every so many")
    parser.add_argument("--points", type=float, default=4.0, help="table points per subaperture")
    arguments = parser.parse_args()
    instrument = replace(load_instrument("flao-lbt"), stop=Stop(arguments.stop))
    modes = np.arange(0, 400, arguments.every)
    pitch_m = instrument.subaperture_m / arguments.points
    table = sampled(instrument, modes, arguments.points)
    print("error of the shift (% of a subaperture), rotation (deg), magnification (%)")
    with threadpool_limits(1), ThreadPoolExecutor(2) as threads:
        exact = InteractionModel(
            instrument, modal_basis(instrument).subset(modes), mapper=threads.map
        )
        measured = {name: exact.interaction_matrix(truth) for name, truth in TRUTHS.items()}
        for end, fill, model, knowing in cases(instrument, table, pitch_m, threads.map):
            for name, truth in TRUTHS.items():
                both = [registered(model, measured[name], which) for which in (None, knowing)]
                errors = [(a.vector - truth.vector) * BOUNDARY_SCALE for a in both]
                texts = [
                    f"{100 * np.hypot(*e[:2]):7.3f} {e[2]:8.4f} {100 * e[3]:8.4f}" for e in errors
                ]
                left = int(knowing.unknown_rows(truth).sum())
                print(
                    f"table ends {end:13s} filled with {fill:19s} {name:24s} all:{texts[0]}   "
                    f"rule:{texts[1]}   ({left} of {model.n_slopes} left out)",
                    flush=True,
                )
        for name, truth in TRUTHS.items():
            for end, fit in by_the_service(
                instrument, table, pitch_m, measured[name].astype(np.float64), threads.map
            ):
                error = (fit.alpha.vector - truth.vector) * BOUNDARY_SCALE
                print(
                    f"table ends {end:13s} the service's fit {name:24s} "
                    f"{100 * np.hypot(*error[:2]):7.3f} {error[2]:8.4f} {100 * error[3]:8.4f}   "
                    f"{fit.verdict}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
