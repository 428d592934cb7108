"""Shapes of functions that end near their actuators, tile by tile of the pupil.

Where every function covers a few subapertures only, a tile of the pupil knows a hundred of them and
not thousands: what a sensor makes of the tile is multiplied by those, and the modes come last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.pupil import PupilGrid

Array = NDArray[Any]
Indices = NDArray[np.intp]

TILE_SUBAP = 4
"""Side of a tile: in smaller ones products are too small, larger ones know too many functions."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tile:
    """A square of the pupil's grid."""

    rows: slice
    columns: slice
    points: NDArray[np.float64]
    """``(n_points, 2)`` x and y of all its points, row-major; some may be dark."""

    lit: Indices
    """``(n_lit,)`` which of them see light."""

    places: Indices
    """Indices of the lit points of this tile among those of the pupil, ``(n_lit,)``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """The functions that reach into a tile."""

    tile: Tile
    functions: Indices
    """``(n_near,)`` which they are."""

    weights: Array
    """``(n_points, n_near)`` their heights, or rates, at all points of the tile."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MadeElsewhere:
    """Recipe for another process to make something.

    It can be pickled: a few kilobytes, and parts.
    """

    parts: tuple[object, ...]
    """Parts that all matrices of a model share: instrument, modes. They are sent to a cluster once.
    """

    prepare: Callable[..., Any]
    """Makes a model of the parts, which is kept for the next matrix, too."""

    make: Callable[[Any], Any]
    """Makes the thing itself of the model."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalShapes:
    """Combinations of local functions: ``rows @ shapes`` is a product as with an array of shapes.

    ``rows`` is ``(n_rows, n_points)`` over the lit points of the pupil, an array or sparse.
    """

    patches: Sequence[Patch]
    n_points: int
    """Lit points of the pupil."""

    n_functions: int
    combination: Array | None = None
    """``(n_functions, n_shapes)`` the weights of the functions in every shape; None: every function
    is a shape."""

    n_layers: int = 1
    """Number of sets of functions with the same combination, placed side by side, such as heights
    and rates. Function j of layer k has the index ``k n_functions + j``."""

    elsewhere: MadeElsewhere | None = None
    """Recipe for another process to make them; None if it cannot."""

    # Makes numpy hand ``array @ shapes`` to __rmatmul__ instead of making an array of objects.
    __array_ufunc__: ClassVar[None] = None

    @property
    def shape(self) -> tuple[int, int]:
        """``(n_points, n_shapes)``, as that of an array."""
        n_shapes = self.n_functions if self.combination is None else self.combination.shape[1]
        return self.n_points, self.n_layers * int(n_shapes)

    @property
    def n_near(self) -> float:
        """Functions that reach a point, as its tile knows them, in the mean."""
        known = sum(len(patch.tile.lit) * len(patch.functions) for patch in self.patches)
        return known / self.n_points

    @property
    def is_cheaper(self) -> bool:
        """True if products with it take fewer operations than with an array of the shapes."""
        # Rows of a sensor times functions near each point, then times the modes; or times whole
        # modes.
        by_tiles = self.n_points * self.n_near + self.n_functions * self.shape[1]
        return by_tiles < self.n_points * self.shape[1]

    def array(self) -> Array:
        """Return the shapes ``(n_points, n_shapes)``."""
        if self.combination is None or self.n_layers > 1:
            return np.asarray(self.combine_functions(self.sparse()))
        weights = [patch.weights.dtype for patch in self.patches]
        found = np.zeros(self.shape, np.result_type(self.combination, *weights))
        for patch in self.patches:
            heights = patch.weights[patch.tile.lit]
            found[patch.tile.places] = heights @ self.combination[patch.functions]
        return found

    def sparse(self) -> Any:  # noqa: ANN401 - scipy has no types
        """Return the functions of all layers ``(n_points, n_all_functions)``, sparse."""
        parts = [
            (
                patch.weights[patch.tile.lit].ravel(),
                np.repeat(patch.tile.places, len(patch.functions)),
                np.tile(patch.functions, len(patch.tile.lit)),
            )
            for patch in self.patches
        ]
        # Parts of a function in several tiles have different rows: no entry is given twice.
        values, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
        shape = (self.n_points, self.n_all_functions)
        return scipy.sparse.csr_array((values, (rows, columns)), shape=shape)

    def __rmatmul__(self, rows: Any) -> Array:  # noqa: ANN401 - scipy has no types
        """Return ``rows`` times the shapes, ``(n_rows, n_shapes)``."""
        if scipy.sparse.issparse(rows):
            return self.combine_functions(rows @ self.sparse())
        by_function = np.zeros((self.n_all_functions, len(rows)), rows.dtype)
        for patch in self.patches:
            heights = patch.weights[patch.tile.lit]
            # A function reaches into several tiles, whose parts add up.
            by_function[patch.functions] += heights.T @ rows[:, patch.tile.places].T
        return self.combine_functions(by_function.T)

    @property
    def n_all_functions(self) -> int:
        """Functions of all layers."""
        return self.n_layers * self.n_functions

    def combine_functions(self, by_function: Any) -> Array:  # noqa: ANN401 - scipy has no types
        """Return what is known of the functions, ``(n_rows, n_all_functions)``, of the shapes."""
        known = by_function.toarray() if scipy.sparse.issparse(by_function) else by_function
        if self.combination is None:
            return np.asarray(known)
        layers = np.split(known, self.n_layers, axis=1)
        return np.hstack([layer @ self.combination for layer in layers])


Shapes = Array | LocalShapes
"""Wavefronts at the lit points of a pupil: ``(n_points, n_shapes)``, or what makes them."""


def stack_shapes(shapes: Sequence[Shapes]) -> Shapes:
    """Return shapes of one pupil as one, their columns one after another: one response for all.

    Local ones are the same functions, their heights or rates, in one combination.
    """
    arrays = [one for one in shapes if isinstance(one, np.ndarray)]
    if len(arrays) == len(shapes):
        return np.hstack(arrays)
    local = [one for one in shapes if isinstance(one, LocalShapes)]
    n_functions = local[0].n_functions
    patches = [
        Patch(
            tile=layers[0].tile,
            functions=np.concatenate(
                [layer.functions + k * n_functions for k, layer in enumerate(layers)]
            ),
            weights=np.hstack([layer.weights for layer in layers]),
        )
        for layers in zip(*(one.patches for one in local), strict=True)
    ]
    recipes, there = [one.elsewhere for one in local if one.elsewhere is not None], None
    if len(recipes) == len(local):
        each = tuple(recipe.make for recipe in recipes)
        there = replace(recipes[0], make=partial(_make_stacked, each=each))
    return replace(local[0], patches=patches, n_layers=len(local), elsewhere=there)


def _make_stacked(model: object, *, each: Sequence[Callable[[Any], Shapes]]) -> Shapes:
    return stack_shapes([make(model) for make in each])


@lru_cache(maxsize=16)
def tiles_of(pupil: PupilGrid) -> tuple[Tile, ...]:
    """Return the tiles of a pupil that see any light, row after row."""
    lit, side = pupil.lit, TILE_SUBAP * pupil.sampling
    end = len(lit)
    # Index of each lit point in the list of all lit points.
    place = np.cumsum(lit).reshape(lit.shape) - 1
    found = []
    for row in range(0, end, side):
        for column in range(0, end, side):
            part = (slice(row, min(row + side, end)), slice(column, min(column + side, end)))
            inside = np.flatnonzero(lit[part])
            # Tiles in the corners of the grid and in the obscuration see nothing.
            if len(inside) == 0:
                continue
            y, x = np.meshgrid(*(pupil.coordinates[one] for one in part), indexing="ij")
            found.append(
                Tile(
                    rows=part[0],
                    columns=part[1],
                    points=np.column_stack([x.ravel(), y.ravel()]),
                    lit=inside,
                    places=place[part].ravel()[inside],
                )
            )
    return tuple(found)


def shapes_on(
    pupil: PupilGrid, n_functions: int, patch: Callable[[Array], tuple[Indices, Array]]
) -> LocalShapes:
    """Return functions on a pupil; ``patch`` gives those that reach some points, and heights."""
    patches = []
    for tile in tiles_of(pupil):
        near, heights = patch(tile.points)
        patches.append(Patch(tile=tile, functions=near, weights=heights))
    n_points = int(pupil.lit.sum())
    return LocalShapes(patches=patches, n_points=n_points, n_functions=n_functions)
