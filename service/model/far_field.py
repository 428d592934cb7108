"""Sums of thin plates: near actuators one by one, far ones as a polynomial of each tile.

With w the place of a point from the middle of a tile, as a complex number, and an actuator at b
far outside of it, the plate ``|w - b|² log|w - b|`` is ``Re(|w|² a(w) + c(w))``, with power series
whose terms fall as ``(|w| / |b|)^k``. The series of all far actuators add up, once for a basis: a
mode is a polynomial and a hundred plates instead of all of them. In float64 throughout: far plates
are thousands high, and cancel.

References
----------
Beatson & Newsam 1992, Computers & Mathematics with Applications 24, 7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.model.surface import ThinPlate

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Indices = NDArray[np.intp]

TILE_SUBAP = 4.0
"""Side of a tile: smaller ones need more memory, larger ones more plates."""

FAR_DISTANCE_RATIO = 2.5
"""Distance of a far actuator over that of the tile's corner from its middle."""

SERIES_DEGREE = 22
"""Degree of the series: 2.5^-22 is 2e-9, and the error of heights is a thousandth of the
rounding error of float32."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tile:
    """A square of the mirror."""

    middle: complex
    near: Indices
    """``(n_near,)`` actuators whose plates are added one by one."""

    series: Array
    """``(4 (SERIES_DEGREE + 1), n_modes)`` coefficients of all other plates, for ``_terms``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlateSum:
    """Modes as sums of thin plates, evaluated anywhere."""

    surface: ThinPlate
    coefficients: Array
    """``(n_actuators + 3, n_modes)`` weights of its functions."""

    tiles: dict[tuple[int, int], _Tile] = field(default_factory=dict)
    """Tiles computed so far, by their place on the grid; two threads may compute the same one."""

    def heights(self, points: Array) -> Array:
        """Return the modes ``(n_points, n_modes)`` at points ``(n_points, 2)``."""
        out = np.empty((len(points), self.coefficients.shape[1]))
        for tile, some in self._iterate_tiles(points):
            w = _complex(points[some]) - tile.middle
            power = _powers(w, SERIES_DEGREE)
            far = _terms(np.abs(w) ** 2 * power, power)
            near = ThinPlate(self.surface.positions[tile.near]).basis(points[some])
            out[some] = self._add_terms(tile, far, near)
        return out

    def slopes(self, points: Array, direction: Array) -> Array:
        """Return the derivative of the modes along ``direction``, ``(n_points, n_modes)``."""
        out = np.empty((len(points), self.coefficients.shape[1]))
        for tile, some in self._iterate_tiles(points):
            w, along = _complex(points[some]) - tile.middle, _complex(direction[some])
            power = _powers(w, SERIES_DEGREE)
            rate = np.zeros_like(power)
            rate[1:] = np.arange(1, SERIES_DEGREE + 1)[:, None] * power[:-1] * along
            widening = 2.0 * (w.conj() * along).real
            far = _terms(widening * power + np.abs(w) ** 2 * rate, rate)
            near = ThinPlate(self.surface.positions[tile.near]).slope(points[some], direction[some])
            out[some] = self._add_terms(tile, far, near)
        return out

    def take_tiles(self, other: PlateSum, combine: Callable[[Array], Array]) -> None:
        """Take over the tiles of modes of which these are the columns that ``combine`` makes."""
        for place, tile in list(other.tiles.items()):
            self.tiles[place] = replace(tile, series=combine(tile.series))

    def _add_terms(self, tile: _Tile, far: Array, near: Array) -> Array:
        """Return the sum of the terms of all far plates, and of near ones and the plane."""
        # The last three functions are the plane 1, x, y, which no series contains.
        used = np.concatenate([tile.near, np.arange(-3, 0)])
        return np.asarray(far @ tile.series + near @ self.coefficients[used])

    def _iterate_tiles(self, points: Array) -> Iterator[tuple[_Tile, Indices]]:
        """Yield every tile that has any of the points, and which they are."""
        places = np.floor(points / TILE_SUBAP).astype(np.intp)
        # Sorted, so that the points of a tile are one run.
        order = np.lexsort(places.T)
        edges = np.flatnonzero(np.any(np.diff(places[order], axis=0), axis=1)) + 1
        for some in np.split(order, edges):
            for x, y in places[some[:1]].tolist():
                if (x, y) not in self.tiles:
                    self.tiles[x, y] = self._tile(TILE_SUBAP * complex(x + 0.5, y + 0.5))
                yield self.tiles[x, y], some

    def _tile(self, middle: complex) -> _Tile:
        b = _complex(self.surface.positions) - middle
        far = np.abs(b) >= FAR_DISTANCE_RATIO * TILE_SUBAP / np.sqrt(2.0)
        plates = _series(b[far])
        # All far actuators at once: a mode is then one polynomial in this tile, whatever their
        # number.
        series = np.concatenate([plates.real, plates.imag]) @ self.coefficients[: len(b)][far]
        return _Tile(middle=middle, near=np.flatnonzero(~far), series=series)


def _series(b: Complex) -> Complex:
    """Return coefficients of a, then of c, of each plate, ``(2 (SERIES_DEGREE + 1), n_plates)``.

    ``log(w - b)`` has the series g; ``|w - b|² = w̄w - w b̄ - w̄ b + b̄b``, and the real part of
    ``w̄ w^k`` is that of ``w̄w w^(k-1)``, of ``w̄`` itself that of w.
    """
    k = np.arange(1, SERIES_DEGREE + 2)
    # The Taylor series of log(w - b) about the middle of the tile.
    g = np.concatenate(
        [np.log(np.abs(b))[None], -1.0 / (k[:, None] * _powers(b, SERIES_DEGREE + 1)[1:])]
    )
    a = g[:-1] - b * g[1:]
    c = np.abs(b) ** 2 * g[:-1]
    c[1:] -= b.conj() * g[:-2]
    c[1] -= b.conj() * g[0]
    return np.concatenate([a, c])


def _terms(a: Complex, c: Complex) -> Array:
    """Return what the real and imaginary coefficients of a series are multiplied by."""
    both = np.concatenate([a, c])
    return np.concatenate([both.real, -both.imag]).T


def _powers(w: Complex, degree: int) -> Complex:
    """Return ``w^k`` for every k up to a degree, ``(degree + 1, n)``."""
    found = np.ones((degree + 1, len(w)), np.complex128)
    np.multiply.accumulate(np.broadcast_to(w, (degree, len(w))), axis=0, out=found[1:])
    return found


def _complex(points: Array) -> Complex:
    return np.asarray(points[:, 0] + 1j * points[:, 1])
