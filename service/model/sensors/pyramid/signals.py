"""Signals of a pyramid's four images, and their response to the wavefront."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.kinds import Normalisation, SignalKind, SlopeOrder
from service.model.local import Shapes
from service.model.sensors.pyramid.optics import (
    LightGradient,
    Nodes,
    PyramidOptics,
)
from service.model.sensors.sensor import KEPT_BYTES, Mapper, Work, by_rows
from service.model.slopes import PLAIN, TO_SLOPES, SlopeRecipe

Array = NDArray[Any]

_ROWS = 512
"""Signals that are normalised at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PyramidSensor:
    """The pyramid as a ``Sensor``."""

    optics: PyramidOptics
    valid: NDArray[np.bool_]
    mapper: Mapper = map
    kept_bytes: float = KEPT_BYTES
    """Size of a gradient at every point that a response keeps for the shapes that come next."""

    @property
    def n_signals(self) -> int:
        """Two slopes or four pixels for each valid subaperture."""
        return self.optics.recipe.kind.n_planes * int(self.valid.sum())

    @property
    def keeps_gradient(self) -> bool:
        """True if the gradient at every point is small enough to be kept."""
        optics = self.optics
        n_points = int(optics.pupil.lit.sum())
        return bool(np.dtype(optics.dtype).itemsize * self.n_signals * n_points <= self.kept_bytes)

    def at(self, shift: tuple[float, float]) -> PyramidResponse:
        """Return the response with the four images moved by ``shift``, (x, y) in subapertures."""
        return PyramidResponse(sensor=self, shift=shift)

    def work(self, n_shapes: int) -> Work:
        """Return what a response and its product with an array of so many shapes take.

        A gradient at every point is held whole where it is kept, else for one row at a time.
        """
        optics, rows, n_valid = self.optics, self.n_signals, int(self.valid.sum())
        n, side = optics.wfs.n_subapertures, len(optics.pupil.coordinates)
        n_points = int(optics.pupil.lit.sum())
        local = optics.recipe.normalisation is Normalisation.LOCAL
        n_terms = 4 * optics.n_pairs * optics.n_nodes
        in_a_row = optics.recipe.kind.n_planes * n + (n if local else 1)
        gradients = rows + (n_valid if local else int(self.valid.any(axis=1).sum()))
        n_lines = 2 * n * optics.n_nodes
        fields = 4.0 * optics.n_pairs * n_lines * (n_lines + side)
        factors = 2.0 * n_terms * side * (n + in_a_row)
        folds = in_a_row * (n_terms * side + side**2 + 2.0 * n_points)
        kept = gradients * n_points if self.keeps_gradient else 0
        itemsize = np.dtype(optics.dtype).itemsize
        folded = 2.0 * n_terms * side * (side * gradients + 8.0 * optics.n_nodes * n_valid)
        return Work(
            memory_bytes=itemsize * (fields + kept + max(factors, folds)),
            flop=folded + 2.0 * gradients * n_points * n_shapes,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PyramidResponse:
    """The pyramid's ``Response``, its images at one place."""

    sensor: PyramidSensor
    shift: tuple[float, float]
    other_light: NDArray[np.float64] | None = None
    """``(2, n, 2, n)`` light at rest; None: that of a flat wavefront."""

    @cached_property
    def light(self) -> NDArray[np.float64]:
        """``(2, n, 2, n)`` the four images: side along y, row, side along x, column."""
        if self.other_light is not None:
            return self.other_light
        return self.sensor.optics.images(self.shift)

    def lit(self, light: NDArray[np.float64]) -> PyramidResponse:
        """Return the response where the images have other light at rest.

        What the phase changes in the light that is missing, some 1e-4 of the flux's gradient, is
        left in.
        """
        return replace(self, other_light=light)

    def jacobian(self) -> Array:
        """Return K whole, ``(n_signals, n_points)`` per metre."""
        return self._per_metre(differentiate_signals(self._gradient, self.sensor.valid))

    def apply(self, shapes: Shapes) -> Array:
        """Return the signals ``(n_signals, n_shapes)`` of wavefronts, metres."""
        light = self._to(shapes)
        return self._per_metre(differentiate_signals(light, self.sensor.valid, out=light.gradient))

    def with_shift_rates(self, shapes: Shapes) -> tuple[Array, Array, Array]:
        """Return the signals, and their change when the images move along x, and along y."""
        at_rest, valid = self._to(shapes), self.sensor.valid
        along_x, along_y = (
            self._per_metre(differentiate_jacobian(at_rest, self._to(shapes, **edges), valid))
            for edges in ({"nodes_x": Nodes.edges()}, {"nodes_y": Nodes.edges()})
        )
        signals = differentiate_signals(at_rest, valid, out=at_rest.gradient)
        return self._per_metre(signals), along_x, along_y

    def image_rates(self, shapes: Shapes) -> Array:
        """Return how the signals change when one image alone moves, ``(8, n_signals, n_shapes)``.

        The images at -x -y, +x -y, -x +y, +x +y along x, then all four along y.
        """
        sensor, valid, recipe = self.sensor, self.sensor.valid, self.sensor.optics.recipe
        apart = replace(sensor.optics, recipe=SlopeRecipe(order=SlopeOrder.IMAGES))
        images = replace(sensor, optics=apart)
        at_rest, rates = self._to(shapes), []
        for edges in ({"nodes_x": Nodes.edges()}, {"nodes_y": Nodes.edges()}):
            moving = replace(self, sensor=images)._to(shapes, **edges)  # noqa: SLF001 - its own kind
            # Images as planes, of which each in turn is the only one that moves.
            by_image = moving.gradient.reshape(2, 2, -1, moving.gradient.shape[1])
            for side_y, side_x in np.ndindex(2, 2):
                light = np.zeros_like(moving.images)
                light[side_y, :, side_x] = moving.images[side_y, :, side_x]
                one = _of_image(by_image[side_y, side_x], (side_y, side_x), recipe)
                rate = differentiate_jacobian(at_rest, replace(one, images=light), valid)
                rates.append(self._per_metre(rate))
        return np.array(rates)

    @cached_property
    def _gradient(self) -> LightGradient:
        """The gradient at every point."""
        sensor = self.sensor
        found = sensor.optics.response(sensor.valid, self.shift, mapper=sensor.mapper)
        return self._as_lit(found)

    def _to(self, shapes: Shapes, **edges: Nodes) -> LightGradient:
        """Return the response to shapes; with edges its rate when the images move, never kept."""
        sensor = self.sensor
        if sensor.keeps_gradient and not edges:
            return self._gradient.to(shapes, self._product)
        # one product of all rows where there is room: row by row, each would read the shapes again
        # ... and where a row's gradient is cheaper than its response to the shapes alone
        few = isinstance(shapes, np.ndarray) and sensor.optics.are_few(shapes.shape[1])
        whole = sensor.keeps_gradient and not few
        found = sensor.optics.response(
            sensor.valid,
            self.shift,
            shapes=None if whole else shapes,
            mapper=sensor.mapper,
            **edges,
        )
        if whole:
            found = found.to(shapes, self._product)
        return found if edges else self._as_lit(found)

    def _as_lit(self, found: LightGradient) -> LightGradient:
        return found if self.other_light is None else replace(found, images=self.other_light)

    def _per_metre(self, jacobian: Array) -> Array:
        wavelength_m = self.sensor.optics.wfs.wavelength_m
        # Gradients are per radian of phase until here; in place, because they may take gigabytes.
        jacobian *= np.asarray(2 * np.pi / wavelength_m, dtype=jacobian.dtype)
        return jacobian

    def _product(self, gradient: Array, shapes: Shapes) -> Array:
        if gradient.ndim == 1:
            return np.asarray((gradient[None] @ shapes)[0])
        return by_rows(self.sensor.mapper, lambda rows: rows @ shapes, gradient)


def _of_image(gradient: Array, image: tuple[int, int], recipe: SlopeRecipe) -> LightGradient:
    """Return the gradient of all signals where only one image ``(n_valid, n_shapes)`` changes."""
    n_valid, n_shapes = gradient.shape
    if recipe.kind is SignalKind.INTENSITY:
        weights = np.eye(4)[2 * image[0] + image[1]]
    else:
        weights = TO_SLOPES[SignalKind.INTENSITY][:, 2 * image[0] + image[1]]
    planes = weights.astype(gradient.dtype)[:, None, None] * gradient
    local = recipe.normalisation is Normalisation.LOCAL
    return LightGradient(
        images=np.empty(0),
        gradient=planes.reshape(-1, n_shapes),
        flux_gradient=gradient if local else gradient.sum(axis=0) / n_valid,
        recipe=recipe,
    )


def pixel_places(valid: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the indices of the pixels of valid subapertures in flat light ``(2, n, 2, n)``.

    ``(4, n_valid)``: in the images at -x -y, +x -y, -x +y, +x +y.
    """
    n = len(valid)
    places = np.arange(4 * n * n, dtype=np.intp).reshape(2, n, 2, n)
    return np.ascontiguousarray(places.swapaxes(1, 2)[..., valid].reshape(4, -1))


def reference_slopes(
    images: Array, valid: NDArray[np.bool_], recipe: SlopeRecipe = PLAIN
) -> tuple[Array, float]:
    """Return the signals ``(n_slopes,)`` of four images and the mean flux per valid subaperture.

    Signs of conventions.md. ``images`` is ``(2, n, 2, n)``.
    """
    signals, flux = signals_of(images, valid, recipe)
    return signals / flux, float(flux.mean())


def signals_of(images: Array, valid: NDArray[np.bool_], recipe: SlopeRecipe) -> tuple[Array, Array]:
    """Return the signals of four images ``(..., 2, n, 2, n)``, and what normalises them.

    The signals are ``(..., n_slopes)``: x, then y differences, or the images. The flux is
    ``(..., 1)``, the mean per valid subaperture, or ``(..., n_slopes)``, each one's own.
    """
    # Sums of the two images on one side.
    by_x, by_y = images.sum(axis=-4), images.sum(axis=-2)
    flux = by_y.sum(axis=-3)[..., valid]
    if recipe.kind is SignalKind.INTENSITY:
        sides = images.swapaxes(-3, -2)[..., valid]
        signals = sides.reshape(*flux.shape[:-1], -1)
    else:
        x = (by_x[..., 0, :] - by_x[..., 1, :])[..., valid]
        y = (by_y[..., 0, :, :] - by_y[..., 1, :, :])[..., valid]
        signals = np.concatenate([x, y], axis=-1)
    if recipe.normalisation is Normalisation.LOCAL:
        return signals, np.concatenate([flux] * recipe.kind.n_planes, axis=-1)
    return signals, flux.mean(axis=-1, keepdims=True)


def differentiate_signals(
    response: LightGradient, valid: NDArray[np.bool_], *, out: Array | None = None
) -> Array:
    """Return the gradient of the normalised signals, ``(n_slopes, n_points)`` per radian.

    Of a response to shapes: their signals, ``(n_slopes, n_shapes)``. ``out`` may be the response's
    own gradient.
    """
    signals, flux = signals_of(response.images, valid, response.recipe)
    slopes = signals / flux
    divisor = np.broadcast_to(flux, slopes.shape)[:, None].astype(response.gradient.dtype)
    jacobian = np.empty_like(response.gradient) if out is None else out
    for start in range(0, len(slopes), _ROWS):
        rows = slice(start, start + _ROWS)
        own = response.flux_gradient
        if own.ndim > 1:
            # With local normalisation all planes of a subaperture share its flux.
            own = own[np.arange(len(slopes))[rows] % len(own)]
        moved = slopes[rows, None].astype(own.dtype) * own
        np.subtract(response.gradient[rows], moved, out=jacobian[rows])
        jacobian[rows] /= divisor[rows]
    return jacobian


def differentiate_jacobian(
    at_rest: LightGradient, moving: LightGradient, valid: NDArray[np.bool_]
) -> Array:
    """Return the rate of ``differentiate_signals`` when the images move, by the product rule."""
    signals, flux = signals_of(at_rest.images, valid, at_rest.recipe)
    signal_rate, flux_rate = signals_of(moving.images, valid, moving.recipe)
    slopes = signals / flux
    slope_rate = (signal_rate - slopes * flux_rate) / flux
    rate = moving.gradient - _times(slopes, moving.flux_gradient)
    rate -= _times(slope_rate, at_rest.flux_gradient)
    rate -= differentiate_signals(at_rest, valid) * flux_rate[:, None].astype(rate.dtype)
    rate /= flux[:, None].astype(rate.dtype)
    return np.asarray(rate)


def _times(slopes: Array, flux_gradient: Array) -> Array:
    """Return each slope times the gradient of its flux, ``(n_slopes, n_points)``."""
    column = slopes[:, None].astype(flux_gradient.dtype)
    if flux_gradient.ndim == 1:
        return np.asarray(column * flux_gradient)
    planes = column.reshape(-1, len(flux_gradient), 1) * flux_gradient
    return planes.reshape(len(slopes), -1)
