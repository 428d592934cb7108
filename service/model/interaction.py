"""The interaction matrix D(α) = K(shift) Φ(rotation, magnification), and its derivatives.

Rows stand in the order and signs of conventions.md, or as one RTC lists its slopes: what travels to
and from the RTC (telemetry, measured matrices, reconstructors) stays as it is, and only the model
speaks two languages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray
from typing_extensions import override

from service.model.instrument import Instrument
from service.model.kinds import Normalisation, SignalKind, Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import Basis
from service.model.pupil import Illumination, annular_pupil, instrument_pupil
from service.model.pyramid import Mapper, Nodes, PyramidOptics, Response, enough_modulation_points
from service.model.slopes import PLAIN, SlopeRecipe, rtc_mask, to_rtc, turned_mask
from service.model.turbulence import Halo

Array = NDArray[Any]
Value = TypeVar("Value")

_ROW_CHUNK = 512
"""Rows of a product per task: large enough for BLAS, small enough to share between cores."""

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
        n_modulation: int | None = None,
        halo: Halo | None = None,
        illumination: Illumination | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        mapper: Mapper = map,
    ) -> None:
        self.instrument = instrument
        self.basis = basis
        pupil = instrument_pupil(instrument, pupil_sampling)
        self.pupil = pupil if illumination is None else pupil.lit_by(illumination)
        self.optics = PyramidOptics(
            wfs=instrument.wfs,
            pupil=self.pupil,
            n_nodes=detector_nodes,
            n_modulation=n_modulation or enough_modulation_points(instrument.wfs),
            dtype=dtype,
            halo=halo,
            recipe=instrument.slopes,
        )
        self.valid = valid_subapertures(instrument)
        self._map = mapper
        self._dtype = dtype
        self._response: _Last[Response] = _Last()
        self._modes: _Last[Array] = _Last()

    def forget(self) -> None:
        """Give back the memory of the last response and the last rendered modes."""
        self._response, self._modes = _Last(), _Last()

    @property
    def n_slopes(self) -> int:
        """Signals of a frame: two or four for each valid subaperture."""
        return self.optics.recipe.kind.n_planes * int(self.valid.sum())

    def interaction_matrix(self, alpha: Misregistration) -> Array:
        """Return D(α), ``(n_slopes, n_modes)``, slope per metre of OPD.

        References
        ----------
        Heritier et al. 2018, equation 6: D = M_WFS M_DM.
        """
        return self._seen(alpha, self._rendered(alpha))

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
        return np.stack([self._seen(alpha, self._moved(points, way)) for way in directions])

    def width_derivative(self, alpha: Misregistration) -> Array:
        """Return how D changes with the logarithm of the influence functions' width.

        ``(n_slopes, n_modes)``; the strokes of the actuators stay.
        """
        shapes = self._by_rows(self.basis.render_wider, self._mirror_points(alpha))
        return self._seen(alpha, shapes.astype(self._dtype))

    def linearise(self, alpha: Misregistration) -> Linearisation:
        """Return D(α) and its derivatives together."""
        return Linearisation(
            alpha=alpha,
            matrix=self.interaction_matrix(alpha).astype(np.float32),
            derivatives=self.derivatives(alpha).astype(np.float32),
        )

    def sensor_jacobian(self, alpha: Misregistration) -> Array:
        """Return K, slopes against pupil OPD, ``(n_slopes, n_points)``, slope per metre."""
        response = self._at_rest(self._image_shift(alpha))
        return self._per_metre(normalised_jacobian(response, self.valid))

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
        return np.tile(distance <= 0.5 + UNKNOWN_REACH_SUBAP, self.optics.recipe.kind.n_planes)

    def _at_rest(self, shift: tuple[float, float]) -> Response:
        """Return the sensor's response with the images at ``shift``; derivatives use it again."""
        return self._response.get(
            shift, lambda: self.optics.response(self.valid, shift, mapper=self._map)
        )

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

    def _seen(self, alpha: Misregistration, shapes: Array) -> Array:
        """Return the slopes ``(n_slopes, n_shapes)`` of shapes ``(n_points, n_shapes)``, metres."""
        response = self._at_rest(self._image_shift(alpha)).to(shapes, self._product)
        return self._per_metre(normalised_jacobian(response, self.valid))

    def _shape_derivatives(self, alpha: Misregistration) -> tuple[Array, Array]:
        points = self._mirror_points(alpha)
        turned = np.column_stack([points[:, 1], -points[:, 0]])
        return (
            self._seen(alpha, self._moved(points, turned)),
            self._seen(alpha, self._moved(points, -points / alpha.magnification)),
        )

    def _shift_derivatives(self, alpha: Misregistration) -> tuple[Array, Array]:
        if self.instrument.stop is Stop.TELESCOPE:
            points = self._mirror_points(alpha)
            steps = -rotation(alpha.rotation_rad) / alpha.magnification
            along_x, along_y = (np.broadcast_to(step, points.shape) for step in steps)
            return (
                self._seen(alpha, self._moved(points, along_x)),
                self._seen(alpha, self._moved(points, along_y)),
            )
        shift, modes = self._image_shift(alpha), self._rendered(alpha)
        at_rest = self._at_rest(shift).to(modes, self._product)
        along_x, along_y = (
            self._per_metre(
                normalised_derivative(
                    at_rest,
                    self.optics.response(self.valid, shift, mapper=self._map, **edges).to(
                        modes, self._product
                    ),
                    self.valid,
                )
            )
            for edges in ({"nodes_x": Nodes.edges()}, {"nodes_y": Nodes.edges()})
        )
        return along_x, along_y

    def _moved(self, points: NDArray[np.float64], direction: NDArray[np.float64]) -> Array:
        both = np.hstack([points, direction])
        moved = self._by_rows(lambda p: self.basis.render_slope(p[:, :2], p[:, 2:]), both)
        return moved.astype(self._dtype)

    def _per_metre(self, jacobian: Array) -> Array:
        jacobian *= np.asarray(2 * np.pi / self.instrument.wfs.wavelength_m, dtype=jacobian.dtype)
        return jacobian

    def _by_rows(self, function: Callable[[Array], Array], rows: Array) -> Array:
        starts = range(0, len(rows), _ROW_CHUNK)
        return np.concatenate(
            list(self._map(lambda start: function(rows[start : start + _ROW_CHUNK]), starts))
        )

    def _product(self, gradient: Array, shapes: Array) -> Array:
        if gradient.ndim == 1:
            return np.asarray(gradient @ shapes)
        return self._by_rows(lambda rows: rows @ shapes, gradient)


def valid_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return the mask ``(n, n)`` [y, x] in our axes: the instrument's own, or by flux at α = 0."""
    own = instrument.wfs.valid_subapertures
    if own is None:
        return lit_subapertures(instrument)
    return turned_mask(own, instrument.slopes.assumed_orientation)


def rtc_valid_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return the mask ``(n, n)`` [y, x] in the RTC's own axes, in which its slopes are listed."""
    if instrument.wfs.valid_subapertures is not None:
        return instrument.wfs.valid_subapertures
    return rtc_mask(lit_subapertures(instrument), instrument.slopes.assumed_orientation)


def lit_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return which subapertures ``(n, n)`` have enough of the pupil's area at α = 0.

    The flux is the pupil's light on each subaperture, so that the mask depends neither on the
    sampling nor on the light diffracted out of the images.
    """
    n = instrument.wfs.n_subapertures
    flux = _light_per_subaperture(n, instrument.wfs.pupil_diameter, instrument.obscuration_ratio)
    return np.asarray(flux >= instrument.wfs.flux_threshold)


@lru_cache(maxsize=8)
def _light_per_subaperture(n: int, diameter_subap: float, obscuration_ratio: float) -> Array:
    """Return the share of each subaperture ``(n, n)`` that the pupil lights."""
    fine = annular_pupil(
        n_subapertures=n,
        diameter_subap=diameter_subap,
        obscuration_ratio=obscuration_ratio,
        sampling=8,
    ).amplitude
    margin = (len(fine) - 8 * n) // 2
    inner = fine[margin : margin + 8 * n, margin : margin + 8 * n]
    return np.asarray(inner.reshape(n, 8, n, 8).mean(axis=(1, 3)))


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


def normalised_jacobian(response: Response, valid: NDArray[np.bool_]) -> Array:
    """Return the gradient of the normalised signals, ``(n_slopes, n_points)`` per radian.

    Of a response to shapes: their signals, ``(n_slopes, n_shapes)``.
    """
    signals, flux = signals_of(response.images, valid, response.recipe)
    jacobian = response.gradient - _times(signals / flux, response.flux_gradient)
    jacobian /= flux[:, None].astype(jacobian.dtype)
    return np.asarray(jacobian)


def normalised_derivative(at_rest: Response, moving: Response, valid: NDArray[np.bool_]) -> Array:
    """Return the rate of ``normalised_jacobian`` when the images move, by the product rule."""
    signals, flux = signals_of(at_rest.images, valid, at_rest.recipe)
    signal_rate, flux_rate = signals_of(moving.images, valid, moving.recipe)
    slopes = signals / flux
    slope_rate = (signal_rate - slopes * flux_rate) / flux
    rate = moving.gradient - _times(slopes, moving.flux_gradient)
    rate -= _times(slope_rate, at_rest.flux_gradient)
    rate -= normalised_jacobian(at_rest, valid) * flux_rate[:, None].astype(rate.dtype)
    rate /= flux[:, None].astype(rate.dtype)
    return np.asarray(rate)


def _times(slopes: Array, flux_gradient: Array) -> Array:
    """Return each slope times the gradient of its flux, ``(n_slopes, n_points)``."""
    column = slopes[:, None].astype(flux_gradient.dtype)
    if flux_gradient.ndim == 1:
        return np.asarray(column * flux_gradient)
    planes = column.reshape(-1, len(flux_gradient), 1) * flux_gradient
    return planes.reshape(len(slopes), -1)


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
