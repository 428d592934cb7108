"""Slopes of single modes as maps: synthetic, measured, and their difference."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from service.fit.options import Fit

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

Array = NDArray[np.float64]

PAPER_MODES = (1, 5, 10, 50, 100, 200, 300, 350, 400)
"""Modes the paper shows, counted from 1 as it does."""

_COLUMNS = ("synthetic", "measured", "difference")

_ACROSS = 2
"""Modes side by side."""


def shown_modes(fit: Fit) -> NDArray[np.intp]:
    """Return which columns of the fit are shown: the paper's modes, as far as they were used."""
    found = np.flatnonzero(np.isin(fit.modes + 1, PAPER_MODES))
    return found if len(found) else np.arange(min(len(fit.modes), 4))


def n_rows(fit: Fit) -> int:
    """Return how many rows of maps there are to draw."""
    return math.ceil(len(shown_modes(fit)) / _ACROSS)


def slope_maps(figure: SubFigure, fit: Fit) -> None:
    """Draw Sx beside Sy for a few modes; all three maps of a mode have one scale."""
    places = figure.subplots(n_rows(fit), _ACROSS * len(_COLUMNS), squeeze=False)
    triples = places.reshape(-1, len(_COLUMNS))
    columns = shown_modes(fit)
    for triple, column in zip(triples, columns, strict=False):
        _mode(triple, fit, int(column))
    for axes in triples[len(columns) :].ravel():
        axes.set_axis_off()
    for axes, name in zip(places[0], _COLUMNS * _ACROSS, strict=True):
        axes.set_title(f"{name}: Sx | Sy", fontsize="small")


def _mode(triple: NDArray[Any], fit: Fit, column: int) -> None:
    """Draw one mode into three axes."""
    synthetic = as_maps(fit.synthetic[:, column] * fit.gains[column], fit.valid)
    measured = as_maps(fit.measured[:, column], fit.valid)
    limit = 3.0 * float(np.nanstd(measured))
    for axes, values in zip(triple, (synthetic, measured, measured - synthetic), strict=True):
        axes.imshow(values, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set(xticks=[], yticks=[])
    triple[0].set_ylabel(f"mode {fit.modes[column]}", fontsize="small")
    left = 100.0 * fit.residual_by_mode[column]
    triple[2].set_xlabel(f"{left:.1f} % left", fontsize="small")


def as_maps(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> Array:
    """Return slopes ``(n_slopes,)`` as ``(n, 2 n)``: Sx beside Sy, NaN where none is valid."""
    maps = np.full((2, *valid.shape), np.nan)
    maps[:, valid] = slopes.reshape(2, -1)
    return np.hstack(list(maps))
