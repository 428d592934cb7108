"""A telescope that propagates the whole field for every frame.

Its optical gain results from the residual wavefront. It shares only the nominal geometry with the
service's model: it has another pupil grid, other influence functions, uneven light, and displaced
actuators.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, Self, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.instrument import Instrument, Mirror, PupilMap
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from service.model.pupil import PupilGrid
from service.model.sensors.pyramid.description import Pyramid, image_offsets, pyramid_in
from service.model.sensors.pyramid.signals import reference_slopes
from service.model.sensors.shack_hartmann.description import ShackHartmann
from service.model.slopes import SlopeRecipe
from sim_rtc.telescope.detector import PixelDetector
from sim_rtc.telescope.imperfections import SlopeErrors
from sim_rtc.telescope.lenslets import LENSLET_SAMPLING, DiffractiveLenslets
from sim_rtc.telescope.mirror import PlantSurface, TensionedPlate, heights
from sim_rtc.telescope.plant import (
    Departures,
    Optics,
    SimulatedPlant,
    interpolate,
    registration_between,
)

Array32 = NDArray[np.float32]
Array = NDArray[Any]

_SAMPLING = 3
"""Pupil points per subaperture of the finest binning."""

_TENSION_PITCHES = 1.0
"""Length beyond which tension rules the plate's shape, in actuator pitches."""

_SOFTNESS = 0.002
"""Compliance of the actuators over the plate's: the shape of mode 400 departs by 2 % from that of
the service's thin plate, its size by 3 %."""

_HALF = 0.5
"""Share of a map's point from which on it is lit."""

_FEW_MODES = 32
"""Largest number of dithered modes beyond the controlled ones that are selected by index."""


class DiffractiveSensor(Protocol):
    """A sensor that makes light of any wavefront, its image of the pupil at one place."""

    shift_subap: tuple[float, float]
    """(x, y) by which the image is moved."""

    def at(self, shift_subap: tuple[float, float]) -> Self:
        """Return the same sensor with its image elsewhere."""

    def images(self, opd_m: Array) -> Array:
        """Return the light on its pixels of a wavefront ``(n_points,)`` where the pupil is lit."""

    def signals(self, light: Array, valid: NDArray[np.bool_], recipe: SlopeRecipe) -> Array:
        """Return what is made of the light ``(n_slopes,)``, of a flat wavefront too."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiffractiveOptics(Optics):
    """The optics of a diffractive plant at one registration.

    A mode of ``opd_per_command`` is contiguous in memory: modes at rest then cost nothing.
    """

    sensor: DiffractiveSensor
    """Its images where the registration puts them."""

    static_opd_m: Array32
    """``(n_points,)`` non-common-path wavefront: only the sensor sees it."""

    valid: NDArray[np.bool_]
    """``(n, n)`` mask of the subapertures that give slopes."""

    errors: SlopeErrors
    """Errors of the light and of the slopes."""

    light_at_rest: float
    """Light of a flat wavefront in all images together, dead pixels included, in the sensor's unit.
    """

    slopes_at_rest: Array32
    """``(n_slopes,)`` of a flat wavefront, the reference: subtracted from all others."""

    @property
    @override
    def n_slopes(self) -> int:
        return len(self.slopes_at_rest)

    @override
    def towards(self, other: DiffractiveOptics, share: float) -> DiffractiveOptics:
        first, last = np.asarray(self.sensor.shift_subap), np.asarray(other.sensor.shift_subap)
        shift_x, shift_y = (1.0 - share) * first + share * last
        sensor = self.sensor.at((float(shift_x), float(shift_y)))
        return replace(
            self,
            alpha=registration_between(self, other, share),
            opd_per_command=interpolate(self.opd_per_command, other.opd_per_command, share),
            stuck_opd_m=interpolate(self.stuck_opd_m, other.stuck_opd_m, share),
            sensor=sensor,
            **_at_rest(sensor, self.valid, self.errors, len(self.static_opd_m)),
        )

    def mirror_opd_m(self, command_m: Array32) -> Array32:
        """Return what the mirror adds ``(n_points,)`` at this command ``(n_modes,)``."""
        modes = self.opd_per_command.T
        at_rest = np.flatnonzero(command_m == 0.0)
        n_first = int(at_rest[0]) if len(at_rest) else len(command_m)
        others = n_first + np.flatnonzero(command_m[n_first:])
        # With so many the indexed sum is slower than the whole product.
        if len(others) > _FEW_MODES:
            return np.asarray(command_m @ modes)
        opd_m = command_m[:n_first] @ modes[:n_first]
        for mode in others:
            opd_m += command_m[mode] * modes[mode]
        return np.asarray(opd_m)

    def light(self, opd_m: Array32) -> Array32:
        """Return what the pixels detect of this wavefront, in the sensor's own shape and unit.

        ``opd_m`` is ``(n_points,)``, the mirror's part in it, the non-common path not.
        """
        return self.errors.read(self.sensor.images(opd_m + self.static_opd_m))

    def slopes(
        self, opd_m: Array32, detector: PixelDetector | None, rng: np.random.Generator
    ) -> Array32:
        """Return the slopes ``(n_slopes,)`` of this wavefront, reference slopes subtracted.

        ``opd_m`` is ``(n_points,)``, the mirror's part in it. Without a detector they are free of
        noise.
        """
        light = self.light(opd_m)
        if detector is not None:
            # Divided by the light of all images, dead pixels included: the electrons of a frame are
            # those of the whole star.
            light = detector.read(light / np.float32(self.light_at_rest), rng)
        slopes = self.sensor.signals(light, self.valid, self.errors.recipe)
        return self.errors.add_errors((slopes - self.slopes_at_rest).astype(np.float32, copy=False))


class DiffractivePlant(SimulatedPlant):
    """A sensor and a mirror with all that linear algebra leaves out."""

    def __init__(
        self,
        instrument: Instrument,
        basis: ModalBasis,
        *,
        binning: int = 1,
        quadrature: Quadrature | None = None,
        **made: Unpack[Departures],
    ) -> None:
        """Take the instrument as it is binned: the finest pixels set how finely it is computed."""
        lenslets = isinstance(instrument.wfs, ShackHartmann)
        sampling = LENSLET_SAMPLING if lenslets else _SAMPLING * binning
        super().__init__(
            instrument, basis, build_centred_pupil(instrument, sampling), made, binning
        )
        self._sensor: DiffractiveSensor
        if isinstance(self._wfs, ShackHartmann):
            self._sensor = DiffractiveLenslets(self._wfs, self._pupil, instrument.subaperture_m)
            return
        wfs = pyramid_in(self._instrument)
        self._sensor = DiffractivePyramid(
            wfs,
            self._pupil,
            quadrature=quadrature or _quadrature(wfs, binning),
            offsets_subap=image_offsets(self._instrument),
        )

    @override
    def optics(self, alpha: Misregistration) -> DiffractiveOptics:
        """Return the optics at ``alpha``: images at its shift, modes turned and scaled."""
        modes, stuck_opd_m = self._render(alpha)
        sensor = self._sensor.at(self._image_shift(alpha))
        return DiffractiveOptics(
            alpha=alpha,
            opd_per_command=np.asfortranarray(modes * self._passes),
            stuck_opd_m=stuck_opd_m * self._passes,
            sensor=sensor,
            static_opd_m=self.sensor_opd_m,
            valid=self.valid,
            errors=self.slope_errors,
            **_at_rest(sensor, self.valid, self.slope_errors, len(self._points)),
        )

    @override
    def _own_surface(self, mirror: Mirror, strokes: Array) -> tuple[PlantSurface, Array]:
        """Return a plate under tension."""
        width_m = self._instrument.subaperture_m
        plate = TensionedPlate(
            mirror.positions_m / width_m,
            tension=width_m / (_TENSION_PITCHES * mirror.pitch_m),
            softness=_SOFTNESS,
        )
        return plate, heights(self._instrument.analytic_mirror, strokes)


def _quadrature(wfs: Pyramid, binning: int) -> Quadrature:
    """Return 24 modulation points at 3 λ/D, more on a larger circle, and nodes for the binning."""
    return Quadrature(
        n_nodes=2 * binning,
        n_modulation=max(24, 2 * int(np.ceil(4 * wfs.largest_modulation))),
    )


class _AtRest(TypedDict):
    """Fields of the optics that describe a flat wavefront."""

    images: Array
    light_at_rest: float
    slopes_at_rest: Array32


def _at_rest(
    sensor: DiffractiveSensor, valid: NDArray[np.bool_], errors: SlopeErrors, n_points: int
) -> _AtRest:
    """Propagate a flat wavefront."""
    light = sensor.images(np.zeros(n_points, dtype=np.float32))
    total = float(light.sum())
    light = errors.read(light)
    slopes = sensor.signals(light, valid, errors.recipe)
    return {
        "images": light.astype(np.float64) / total,
        "light_at_rest": total,
        "slopes_at_rest": slopes.astype(np.float32),
    }


_EDGE_SAMPLES = 16
"""Samples across a cell of the pupil: its light is good to about 1e-3 of a cell."""

_SIDES = np.array([-1.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Quadrature:
    """Number of points that sample modulation and detector."""

    n_nodes: int = 2
    """Gauss-Legendre nodes per axis in a subaperture."""

    n_modulation: int = 24
    """Points on the modulation circle, even; 24 leave an error of 2e-3 on tip at 3 λ/D."""

    dtype: type[np.complex64] | type[np.complex128] = np.complex64
    """Precision of the fields."""

    def __post_init__(self) -> None:
        """Refuse a modulation whose points do not pair up.

        Raises
        ------
        ModelError
            If the number of modulation points is odd or not positive.
        """
        if self.n_modulation < 2 or self.n_modulation % 2:
            raise ModelError(
                f"pyramid: found {self.n_modulation} modulation points; expected an even number"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ImageGroup:
    """Images whose detector points form one regular grid: their propagation is separable."""

    sides_y: slice
    sides_x: slice

    left: Array
    """``(n_pairs n_y, N)`` operator along y: pairs of modulation points, detector points."""

    right: Array
    """``(n_pairs, N, 2 n_x)`` operator along x."""

    by_row: Array
    """Working memory of the first product."""

    light: Array
    """Working memory of the second product."""


class DiffractivePyramid:
    """The light on the four pupil images for any wavefront, at one shift of the images.

    Not for two threads at once: its fields are computed in place.
    """

    def __init__(
        self,
        wfs: Pyramid,
        pupil: PupilGrid,
        shift_subap: tuple[float, float] = (0.0, 0.0),
        quadrature: Quadrature | None = None,
        offsets_subap: NDArray[np.float64] | None = None,
    ) -> None:
        """Prepare the sensor; ``offsets_subap`` ``(2, 2, 2)`` displaces the pupil images.

        Indices: side along y, side along x, (x, y); subapertures. None if there are none.
        """
        if wfs.rooftop_lambda_over_d:
            raise ModelError(
                f"pyramid: found a rooftop of {wfs.rooftop_lambda_over_d:g} λ/D, expected a tip: "
                "the diffractive telescope has no rooftop; use --plant linear"
            )
        self._wfs, self._pupil = wfs, pupil
        self.shift_subap = shift_subap
        """(x, y) by which the images are moved."""

        self._quadrature = quadrature or Quadrature()
        self._offsets_subap = offsets_subap
        dtype = self._quadrature.dtype
        n_u = len(pupil.coordinates)
        self._groups = self._image_groups()
        self._field = np.zeros((n_u, n_u), dtype)
        real = np.empty(0, dtype).real.dtype
        self._lit = np.flatnonzero(pupil.lit)
        self._amplitude = pupil.amplitude[pupil.lit].astype(real)
        self._wavenumber = real.type(2 * np.pi / wfs.wavelength_m)

    def at(self, shift_subap: tuple[float, float]) -> DiffractivePyramid:
        """Return the same sensor with its images elsewhere."""
        return DiffractivePyramid(
            self._wfs, self._pupil, shift_subap, self._quadrature, self._offsets_subap
        )

    def images(self, opd_m: Array) -> Array:
        """Return the light ``(2, n, 2, n)``: side, row along y, side, column along x.

        ``opd_m`` is ``(n_points,)``, at the lit points of the pupil. The unit is the light of a
        fully lit subaperture of the pupil.
        """
        phase = self._wavenumber * opd_m.astype(self._wavenumber.dtype, copy=False)
        field = self._field.reshape(-1)
        field.real[self._lit] = self._amplitude * np.cos(phase)
        field.imag[self._lit] = self._amplitude * np.sin(phase)
        if len(self._groups) == 1:
            return self._light_of(self._groups[0])
        n = self._wfs.n_subapertures
        images = np.empty((2, n, 2, n), self._amplitude.dtype)
        for group in self._groups:
            images[group.sides_y, :, group.sides_x] = self._light_of(group)
        return images

    def _light_of(self, group: _ImageGroup) -> Array:
        """Return the light ``(n_sides_y, n, n_sides_x, n)`` on a group's images, of the field."""
        np.matmul(group.left, self._field, out=group.by_row)
        n_pairs, n_y, _ = group.light.shape
        np.matmul(group.by_row.reshape(n_pairs, n_y, -1), group.right, out=group.light)
        # Complex numbers seen as pairs of reals: the power is the sum of their squares, without a
        # temporary.
        parts = group.light.view(self._amplitude.dtype)
        power = np.einsum("mij,mij->ij", parts, parts)
        n, nodes = self._wfs.n_subapertures, self._quadrature.n_nodes
        # Rows: side, subaperture, node; columns: point of the pair, side, subaperture, node, part.
        n_sides = n_y // (n * nodes)
        by_node = power.reshape(n_sides, n, nodes, 2, -1, n, nodes * 2)
        return np.asarray(by_node.sum(axis=(2, 3, 6)))

    def _image_groups(self) -> tuple[_ImageGroup, ...]:
        """Return the images in groups that share one grid of detector points: all four, or each."""
        both = slice(0, 2)
        if self._offsets_subap is None:
            return (self._group(both, both, np.zeros(2)),)
        return tuple(
            self._group(slice(y, y + 1), slice(x, x + 1), self._offsets_subap[y, x])
            for y, x in np.ndindex(2, 2)
        )

    def _group(self, sides_y: slice, sides_x: slice, offset_subap: Array) -> _ImageGroup:
        dtype, n_u = self._quadrature.dtype, len(self._pupil.coordinates)
        roof_y = self._roof(self.shift_subap[1] + offset_subap[1], sides_y)
        roof_x = self._roof(self.shift_subap[0] + offset_subap[0], sides_x)
        tilt_y, tilt_x = self._tilts()
        # Points of the modulation that share their y component share the first product.
        left = (tilt_y[:, None] * roof_y).reshape(-1, n_u)
        right = (tilt_x[:, :, None] * roof_x).reshape(len(tilt_x), -1, n_u).transpose(0, 2, 1)
        return _ImageGroup(
            sides_y=sides_y,
            sides_x=sides_x,
            left=left.astype(dtype),
            right=np.ascontiguousarray(right, dtype),
            by_row=np.empty((len(left), n_u), dtype),
            light=np.empty((len(tilt_y), len(roof_y), 2 * len(roof_x)), dtype),
        )

    def signals(self, light: Array, valid: NDArray[np.bool_], recipe: SlopeRecipe) -> Array:
        """Return the signals of its images ``(n_slopes,)``, of a flat wavefront too."""
        return reference_slopes(light, valid, recipe)[0]

    def _roof(self, shift_subap: float, sides: slice) -> Array:
        """Return the roof operator along one axis, ``(n_sides n n_nodes, N)``, weights included.

        The kernel of one edge is that of a half-plane's transform, cut at the band limit of the
        pupil grid; the light of a subaperture is a Gauss-Legendre sum over its nodes.
        """
        n, half = self._wfs.n_subapertures, self._wfs.image_separation_subap / 2
        offsets, weights = np.polynomial.legendre.leggauss(self._quadrature.n_nodes)
        centres = np.arange(n) - (n - 1) / 2
        x = _SIDES[sides, None, None] * half + centres[:, None] + offsets / 2 - shift_subap
        distance = x[..., None] - self._pupil.coordinates
        near, far = ((distance + sign * half) * self._pupil.sampling for sign in (1.0, -1.0))
        kernel = np.sinc(far) + np.sinc(near) + 1j * (_half_plane(near) - _half_plane(far))
        # Square root, because the light is the square of the field; Gauss-Legendre weights sum to
        # 2.
        kernel *= 0.5 * np.sqrt(weights / 2)[:, None]
        # Each of M points has 1/M of the light.
        kernel /= np.sqrt(np.sqrt(self._quadrature.n_modulation))
        return np.asarray(kernel.reshape(-1, len(self._pupil.coordinates)))

    def _tilts(self) -> tuple[Array, Array]:
        """Return modulation phasors ``(M/2, N)`` along y and ``(M/2, 2, N)`` along x."""
        n_modulation = self._quadrature.n_modulation
        # Half a step off the axes: every point then has a partner of the same y.
        angle = 2 * np.pi * (np.arange(n_modulation // 2) + 0.5) / n_modulation
        first, second, direction = self._wfs.modulation_axes
        axes = np.exp(1j * direction) * np.array([first, 1j * second])
        # Of the conjugate diameters of an ellipse one is chosen along x.
        turn = np.exp(1j * np.arctan2(axes[1].imag, axes[0].imag))
        diameters = (
            2
            * np.pi
            / self._wfs.pupil_diameter
            * axes
            @ [[turn.real, turn.imag], [turn.imag, -turn.real]]
        )
        u = self._pupil.coordinates
        along_y = np.exp(1j * diameters[0].imag * np.cos(angle)[:, None] * u)
        x = (
            diameters[0].real * np.cos(angle)[:, None]
            + diameters[1].real * np.sin(angle)[:, None] * _SIDES
        )
        along_x = np.exp(1j * x[..., None] * u)
        return along_y, along_x


def build_centred_pupil(instrument: Instrument, sampling: int) -> PupilGrid:
    """Return the pupil on an odd grid, with a point at its centre.

    The service's grids are even: half a point away. A cell's amplitude is the fraction of its area
    inside the annulus, by counting.
    """
    radius = instrument.wfs.pupil_diameter / 2
    n = 2 * int(np.ceil(sampling * max(radius, instrument.wfs.n_subapertures / 2))) + 1
    coordinates = (np.arange(n) - (n - 1) / 2) / sampling
    inside = ((np.arange(_EDGE_SAMPLES) + 0.5) / _EDGE_SAMPLES - 0.5) / sampling
    fine = (coordinates[:, None] + inside).reshape(-1)
    squared = fine[:, None] ** 2 + fine**2
    lit = (squared <= radius**2) & (squared >= (radius * instrument.obscuration_ratio) ** 2)
    if instrument.pupil is not None:
        lit = _lit_in_map(instrument.pupil, fine * instrument.subaperture_m)
    for degrees in instrument.spiders_deg:
        ray = np.exp(-1j * np.deg2rad(degrees)) * (fine + 1j * fine[:, None])
        width = (instrument.spiders_m or 0.0) / instrument.subaperture_m
        lit &= (ray.real < 0.0) | (np.abs(ray.imag) > width / 2)
    amplitude = lit.reshape(n, _EDGE_SAMPLES, n, _EDGE_SAMPLES).mean(axis=(1, 3))
    return PupilGrid(sampling=sampling, coordinates=coordinates, amplitude=amplitude)


def _lit_in_map(own: PupilMap, fine_m: Array) -> NDArray[np.bool_]:
    """Return where a map is lit, by its nearest point; beyond it all is dark."""
    # A dark border: indices beyond the map are clipped onto it.
    lit, ny, nx = np.pad(own.lit > _HALF, 1), *own.lit.shape
    row, column = (
        np.clip(np.rint(fine_m / own.pitch_m + (n - 1) / 2).astype(int) + 1, 0, n + 1)
        for n in (ny, nx)
    )
    return np.asarray(lit[np.ix_(row, column)])


def _half_plane(n: Array) -> Array:
    """Return ``(1 - cos πn) / (πn)``, 0 at 0: the transform of a sign, cut at the band limit."""
    return np.asarray(np.sinc(n / 2) * np.sin(np.pi * n / 2))
