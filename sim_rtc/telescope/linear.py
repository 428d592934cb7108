"""A linear telescope: slopes are ``K_eff turbulence + D G command``.

It differs from the service's model by its grid (q = 4, of an ELT 2), its quadrature and source
points, by everything in ``Imperfections``, and by an optical gain for every mode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.instrument import Instrument, Mirror
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from service.model.pupil import instrument_pupil, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from sim_rtc.telescope.atmosphere import PhaseResponse
from sim_rtc.telescope.imperfections import Imperfections
from sim_rtc.telescope.mirror import DrawnSurface, modal_content
from sim_rtc.telescope.plant import (
    Departures,
    Optics,
    SimulatedPlant,
    interpolate,
    registration_between,
)

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_SAMPLINGS = (4, 2)
"""Points a subaperture: the first of which K is no larger than this, or the last."""

_LARGEST_BYTES = 1e9

_ROWS = 4096

_NODES = 4
_SOURCE_POINTS = 32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearOptics(Optics):
    """The optics of a linear plant, the optical gain included."""

    slopes_per_command: Array32
    """``(n_slopes, n_modes)`` slope per metre of command."""

    @property
    @override
    def n_slopes(self) -> int:
        return len(self.slopes_per_command)

    @property
    def slopes_per_phase(self) -> Array32:
        """``(n_slopes, n_points)`` slope per metre of turbulence OPD."""
        parts = [np.float32(share) * one.matrix for share, one in self.responses]
        return np.asarray(sum(parts[1:], parts[0]))

    def slopes_of(self, opd_m: Array32) -> Array32:
        """Return the slopes ``(n_slopes, ...)`` of wavefronts ``(n_points, ...)``, mirror apart."""
        parts = [np.float32(share) * (one.matrix @ opd_m) for share, one in self.responses]
        return np.asarray(sum(parts[1:], parts[0]))

    @override
    def towards(self, other: LinearOptics, share: float) -> LinearOptics:
        return LinearOptics(
            alpha=registration_between(self, other, share),
            responses=tuple(
                (weight * part, response)
                for part, optics in ((1.0 - share, self), (share, other))
                for weight, response in optics.responses
                if part > 0.0
            ),
            slopes_per_command=interpolate(
                self.slopes_per_command, other.slopes_per_command, share
            ),
            opd_per_command=interpolate(self.opd_per_command, other.opd_per_command, share),
            images=(1.0 - share) * self.images + share * other.images,
            stuck_opd_m=interpolate(self.stuck_opd_m, other.stuck_opd_m, share),
        )


class LinearPlant(SimulatedPlant):
    """A sensor and a thin-plate mirror, each slightly unlike the service's model of them."""

    def __init__(
        self, instrument: Instrument, basis: ModalBasis, **made: Unpack[Departures]
    ) -> None:
        sampling, n_nodes = choose_sampling(instrument), _NODES * instrument.binning
        pupil = instrument_pupil(instrument, sampling)
        super().__init__(instrument, basis, pupil, made, instrument.binning)
        self._sensor = kind_of(instrument).sensor(
            self._instrument,
            self._pupil,
            Fineness(n_nodes=n_nodes, n_source_points=_SOURCE_POINTS),
        )
        imperfections = made.get("imperfections") or Imperfections()
        self._gain = optical_gain(basis.mode_to_actuator.shape[1], imperfections)

    @override
    def optics(self, alpha: Misregistration) -> LinearOptics:
        """Return the optics at ``alpha``: K at the shifted images, modes turned and scaled.

        The optical gain acts on the part of the turbulence the mirror can reproduce exactly as it
        acts on the mirror: ``K_eff = K + D (G - 1) P`` with P the projection of phase on modes.
        """
        response = self._sensor.at(self._image_shift(alpha))
        light = self.slope_errors.read(response.light)
        jacobian = self.slope_errors.add_errors(response.lit(light).jacobian())
        shapes, stuck_opd_m = self._render(alpha)
        modes = np.ascontiguousarray(shapes)
        matrix = jacobian @ modes
        content = modal_content(modes, self.weights).astype(np.float32)
        lost = matrix * (self._gain - 1.0)
        for start in range(0, len(lost), _ROWS):  # the whole product would be as large as K
            rows = slice(start, start + _ROWS)
            jacobian[rows] += lost[rows] @ content
        return LinearOptics(
            alpha=alpha,
            responses=((1.0, PhaseResponse(jacobian)),),
            slopes_per_command=np.asfortranarray(matrix * (self._gain * self._passes)),
            opd_per_command=modes * self._passes,
            # Over the light of all pixels, the dead ones included: their share is lost.
            images=light / float(response.light.sum()),
            stuck_opd_m=stuck_opd_m * self._passes,
        )

    @override
    def _own_surface(self, mirror: Mirror, strokes: Array) -> tuple[DrawnSurface, Array]:
        return DrawnSurface(mirror=mirror, subaperture_m=self._instrument.subaperture_m), strokes


def choose_sampling(instrument: Instrument) -> int:
    """Return points along a subaperture, of which K ``(n_slopes, n_points)`` has a size to keep."""
    n_valid = int(valid_subapertures(instrument).sum())
    n_slopes = instrument.slopes.kind.n_planes * n_valid
    for sampling in _SAMPLINGS:
        finest = sampling * instrument.binning
        if 4.0 * n_slopes * n_valid * finest**2 <= _LARGEST_BYTES:
            return finest
    return finest


def optical_gain(n_modes: int, imperfections: Imperfections) -> Array32:
    """Return the plant's optical gain per mode: a smooth rise from low to high order."""
    progress = np.sqrt(np.arange(n_modes) / max(n_modes - 1, 1))
    low, high = imperfections.lowest_optical_gain, imperfections.highest_optical_gain
    return (low + (high - low) * progress).astype(np.float32)
