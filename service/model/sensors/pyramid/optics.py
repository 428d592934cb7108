"""The modulated pyramid without an FFT.

The four-face pyramid's transmission is separable, so the detector field is ``Wy X Wx^T`` with X
the modulated pupil field and W the one-dimensional "roof" operator. With a rooftop it is a sum of
such products. Unit of length: a subaperture.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.arrays import NUMPY, Arrays, Foreign
from service.model.kinds import Normalisation, SignalKind
from service.model.local import LocalShapes, MadeElsewhere, Shapes
from service.model.pupil import PupilGrid, gauss_legendre
from service.model.sensors.pyramid.description import Pyramid
from service.model.sensors.pyramid.few import respond_to_few
from service.model.sensors.pyramid.rooftop import Rooftop, make_rooftop
from service.model.sensors.pyramid.table import FftGrid
from service.model.sensors.pyramid.tiles import TiledResponse
from service.model.sensors.pyramid.working_point import Halo
from service.model.sensors.sensor import Mapper, RowTask
from service.model.slopes import PLAIN, SlopeRecipe

Array = NDArray[Any]

Finish = Callable[[Foreign, list[Foreign]], Foreign]
"""Function of a row's factors along y and x."""

_SIDES = np.array([-1.0, 1.0])
_SIGNS = -_SIDES
"""A wavefront rising along +x brightens the images at -x, and must give a positive slope."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nodes:
    """Quadrature over a subaperture along one axis."""

    offsets: NDArray[np.float64]
    """Positions relative to the subaperture's centre, in subapertures."""

    weights: NDArray[np.float64]

    @classmethod
    def area(cls, n: int) -> Nodes:
        """Return ``n`` Gauss-Legendre nodes: the light that falls on the subaperture."""
        offsets, weights = gauss_legendre(n)
        return cls(offsets=offsets / 2, weights=weights / 2)

    @classmethod
    def points(cls, n: int) -> Nodes:
        """Return ``n`` points that a simulation adds up to the light of a pixel."""
        return cls(offsets=(np.arange(n) - (n - 1) / 2) / n, weights=np.full(n, 1.0 / n))

    @classmethod
    def edges(cls) -> Nodes:
        """Return the two edges, signed: the derivative of that light when the image moves by +1."""
        return cls(offsets=np.array([-0.5, 0.5]), weights=np.array([1.0, -1.0]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightGradient:
    """Intensities at rest and their gradient with respect to the pupil phase, not normalised."""

    images: NDArray[np.float64]
    """``(2, n, 2, n)`` light at zero phase: image side along y, row, image side along x, column."""

    gradient: Array
    """``(n_slopes, n_points)`` gradient of the x and y differences of the four images, or of the
    images themselves."""

    flux_gradient: Array
    """Gradient of what normalises them: ``(n_points,)`` of the mean flux per valid subaperture;
    ``(n_valid, n_points)`` of each one's own flux with local normalisation."""

    recipe: SlopeRecipe
    """Definition of the signals, and their normalisation."""

    def to(self, shapes: Shapes, product: Callable[[Array, Shapes], Array]) -> LightGradient:
        """Return the response to combinations of points, ``shapes`` ``(n_points, n_shapes)``.

        What is linear in the phase may be done to a few hundred shapes as well as to thousands of
        points, and costs less. ``product`` multiplies two matrices.
        """
        return replace(
            self,
            gradient=product(self.gradient, shapes),
            flux_gradient=product(self.flux_gradient, shapes),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidOptics:
    """The pyramid's small-signal response to pupil phase, for one pupil illumination.

    The Jacobian of the intensity at x with respect to the phase at u is
    ``-2 A(u) Im{ Wy Wx sum_m w_m conj(psi_m(x)) exp(i k_m u) }``, psi_m the field at rest of source
    point m, w_m its share of the light. Points m and M-1-m of a ring share their component along
    y, which halves the work.
    """

    wfs: Pyramid
    pupil: PupilGrid
    n_nodes: int = 3
    """Quadrature nodes per axis in a subaperture."""

    n_modulation: int = 28
    """Points on the modulation circle; below 28 tip is wrong at 3 λ/D."""

    dtype: type[np.float32] | type[np.float64] = np.float32
    """Precision of the products; float64 for derivative checks."""

    halo: Halo | None = None
    """Light spread by residual turbulence; None for a flat wavefront."""

    recipe: SlopeRecipe = PLAIN
    """Signals and flux whose gradient a response has."""

    arrays: Arrays = NUMPY
    """Array library that computes a row of subapertures; parts that all rows share use NumPy."""

    offsets: NDArray[np.float64] | None = None
    """Displacement of each image from its place on the pixel grid, ``(2, 2, 2)``, subapertures:
    side along y, side along x, (x, y); None for no displacement."""

    aberration_rad: NDArray[np.float64] | None = None
    """``(N, N)`` phase over the pupil at rest, radians; None for a flat wavefront."""

    def __post_init__(self) -> None:
        """Refuse a modulation that the formulas cannot fold.

        Raises
        ------
        ModelError
            If the number of modulation points is odd or too low for the modulation radius.
        """
        least = enough_modulation_points(self.wfs)
        if self.n_modulation % 2 or self.n_modulation < least:
            raise ModelError(
                f"pyramid: found {self.n_modulation} modulation points; expected an even number "
                f">= {least} for a radius of {self.wfs.largest_modulation} λ/D"
            )

    def response(
        self,
        valid: NDArray[np.bool_],
        shift: tuple[float, float] = (0.0, 0.0),
        *,
        shapes: Shapes | None = None,
        nodes_y: Nodes | None = None,
        nodes_x: Nodes | None = None,
        mapper: Mapper = map,
    ) -> LightGradient:
        """Return the response of the valid subapertures with the pupil images moved by ``shift``.

        ``valid`` is ``(n, n)`` [y, x]; ``shift`` is (x, y) in subapertures. Replacing the nodes of
        an axis by ``Nodes.edges()`` gives the derivative with respect to the shift on that axis.
        With ``shapes`` it is the response to them, and the gradient exists for one row of
        subapertures at a time.
        """
        nodes = nodes_y or self.nodes, nodes_x or self.nodes
        if isinstance(shapes, np.ndarray) and self.are_few(shapes.shape[1]):
            return self._respond_to_few(shapes, valid, shift, nodes, mapper)
        of_row = RowResponse(
            optics=self,
            valid=valid,
            shift=shift,
            shapes=shapes,
            nodes_y=nodes[0],
            nodes_x=nodes[1],
        )
        images = of_row.shared.images  # once, before several threads ask
        n_out = int(self.pupil.lit.sum()) if shapes is None else shapes.shape[1]
        gradient = np.empty((self.recipe.kind.n_planes, int(valid.sum()), n_out), self.dtype)
        rows, light, end = np.flatnonzero(valid.any(axis=1)).tolist(), [], 0
        for row, lines in zip(rows, mapper(of_row, rows), strict=True):
            begin, end = end, end + int(valid[row].sum())
            n_signals = len(gradient) * (end - begin)
            gradient[:, begin:end] = lines[:n_signals].reshape(len(gradient), -1, n_out)
            # Copied, because a view would keep the whole row in memory.
            light.append(lines[n_signals:].copy())
        if self.recipe.normalisation is Normalisation.LOCAL:
            flux = np.concatenate(light)
        else:
            flux = np.asarray(np.sum(light, axis=(0, 1)) / int(valid.sum()))
        return LightGradient(
            images=images,
            gradient=gradient.reshape(-1, n_out),
            flux_gradient=flux,
            recipe=self.recipe,
        )

    def _respond_to_few(
        self,
        shapes: Array,
        valid: NDArray[np.bool_],
        shift: tuple[float, float],
        nodes: tuple[Nodes, Nodes],
        mapper: Mapper,
    ) -> LightGradient:
        """Return the response to so few shapes that a gradient at every point would cost more.

        ``nodes`` are those along y and x.
        """
        n, n_u, n_shapes = self.wfs.n_subapertures, len(self.pupil.coordinates), shapes.shape[1]
        # On the whole grid, where points without light have no part in any product.
        field = self.pupil_field
        on_grid = np.zeros((n_u, n_u, n_shapes), field.dtype)
        on_grid[self.pupil.lit] = shapes * (-2.0 * field[self.pupil.lit])[:, None]
        images = np.empty((2, n, 2, n))
        changes = np.empty((2, 2, n, n, n_shapes), self.dtype)
        # image by image, arrays of all subapertures stay in the cache
        for grid in _SINGLE_IMAGES if self.offsets is None else self._grids:
            roof_y, roof_x = self._roofs(grid, shift, nodes)
            modulated_y, modulated_x = self._modulate_roof(roof_y, roof_x)
            light, change = respond_to_few(
                field,
                on_grid.reshape(n_u, -1),
                (modulated_y[:, :, 0], modulated_x.reshape(n, len(modulated_y), -1, n_u)),
                (roof_y.weights, np.tile(roof_x.weights, 2)),
                mapper,
                self._n_products,
            )
            place = grid.sides_y.start, grid.sides_x.start
            images[place[0], :, place[1]] = light / self._all_light
            changes[place] = change
        return self.gather_light(images, changes, valid)

    def gather_light(
        self, images: NDArray[np.float64], changes: Array, valid: NDArray[np.bool_]
    ) -> LightGradient:
        """Return the response of images ``(2, n, 2, n)``; changes ``(2, 2, n, n, n_shapes)``."""
        n_shapes = changes.shape[-1]
        lines = changes[:, :, valid].reshape(4, -1, n_shapes)
        planes: Array = self._plane_signs(_ALL_IMAGES).reshape(-1, 4).astype(self.dtype)
        signals = (planes @ lines.reshape(4, -1)).reshape(-1, *lines.shape[1:])
        n_planes = self.recipe.kind.n_planes
        if self.recipe.normalisation is Normalisation.LOCAL:
            flux = signals[n_planes]
        else:
            flux = lines.sum(axis=(0, 1)) / lines.shape[1]
        return LightGradient(
            images=images,
            gradient=signals[:n_planes].reshape(-1, n_shapes),
            flux_gradient=flux,
            recipe=self.recipe,
        )

    @property
    def _apart(self) -> bool:
        """True if each image is computed by itself, and the signals are combined of them."""
        # pixels that differ in many places of the sum are cheaper image by image, and so are images
        # on grids of their own: each is in one plane then, and not in all
        return self.recipe.kind is SignalKind.INTENSITY or self.offsets is not None

    def prepare(self, of_row: RowResponse) -> PreparedRows:
        """Return what all rows of subapertures share."""
        images = np.empty((2, self.wfs.n_subapertures, 2, self.wfs.n_subapertures))
        parts: list[PreparedGrid] = []
        for grid in _SINGLE_IMAGES if self._apart and self.offsets is None else self._grids:
            roof_y, roof_x = self._roofs(grid, of_row.shift, (of_row.nodes_y, of_row.nodes_x))
            modulated_y, modulated_x = self._modulate_roof(roof_y, roof_x)
            fields_at_rest = self._fields(modulated_y, modulated_x)
            images[grid.sides_y, :, grid.sides_x] = self._images(fields_at_rest, roof_y, roof_x)
            last = parts[-1].grid if parts else None
            # The images of one side along y have the same factors along y.
            shares_y = last is not None and (last.sides_y, last.y) == (grid.sides_y, grid.y)
            planes = np.ones((1, 1, 1)) if self._apart else self._plane_signs(grid)
            parts.append(
                PreparedGrid(
                    grid=grid,
                    fields=fields_at_rest,
                    factors_y=parts[-1].factors_y
                    if shares_y
                    else _weight_parts(modulated_y, roof_y, axis=1),
                    factors_x=self.arrays.there(_weight_parts(modulated_x, roof_x, axis=-2)),
                    signs=self._signs(len(roof_y.weights), len(roof_x.weights), planes),
                )
            )
        finish = tuple(self._finish(of_row.shapes, scale) for scale in self._scales)
        return PreparedRows(images=images, parts=tuple(parts), finish=finish[0], turned=finish[1:])

    def lines(self, row: int, columns: Array, rows: PreparedRows) -> Array:
        """Return the lines of subapertures in these columns of a row, ``(n_lines, n_shapes)``."""
        found = self._lines(row, columns, rows)
        return found + self._lines(row, columns, rows.turn()) if rows.turned else found

    def _lines(self, row: int, columns: Array, rows: PreparedRows) -> Array:
        if self._apart:
            return self._combine_images(self._image_lines(row, columns, rows))
        factors = [self._row_factors(row, columns, part) for part in rows.parts]
        if len(factors) == 1:
            return self.arrays.here(rows.finish(*factors[0]))
        # each image is one more set of terms in the sum over products of factors
        xp = self.arrays.xp
        along_y = xp.concat([along_y for along_y, _ in factors], axis=1)
        every_x = zip(*(along_x for _, along_x in factors), strict=True)
        along_x = [xp.concat(list(same), axis=1) for same in every_x]
        return self.arrays.here(rows.finish(along_y, along_x))

    def _image_lines(self, row: int, columns: Array, rows: PreparedRows) -> Array:
        """Return the lines of each image by itself, ``(4, n_columns, n_shapes)``."""
        found = []
        for _, group in groupby(rows.parts, key=lambda part: id(part.factors_y)):
            factors = [self._row_factors(row, columns, part) for part in group]
            along_x = [line for _, lines in factors for line in lines]
            found.append(self.arrays.here(rows.finish(factors[0][0], along_x)))
        lines = np.concatenate(found)
        return lines.reshape(4, len(columns), -1)

    def _combine_images(self, lines: Array) -> Array:
        """Return the lines of the signals, and of what normalises them, of those of the images."""
        planes = self._plane_signs(_ALL_IMAGES).reshape(-1, 4).astype(lines.dtype)
        signals = np.tensordot(planes, lines, axes=1).reshape(-1, lines.shape[2])
        if self.recipe.normalisation is Normalisation.LOCAL:
            return signals
        return np.concatenate([signals, lines.sum(axis=(0, 1))[None]])

    @property
    def n_pairs(self) -> int:
        """Pairs of source points, each as often as the roof operator has products."""
        return len(self._source()[1]) * self._n_products

    def images(self, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
        """Return the light at rest ``(2, n, 2, n)``: side, row along y, side, column along x."""
        n, nodes = self.wfs.n_subapertures, self.nodes
        images = np.empty((2, n, 2, n))
        for grid in self._grids:
            roof_y, roof_x = self._roofs(grid, shift, (nodes, nodes))
            fields_at_rest = self._fields(*self._modulate_roof(roof_y, roof_x))
            images[grid.sides_y, :, grid.sides_x] = self._images(fields_at_rest, roof_y, roof_x)
        return images

    @property
    def _fft_grid(self) -> FftGrid | None:
        """Grid of the simulation that made a matrix, if the pupil has its points."""
        grid = self.wfs.fft_grid
        same = grid is not None and grid.points_per_subaperture == self.pupil.sampling
        return grid if same else None

    @property
    def nodes(self) -> Nodes:
        """Quadrature over a subaperture."""
        grid = self._fft_grid
        return Nodes.area(self.n_nodes) if grid is None else Nodes.points(self.pupil.sampling)

    @property
    def focal_frequencies(self) -> NDArray[np.float64]:
        """Frequencies along an axis of the focal plane, 1 / subaperture, the tip between four."""
        wide = 2.0 * (self.wfs.image_separation_subap + self.wfs.n_subapertures)
        width = wide if self._fft_grid is None else self._fft_grid.width_subap
        n = round(width * self.pupil.sampling)
        return np.asarray((np.arange(n) - (n - 1) / 2) / width)

    @property
    def _grids(self) -> tuple[_Grid, ...]:
        """The four images together, or one by one if they are displaced differently."""
        if self.offsets is None:
            return (_ALL_IMAGES,)
        return tuple(
            _Grid(sides_y=slice(y, y + 1), sides_x=slice(x, x + 1), x=float(at[0]), y=float(at[1]))
            for y, row in enumerate(self.offsets)
            for x, at in enumerate(row)
        )

    @property
    def _complex(self) -> type[np.complex64] | type[np.complex128]:
        return np.complex64 if self.dtype is np.float32 else np.complex128

    def _roofs(
        self, grid: _Grid, shift: tuple[float, float], nodes: tuple[Nodes, Nodes]
    ) -> tuple[_Roof, _Roof]:
        """Return the roof operators along y and x; ``nodes`` are those along y and x."""
        rooftop = self._rooftop
        return (
            self._roof(shift[1] + grid.y, nodes[0], grid.sides_y, rooftop.along_y),
            self._roof(shift[0] + grid.x, nodes[1], grid.sides_x, rooftop.along_x),
        )

    def _roof(self, shift: float, nodes: Nodes, sides: slice, factors: Array) -> _Roof:
        """Return the roof operator along one axis, at the nodes of every subaperture.

        ``factors`` are coefficients ``(n_products, n_functions)`` of the rooftop.
        """
        n, half = self.wfs.n_subapertures, self.wfs.image_separation_subap / 2
        # Points of the detector along an axis, those of the images on either side of the middle.
        centres = np.arange(n) - (n - 1) / 2
        x = _SIDES[sides, None, None] * half + centres[:, None] + nodes.offsets - shift
        distance = x[..., None] - self.pupil.coordinates
        faces = _face_kernels(distance, half, self.pupil.sampling, self._width_subap)
        functions = [*faces, *self._rooftop.list_waves(distance)]
        kernels = np.tensordot(factors, functions, axes=1).swapaxes(1, 2)
        return _Roof(kernels=np.ascontiguousarray(kernels, self._complex), weights=nodes.weights)

    @property
    def _width_subap(self) -> float:
        """Width of the grid of a simulation's FFT, subapertures; infinite for a real sensor."""
        return math.inf if self._fft_grid is None else self._fft_grid.width_subap

    @property
    def _rooftop(self) -> Rooftop:
        return make_rooftop(self.wfs, self.pupil.sampling, self._width_subap)

    @property
    def _n_products(self) -> int:
        """Number of separable products that the roof operator is the sum of."""
        return len(self._rooftop.along_y)

    def _source(self) -> tuple[Array, Array]:
        """Return tilt ``(3, M/2)`` and weight ``(M/2,)`` of every pair of source points.

        The tilt is that of both along y, then half the sum and half the difference of those along
        x. Without a halo the source is the path of the modulation. The halo of an ellipse is taken
        as that of the circle of the same area.
        """
        path = tuple(2 * np.pi * a / self.wfs.pupil_diameter for a in self.wfs.modulation_path)
        rings = [(path, 1.0 if self.halo is None else self.halo.core_weight, self.n_modulation)]
        if self.halo is not None:
            halo = self.halo
            rings += [
                ((float(radius), 0.0, float(radius)), float(weight), n)
                for radius, weight, n in zip(halo.radii, halo.weights, halo.n_points, strict=True)
            ]
        tilts, weights = [], []
        grid = self._fft_grid
        n_simulated = None if grid is None else grid.modulation_points
        for place, ((along_y, middle_x, half_x), weight, n) in enumerate(rings):
            # Half of a ring and half a step off its ends: every point then has a partner that
            # differs along x only.
            steps, share = (np.arange(n // 2) + 0.5) / n, np.full(n // 2, 1.0 / n)
            if place == 0 and n_simulated is not None:
                # Points at the ends as well, each of which is its own partner.
                steps = np.arange(n_simulated // 2 + 1) / n_simulated
                share = np.full(len(steps), 1.0 / n_simulated)
                share[[0, -1]] /= 2.0
            cosine, sine = np.cos(2 * np.pi * steps), np.sin(2 * np.pi * steps)
            tilts.append(np.array([along_y * cosine, middle_x * cosine, half_x * sine]))
            weights.append(weight * share)
        return np.concatenate(tilts, axis=1), np.concatenate(weights)

    def source_phasors(self) -> tuple[Array, Array]:
        """Return source phasors ``(M/2, N)`` along y and ``(M/2, 2, N)`` along x.

        The second index along x is the pair of points that share their y component. The phasor
        along y carries the root of the point's weight: it enters every product twice.
        """
        (y, middle_x, half_x), weights = self._source()
        u = self.pupil.coordinates
        along_y = np.sqrt(weights)[:, None] * np.exp(1j * y[:, None] * u)
        x = middle_x[:, None, None] + half_x[:, None, None] * _SIDES[:, None]
        return along_y.astype(self._complex), np.exp(1j * x * u).astype(self._complex)

    def _modulate_roof(self, roof_y: _Roof, roof_x: _Roof) -> tuple[Array, Array]:
        """Return the roof operators times the source's phasors.

        Along y ``(M/2, n, 2, n_nodes, N)``: source, subaperture, image side, node; along x
        ``(n, M/2, 2, 2 of the pair, n_nodes, N)``. If the operator is a sum of products, each
        source is repeated for every one.
        """
        along_y, along_x = self.source_phasors()
        kernels_x = roof_x.kernels.swapaxes(0, 1)[:, None, :, :, None]
        modulated_y = along_y[:, None, None, None, None] * roof_y.kernels
        modulated_x = along_x[:, None, None, :, None] * kernels_x
        return (
            modulated_y.reshape(-1, *modulated_y.shape[2:]),
            modulated_x.reshape(len(modulated_x), -1, *modulated_x.shape[3:]),
        )

    def _fields(self, modulated_y: Array, modulated_x: Array) -> Array:
        """Return the fields at rest, for each subaperture together.

        ``(n, n, M/2, 2, n_nodes, 2, 2 of the pair, n_nodes)``: row, column, source, image side and
        node along y, image side, one of the pair and node along x.
        """
        amplitude = self.pupil_field.astype(self._complex)
        n, n_products = modulated_y.shape[1], self._n_products
        n_source, n_u = len(modulated_y) // n_products, modulated_y.shape[-1]
        at_y, at_x = modulated_y.shape[2:-1], modulated_x.shape[2:-1]
        fields = np.zeros((n, n, n_source, math.prod(at_y), math.prod(at_x)), self._complex)
        for place, left in enumerate(modulated_y):
            right = modulated_x[:, place].reshape(-1, n_u)
            # Along y, then along x: each product of the roof operator is separable.
            seen = (left.reshape(-1, n_u) @ amplitude) @ right.T
            seen = seen.reshape(n, math.prod(at_y), n, -1).swapaxes(1, 2)
            fields[:, :, place // n_products] += seen
        return fields.reshape(n, n, n_source, *at_y, *at_x)

    def _images(self, fields: Array, roof_y: _Roof, roof_x: _Roof) -> NDArray[np.float64]:
        parts = fields.view(self.dtype).reshape(*fields.shape[:3], -1)
        # In double precision, because a halo has hundreds of source points to sum over.
        power = np.square(parts).sum(axis=2, dtype=np.float64)
        power = power.reshape(*fields.shape[:2], *fields.shape[3:], 2)
        # Sum over nodes (a, b), pair (p) and real and imaginary part (c).
        images = np.einsum("ijyaxpbc,a,b->yixj", power, roof_y.weights, roof_x.weights)
        return np.asarray(images / self._all_light)

    @property
    def _all_light(self) -> float:
        """Light of all source points.

        What the halo loses beyond the grid still falls on the detector, only without signal.
        """
        return float(2.0 * self._source()[1].sum())

    def _plane_signs(self, grid: _Grid) -> Array:
        """Return the sign of each image in every plane of signals ``(n_planes, n_sides, n_sides)``.

        With local normalisation the flux is one more plane.
        """
        if self.recipe.kind is SignalKind.INTENSITY:
            signs = np.eye(4).reshape(4, 2, 2)
        else:
            signs = np.stack([np.tile(_SIGNS, (2, 1)), np.tile(_SIGNS, (2, 1)).T])
        if self.recipe.normalisation is Normalisation.LOCAL:
            signs = np.concatenate([signs, np.ones((1, 2, 2))])
        return np.asarray(signs[:, grid.sides_y, grid.sides_x])

    def _signs(self, n_y: int, n_x: int, signs: Array) -> Array:
        """Return with which sign each field at rest has a part in every plane of signals.

        ``(n_planes, 1, 1, 2, n_sides, n_y, n_sides, 2, n_x)``, of ``signs`` as ``_plane_signs``
        returns them. Of the two parts of a field, times i and as it is, see ``_row_factors``.
        """
        parts = np.array([1j, 1.0])[:, None, None, None, None, None]
        every = signs[:, None, None, None, :, None, :, None, None] * parts
        n_planes, on_y, on_x = signs.shape
        shape = (n_planes, 1, 1, 2, on_y, n_y, on_x, 2, n_x)
        return np.broadcast_to(every, shape).astype(self._complex)

    def _row_factors(
        self, row: int, columns: Array, rows: PreparedGrid
    ) -> tuple[Foreign, list[Foreign]]:
        """Return factors ``(N, n_terms)`` along y, ``(n_lines, n_terms, N)`` along x of one row.

        The sum of their products over the terms, times the amplitude, is the gradient of each line:
        the signals plane by plane, then the flux of every subaperture with local normalisation,
        otherwise their sum by itself. Modulation, nodes and images along y are terms. Only the
        imaginary part is needed, so Re | Im of one factor is paired with Im | Re of the other.
        """
        xp, there = self.arrays.xp, self.arrays.there
        along_y = rows.factors_y[:, :, row]
        n_u = along_y.shape[-1]
        span = slice(int(columns[0]), int(columns[-1]) + 1)  # not copied, as a list of columns is
        if len(columns) == span.stop - span.start:
            here, right = rows.fields[row, span], rows.factors_x[span, ...]
        else:
            here = rows.fields[row, columns]
            right = xp.take(rows.factors_x, there(columns), axis=0)
        # Each product of the roof operator is a term of its own, with the field of all together.
        here = np.repeat(here, self._n_products, axis=1)
        # Complex numbers as pairs: the imaginary part of a product is a real product of twice the
        # length.
        left = (here[None, :, :, None] * rows.signs).view(self.dtype)
        n_planes, n_columns, n_source = left.shape[:3]
        left = left.reshape(n_planes, n_columns, n_source, along_y[0].size // n_u, -1)
        right = xp.reshape(right, (n_columns, n_source, -1, n_u))
        lines = xp.matmul(there(left), right)
        along_x = [xp.reshape(lines, (n_planes * n_columns, -1, n_u))]
        # A part of one plane gives the lines of one image, not of signals.
        if self.recipe.normalisation is Normalisation.GLOBAL and n_planes > 1:
            along_x.append(self._flux_factor(lines, along_y, rows.grid))
        return there(along_y.reshape(-1, n_u).T), along_x

    def _flux_factor(self, lines: Foreign, along_y: Array, grid: _Grid) -> Foreign:
        """Return the factor along x of a row's whole flux, ``(1, n_terms, N)``."""
        xp = self.arrays.xp
        if self.recipe.kind is SignalKind.INTENSITY:
            flux = xp.sum(lines, axis=(0, 1))
        else:  # the plane along y, less its signs
            signs = np.broadcast_to(_SIGNS[grid.sides_y, None, None], (*along_y.shape[:-1], 1))
            signs = signs.reshape(len(along_y), -1, 1).astype(self.dtype)
            flux = xp.sum(lines[1, ...], axis=0) * self.arrays.there(signs)
        return xp.reshape(flux, (1, -1, flux.shape[-1]))

    def _finish(self, shapes: Shapes | None, scale: Array) -> Finish:
        """Return what makes of a row's factors its gradient, or its response to shapes.

        ``scale`` ``(N, N)`` multiplies a product of factors.
        """
        if isinstance(shapes, LocalShapes):
            return TiledResponse(shapes, scale, self.arrays)
        xp, there = self.arrays.xp, self.arrays.there
        lit, scale = there(np.flatnonzero(self.pupil.lit)), there(scale[self.pupil.lit])
        # Sent to the device once, before the rows.
        known = None if shapes is None else there(shapes)

        def fold(along_y: Foreign, along_x: list[Foreign]) -> Foreign:
            products = (xp.matmul(along_y, part) for part in along_x)
            flat = [xp.reshape(product, (product.shape[0], -1)) for product in products]
            gradient = xp.concat([xp.take(lines, lit, axis=1) for lines in flat], axis=0)
            gradient *= scale
            return gradient if known is None else xp.matmul(gradient, known)

        return fold

    def are_few(self, n_shapes: int) -> bool:
        """Return True if so few shapes cost less than the gradient at every point of a row.

        Another array library computes the gradient whatever it costs: few shapes use NumPy only.
        """
        if self.arrays != NUMPY:
            return False
        n_lines = self.recipe.kind.n_planes * self.wfs.n_subapertures
        n_points = len(self.pupil.coordinates)
        return n_shapes * (n_points + n_lines) < n_points * n_lines

    @property
    def pupil_field(self) -> Array:
        """``(N, N)`` field over the pupil, complex only with an aberration."""
        if self.aberration_rad is None:
            return self.pupil.amplitude.astype(self.dtype)
        field: Array = self.pupil.amplitude * np.exp(1j * self.aberration_rad)
        return field.astype(self._complex)

    @property
    def _scales(self) -> list[Array]:
        """``(N, N)`` what products of factors are multiplied by, of imaginary and real parts.

        Without an aberration the imaginary part alone counts.
        """
        field = -2.0 * self.pupil_field
        return [field.real] if self.aberration_rad is None else [field.real, field.imag]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Grid:
    """Images whose detector points form one regular grid, so that their optics are separable."""

    sides_y: slice
    sides_x: slice
    x: float = 0.0
    """Displacement along x, subapertures."""

    y: float = 0.0


_ALL_IMAGES = _Grid(sides_y=slice(0, 2), sides_x=slice(0, 2))

_SINGLE_IMAGES = tuple(
    _Grid(sides_y=slice(y, y + 1), sides_x=slice(x, x + 1)) for y in range(2) for x in range(2)
)
"""Each of four images in its place."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedGrid:
    """Arrays that all rows of subapertures share, for the images on one grid."""

    grid: _Grid
    fields: Array
    factors_y: Array
    """``(M/2, Re | Im, n, 2, n_nodes, N)``."""

    factors_x: Foreign
    """``(n, M/2, 2, 2 of the pair, n_nodes, Re | Im, N)``."""

    signs: Array
    """Factor of a field in every plane of signals."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedRows:
    """Arrays that all rows of subapertures share."""

    images: NDArray[np.float64]
    parts: tuple[PreparedGrid, ...]
    """One for the four images together, or one for each."""

    finish: Finish
    """Function that turns a row's factors into its gradient, or into its response to shapes."""

    turned: tuple[Finish, ...] = ()
    """The same for the real part of a product of factors; empty without an aberration."""

    def turn(self) -> PreparedRows:
        """Return the same for the real parts of products instead of their imaginary ones."""
        parts = tuple(replace(part, signs=-1j * part.signs) for part in self.parts)
        return replace(self, parts=parts, finish=self.turned[0], turned=())


@dataclass(frozen=True, kw_only=True, eq=False)
class RowResponse(RowTask):
    """The response of any row of subapertures."""

    optics: PyramidOptics
    valid: NDArray[np.bool_]
    shift: tuple[float, float]
    shapes: Shapes | None
    nodes_y: Nodes
    nodes_x: Nodes

    @override
    def __call__(self, row: int) -> Array:
        """Return ``(n_lines, n_shapes)``: the signals plane by plane, then what normalises them."""
        return self.optics.lines(row, np.flatnonzero(self.valid[row]), self.shared)

    @cached_property
    def shared(self) -> PreparedRows:
        """Arrays that all rows share."""
        return self.optics.prepare(self)

    @property
    @override
    def elsewhere(self) -> MadeElsewhere | None:
        """Recipe for another process to make the same; None if it cannot make the shapes."""
        shapes = self.shapes.elsewhere if isinstance(self.shapes, LocalShapes) else None
        if shapes is None:
            return None
        where = {"shift": self.shift, "nodes_y": self.nodes_y, "nodes_x": self.nodes_x}
        return replace(shapes, make=partial(_of_model, shapes_of=shapes.make, **where))

    @override
    def __getstate__(self) -> dict[str, object]:
        """Leave out the arrays that the receiving process prepares itself."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def _of_model(model: Any, *, shapes_of: Callable[[Any], Shapes], **where: Any) -> RowResponse:  # noqa: ANN401 - a model of its own
    """Return rows of a model's pyramid, of the shapes that can be made of it."""
    optics = model.sensor.optics
    return RowResponse(optics=optics, valid=model.valid, shapes=shapes_of(model), **where)


def enough_modulation_points(wfs: Pyramid) -> int:
    """Return the even number of points that samples the modulation circle to 5e-5 of tip: 28 at 3.

    With 16 points at 3 λ/D tip is wrong by 45 %, with 20 by 5 %, with 24 by 2e-3.
    """
    least = int(np.ceil(6 * wfs.largest_modulation)) + 10
    return least + least % 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Roof:
    """The roof operator along one axis at every quadrature node."""

    kernels: Array
    """``(n_products, n, 2, n_nodes, N)``: factor of each product of a rooftop, subaperture, image
    side, node, pupil coordinate."""

    weights: NDArray[np.float64]
    """``(n_nodes,)``."""


def _weight_parts(modulated: Array, roof: _Roof, axis: int) -> Array:
    """Return roof operators times phasors and weights of the nodes, Re | Im along an axis."""
    weighted = modulated * roof.weights[:, None].astype(modulated.real.dtype)
    return np.stack([weighted.real, weighted.imag], axis=axis)


def _face_kernels(
    distance: NDArray[np.float64], half_separation: float, sampling: int, width: float = math.inf
) -> tuple[Array, Array]:
    """Return the band-limited kernels of the faces at positive and negative frequencies.

    Their sum is the kernel of one pyramid edge between two points of an axis. ``width`` is that of
    the grid of an FFT, subapertures, which sums over frequencies: at half integers, with the tip of
    the pyramid between four of them. Its sum differs from the integral by the ratio of a distance
    to its sine, and repeats itself.
    """
    plus, minus = distance + half_separation, distance - half_separation
    sum_plus, sum_minus = (1.0 / np.sinc(part / width) for part in (plus, minus))
    return (
        0.5 * (np.sinc(plus * sampling) + 1j * _edge(plus * sampling)) * sum_plus,
        0.5 * (np.sinc(minus * sampling) - 1j * _edge(minus * sampling)) * sum_minus,
    )


def _edge(n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``(1 - cos πn) / (πn)``, 0 at 0: the transform of a sign, cut at the band limit."""
    return np.asarray(np.sinc(n / 2) * np.sin(np.pi * n / 2))
