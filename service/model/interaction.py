"""The interaction matrix D(α) = K(shift) Φ(rotation, magnification), and its derivatives.

Rows are in the order and signs of conventions.md, or in those of one RTC. Data exchanged with the
RTC (telemetry, measured matrices, reconstructors) is never reordered; only the model converts
between the two.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Generic, Self, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray
from typing_extensions import override

from service.model.arrays import NUMPY, Arrays
from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.local import LocalShapes, MadeElsewhere, Patch, Shapes, stack_shapes, tiles_of
from service.model.misregistration import Misregistration, rotation, stretch_matrix
from service.model.modes import Basis, LocalBasis, local_of
from service.model.pupil import Illumination, instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import (
    KEPT_BYTES,
    Fineness,
    Mapper,
    Response,
    Sensor,
    SeveralImages,
    WorkingPoint,
    by_rows,
)
from service.model.slopes import rtc_mask, to_rtc

Array = NDArray[Any]
Value = TypeVar("Value")

Way = Callable[[Array], Array]
"""From points of the mirror ``(n_points, 2)`` to the direction in which each of them moves."""

LARGEST_STRETCH = 0.2
"""Beyond a fifth the image is another one."""

_AXES = 2

_MAX_DENSE_PRODUCT = 5e5
"""Points times functions of actuators up to which all are evaluated at once: tile by tile, what is
done for each tile takes longer."""

_POINTS_TOGETHER = 2048
"""Pupil points whose modes are evaluated at once: with fewer, tiles of thin plates would be split.
"""

UNKNOWN_REACH_SUBAP = 1.0
"""Slopes this near to surface that a table does not know are left out of comparisons."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """D and its four derivatives at one registration: D(α) nearby costs one sum."""

    alpha: Misregistration
    """Registration at which the derivatives were computed."""

    matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` slope per metre OPD."""

    derivatives: NDArray[np.float32]
    """``(4, n_slopes, n_modes)`` per subaperture, subaperture, radian, unit of magnification."""

    noise_shape: NDArray[np.float64] | None = None
    """``(n_slopes,)`` σ of each slope over their RMS; None: all alike."""

    stretches: NDArray[np.float32] | None = None
    """``(2, n_slopes, n_modes)`` per unit of each anamorphosis; None: it is not followed."""

    @property
    def rates(self) -> NDArray[np.float32]:
        """The derivatives, ``(4 or 6, n_slopes, n_modes)``: of the anamorphosis where followed."""
        if self.stretches is None:
            return self.derivatives
        return np.concatenate([self.derivatives, self.stretches])

    def of_modes(self, modes: NDArray[np.intp]) -> Linearisation:
        """Return the same of some modes ``(n,)`` alone."""
        stretches = None if self.stretches is None else self.stretches[:, :, modes]
        return replace(
            self,
            matrix=self.matrix[:, modes],
            derivatives=self.derivatives[:, :, modes],
            stretches=stretches,
        )

    def matrix_at(self, alpha: Misregistration) -> NDArray[np.float32]:
        """Return D at a registration close by, to first order, ``(n_slopes, n_modes)``."""
        step = alpha.vector - self.alpha.vector
        if self.stretches is not None:
            step = np.concatenate([step, alpha.stretches - self.alpha.stretches])
        return self.matrix_by(step)

    def matrix_by(self, step: Array) -> NDArray[np.float32]:
        """Return D a short ``step`` ``(4,)`` or ``(6,)`` away, ``(n_slopes, n_modes)``."""
        moved = np.tensordot(step[:4].astype(np.float32), self.derivatives, axes=1)
        if self.stretches is not None and len(step) > 4:
            moved += np.tensordot(step[4:].astype(np.float32), self.stretches, axes=1)
        # Into the new array: D of a large telescope takes gigabytes.
        moved += self.matrix
        return np.asarray(moved)

    def add_step(self, step: Array) -> Misregistration:
        """Return the registration one ``step`` ``(4,)`` or ``(6,)`` from ``alpha``.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the step leads to a singular stretch: the fit did not determine it.
        """
        moved = self.alpha.add_step(step[:4])
        if len(step) == 4:
            return moved
        stretches = self.alpha.stretches + step[4:]
        if np.any(np.abs(stretches) > LARGEST_STRETCH):
            raise np.linalg.LinAlgError(f"an anamorphosis of {np.abs(stretches).max():.2g}")
        return moved.with_anamorphosis(stretches)


class InteractionModel:
    """Noise-free interaction matrices of one instrument at any registration.

    Keeps what does not depend on α, and the sensor's last response and the last rendered modes, so
    that a new rotation costs no optics and a new shift no rendering.
    """

    def __init__(
        self,
        instrument: Instrument,
        basis: Basis,
        *,
        pupil_sampling: int = 3,
        detector_nodes: int = 3,
        working_point: WorkingPoint | None = None,
        illumination: Illumination | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        mapper: Mapper = map,
        kept_bytes: float = KEPT_BYTES,
        anamorphosis: bool = False,
        arrays: Arrays = NUMPY,
    ) -> None:
        self.instrument = instrument
        self._anamorphosis = anamorphosis
        self._again = partial(
            InteractionModel,
            instrument,
            pupil_sampling=pupil_sampling,
            detector_nodes=detector_nodes,
            working_point=working_point,
            illumination=illumination,
            dtype=dtype,
            kept_bytes=kept_bytes,
            arrays=arrays,
        )
        binning = instrument.binning  # of the finest subapertures, so fine are points and nodes
        pupil = instrument_pupil(instrument, pupil_sampling * binning)
        self.pupil = pupil if illumination is None else pupil.lit_by(illumination)
        fineness = Fineness(
            n_nodes=detector_nodes * binning,
            dtype=dtype,
            mapper=mapper,
            kept_bytes=kept_bytes,
            arrays=arrays,
        )
        kind = kind_of(instrument)
        self.sensor: Sensor = kind.sensor(instrument, self.pupil, fineness, working_point)
        self._map = mapper
        self._dtype = dtype
        self._response: _Last[Response] = _Last()
        self._take_up(basis)

    def of_modes(self, basis: Basis) -> Self:
        """Return a model of other modes that shares all optics, and the last response."""
        other = copy.copy(self)
        other._take_up(basis)  # noqa: SLF001 - its own kind
        return other

    def _take_up(self, basis: Basis) -> None:
        self.basis = basis
        self._modes: _Last[Shapes] = _Last()
        local = local_of(basis)
        by_tiles = (
            local is not None
            and len(self.pupil.points) * len(local.coefficients) > _MAX_DENSE_PRODUCT
        )
        self._tiles = tiles_of(self.pupil) if by_tiles else ()
        self._local: LocalBasis | None = local if by_tiles else None

    def share_modes(self, other: InteractionModel) -> None:
        """Take over the modes that another model has rendered, if both have the same points.

        A model of another sensor behind the same pupil needs no rendering then.
        """
        if self.basis is other.basis and np.array_equal(self.pupil.points, other.pupil.points):
            self._modes = other._modes

    def forget(self) -> None:
        """Give back the memory of the last response and the last rendered modes."""
        self._response, self._modes = _Last(), _Last()

    @property
    def valid(self) -> NDArray[np.bool_]:
        """``(n, n)`` [y, x] subapertures that give signals."""
        return self.sensor.valid

    @property
    def n_slopes(self) -> int:
        """Signals of a frame."""
        return self.sensor.n_signals

    def interaction_matrix(self, alpha: Misregistration) -> Array:
        """Return D(α), ``(n_slopes, n_modes)``, slope per metre of OPD.

        References
        ----------
        Heritier et al. 2018, equation 1: D = M_WFS M_DM.
        """
        return self._as_listed(self.measure_signals(alpha, self._render_modes(alpha)))

    def derivatives(
        self,
        alpha: Misregistration,
        of_images: Array | None = None,
        *,
        with_stretches: bool = False,
    ) -> Array:
        """Return dD/dα ``(4, n_slopes, n_modes)``: per subaperture, radian, magnification.

        ``of_images`` are those by each pupil image if they are known, see ``image_derivatives``:
        with the mirror as stop a shift moves all images, so that their sums are its derivatives.
        ``with_stretches`` appends those of ``stretch_derivatives``, which cost less together.
        """
        more = self._stretch_ways(alpha) if with_stretches else []
        if self.instrument.stop is Stop.TELESCOPE:
            rates = self._measure_shapes(alpha, self._rates_of_modes(alpha, more))
        elif of_images is not None and len(of_images):
            rates = self._measure_shapes(alpha, self._rates_of_modes(alpha, more))
            by_axis = of_images.reshape(_AXES, -1, *of_images.shape[1:]).sum(axis=1)
            return np.stack([*by_axis, *(self._as_listed(rate) for rate in rates)])
        else:
            _, *rates = self._with_rates(alpha, more)
        return self._all_listed(rates)

    def mirror_shift_derivatives(self, alpha: Misregistration) -> Array:
        """Return how D changes with a shift of the mirror, the pupil unmoved, ``(2, ...)``."""
        moved = [self._move_modes(alpha, way) for way in self._shift_ways(alpha)]
        return self._all_listed(self._measure_shapes(alpha, moved))

    def stretch_derivatives(self, alpha: Misregistration) -> Array:
        """Return how D changes with an anamorphosis of the mirror's image, ``(2, ...)``.

        Per unit of stretch along x, and as much shrinking along y; the second along 45 deg and
        135 deg.
        """
        moved = [self._move_modes(alpha, way) for way in self._stretch_ways(alpha)]
        return self._all_listed(self._measure_shapes(alpha, moved))

    def image_derivatives(self, alpha: Misregistration) -> Array:
        """Return how D changes when one of the sensor's pupil images alone moves on its pixels.

        ``(8, n_slopes, n_modes)`` per subaperture: the images at -x -y, +x -y, -x +y, +x +y along
        x, then along y. The mirror moves with its image. Empty for a sensor with one image.
        """
        # A sensor with one image has no images to be displaced against each other.
        response = self._at(self._image_shift(alpha))
        if not isinstance(response, SeveralImages):
            return np.empty((0, self.n_slopes, self.basis.n_modes))
        return self._all_listed(response.image_rates(self._render_modes(alpha)))

    def width_derivative(self, alpha: Misregistration) -> Array:
        """Return how D changes with the logarithm of the influence functions' width.

        ``(n_slopes, n_modes)``; the strokes of the actuators stay.
        """
        shapes = self._by_rows(self.basis.render_wider, self._mirror_points(alpha))
        return self.measure_signals(alpha, shapes)

    def linearise(self, alpha: Misregistration) -> Linearisation:
        """Return D(α) and its derivatives together, by an anamorphosis where it is followed."""
        alpha = self.instrument.with_anamorphosis(alpha)
        matrix, *rates = self._with_rates(alpha)
        return Linearisation(
            alpha=alpha,
            stretches=self.stretch_derivatives(alpha).astype(np.float32, copy=False)
            if self._anamorphosis
            else None,
            matrix=np.ascontiguousarray(self._as_listed(matrix), np.float32),
            derivatives=self._all_listed(rates).astype(np.float32, copy=False),
            noise_shape=self.noise_shape,
        )

    @cached_property
    def noise_shape(self) -> NDArray[np.float64] | None:
        """``(n_slopes,)`` σ of each slope over their RMS, of the same light; None: all alike."""
        shape = kind_of(self.instrument).noise_shape(self.instrument)
        # abs, because the RTC's order of slopes may turn signs, and a σ has none.
        return None if shape is None else np.abs(self._sort_rows(shape))

    def slope_noise(self, noise: float) -> NDArray[np.float64]:
        """Return σ of every signal ``(n_slopes,)`` where that of a slope is ``noise``, RMS."""
        shape = np.ones(self.n_slopes) if self.noise_shape is None else self.noise_shape
        return noise * self.instrument.slopes.kind.noise * shape

    def measure_signals(self, alpha: Misregistration, shapes: Shapes) -> Array:
        """Return the signals ``(n_slopes, n_shapes)`` of shapes ``(n_points, n_shapes)``, metres.

        In the axes of conventions.md, at the points of ``pupil``.
        """
        return self._at(self._image_shift(alpha)).apply(shapes)

    def render_modes(self, alpha: Misregistration) -> Array:
        """Return the modes where α puts them, ``(n_points, n_modes)`` at the points of ``pupil``.

        OPD per unit command.
        """
        return np.asarray(self.basis.render(self._mirror_points(alpha)))

    def unknown_rows(self, alpha: Misregistration) -> NDArray[np.bool_]:
        """Return which slopes are within one subaperture of unknown surface, ``(n_slopes,)``.

        Surface outside a table of modes cannot be compared with a measurement. Surface that is not
        illuminated does not count.
        """
        unknown = ~self.basis.known(self._mirror_points(alpha))
        if not unknown.any():
            return np.zeros(self.n_slopes, dtype=np.bool_)
        y, x = np.nonzero(self.valid)
        centre = (len(self.valid) - 1) / 2
        seen = np.column_stack([x, y]) - centre - self._image_shift(alpha)
        distance, _ = scipy.spatial.cKDTree(self.pupil.points[unknown]).query(seen, p=np.inf)
        # Half a subaperture from its centre to its edge; p = inf, because subapertures are square.
        marks = np.tile(distance <= 0.5 + UNKNOWN_REACH_SUBAP, self.n_slopes // len(x))
        # As numbers, because an RTC's signs are multiplied into the rows.
        return np.asarray(self._sort_rows(marks.astype(np.float32)) != 0.0)

    def _at(self, shift: tuple[float, float]) -> Response:
        """Return the sensor's response with the image at ``shift``; derivatives use it again."""
        return self._response.get(shift, lambda: self.sensor.at(shift))

    def _image_shift(self, alpha: Misregistration) -> tuple[float, float]:
        """Shift of the pupil images: with the telescope as stop they stay where they are."""
        if self.instrument.stop is Stop.TELESCOPE:
            offset = kind_of(self.instrument).pupil_offset(self.instrument)
            return self.instrument.pupil_shift_subap or offset or (0.0, 0.0)
        return (alpha.shift_x_subap, alpha.shift_y_subap)

    def _mirror_points(self, alpha: Misregistration) -> NDArray[np.float64]:
        """Return the position of each lit pupil point on the mirror, ``(n_points, 2)``."""
        return self._on_mirror(alpha, self.pupil.points)

    def _on_mirror(
        self, alpha: Misregistration, points: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the positions of pupil points on the mirror, ``(n_points, 2)``."""
        # Zero with the mirror as stop, whose image carries the pupil's points along; minus the
        # shift with a fixed pupil.
        displacement = np.array(self._image_shift(alpha)) - alpha.vector[:2]
        return self.instrument.with_anamorphosis(alpha).on_mirror(points + displacement)

    def _render_modes(self, alpha: Misregistration) -> Shapes:
        shift = self._image_shift(alpha)
        # A shift that the pupil's images follow is not in the key: it does not move the mirror over
        # the pupil.
        moved = alpha.vector - np.array([*shift, 0.0, 0.0])
        stretches = self.instrument.with_anamorphosis(alpha).stretches
        return self._modes.get((*moved, *stretches), lambda: self._move_modes(alpha, None))

    def _sort_rows(self, rows: Array) -> Array:
        """Return rows ``(n_slopes, ...)`` in the order and signs that this model's caller uses."""
        return rows

    def _as_listed(self, matrix: Array) -> Array:
        """Return a matrix in that order, its columns as the modes answer."""
        return self._sort_rows(matrix)

    def _all_listed(self, matrices: Iterable[Array]) -> Array:
        """Return several matrices so, in one array."""
        return np.stack([self._as_listed(matrix) for matrix in matrices])

    def _with_rates(self, alpha: Misregistration, more: Sequence[Way] = ()) -> list[Array]:
        """Return D and its four derivatives, then those along ``more`` ways of the mirror."""
        rendered, rates = self._render_modes(alpha), self._rates_of_modes(alpha, more)
        if self.instrument.stop is Stop.TELESCOPE:
            return self._measure_shapes(alpha, [rendered, *rates])
        turned = self._measure_shapes(alpha, rates)
        return [*self._at(self._image_shift(alpha)).with_shift_rates(rendered), *turned]

    def _rates_of_modes(self, alpha: Misregistration, more: Sequence[Way] = ()) -> list[Shapes]:
        """Return how the modes change at the pupil's points with each parameter that moves them.

        With the mirror as stop a shift does not: it moves the pupil's images. The changes along
        ``more`` ways are appended.
        """
        ways: list[Way] = [_rotation_rate, partial(_scale_rate, magnification=alpha.magnification)]
        if self.instrument.stop is Stop.TELESCOPE:
            ways[:0] = self._shift_ways(alpha)
        ways += more
        # With more ways than axes the gradient along both axes is cheaper than a rendering for each
        # way.
        if len(ways) > _AXES:
            return self._along(alpha, ways)
        return [self._move_modes(alpha, way) for way in ways]

    def _shift_ways(self, alpha: Misregistration) -> list[Way]:
        """Return the ways of the mirror's points with shifts of the mirror along x and along y."""
        # Minus: when the mirror's image moves by +x, a fixed point of the pupil sees the mirror at
        # -x.
        steps = -self.instrument.with_anamorphosis(alpha).on_mirror(np.eye(_AXES))
        return [partial(_shift_rate, step=step) for step in steps]

    def _stretch_ways(self, alpha: Misregistration) -> list[Way]:
        """Return the ways of the mirror's points with each anamorphosis of its image."""
        # The stretch acts last on the way to the sensor, so first on the way back: S⁻¹ is
        # differentiated.
        turn = rotation(alpha.rotation_rad)
        stretches = self.instrument.with_anamorphosis(alpha).stretches
        back = np.linalg.inv(stretch_matrix(stretches)) @ turn
        along, askew = -turn.T * [1.0, -1.0] @ back, -turn.T[:, ::-1] @ back
        return [partial(_stretch_rate, by=by) for by in (along, askew)]

    def _along(self, alpha: Misregistration, ways: list[Way]) -> list[Shapes]:
        """Return the rates of the modes along several ways, from their gradient."""
        # Two renderings give the gradient, of which every way is a combination point by point.
        along_x, along_y = self._gradient(alpha)
        if isinstance(along_x, LocalShapes) and isinstance(along_y, LocalShapes) and self._local:
            return [self._by_tiles(self._local, alpha, way, (along_x, along_y)) for way in ways]
        points = self._mirror_points(alpha)
        found: list[Shapes] = []
        for way in ways:
            x, y = way(points).astype(self._dtype).T
            found.append(along_x * x[:, None] + along_y * y[:, None])
        return found

    def _gradient(self, alpha: Misregistration) -> tuple[Shapes, Shapes]:
        """Return the rates of the modes along both axes of the mirror."""
        along_x, along_y = (
            self._move_modes(alpha, partial(_shift_rate, step=step)) for step in np.eye(_AXES)
        )
        return along_x, along_y

    def _measure_shapes(self, alpha: Misregistration, shapes: list[Shapes]) -> list[Array]:
        """Return the signals of each of some shapes, with one response for all if none is kept."""
        # The tiles of a kept one are read once for all local shapes.
        if self.sensor.keeps_gradient and not isinstance(shapes[0], LocalShapes):
            return [self.measure_signals(alpha, one) for one in shapes]
        return np.split(self.measure_signals(alpha, stack_shapes(shapes)), len(shapes), axis=1)

    def _move_modes(self, alpha: Misregistration, way: Way | None) -> Shapes:
        """Return the modes where α puts them or, with a way, their rates along it."""
        if self._local is not None:
            return self._by_tiles(self._local, alpha, way)
        points = self._mirror_points(alpha)
        if way is None:
            return self._by_rows(self.basis.render, points)
        both = np.hstack([points, way(points)])
        return self._by_rows(lambda p: self.basis.render_slope(p[:, :2], p[:, 2:]), both)

    def _by_tiles(
        self,
        basis: LocalBasis,
        alpha: Misregistration,
        way: Way | None,
        gradient: tuple[LocalShapes, LocalShapes] | None = None,
    ) -> Shapes:
        """Return local modes, or their rates along a way, of their ``gradient`` if it is known."""
        kept = basis.in_single if self._dtype is np.float32 else basis

        def patch(number: int) -> Patch:
            tile = self._tiles[number]
            at = self._on_mirror(alpha, tile.points)
            if way is not None and gradient is not None:
                x, y = way(at).astype(self._dtype).T
                along_x, along_y = (rates.patches[number] for rates in gradient)
                weights = along_x.weights * x[:, None] + along_y.weights * y[:, None]
                return replace(along_x, weights=weights)
            functions, weights = basis.patch(at, None if way is None else way(at))
            return Patch(tile=tile, functions=functions, weights=weights.astype(self._dtype))

        shapes = LocalShapes(
            patches=tuple(self._map(patch, range(len(self._tiles)))),
            n_points=int(self.pupil.lit.sum()),
            n_functions=len(basis.coefficients),
            combination=kept.coefficients,
            elsewhere=MadeElsewhere(
                parts=(self._again, kept),
                prepare=operator.call,
                make=partial(_moved_modes, alpha=alpha, way=way, combined=gradient is not None),
            ),
        )
        return shapes if shapes.is_cheaper else shapes.array()

    def _by_rows(self, render: Callable[[Array], Array], points: Array) -> Array:
        """Return what a basis makes of points, in the precision of products."""
        return by_rows(
            self._map,
            lambda some: render(some).astype(self._dtype, copy=False),
            points,
            _POINTS_TOGETHER,
        )


def _moved_modes(
    model: InteractionModel, *, alpha: Misregistration, way: Way | None, combined: bool
) -> Shapes:
    """Return the shapes that the model of another process has made, equal to the bit."""
    if combined and way is not None:
        return model._along(alpha, [way])[0]  # noqa: SLF001 - its own, in another process
    return model._move_modes(alpha, way)  # noqa: SLF001


def _rotation_rate(at: Array) -> Array:
    return at[:, ::-1] * [1.0, -1.0]


def _scale_rate(at: Array, *, magnification: float) -> Array:
    return -at / magnification


def _shift_rate(at: Array, *, step: Array) -> Array:
    return np.broadcast_to(step, at.shape)


def _stretch_rate(at: Array, *, by: Array) -> Array:
    return at @ by


@dataclass(slots=True)
class _Last(Generic[Value]):
    """The last value computed, by its key."""

    key: tuple[float, ...] = ()
    value: Value | None = None

    def get(self, key: tuple[float, ...], compute: Callable[[], Value]) -> Value:
        if self.value is None or key != self.key:
            self.value = None  # its memory is the next one's
            self.key, self.value = key, compute()
        return self.value


class RtcInteractionModel(InteractionModel):
    """Interaction matrices whose rows are in the RTC's order of slopes.

    Data exchanged with the RTC (telemetry, measured matrices, reconstructors) is never reordered;
    only the model converts.
    """

    def __init__(
        self,
        instrument: Instrument,
        basis: Basis,
        *,
        mode_response: Array | None = None,
        **settings: Any,  # noqa: ANN401 - those of every interaction model
    ) -> None:
        super().__init__(instrument, basis, **settings)
        self._mode_response = mode_response
        """Slopes per unit command relative to the nominal mode, ``(n_modes,)``; None if nominal."""

    @override
    def _as_listed(self, matrix: Array) -> Array:
        listed = self._sort_rows(matrix)
        if self._mode_response is None:
            return listed
        return np.asarray(listed * self._mode_response.astype(listed.dtype))

    @override
    def _sort_rows(self, rows: Array) -> Array:
        recipe = self.instrument.slopes
        mask = rtc_mask(self.valid, recipe.assumed_orientation)
        return to_rtc(rows, recipe, mask)
