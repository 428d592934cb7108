"""Import and fit matrices of which a part of the pupil's rim is missing, against their truth.

Each of 20 shapes takes outer columns, rows, corners or sectors from the mask of a matrix with known
registration. The slopes there are absent from mask and matrix, or 0, or NaN. The matrices are those
of ``failing/`` in the folder of public data; they are arrays for ``pyrcal import files``, which
read the mask as it is. With ``--off`` all of the mask is there, on a grid that is larger on two
sides, and the width of the pupil is given.
Run: ``python -m pyrcal_studies.missing_rim --data PATH``, the same with ``--off 1 2 4 6``, and with
``--others``: 20 further shapes, each in the middle of the grid and one subaperture off.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.matrix import FitOptions
from pyrcal.importers.files import Reported, from_arrays
from pyrcal_studies.shared import study_parser
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

Array = NDArray[Any]
Shape = Callable[[Array, Array], Array]

RIM_TRUTH = {
    "shift_x_subap": 0.2,
    "shift_y_subap": -0.3,
    "rotation_deg": 1.5,
    "magnification": 1.01,
}
"""Registration of ``rim_columns_missing.npz``, as the README of the data has it."""

MAX_SIGMA = 3.0

WAYS = ("absent", "zeros", "NaN")
"""How slopes of the missing subapertures are in the files."""

BENCHES = ("U1_rms05", "P16_wfsshift", "P09_nl_push200nm", "S01_diff8", "rim_columns_missing")

SHAPES: dict[str, Shape] = {
    "left column": lambda x, y: x < -0.999,
    "right column": lambda x, y: x > 0.999,
    "top row": lambda x, y: y < -0.999,
    "bottom row": lambda x, y: y > 0.999,
    "a tenth at the left": lambda x, y: x < -0.8,
    "a tenth at the right": lambda x, y: x > 0.8,
    "a tenth at the bottom": lambda x, y: y > 0.8,
    "a sixth at the top": lambda x, y: y < -0.67,
    "left and right columns": lambda x, y: np.abs(x) > 0.999,
    "a tenth at top and bottom": lambda x, y: np.abs(y) > 0.8,
    "left column, top row": lambda x, y: (x < -0.999) | (y < -0.999),
    "right column, a tenth at the bottom": lambda x, y: (x > 0.999) | (y > 0.8),
    "upper left corner": lambda x, y: x + y < -1.05,
    "lower right corner": lambda x, y: x + y > 1.15,
    "upper right corner": lambda x, y: (x > 0.4) & (y < -0.4),
    "two corners": lambda x, y: np.abs(x - y) > 1.15,
    "a sector": lambda x, y: (np.hypot(x, y) > 0.4) & (np.abs(np.arctan2(y, x) - 0.7) < 0.25),
    "ring wider, lower left corner": lambda x, y: y - x > 1.15,
    "ring wider, left column": lambda x, y: x < -0.999,
    "half of the outer ring": lambda x, y: (np.hypot(x, y) > 0.85) & (x > 0.0),
}
"""Missing subapertures by their place, in units that are 1 at the outermost lit ones. A mask of
"ring wider" has a dark ring around it, as an RTC's window may have."""


def _turned(x: Array, y: Array) -> Array:
    """Return the angle of each subaperture, degrees from 0 to 360."""
    return np.asarray(np.rad2deg(np.arctan2(y, x)) % 360.0)


def _spots(*places: tuple[float, float], size: float = 0.09) -> Shape:
    """Return the shape of spots of a radius at the places."""
    return lambda x, y: np.any([np.hypot(x - u, y - v) < size for u, v in places], axis=0)


OTHERS: dict[str, Shape] = {
    "left and right tenth": lambda x, y: np.abs(x) > 0.8,
    "top column, left tenth": lambda x, y: (y < -0.999) | (x < -0.8),
    "all four sides": lambda x, y: np.maximum(np.abs(x), np.abs(y)) > 0.9,
    "three sides": lambda x, y: (np.abs(x) > 0.9) | (y > 0.9),
    "a fifth at the right": lambda x, y: x > 0.6,
    "a quarter at the bottom": lambda x, y: y > 0.5,
    "a wedge of 20 deg": lambda x, y: np.abs(_turned(x, y) - 200.0) < 10.0,
    "a wedge of 45 deg": lambda x, y: np.abs(_turned(x, y) - 70.0) < 22.5,
    "a quadrant": lambda x, y: (x > 0.0) & (y > 0.0),
    "two wedges": lambda x, y: np.abs(_turned(x, y) % 180.0 - 30.0) < 12.0,
    "a hole of a third": lambda x, y: np.hypot(x, y) < 0.33,
    "a hole of a half": lambda x, y: np.hypot(x, y) < 0.5,
    "a hole off the middle": lambda x, y: np.hypot(x - 0.15, y + 0.1) < 0.35,
    "a ring inside": lambda x, y: np.abs(np.hypot(x, y) - 0.6) < 0.08,
    "a dead subaperture": _spots((0.4, 0.3)),
    "five dead subapertures": _spots(
        (0.4, 0.3), (-0.5, 0.1), (0.0, -0.6), (-0.2, 0.5), (0.6, -0.2)
    ),
    "a dead patch": _spots((-0.3, -0.4), size=0.22),
    "a row inside": lambda x, y: np.abs(y - 0.3) < 0.06,
    "two columns inside": lambda x, y: np.abs(np.abs(x) - 0.45) < 0.06,
    "every fifth": lambda x, y: np.arange(len(x)) % 5 == 0,
}
"""Further shapes, none of which was looked at while the code was written."""

OFF_LINES = 2
"""Lines more on two sides of the grid of a mask of ``OTHERS``: its pupil is one subaperture off."""


def read_bench(data: Path, name: str) -> tuple[dict[str, Array], Reported, dict[str, float]]:
    """Return the arrays of a bench by role, what they do not say, and the true registration."""
    with np.load(data / "failing" / f"{name}.npz") as stored:
        found = {key: stored[key] for key in stored.files}
    reported = Reported(diameter_m=0.6, stop="telescope", unit="m", obscuration_ratio=0.0)
    if "truth" not in found:
        arrays = {
            "matrix": found["interaction_matrix"],
            "valid": found["valid"],
            "modes": found["modes"],
            "mode_to_actuator": found["M2C"],
        }
        reported = replace(reported, wavelength_m=640e-9, modulation_lambda_over_d=0.0)
        return arrays, reported, RIM_TRUTH
    truth = json.loads(str(found["truth"]))
    case = truth["case"]
    reported = replace(
        reported,
        diameter_m=case["D"],
        obscuration_ratio=case.get("obs", 0.0),
        wavelength_m=790e-9,
        sensor="shack-hartmann" if case.get("sh") else "pyramid",
        modulation_lambda_over_d=case.get("mod"),
        unit=None if case.get("sh") else "m",
    )
    arrays = {
        "matrix": found["interaction_matrix"].astype(np.float64),
        "valid": found["valid_subapertures"],
        "positions": found["positions"],
    }
    return arrays, reported, {name: truth[name] for name in PARAMETERS}


def without(arrays: dict[str, Array], shape: str, way: str) -> dict[str, Array]:
    """Return the arrays of a bench without the subapertures of a shape."""
    valid = arrays["valid"].astype(bool)
    planes = arrays["matrix"].reshape(2, int(valid.sum()), -1)
    places = np.argwhere(valid) - (len(valid) - 1) / 2.0
    y, x = (places / np.abs(places).max(axis=0)).T
    gone = (SHAPES | OTHERS)[shape](x, y)
    if way == "absent":
        planes, valid = planes[:, ~gone], valid.copy()
        valid[tuple(np.argwhere(arrays["valid"])[gone].T)] = False
    else:
        planes = np.where(gone[:, None], 0.0 if way == "zeros" else np.nan, planes)
    if shape.startswith("ring wider"):
        valid = np.pad(valid, 1)
    return {**arrays, "matrix": planes.reshape(-1, planes.shape[-1]), "valid": valid}


def compare(
    name: str, what: str, arrays: dict[str, Array], reported: Reported, truth: Array
) -> tuple[float, bool]:
    """Import and fit; print a line and return the largest error over σ, and the verdict."""
    imported = from_arrays(name, arrays, reported)
    with tempfile.TemporaryDirectory() as folder:
        saved = imported.save(folder)
        fit = fit_file(load_instrument(saved.instrument), saved.matrix, FitOptions()).fit
    errors = fit.alpha.vector * BOUNDARY_SCALE - truth
    over = float(np.max(np.abs(errors / (fit.sigma * BOUNDARY_SCALE))))
    numbers = " ".join(f"{one:+.4f}" for one in errors)
    print(f"{what:45} {name:20} {over:5.2f} sigma  {fit.verdict[:60]:60} {numbers}", flush=True)
    return over, fit.accepted


def main(words: list[str]) -> int:
    """Print a line for each fit, and how many are right."""
    parser = study_parser("pyrcal_studies.missing_rim", __doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--off", nargs="+", type=int, help="lines more on two sides of a grid")
    parser.add_argument("--others", action="store_true", help="further shapes, also off the middle")
    options = parser.parse_args(words)
    found = []
    for k, shape in enumerate(() if options.off or options.others else SHAPES):
        name = BENCHES[k % len(BENCHES)]
        arrays, reported, truth = read_bench(options.data, name)
        expected = np.array([truth[one] for one in PARAMETERS])
        for way in options.ways:
            cut = without(arrays, shape, way)
            found.append(compare(name, f"{shape}, {way}", cut, reported, expected))
    for (k, shape), lines in product(enumerate(OTHERS), (0, OFF_LINES) if options.others else ()):
        name = BENCHES[k % len(BENCHES)]
        arrays, reported, truth = read_bench(options.data, name)
        if lines:
            width = float(len(arrays["valid"]))
            reported = replace(reported, pupil_diameter_subap=width)
        cut = without(arrays, shape, "absent")
        cut["valid"] = np.pad(cut["valid"], ((lines, 0), (0, lines)))
        expected = np.array([truth[one] for one in PARAMETERS])
        expected[:2] += np.array([-0.5, 0.5]) * lines
        found.append(compare(name, f"{shape}, {lines} lines off", cut, reported, expected))
    for name, lines in product(BENCHES[:4], options.off or ()):
        arrays, reported, truth = read_bench(options.data, name)
        wide = replace(reported, pupil_diameter_subap=float(len(arrays["valid"])))
        moved = {**arrays, "valid": np.pad(arrays["valid"], ((lines, 0), (0, lines)))}
        expected = np.array([truth[one] for one in PARAMETERS])
        expected[:2] += np.array([-0.5, 0.5]) * lines
        found.append(compare(name, f"{lines / 2} off along x and y", moved, wide, expected))
    over, accepted = np.transpose(found)
    print(
        f"{np.sum(over <= MAX_SIGMA)} of {len(over)} within {MAX_SIGMA} sigma, at most "
        f"{over.max():.2f}; {int(accepted.sum())} accepted"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
