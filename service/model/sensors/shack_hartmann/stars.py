"""Spots of an instrument's star: a point at infinity, or a laser's elongated ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.pupil import valid_subapertures
from service.model.sensors.model import Term
from service.model.sensors.shack_hartmann.description import (
    ShackHartmann,
    point_variances,
    shack_hartmann_in,
)
from service.model.sensors.shack_hartmann.elongated import ElongatedSpots, blur_of, elongation_rad
from service.model.sensors.shack_hartmann.spots import MeanGradients, Spots
from service.model.sensors.shack_hartmann.table import Centroid, LaserStar

LINEARITY_RANGE = (0.8, 1.25)
"""Range of a centroid's motion relative to the motion computed with the pixels used at rest;
further from 1, pixels cross the threshold as the spot moves."""

_SPOT_MOTION_LAMBDA_OVER_D = 0.2
"""Motion of a spot in a closed loop, λ/d."""

_N_CHECKED_SPOTS = 8
"""Across a sensor whose spots are not alike."""

_MIN_SPOT_LAMBDA_OVER_D = 0.5
"""Smallest spot of a laser star, λ/d: a laser's beam is wider than that."""

_MAX_SPOT_FIELD_RATIO = 2.0
"""Largest length of a spot relative to the width of a field, which holds only a part of a longer
one."""


def spots_of(wfs: ShackHartmann, width_m: float, lenslets: NDArray[np.bool_]) -> Spots:
    """Return the spots of these lenslets ``(n, n)`` [y, x], row by row, each so wide."""
    pixels: dict[str, Any] = {
        "n_pixels": wfs.pixels_per_subaperture,
        "pixel": wfs.pixel_lambda_over_d(width_m),
        "centroid": wfs.centroid,
        "threshold": wfs.threshold,
    }
    if wfs.laser is None:
        made = MeanGradients if wfs.centroid is Centroid.GRADIENT else Spots
        return made(**pixels)
    line_m = width_m * (np.arange(len(lenslets)) - (len(lenslets) - 1) / 2)
    places_m = np.stack(np.meshgrid(line_m, line_m), axis=-1)
    blur = blur_of(wfs.laser, places_m, wfs.wavelength_m / width_m)
    # Of all lenslets, so that each has the same grid of angles whichever are asked for.
    widest = float(np.sqrt(np.linalg.eigvalsh(blur).max()))
    return ElongatedSpots(**pixels, blur=blur[lenslets], widest=widest)


def centroid_variances(instrument: Instrument) -> tuple[Term, Term]:
    """Return the variance of centroids by a photon's place, and by noise 1 of all their pixels.

    In (λ/d)², over the square of the photons yet; of a laser star's spots ``(n_slopes,)``.
    """
    wfs, width_m = shack_hartmann_in(instrument), instrument.subaperture_m
    spots = spots_of(wfs, width_m, valid_subapertures(instrument))
    if isinstance(spots, ElongatedSpots):
        of_photon, of_pixels = spots.variances
        return of_photon.reshape(-1), of_pixels.reshape(-1)
    return point_variances(wfs, width_m)


def check_star(wfs: ShackHartmann, width_m: float) -> None:
    """Refuse a laser star that no field of this sensor can hold, and nonlinear centroids.

    Raises
    ------
    ModelError
        One line that begins with the key.
    """
    n = wfs.n_subapertures
    if wfs.laser is not None:
        _check_laser(wfs.laser, wfs, width_m)
    if wfs.threshold is None:
        return
    # Spots of a point are alike; of a laser's, a coarse grid of lenslets is checked.
    some = np.zeros((n, n), np.bool_)
    each = 1 if wfs.laser is None else max(1, n // _N_CHECKED_SPOTS)
    some[::each, ::each] = True
    moved = spots_of(wfs, width_m, some).straightness(_SPOT_MOTION_LAMBDA_OVER_D)
    # Farthest from 1 as a ratio: half as much is as wrong as twice as much.
    worst = float(moved[np.argmax(np.abs(np.log(np.maximum(moved, 1e-3))))])
    low, high = LINEARITY_RANGE
    if not low < worst < high:
        raise ModelError(
            f"threshold: found {wfs.threshold:g}: a spot that moves by "
            f"{_SPOT_MOTION_LAMBDA_OVER_D:g} λ/d moves its "
            f"centroid by {worst:.2g} times what its pixels at rest say, expected {low:g} to "
            f"{high:g}: a lower one, or another centroid"
        )


def _check_laser(laser: LaserStar, wfs: ShackHartmann, width_m: float) -> None:
    lambda_over_d = math.degrees(wfs.wavelength_m / width_m) * 3600.0
    if laser.spot_arcsec < _MIN_SPOT_LAMBDA_OVER_D * lambda_over_d:
        raise ModelError(
            f"laser.spot_arcsec: found {laser.spot_arcsec:g}, expected "
            f"{_MIN_SPOT_LAMBDA_OVER_D:g} λ/d or more: "
            f"{_MIN_SPOT_LAMBDA_OVER_D * lambda_over_d:.2g} of a subaperture of {width_m:.3g} m"
        )
    # The lenslet farthest from the launcher has the longest spot.
    corner = width_m * wfs.n_subapertures / 2 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    long = math.degrees(np.linalg.norm(elongation_rad(laser, corner), axis=1).max()) * 3600.0
    field = wfs.pixels_per_subaperture * wfs.pixel_lambda_over_d(width_m) * lambda_over_d
    if long > _MAX_SPOT_FIELD_RATIO * field:
        raise ModelError(
            f"laser.thickness_m: found spots of up to {long:.3g} arcseconds in a field of "
            f"{field:.3g}, expected {_MAX_SPOT_FIELD_RATIO:g} times that at most: "
            "thickness_m, height_m and "
            "launcher_m are metres"
        )
