"""What the figures of a fit are drawn from, and the same as numbers few enough for a browser."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.fit.matrix import Fit

Array = NDArray[np.float64]

PAPER_MODES = (1, 5, 10, 50, 100, 200, 300, 350, 400)
"""Modes the paper shows, counted from 1 as it does."""

MAPS = 4
"""Modes whose slopes a browser is given."""


def numbers(fit: Fit) -> dict[str, Any]:
    """Return what a page draws a fit from, as JSON can hold it; null where nothing is known.

    Maps are lists of rows from the lowest y on, Sx beside Sy, or the four images as they lie on the
    detector, in whole percent: of the measured RMS
    for ``residual_map``, of three times a mode's own RMS for ``maps``, cut there.
    """
    shown = shown_modes(fit)
    picked = shown[np.unique(np.linspace(0, len(shown) - 1, MAPS).round().astype(int))]
    singular = {name: _plain(values, 5) for name, values in singular_values_of(fit).items()}
    return {
        "modes": fit.modes.tolist(),
        "residual_by_mode": _plain(fit.residual_by_mode, 4),
        "singular_values": singular,
        "residual_map": _percent(side_by_side(fit.residual_map)),
        "maps": [_columns(fit, int(column)) for column in picked],
    }


def singular_values_of(fit: Fit) -> dict[str, Array]:
    """Return the singular values of both matrices, each over its largest, by the matrix's name."""
    found = {}
    for name, matrix in (("synthetic", fit.synthetic * fit.gains), ("measured", fit.measured)):
        values = scipy.linalg.svdvals(np.asarray(matrix, dtype=np.float64))
        found[name] = values / values[0]
    return found


def shown_modes(fit: Fit) -> NDArray[np.intp]:
    """Return which columns of the fit are shown: the paper's modes, as far as they were used."""
    found = np.flatnonzero(np.isin(fit.modes + 1, PAPER_MODES))
    return found if len(found) else np.arange(min(len(fit.modes), MAPS))


def as_maps(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> Array:
    """Return signals ``(n_slopes,)`` as one map, NaN where none is valid: see ``side_by_side``."""
    planes = slopes.reshape(-1, int(valid.sum()))
    maps = np.full((len(planes), *valid.shape), np.nan)
    maps[:, valid] = planes
    return side_by_side(maps)


def side_by_side(maps: Array) -> Array:
    """Return Sx beside Sy ``(n, 2 n)``, or four images as they lie ``(2 n, 2 n)``."""
    return np.vstack([np.hstack(list(maps[k : k + 2])) for k in range(0, len(maps), 2)])


def _columns(fit: Fit, column: int) -> dict[str, Any]:
    """Return one mode's slopes as maps of one scale, measured and synthetic."""
    measured = as_maps(fit.measured[:, column], fit.valid)
    synthetic = as_maps(fit.synthetic[:, column] * fit.gains[column], fit.valid)
    limit = 3.0 * float(np.nanstd(measured)) or 1.0
    return {
        "mode": int(fit.modes[column]),
        "measured": _percent(np.clip(measured / limit, -1.0, 1.0)),
        "synthetic": _percent(np.clip(synthetic / limit, -1.0, 1.0)),
    }


def _percent(shares: Array) -> list[Any]:
    rounded = np.where(np.isfinite(shares), np.round(100.0 * shares), np.nan)
    plain = rounded.astype(object)
    plain[np.isnan(rounded)] = None
    plain[~np.isnan(rounded)] = rounded[~np.isnan(rounded)].astype(int)
    listed: list[Any] = plain.tolist()
    return listed


def _plain(values: Array, digits: int) -> list[float | None]:
    return [round(v, digits) if np.isfinite(v) else None for v in values.tolist()]
