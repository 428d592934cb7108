"""The telescope the loop really has: finer, uneven, misaligned, and not the service's model.

It is linear: the slopes are ``K_eff turbulence + D G command``. It differs from the service's
model by its grid (q = 4), its quadrature and modulation points, by everything in ``Imperfections``,
and by an optical gain for every mode.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from service.model.instrument import Instrument, Stop
from service.model.interaction import normalised_jacobian, rotation, valid_subapertures
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from service.model.pupil import PupilGrid, instrument_pupil
from service.model.pyramid import PyramidOptics
from sim_rtc.flow import PhaseResponse
from sim_rtc.imperfections import (
    Imperfections,
    SlopeErrors,
    distorted,
    non_common_path,
    true_sensor,
)
from sim_rtc.influence import InfluenceCube
from sim_rtc.loop import ControlTerms, LoopTerms
from sim_rtc.mirror import DrawnSurface, MirrorFaults, PlantSurface, disobedient, misplaced
from sim_rtc.scene import Scene

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_SAMPLING = 4
_NODES = 4
_FEWEST_MODULATION_POINTS = 32
_RENDER_ROWS = 512


class TelescopeOptics(Protocol):
    """What the telescope does to a wavefront at one registration, whatever the kind of plant."""

    @property
    def alpha(self) -> Misregistration:
        """Where the mirror truly lies on the sensor."""

    @property
    def opd_per_command(self) -> Array32:
        """``(n_points, n_modes)`` OPD at the plant's pupil points per metre of command."""

    @property
    def images(self) -> Array:
        """``(2, n, 2, n)`` share of the light that every pixel detects, 0 where it is dead.

        Side, row along y, side, column along x.
        """

    @property
    def responses(self) -> tuple[tuple[float, PhaseResponse], ...]:
        """What of it is linear in the turbulence's phase."""

    @property
    def n_slopes(self) -> int:
        """Slopes of a frame."""

    def terms(self, reconstructor: Array32, gains: Array32, leak: float) -> ControlTerms:
        """Return what the integrator needs to run on these optics."""

    def towards(self, other: Self, share: float) -> Self:
        """Return the optics part of the way to ``other``, for small steps of a drift."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optics:
    """The optics of a linear plant."""

    alpha: Misregistration
    """Where the mirror truly lies on the sensor."""

    responses: tuple[tuple[float, PhaseResponse], ...]
    """Slopes per metre of turbulence OPD, optical gain included: shares of exact ones, sum 1."""

    slopes_per_command: Array32
    """``(n_slopes, n_modes)`` slope per metre of command, optical gain included."""

    opd_per_command: Array32
    """``(n_points, n_modes)`` OPD at the plant's pupil points per metre of command."""

    images: Array
    """``(2, n, 2, n)`` share of the light that every pixel detects, 0 where it is dead."""

    stuck_opd_m: Array32 | None = None
    """``(n_points,)`` what stuck actuators add; None: none is stuck."""

    @property
    def n_slopes(self) -> int:
        """Slopes of a frame."""
        return len(self.slopes_per_command)

    @property
    def slopes_per_phase(self) -> Array32:
        """``(n_slopes, n_points)`` slope per metre of turbulence OPD, optical gain included."""
        (share, response), *others = self.responses
        total = response.matrix if share == 1.0 else np.float32(share) * response.matrix
        for share, response in others:
            total = total + np.float32(share) * response.matrix
        return total

    def slopes_of(self, opd_m: Array32) -> Array32:
        """Return the slopes ``(n_slopes, ...)`` of wavefronts ``(n_points, ...)``, mirror apart."""
        parts = [np.float32(share) * (one.matrix @ opd_m) for share, one in self.responses]
        return np.asarray(sum(parts[1:], parts[0]))

    def terms(self, reconstructor: Array32, gains: Array32, leak: float) -> LoopTerms:
        """Return the terms of a loop around the interaction matrix."""
        return LoopTerms(
            # in columns, as the product with rows of slopes reads it
            reconstructor=np.asfortranarray(reconstructor),
            slopes_per_command=self.slopes_per_command,
            modal_response=np.asfortranarray(reconstructor @ self.slopes_per_command),
            gains=gains,
            leak=leak,
        )

    def towards(self, other: Optics, share: float) -> Optics:
        """Return the optics part of the way to ``other``: linear, for small steps of a drift."""

        def blend(a: Array32, b: Array32) -> Array32:
            mixed = b - a
            mixed *= np.float32(share)
            mixed += a
            return mixed

        return Optics(
            alpha=Misregistration.from_vector(
                (1.0 - share) * self.alpha.vector + share * other.alpha.vector
            ),
            responses=tuple(
                (weight * part, response)
                for part, optics in ((1.0 - share, self), (share, other))
                for weight, response in optics.responses
                if part > 0.0
            ),
            slopes_per_command=blend(self.slopes_per_command, other.slopes_per_command),
            opd_per_command=blend(self.opd_per_command, other.opd_per_command),
            images=(1.0 - share) * self.images + share * other.images,
            stuck_opd_m=None
            if self.stuck_opd_m is None or other.stuck_opd_m is None
            else blend(self.stuck_opd_m, other.stuck_opd_m),
        )


class Plant(Protocol):
    """A telescope, at any registration."""

    @property
    def points_m(self) -> Array:
        """``(n_points, 2)`` where the phase is sampled in the pupil, metres."""

    @property
    def pitch_m(self) -> float:
        """Distance between neighbouring points, metres."""

    @property
    def weights(self) -> Array:
        """``(n_points,)`` share of the pupil's area at each point; sums to 1."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """``(n_subapertures, n_subapertures)`` mask of the subapertures that give slopes."""

    @property
    def slope_errors(self) -> SlopeErrors:
        """What the sensor makes of correct light and slopes."""

    @property
    def sensor_opd_m(self) -> Array32:
        """``(n_points,)`` static OPD that the sensor sees and the science does not."""

    def optics(self, alpha: Misregistration) -> TelescopeOptics:
        """Return the optics at ``alpha``; takes seconds."""


class LinearPlant:
    """A pyramid and a thin-plate mirror, each slightly unlike the service's model of them."""

    def __init__(
        self,
        instrument: Instrument,
        basis: ModalBasis,
        *,
        rng: np.random.Generator,
        imperfections: Imperfections | None = None,
        scene: Scene | None = None,
        faults: MirrorFaults | None = None,
        influence: InfluenceCube | None = None,
    ) -> None:
        """Take influence functions to use instead of the drawing's."""
        imperfections, scene = imperfections or Imperfections(), scene or Scene()
        self._instrument = instrument
        self._passes = np.float32(scene.passes)
        pupil = instrument_pupil(instrument, _SAMPLING)
        pupil = scene.light(pupil, instrument.subaperture_m)
        uneven_rng, position_rng, pixel_rng, path_rng = rng.spawn(4)
        wfs = true_sensor(instrument.wfs, imperfections)
        self._pyramid = PyramidOptics(
            wfs=wfs,
            pupil=uneven(pupil, imperfections.unevenness, uneven_rng),
            n_nodes=_NODES,
            n_modulation=_modulation_points(wfs.modulation_lambda_over_d),
        )
        drawn, width_m = instrument.analytic_mirror, instrument.subaperture_m
        mirror = misplaced(drawn, imperfections.position_error, position_rng)
        self._surface: PlantSurface = (
            DrawnSurface(mirror=mirror, subaperture_m=width_m)
            if influence is None
            else influence.surface(drawn.positions_m, mirror.positions_m, width_m)
        )
        weights = disobedient(self._surface, basis.mode_to_actuator, faults or MirrorFaults())
        self._weights = np.column_stack(weights)
        self._gain = optical_gain(basis.mode_to_actuator.shape[1], imperfections)
        self._points = distorted(pupil.points, pupil.weights, imperfections)
        self.points_m: Array = self._points * instrument.subaperture_m
        self.pitch_m: float = instrument.subaperture_m / _SAMPLING
        self.weights: Array = pupil.weights
        self.valid: NDArray[np.bool_] = valid_subapertures(instrument)
        self.slope_errors = SlopeErrors(self.valid, imperfections, pixel_rng)
        """What the sensor makes of correct light and slopes."""
        self.sensor_opd_m: Array32 = non_common_path(
            self._points, self.weights, imperfections, path_rng
        )
        """``(n_points,)`` static OPD that the sensor sees and the science does not."""

    def optics(self, alpha: Misregistration) -> Optics:
        """Return the optics at ``alpha``: K at the shifted images, modes turned and scaled.

        The optical gain acts on the part of the turbulence the mirror can reproduce exactly as it
        acts on the mirror: ``K_eff = K + D (G - 1) P`` with P the projection of phase on modes.
        Of dead pixels the lost flux counts; what the phase would have changed in it, some 1e-4 of
        the flux's gradient, does not.
        """
        shift = self._image_shift(alpha)
        response = self._pyramid.response(self.valid, shift)
        light = float(response.images.sum())
        response = replace(response, images=self.slope_errors.read(response.images))
        jacobian = normalised_jacobian(response, self.valid)
        jacobian *= np.float32(2 * np.pi / self._instrument.wfs.wavelength_m)
        jacobian = self.slope_errors.applied(jacobian)
        modes, stuck_opd_m = self._render(alpha)
        matrix = jacobian @ modes
        jacobian += (matrix * (self._gain - 1.0)) @ self._projection(modes)
        return Optics(
            alpha=alpha,
            responses=((1.0, PhaseResponse(jacobian)),),
            slopes_per_command=np.asfortranarray(matrix * (self._gain * self._passes)),
            opd_per_command=modes * self._passes,
            images=response.images / light,
            stuck_opd_m=stuck_opd_m * self._passes if stuck_opd_m.any() else None,
        )

    def _image_shift(self, alpha: Misregistration) -> tuple[float, float]:
        if self._instrument.stop is Stop.TELESCOPE:
            return (0.0, 0.0)
        return (alpha.shift_x_subap, alpha.shift_y_subap)

    def _render(self, alpha: Misregistration) -> tuple[Array32, Array32]:
        """Return the modes ``(n_points, n_modes)`` and what is stuck ``(n_points,)``, seen once."""
        points = self._points
        if self._instrument.stop is Stop.TELESCOPE:
            points = points - alpha.vector[:2]
        on_mirror = points @ rotation(alpha.rotation_rad) / alpha.magnification
        blocks = [
            self._surface.basis(on_mirror[start : start + _RENDER_ROWS]) @ self._weights
            for start in range(0, len(on_mirror), _RENDER_ROWS)
        ]
        shapes = np.concatenate([block.astype(np.float32) for block in blocks])
        return np.ascontiguousarray(shapes[:, :-1]), shapes[:, -1]

    def _projection(self, modes: Array32) -> Array32:
        """Return ``(n_modes, n_points)``: least-squares modal content of a phase, by area."""
        weighted = modes * self.weights[:, None].astype(np.float32)
        gram = (modes.T @ weighted).astype(np.float64)
        return np.asarray(cho_solve(cho_factor(gram), weighted.T.astype(np.float64)), np.float32)


def _modulation_points(radius_lambda_over_d: float) -> int:
    """Return an even number of points that is enough for the radius."""
    enough = 2 * int(np.ceil(3 * radius_lambda_over_d)) + 10
    return max(_FEWEST_MODULATION_POINTS, enough)


def optical_gain(n_modes: int, imperfections: Imperfections) -> Array32:
    """Return the plant's optical gain per mode: a smooth rise from low to high order."""
    progress = np.sqrt(np.arange(n_modes) / max(n_modes - 1, 1))
    low, high = imperfections.lowest_optical_gain, imperfections.highest_optical_gain
    return (low + (high - low) * progress).astype(np.float32)


def uneven(pupil: PupilGrid, unevenness: float, rng: np.random.Generator) -> PupilGrid:
    """Return the pupil lit by a random smooth map: polynomials up to third order, mean kept."""
    u = pupil.coordinates / np.abs(pupil.coordinates).max()
    x, y = u[None, :], u[:, None]
    powers = [(i, j) for i in range(4) for j in range(4) if 0 < i + j <= 3]
    departure = np.zeros_like(pupil.amplitude)
    for (i, j), weight in zip(powers, rng.standard_normal(len(powers)), strict=True):
        departure += weight * x**i * y**j
    departure -= departure[pupil.lit] @ pupil.weights
    departure *= unevenness / np.abs(departure[pupil.lit]).max()
    flux = np.maximum(1.0 + np.where(pupil.lit, departure, 0.0), 0.0)
    return replace(pupil, amplitude=pupil.amplitude * np.sqrt(flux))
