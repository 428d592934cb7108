"""A telescope whose pyramid is not linear: every frame is an exposure of the whole field.

Its optical gain is what the residual wavefront makes of it. It shares nothing of the service's
model but the drawing: another pupil grid, other influence functions, uneven light, actuators out
of place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.model.instrument import Instrument, Mirror, Pyramid, Stop
from service.model.interaction import reference_slopes, rotation, valid_subapertures
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from sim_rtc.diffractive import DiffractivePyramid, Quadrature, centred_pupil
from sim_rtc.imperfections import (
    Imperfections,
    SlopeErrors,
    distorted,
    non_common_path,
    true_sensor,
)
from sim_rtc.influence import InfluenceCube
from sim_rtc.loop import ControlTerms
from sim_rtc.mirror import (
    MirrorFaults,
    PlantSurface,
    TensionedPlate,
    disobedient,
    heights,
    misplaced,
)
from sim_rtc.pixels import PixelDetector
from sim_rtc.plant import uneven
from sim_rtc.scene import Scene

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_SAMPLING = 3
"""Pupil points per subaperture of the finest binning."""

_TENSION_PITCHES = 1.0
"""Length beyond which tension rules the plate's shape, in actuator pitches."""

_SOFTNESS = 0.002
"""Compliance of the actuators over the plate's: the shape of mode 400 departs by 2 % from that of
the service's thin plate, its size by 3 %."""

_RENDER_ROWS = 512
_FEW_MODES = 32
"""Dithered modes beyond the controlled ones that are worth picking out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AtRest:
    """The sensor with a flat wavefront."""

    images: Array
    """``(2, n, 2, n)`` share of the light that every pixel detects, 0 where it is dead."""

    light: float
    """In all images together, dead pixels included, in the sensor's unit."""

    slopes: Array32
    """``(n_slopes,)``, the reference: subtracted from all others."""

    @classmethod
    def of(
        cls,
        sensor: DiffractivePyramid,
        n_points: int,
        valid: NDArray[np.bool_],
        errors: SlopeErrors,
    ) -> AtRest:
        """Look at a flat wavefront."""
        light = sensor.images(np.zeros(n_points, dtype=np.float32))
        total = float(light.sum())
        light = errors.read(light)
        slopes, _ = reference_slopes(light, valid)
        return cls(
            images=light.astype(np.float64) / total, light=total, slopes=slopes.astype(np.float32)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiffractiveOptics:
    """The optics of a diffractive plant at one registration."""

    alpha: Misregistration
    """Where the mirror truly lies on the sensor."""

    opd_per_command: Array32
    """``(n_points, n_modes)`` OPD at the plant's pupil points per metre of command, as seen.

    A mode is contiguous in memory: modes at rest then cost nothing.
    """

    stuck_opd_m: Array32
    """``(n_points,)`` what stuck actuators add."""

    sensor: DiffractivePyramid
    """Its images where the registration puts them."""

    static_opd_m: Array32
    """``(n_points,)`` non-common-path wavefront: only the sensor sees it."""

    valid: NDArray[np.bool_]
    """``(n, n)`` mask of the subapertures that give slopes."""

    errors: SlopeErrors
    """What happens to light and slopes that were right."""

    at_rest: AtRest
    """What it shows with a flat wavefront."""

    @property
    def images(self) -> Array:
        """``(2, n, 2, n)`` share of a flat wavefront's light that every pixel detects."""
        return self.at_rest.images

    @property
    def responses(self) -> tuple[()]:
        """Nothing is linear in the phase."""
        return ()

    @property
    def n_slopes(self) -> int:
        """Slopes of a frame."""
        return len(self.at_rest.slopes)

    def terms(self, reconstructor: Array32, gains: Array32, leak: float) -> ControlTerms:
        """Return the terms of a loop that learns its slopes frame by frame."""
        return ControlTerms(reconstructor=reconstructor, gains=gains, leak=leak)

    def towards(self, other: DiffractiveOptics, share: float) -> DiffractiveOptics:
        """Return the optics part of the way to ``other``: images moved exactly, modes blended."""
        vector = (1.0 - share) * self.alpha.vector + share * other.alpha.vector
        first, last = np.asarray(self.sensor.shift_subap), np.asarray(other.sensor.shift_subap)
        shift_x, shift_y = (1.0 - share) * first + share * last
        sensor = self.sensor.at((float(shift_x), float(shift_y)))
        return DiffractiveOptics(
            alpha=Misregistration.from_vector(vector),
            opd_per_command=_blend(self.opd_per_command, other.opd_per_command, share),
            stuck_opd_m=_blend(self.stuck_opd_m, other.stuck_opd_m, share),
            sensor=sensor,
            static_opd_m=self.static_opd_m,
            valid=self.valid,
            errors=self.errors,
            at_rest=AtRest.of(sensor, len(self.static_opd_m), self.valid, self.errors),
        )

    def mirror_opd_m(self, command_m: Array32) -> Array32:
        """Return what the mirror adds ``(n_points,)`` at this command ``(n_modes,)``."""
        modes = self.opd_per_command.T
        at_rest = np.flatnonzero(command_m == 0.0)
        n_first = int(at_rest[0]) if len(at_rest) else len(command_m)
        others = n_first + np.flatnonzero(command_m[n_first:])
        if len(others) > _FEW_MODES:
            return np.asarray(command_m @ modes)
        opd_m = command_m[:n_first] @ modes[:n_first]
        for mode in others:
            opd_m += command_m[mode] * modes[mode]
        return np.asarray(opd_m)

    def light(self, opd_m: Array32) -> Array32:
        """Return what the pixels detect of this wavefront ``(2, n, 2, n)``, in the sensor's unit.

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
            light = detector.read(light / np.float32(self.at_rest.light), rng)
        slopes, _ = reference_slopes(light, self.valid)
        return self.errors.applied((slopes - self.at_rest.slopes).astype(np.float32, copy=False))


class DiffractivePlant:
    """A pyramid and a mirror with everything that linear algebra leaves out."""

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
        binning: int = 1,
        quadrature: Quadrature | None = None,
    ) -> None:
        """Take the instrument as it is binned: the finest pixels set how finely it is computed.

        Without influence functions the mirror is a plate under tension.
        """
        imperfections, scene = imperfections or Imperfections(), scene or Scene()
        self._instrument, self._scene = instrument, scene
        uneven_rng, position_rng, pixel_rng, path_rng = rng.spawn(4)
        pupil = centred_pupil(instrument, _SAMPLING * binning)
        pupil = scene.light(pupil, instrument.subaperture_m)
        wfs = true_sensor(instrument.wfs, imperfections)
        self._sensor = DiffractivePyramid(
            wfs,
            uneven(pupil, imperfections.unevenness, uneven_rng),
            quadrature=quadrature or _quadrature(wfs, binning),
        )
        drawn = instrument.analytic_mirror
        mirror = misplaced(drawn, imperfections.position_error, position_rng)
        width_m, strokes = instrument.subaperture_m, basis.mode_to_actuator
        if influence is None:
            self._surface: PlantSurface = _plate(mirror, width_m)
            strokes = heights(drawn, strokes)
        else:
            self._surface = influence.surface(drawn.positions_m, mirror.positions_m, width_m)
        self._weights = disobedient(self._surface, strokes, faults or MirrorFaults())
        self._points = distorted(pupil.points, pupil.weights, imperfections)
        self.points_m: Array = self._points * instrument.subaperture_m
        self.pitch_m: float = instrument.subaperture_m / pupil.sampling
        self.weights: Array = pupil.weights
        self.valid: NDArray[np.bool_] = valid_subapertures(instrument)
        self.slope_errors = SlopeErrors(self.valid, imperfections, pixel_rng)
        """What the sensor makes of correct light and slopes."""
        self.sensor_opd_m: Array32 = non_common_path(
            self._points, self.weights, imperfections, path_rng
        )
        """``(n_points,)`` static OPD that the sensor sees and the science does not."""

    def optics(self, alpha: Misregistration) -> DiffractiveOptics:
        """Return the optics at ``alpha``: images at its shift, modes turned and scaled."""
        modes, stuck = self._render(alpha)
        sensor = self._sensor.at(self._image_shift(alpha))
        return DiffractiveOptics(
            alpha=alpha,
            opd_per_command=modes,
            stuck_opd_m=stuck,
            sensor=sensor,
            static_opd_m=self.sensor_opd_m,
            valid=self.valid,
            errors=self.slope_errors,
            at_rest=AtRest.of(sensor, len(self._points), self.valid, self.slope_errors),
        )

    def _image_shift(self, alpha: Misregistration) -> tuple[float, float]:
        if self._instrument.stop is Stop.TELESCOPE:
            return (0.0, 0.0)
        return (alpha.shift_x_subap, alpha.shift_y_subap)

    def _render(self, alpha: Misregistration) -> tuple[Array32, Array32]:
        points = self._points
        if self._instrument.stop is Stop.TELESCOPE:
            points = points - alpha.vector[:2]
        on_mirror = points @ rotation(alpha.rotation_rad) / alpha.magnification
        weights = self._scene.passes * np.column_stack(self._weights)
        blocks = [
            self._surface.basis(on_mirror[start : start + _RENDER_ROWS]) @ weights
            for start in range(0, len(on_mirror), _RENDER_ROWS)
        ]
        shapes = np.concatenate([block.astype(np.float32) for block in blocks])
        return np.asfortranarray(shapes[:, :-1]), np.ascontiguousarray(shapes[:, -1])


def _plate(mirror: Mirror, subaperture_m: float) -> TensionedPlate:
    """Return the plate through these actuators, in coordinates of subapertures."""
    return TensionedPlate(
        mirror.positions_m / subaperture_m,
        tension=subaperture_m / (_TENSION_PITCHES * mirror.pitch_m),
        softness=_SOFTNESS,
    )


def _quadrature(wfs: Pyramid, binning: int) -> Quadrature:
    """Return 24 modulation points at 3 λ/D, more on a larger circle, and nodes for the binning."""
    return Quadrature(
        n_nodes=2 * binning,
        n_modulation=max(24, 2 * int(np.ceil(4 * wfs.modulation_lambda_over_d))),
    )


def _blend(a: Array32, b: Array32, share: float) -> Array32:
    mixed = b - a
    mixed *= np.float32(share)
    mixed += a
    return np.asarray(mixed)
