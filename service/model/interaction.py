"""The interaction matrix D(α) = K(shift) Φ(rotation, magnification), and its derivatives.

Rows stand in the order and signs of conventions.md, or as one RTC lists its slopes: what travels to
and from the RTC (telemetry, measured matrices, reconstructors) stays as it is, and only the model
speaks two languages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray
from typing_extensions import override

from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import Basis
from service.model.pupil import Illumination, instrument_pupil
from service.model.sensors.kind import WorkingPoint
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness, Mapper, Response, Sensor, by_rows
from service.model.slopes import rtc_mask, to_rtc

Array = NDArray[Any]
Value = TypeVar("Value")

UNKNOWN_REACH_SUBAP = 1.0
"""Slopes this near to surface that a table does not know are left out of comparisons."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """D and its four derivatives at one registration: D(α) nearby costs one sum."""

    alpha: Misregistration
    """Where it was taken."""

    matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` slope per metre OPD."""

    derivatives: NDArray[np.float32]
    """``(4, n_slopes, n_modes)`` per subaperture, subaperture, radian, unit of magnification."""

    def matrix_at(self, alpha: Misregistration) -> NDArray[np.float32]:
        """Return D at a registration close by, to first order, ``(n_slopes, n_modes)``."""
        return self.matrix_by(alpha.vector - self.alpha.vector)

    def matrix_by(self, step: Array) -> NDArray[np.float32]:
        """Return D a short ``step`` ``(4,)`` away, numeric units, ``(n_slopes, n_modes)``."""
        moved = np.tensordot(step.astype(np.float32), self.derivatives, axes=1)
        moved += self.matrix
        return np.asarray(moved)


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
    ) -> None:
        self.instrument = instrument
        self.basis = basis
        pupil = instrument_pupil(instrument, pupil_sampling)
        self.pupil = pupil if illumination is None else pupil.lit_by(illumination)
        fineness = Fineness(n_nodes=detector_nodes, dtype=dtype, mapper=mapper)
        kind = kind_of(instrument)
        self.sensor: Sensor = kind.sensor(instrument, self.pupil, fineness, working_point)
        self._map = mapper
        self._dtype = dtype
        self._response: _Last[Response] = _Last()
        self._modes: _Last[Array] = _Last()

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
        Heritier et al. 2018, equation 6: D = M_WFS M_DM.
        """
        return self.seen(alpha, self._rendered(alpha))

    def derivatives(self, alpha: Misregistration) -> Array:
        """Return dD/dα ``(4, n_slopes, n_modes)``: per subaperture, radian, magnification."""
        return np.stack([*self._shift_derivatives(alpha), *self._shape_derivatives(alpha)])

    def stretch_derivatives(self, alpha: Misregistration) -> Array:
        """Return how D changes with an anamorphosis of the mirror's image, ``(2, ...)``.

        Per unit of stretch along x, and as much shrinking along y; the second along 45 deg and
        135 deg. The size stays, so that neither is a magnification.
        """
        points = self._mirror_points(alpha)
        turn = rotation(alpha.rotation_rad)
        on_sensor = points @ turn.T
        directions = (on_sensor * [-1.0, 1.0] @ turn, -on_sensor[:, ::-1] @ turn)
        return np.stack([self.seen(alpha, self._moved(points, way)) for way in directions])

    def width_derivative(self, alpha: Misregistration) -> Array:
        """Return how D changes with the logarithm of the influence functions' width.

        ``(n_slopes, n_modes)``; the strokes of the actuators stay.
        """
        shapes = self._by_rows(self.basis.render_wider, self._mirror_points(alpha))
        return self.seen(alpha, shapes.astype(self._dtype))

    def linearise(self, alpha: Misregistration) -> Linearisation:
        """Return D(α) and its derivatives together."""
        return Linearisation(
            alpha=alpha,
            matrix=self.interaction_matrix(alpha).astype(np.float32),
            derivatives=self.derivatives(alpha).astype(np.float32),
        )

    def seen(self, alpha: Misregistration, shapes: Array) -> Array:
        """Return the signals ``(n_slopes, n_shapes)`` of shapes ``(n_points, n_shapes)``, metres.

        In the axes of conventions.md, at the points of ``pupil``.
        """
        return self._at(self._image_shift(alpha)).apply(shapes)

    def unknown_rows(self, alpha: Misregistration) -> NDArray[np.bool_]:
        """Return which slopes lie within one subaperture of unknown surface, ``(n_slopes,)``.

        What a table of modes does not know cannot be compared with a measurement. Surface that no
        light falls on does not count.
        """
        unknown = ~self.basis.known(self._mirror_points(alpha))
        if not unknown.any():
            return np.zeros(self.n_slopes, dtype=np.bool_)
        y, x = np.nonzero(self.valid)
        centre = (len(self.valid) - 1) / 2
        seen = np.column_stack([x, y]) - centre - self._image_shift(alpha)
        distance, _ = scipy.spatial.cKDTree(self.pupil.points[unknown]).query(seen, p=np.inf)
        return np.tile(distance <= 0.5 + UNKNOWN_REACH_SUBAP, self.n_slopes // len(x))

    def _at(self, shift: tuple[float, float]) -> Response:
        """Return the sensor's response with the image at ``shift``; derivatives use it again."""
        return self._response.get(shift, lambda: self.sensor.at(shift))

    def _image_shift(self, alpha: Misregistration) -> tuple[float, float]:
        """Shift of the pupil images: with the telescope as stop they stay where they are."""
        if self.instrument.stop is Stop.TELESCOPE:
            return (0.0, 0.0)
        return (alpha.shift_x_subap, alpha.shift_y_subap)

    def _mirror_points(self, alpha: Misregistration) -> NDArray[np.float64]:
        """Return where each lit pupil point lies on the mirror, ``(n_points, 2)``."""
        points = self.pupil.points
        if self.instrument.stop is Stop.TELESCOPE:
            points = points - alpha.vector[:2]
        return points @ rotation(alpha.rotation_rad) / alpha.magnification

    def _rendered(self, alpha: Misregistration) -> Array:
        points = self._mirror_points(alpha)
        shift = self._image_shift(alpha)
        moved = alpha.vector - np.array([*shift, 0.0, 0.0])
        return self._modes.get(
            tuple(moved), lambda: self._by_rows(self.basis.render, points).astype(self._dtype)
        )

    def _shape_derivatives(self, alpha: Misregistration) -> tuple[Array, Array]:
        points = self._mirror_points(alpha)
        turned = np.column_stack([points[:, 1], -points[:, 0]])
        return (
            self.seen(alpha, self._moved(points, turned)),
            self.seen(alpha, self._moved(points, -points / alpha.magnification)),
        )

    def _shift_derivatives(self, alpha: Misregistration) -> tuple[Array, Array]:
        if self.instrument.stop is Stop.TELESCOPE:
            points = self._mirror_points(alpha)
            steps = -rotation(alpha.rotation_rad) / alpha.magnification
            along_x, along_y = (np.broadcast_to(step, points.shape) for step in steps)
            return (
                self.seen(alpha, self._moved(points, along_x)),
                self.seen(alpha, self._moved(points, along_y)),
            )
        return self._at(self._image_shift(alpha)).shift_rates(self._rendered(alpha))

    def _moved(self, points: NDArray[np.float64], direction: NDArray[np.float64]) -> Array:
        both = np.hstack([points, direction])
        moved = self._by_rows(lambda p: self.basis.render_slope(p[:, :2], p[:, 2:]), both)
        return moved.astype(self._dtype)

    def _by_rows(self, function: Callable[[Array], Array], rows: Array) -> Array:
        return by_rows(self._map, function, rows)


@dataclass(slots=True)
class _Last(Generic[Value]):
    """The last value computed, by its key."""

    key: tuple[float, ...] = ()
    value: Value | None = None

    def get(self, key: tuple[float, ...], compute: Callable[[], Value]) -> Value:
        if self.value is None or key != self.key:
            self.key, self.value = key, compute()
        return self.value


class RtcInteractionModel(InteractionModel):
    """Interaction matrices whose rows stand as the RTC lists its slopes.

    What travels to and from the RTC (telemetry, measured matrices, reconstructors) stays as it is;
    only the model speaks two languages.
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
        """``(n_modes,)`` slopes per unit of command over the drawing's; None: as drawn."""

    @override
    def interaction_matrix(self, alpha: Misregistration) -> Array:
        """Return D(α), ``(n_slopes, n_modes)``, as the RTC lists slopes and its modes answer."""
        return self._answered(self._listed(super().interaction_matrix(alpha)))

    @override
    def derivatives(self, alpha: Misregistration) -> Array:
        """Return dD/dα ``(4, n_slopes, n_modes)``, as the RTC lists and its modes answer."""
        every = np.stack([self._listed(matrix) for matrix in super().derivatives(alpha)])
        return self._answered(every)

    @override
    def unknown_rows(self, alpha: Misregistration) -> NDArray[np.bool_]:
        """Return which of the RTC's slopes lie near unknown surface, ``(n_slopes,)``."""
        marks = self._listed(super().unknown_rows(alpha).astype(np.float32))
        return np.asarray(marks != 0.0)

    def _answered(self, columns: Array) -> Array:
        if self._mode_response is None:
            return columns
        return np.asarray(columns * self._mode_response.astype(columns.dtype))

    def _listed(self, rows: Array) -> Array:
        recipe = self.instrument.slopes
        mask = rtc_mask(self.valid, recipe.assumed_orientation)
        return to_rtc(rows, recipe, mask)
