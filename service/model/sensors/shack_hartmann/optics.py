"""The Shack-Hartmann's signals: one sparse matrix from pupil points to centroids.

A lenslet reads wavefronts between the points of the pupil at nodes of its own, which move over the
pupil with its image, so the derivative by the shift is exact; light it reads on a finer grid, for
where the edge cuts a lenslet, light is what moves its spot. Beyond the edge the wavefront goes on
as a parabola through what is lit nearby.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.local import Shapes
from service.model.pupil import Illumination, PupilGrid, instrument_pupil, valid_subapertures
from service.model.sensors.sensor import Work
from service.model.sensors.shack_hartmann.description import shack_hartmann_in
from service.model.sensors.shack_hartmann.spots import Spots
from service.model.sensors.shack_hartmann.stars import spots_of

Array = NDArray[Any]

_DARK_SHARE = 0.1
"""Light relative to a full subaperture below which a slope is attenuated: with little light it
measures only the edge, and no RTC divides by it."""

_LIGHT_SAMPLING = 12
"""Points of the light's grid along a subaperture, at least."""

_MARGIN_POINTS = 3
"""Points beyond the edge that a node next to it may read."""

_N_PARABOLA_POINTS = 16
"""Lit points that the parabola beyond the edge goes through, in least squares."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShackHartmannSensor:
    """The Shack-Hartmann as a ``Sensor``."""

    instrument: Instrument
    pupil: PupilGrid
    dtype: type[np.float32] | type[np.float64] = np.float32

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """``(n, n)`` [y, x] subapertures that give signals."""
        return valid_subapertures(self.instrument)

    @property
    def n_signals(self) -> int:
        """Two slopes for each valid subaperture."""
        return 2 * int(self.valid.sum())

    @property
    def keeps_gradient(self) -> bool:
        """True: K is sparse, so that it can be kept."""
        return True

    @property
    def side(self) -> int:
        """Points across the grid of wavefronts that lenslets read: the pupil's, and beyond."""
        return len(self.pupil.coordinates) + 2 * _MARGIN_POINTS

    @cached_property
    def spots(self) -> Spots:
        """Pixels and centroids of valid subapertures."""
        return spots_of(
            shack_hartmann_in(self.instrument), self.instrument.subaperture_m, self.valid
        )

    @cached_property
    def light_grid(self) -> PupilGrid:
        """The pupil on the light's grid, as evenly lit as on its own.

        A pupil that is not drawn on the instrument's own grid is taken as it is.
        """
        drawn = instrument_pupil(self.instrument, self.pupil.sampling)
        if drawn.amplitude.shape != self.pupil.amplitude.shape:
            return self.pupil
        # A multiple of the pupil's sampling, so that both grids have the same cells.
        times = -(-_LIGHT_SAMPLING // self.pupil.sampling)
        fine = instrument_pupil(self.instrument, times * self.pupil.sampling)
        root = np.divide(
            self.pupil.amplitude,
            drawn.amplitude,
            where=drawn.lit,
            out=np.ones_like(drawn.amplitude),
        )
        nearest = scipy.ndimage.distance_transform_edt(
            ~drawn.lit, return_distances=False, return_indices=True
        )
        intensity = root[tuple(nearest)] ** 2
        return fine.lit_by(Illumination(coordinates=drawn.coordinates, intensity=intensity))

    @cached_property
    def extend_wavefronts(self) -> Any:  # noqa: ANN401 - scipy has no types
        """``(n_grid, n_points)``: from wavefronts where it is lit to that grid; sparse."""
        # Nodes of a lenslet at the edge read points that see no light: a wavefront is needed there.
        lit = np.pad(self.pupil.lit, _MARGIN_POINTS)
        near = scipy.ndimage.binary_dilation(lit, np.ones((2 * _MARGIN_POINTS + 1,) * 2)) & ~lit
        inside, beyond = np.argwhere(lit), np.argwhere(near)
        n = min(_N_PARABOLA_POINTS, len(inside))
        _, nearest = scipy.spatial.cKDTree(inside).query(beyond, n)
        y, x = np.moveaxis(inside[nearest] - beyond[:, None], 2, 0)
        shapes = np.stack([np.ones(x.shape), x, y, x**2, x * y, y**2], axis=2)
        # The constant of the parabola is its height at the point itself, from which distances are
        # counted.
        height = np.linalg.pinv(shapes)[:, 0]
        rows = np.concatenate([np.flatnonzero(lit), np.repeat(np.flatnonzero(near), n)])
        columns = np.concatenate([np.arange(len(inside)), nearest.reshape(-1)])
        values = np.concatenate([np.ones(len(inside)), height.reshape(-1)])
        return scipy.sparse.csr_matrix((values, (rows, columns)), shape=(lit.size, len(inside)))

    def at(self, shift: tuple[float, float]) -> ShackHartmannResponse:
        """Return the response with the pupil's image moved by ``shift``, (x, y) subapertures."""
        return ShackHartmannResponse(sensor=self, shift=shift)

    def work(self, n_shapes: int) -> Work:
        """Return what K, which is sparse, and its product with so many shapes take."""
        # A lenslet reads its own points and two more on either side.
        entries = float(self.n_signals * (self.pupil.sampling + 4) ** 2)
        n_nodes = len(self.spots.nodes[0])
        spots = 16.0 * self.n_signals * n_nodes**2
        return Work(
            memory_bytes=24.0 * entries + 8.0 * spots + self.spots.memory_bytes,
            flop=2.0 * entries * n_shapes + 4.0 * n_nodes * spots,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Interpolation:
    """Interpolation from the pupil's grid to the nodes of every lenslet, along one axis."""

    first: NDArray[np.intp]
    """``(n,)`` first point of the grid that the nodes of each lenslet read."""

    weights: Array
    """``(n_nodes, n_read)``, cubic."""

    rate: Array
    """Derivative of the weights with respect to the image's shift."""


def interpolation(sensor: ShackHartmannSensor, shift: float) -> Interpolation:
    """Return how nodes read the grid along an axis along which the image is moved by ``shift``."""
    n, sampling = sensor.instrument.wfs.n_subapertures, sensor.pupil.sampling
    start = sensor.pupil.coordinates[0] - _MARGIN_POINTS / sampling
    # of the first lenslet, in points of the grid; the others lie whole numbers of points further
    places = (sensor.spots.nodes[0] + 0.5 - n / 2 - shift - start) * sampling
    first = int(np.floor((-n / 2 - shift - start) * sampling)) - 1
    cell = np.floor(places)
    part = (places - cell)[:, None]
    columns = (cell - first - 1).astype(np.intp)[:, None] + np.arange(4)
    cubic = [
        -part * (part - 1) * (part - 2) / 6,
        (part + 1) * (part - 1) * (part - 2) / 2,
        -(part + 1) * part * (part - 2) / 2,
        (part + 1) * part * (part - 1) / 6,
    ]
    cubic_rate = [
        -(3 * part**2 - 6 * part + 2) / 6,
        (3 * part**2 - 4 * part - 1) / 2,
        -(3 * part**2 - 2 * part - 2) / 2,
        (3 * part**2 - 1) / 6,
    ]
    weights, rate = np.zeros((2, len(places), sampling + 4))
    np.put_along_axis(weights, columns, np.hstack(cubic), axis=1)
    np.put_along_axis(rate, columns, -sampling * np.hstack(cubic_rate), axis=1)
    return Interpolation(first=first + sampling * np.arange(n), weights=weights, rate=rate)


def light_at_nodes(sensor: ShackHartmannSensor, shift: float) -> tuple[Any, Any]:
    """Return how the nodes of all lenslets read the light's grid along an axis, and its rate.

    ``(n n_nodes, n_grid)`` each, sparse: straight from point to point, dark beyond the grid.
    """
    n, grid = sensor.instrument.wfs.n_subapertures, sensor.light_grid
    centres = np.arange(n) - (n - 1) / 2 - shift
    places = (centres[:, None] + sensor.spots.nodes[0]).reshape(-1)
    distance = (places - grid.coordinates[0]) * grid.sampling
    cell = np.floor(distance)
    part, row = distance - cell, np.arange(len(places))
    values = np.concatenate([1 - part, part])
    rates = np.repeat([grid.sampling, -grid.sampling], len(places)).astype(np.float64)
    rows, columns = np.tile(row, 2), np.concatenate([cell, cell + 1]).astype(np.intp)
    known = (columns >= 0) & (columns < len(grid.coordinates))
    shape = (len(places), len(grid.coordinates))
    at = (rows[known], columns[known])
    return tuple(scipy.sparse.csr_matrix((each[known], at), shape) for each in (values, rates))


@dataclass(frozen=True, kw_only=True, eq=False)
class ShackHartmannResponse:
    """The Shack-Hartmann's ``Response``, the pupil's image at one place."""

    sensor: ShackHartmannSensor
    shift: tuple[float, float]

    @cached_property
    def _read(self) -> tuple[Interpolation, Interpolation]:
        """Along x, and along y."""
        return interpolation(self.sensor, self.shift[0]), interpolation(self.sensor, self.shift[1])

    @cached_property
    def light(self) -> NDArray[np.float64]:
        """``(n, m, n, m)`` light on the pixels: row of lenslets, row of theirs, and so along x.

        Of a full lenslet, wings beyond its field counted, it is 1.
        """
        instrument, n = self.sensor.instrument, len(self.sensor.valid)
        # Light is asked for on all pixels, those of invalid subapertures included.
        every = np.ones((n, n), np.bool_)
        spots = spots_of(shack_hartmann_in(instrument), instrument.subaperture_m, every)
        light = spots.images(self._amplitudes[0].reshape(n * n, *self._amplitudes[0].shape[2:]))
        return light.reshape(n, n, *light.shape[1:]).swapaxes(1, 2)

    def lit(self, light: NDArray[np.float64]) -> ShackHartmannResponse:
        """Return the response itself: a centroid does not depend on the light of its spot."""
        return self

    def apply(self, shapes: Shapes) -> Array:
        """Return the signals ``(n_signals, n_shapes)`` of wavefronts, metres."""
        return np.asarray(self._matrix @ shapes)

    def with_shift_rates(self, shapes: Shapes) -> tuple[Array, Array, Array]:
        """Return the signals, and their change when the image moves along x, and along y."""
        along_x, along_y = self._rates
        return self.apply(shapes), np.asarray(along_x @ shapes), np.asarray(along_y @ shapes)

    def jacobian(self) -> Array:
        """Return K whole, ``(n_signals, n_points)`` per metre."""
        return np.asarray(self._matrix.toarray(), np.float32)

    @cached_property
    def _matrix(self) -> Any:  # noqa: ANN401 - scipy has no types
        pulls, light, _ = self._pulls
        on_x, on_y = (axis.weights for axis in self._read)
        return self._sparse([on_y.T @ (pull / light) @ on_x for pull in pulls])

    @cached_property
    def _rates(self) -> tuple[Any, Any]:
        """Return the rates of the matrix by both shifts."""
        spots = self.sensor.spots
        pulls, light, (amplitude, *moved) = self._pulls
        (on_x, rate_x), (on_y, rate_y) = ((axis.weights, axis.rate) for axis in self._read)
        rates = []
        for change, of_y, of_x in ((moved[0], on_y, rate_x), (moved[1], rate_y, on_x)):
            # Twice, because the light is the square of the amplitude.
            dimmer = 2.0 * spots.light(amplitude, change)[:, None, None] / light
            # Below the limit the divisor is constant and does not change with the shift.
            dimmer[spots.light(amplitude, amplitude) < light[:, 0, 0]] = 0.0
            parts = zip(
                pulls,
                spots.pull(change, amplitude),
                spots.pull(amplitude, change),
                strict=True,
            )
            rates.append(
                self._sparse(
                    [
                        on_y.T @ ((outer + inner - pull * dimmer) / light) @ on_x
                        + of_y.T @ (pull / light) @ of_x
                        for pull, outer, inner in parts
                    ]
                )
            )
        return rates[0], rates[1]

    @cached_property
    def _pulls(self) -> tuple[tuple[Array, Array], Array, tuple[Array, Array, Array]]:
        """Return pulls along x and y, the light that counts, amplitudes and their rates."""
        # Rates are those of the light's grid, so that the derivative by the shift is exact.
        spots = self.sensor.spots
        amplitude, *rates = (each[self.sensor.valid] for each in self._amplitudes)
        full = np.ones((1, *amplitude.shape[1:]))
        light = np.maximum(spots.light(amplitude, amplitude), _DARK_SHARE * spots.light(full, full))
        light = light[:, None, None]
        return spots.pull(amplitude, amplitude), light, (amplitude, rates[0], rates[1])

    @cached_property
    def _amplitudes(self) -> tuple[Array, Array, Array]:
        """Return amplitudes ``(n, n, n_nodes, n_nodes)`` at nodes, their rates along x and y."""
        sensor, n = self.sensor, len(self.sensor.valid)
        (on_x, rate_x), (on_y, rate_y) = (light_at_nodes(sensor, shift) for shift in self.shift)

        def sample(of_y: Any, of_x: Any) -> Array:  # noqa: ANN401 - scipy has no types
            along = of_y @ sensor.light_grid.amplitude @ of_x.T
            return np.asarray(along).reshape(n, len(along) // n, n, -1).swapaxes(1, 2)

        return sample(on_y, on_x), sample(on_y, rate_x), sample(rate_y, on_x)

    def _window(self, y: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return rows and columns of the grid that lenslets read, and which exist."""
        side, read = self.sensor.side, np.arange(self.sensor.pupil.sampling + 4)
        along_x, along_y = (axis.first for axis in self._read)
        rows = (along_y[y][:, None] + read)[:, :, None]
        columns = (along_x[x][:, None] + read)[:, None, :]
        inside = (rows >= 0) & (rows < side) & (columns >= 0) & (columns < side)
        return np.clip(rows, 0, side - 1), np.clip(columns, 0, side - 1), inside

    def _sparse(self, planes: list[Array]) -> Any:  # noqa: ANN401 - scipy has no types
        """Return weights ``(n_valid, n_read, n_read)`` of Sx and Sy per metre of lit points."""
        sensor = self.sensor
        y, x = np.nonzero(sensor.valid)
        rows, columns, inside = self._window(y, x)
        # Points outside the grid have weight 0, whatever index they get.
        places = np.where(inside, rows * sensor.side + columns, 0)
        values = np.concatenate([np.where(inside, plane, 0.0) for plane in planes])
        values *= 2 * np.pi / sensor.instrument.wfs.wavelength_m
        n_read = values[0].size
        matrix = scipy.sparse.csr_matrix(
            (
                values.reshape(-1),
                np.tile(places.reshape(-1), len(planes)),
                n_read * np.arange(len(values) + 1),
            ),
            shape=(len(values), sensor.side**2),
        )
        return (matrix @ sensor.extend_wavefronts).astype(sensor.dtype)
