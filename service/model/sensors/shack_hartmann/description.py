"""A Shack-Hartmann as an instrument has it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from service.model.instrument import Instrument, sensor_of_kind
from service.model.sensors.shack_hartmann.table import (
    Centroid,
    PartlyLit,
    ShackHartmannNumbers,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShackHartmann(ShackHartmannNumbers):
    """The lenslets, and which of them are valid."""

    kind: ClassVar[str] = "shack-hartmann"

    valid_subapertures: NDArray[np.bool_] | None = None
    """Mask ``(n_subapertures, n_subapertures)``, [y, x] in the RTC's own axes, as its slopes are
    listed; None: by ``flux_threshold`` at α = 0."""

    @property
    def leaves_out_partly_lit(self) -> bool:
        """True if fits leave out the subapertures that the pupil's edge cuts."""
        if self.partly_lit is not None:
            return self.partly_lit is PartlyLit.LEAVE_OUT
        # A threshold, or no pixels at all, is nonlinear where the edge cuts a lenslet.
        return self.centroid in {Centroid.THRESHOLD, Centroid.GRADIENT}

    def pixel_lambda_over_d(self, subaperture_m: float) -> float:
        """Return the width of a pixel in units of λ/d, d the width of a subaperture."""
        if self.pixel_scale_arcsec is None:
            return 1.0
        return math.radians(self.pixel_scale_arcsec / 3600.0) * subaperture_m / self.wavelength_m


def shack_hartmann_in(instrument: Instrument) -> ShackHartmann:
    """Return the Shack-Hartmann of an instrument that has one.

    Raises
    ------
    ModelError
        If its sensor is another.
    """
    return sensor_of_kind(instrument, ShackHartmann)


def pixel_places(sensor: ShackHartmann, valid: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the indices of the pixels of valid subapertures in flat light ``(n, m, n, m)``.

    ``(m**2, n_valid)``: m pixels along a side of each of n subapertures, row by row.
    """
    n, m = len(valid), sensor.pixels_per_subaperture
    places = np.arange((n * m) ** 2, dtype=np.intp).reshape(n, m, n, m)
    return np.ascontiguousarray(places.transpose(1, 3, 0, 2)[..., valid].reshape(m * m, -1))


def point_variances(sensor: ShackHartmann, subaperture_m: float) -> tuple[float, float]:
    """Return the variance of a centroid by one photon's place, and by noise 1 of all its pixels.

    Of a star that is a point, in (λ/d)², over the square of the photons yet: of a spot sinc² u its
    variance within a field from -w to w is w / π². A threshold, or weights, let the core count
    alone: w = 1.
    """
    pixel = sensor.pixel_lambda_over_d(subaperture_m)
    # Wings of a spot fall as 1/u², so that its variance grows with the width of the field.
    half = sensor.pixels_per_subaperture * pixel / 2
    if sensor.centroid is not Centroid.CENTRE_OF_GRAVITY:
        half = min(half, 1.0)
    across = 2.0 * half / pixel
    return half / math.pi**2, across**2 * (2.0 * half) ** 2 / 12.0
