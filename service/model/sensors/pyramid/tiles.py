"""Products of rows of subapertures with local functions, by strips of the pupil and by tiles.

The code uses the array API standard alone, so any library that implements it can compute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.arrays import Arrays, Foreign
from service.model.local import LocalShapes, Patch

Array = NDArray[Any]
Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sum:
    """Sum of the rows of each function by slices alone: the standard has no scatter-add.

    Functions are sorted by their number of rows, so that the second rows of all functions that have
    one form a slice, and likewise the third.
    """

    functions: Indices
    """``(n_functions,)`` whose sums are returned, most rows first."""

    rows: Sequence[Foreign]
    """Places of first rows, of second rows, of third rows."""

    @classmethod
    def over(cls, functions: Indices, arrays: Arrays) -> _Sum:
        """Return the sum of rows that belong to these functions, ``(n_rows,)``."""
        by_function = np.argsort(functions, kind="stable")
        names, first, counts = np.unique(
            functions[by_function], return_index=True, return_counts=True
        )
        most_first = np.argsort(-counts, kind="stable")
        first, counts = first[most_first], counts[most_first]
        places = [
            arrays.there(by_function[first[counts > k] + k]) for k in range(int(counts.max()))
        ]
        return cls(functions=names[most_first], rows=places)

    def __call__(self, rows: Foreign, arrays: Arrays) -> Foreign:
        """Return the sums ``(n_functions, n_columns)`` of rows ``(n_rows, n_columns)``."""
        xp = arrays.xp
        total = xp.take(rows, self.rows[0], axis=0)
        for places in self.rows[1:]:
            total[: places.shape[0], :] += xp.take(rows, places, axis=0)
        return total


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Strip:
    """Tiles that share the same lines of the pupil."""

    lines: slice
    tiles: Sequence[tuple[slice, Foreign]]
    """Columns of the pupil, and heights ``(n_near, n_points)`` at their points."""

    sum: _Sum

    def measure_functions(
        self, along_y: Foreign, along_x: Sequence[Foreign], arrays: Arrays
    ) -> Foreign:
        """Return ``(n_functions, n_lines)`` what lines see of the strip's functions."""
        xp = arrays.xp
        products = [xp.matmul(along_y[self.lines, :], part) for part in along_x]
        by_line = xp.concat(products, axis=0)
        rows = [
            xp.matmul(heights, xp.reshape(by_line[:, :, columns], (by_line.shape[0], -1)).T)
            for columns, heights in self.tiles
        ]
        return self.sum(xp.concat(rows, axis=0), arrays)


class TiledResponse:
    """The response to local shapes of a row of subapertures, of its factors along y and x."""

    def __init__(self, shapes: LocalShapes, scale: Array, arrays: Arrays) -> None:
        """Prepare strips of the shapes; ``scale`` ``(N, N)`` multiplies a product of factors."""
        self._arrays = arrays
        # Tiles of a strip share the product along y.
        by_strip: dict[int, list[Patch]] = {}
        for patch in shapes.patches:
            by_strip.setdefault(patch.tile.rows.start, []).append(patch)
        self._strips = [_strip_of(patches, scale, arrays) for patches in by_strip.values()]
        every = np.concatenate([strip.sum.functions for strip in self._strips])
        self._sum = _Sum.over(every, arrays)
        # Functions that reach no lit point have no row: they read the zeros behind the last one.
        places = np.full(shapes.n_all_functions, len(self._sum.functions))  # of a row of zeros
        places[self._sum.functions] = np.arange(len(self._sum.functions))
        self._layers = [arrays.there(layer) for layer in np.split(places, shapes.n_layers)]
        known = shapes.combination
        self._combination = None if known is None else arrays.there(known)

    def __call__(self, along_y: Foreign, along_x: Sequence[Foreign]) -> Foreign:
        """Return ``(n_lines, n_shapes)`` of ``(N, n_terms)`` and ``(n_lines, n_terms, N)``."""
        xp, arrays = self._arrays.xp, self._arrays
        strips = [strip.measure_functions(along_y, along_x, arrays) for strip in self._strips]
        by_function = self._sum(xp.concat(strips, axis=0), arrays)
        by_function = xp.concat([by_function, xp.zeros_like(by_function[:1, :])], axis=0)
        layers = [xp.take(by_function, places, axis=0).T for places in self._layers]
        if self._combination is not None:
            layers = [xp.matmul(layer, self._combination) for layer in layers]
        return layers[0] if len(layers) == 1 else xp.concat(layers, axis=1)


def _strip_of(patches: Sequence[Patch], scale: Array, arrays: Arrays) -> _Strip:
    tiles = []
    for patch in patches:
        tile = patch.tile
        # Multiplied into the heights once, instead of into each row's product.
        at_points = scale[tile.rows, tile.columns].reshape(-1, 1)
        heights = np.ascontiguousarray((patch.weights * at_points).T)
        tiles.append((tile.columns, arrays.there(heights)))
    functions = np.concatenate([patch.functions for patch in patches])
    return _Strip(lines=patches[0].tile.rows, tiles=tiles, sum=_Sum.over(functions, arrays))
