"""The laser guide star as each lenslet sees it: light from many heights, each at its own position.

The service's model blurs spots by a Gaussian along a straight line. Here the layer is cut into
sheets. Each sends light from its own height, so that light from below arrives further out than
light from above, and the pixels collect it sheet by sheet.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.sensors.shack_hartmann.description import ShackHartmann
from service.model.sensors.shack_hartmann.table import LaserStar

Array = NDArray[Any]

ANGLE_STEP = 0.5
"""Sampling of a point's light, λ/d; it has no finer structure."""

_SHEETS = 9
"""The layer is cut into, over four times its standard deviation."""

_BEYOND_SIGMA = 1.5
"""σ of the widest star that light is sampled beyond the field: little of it comes back into it."""

_FWHM = math.sqrt(8.0 * math.log(2.0))


class SodiumStar:
    """Spreads the light of a point over the pixels as a layer of sodium would."""

    def __init__(self, wfs: ShackHartmann, laser: LaserStar, subaperture_m: float) -> None:
        """Prepare the sheets of the layer for these lenslets."""
        n, m = wfs.n_subapertures, wfs.pixels_per_subaperture
        lambda_over_d = wfs.wavelength_m / subaperture_m
        across = math.radians(laser.spot_arcsec / 3600.0) / _FWHM / lambda_over_d
        sheets = np.linspace(-2.0, 2.0, _SHEETS)
        light = np.exp(-(sheets**2) / 2.0)
        heights = laser.height_m + sheets * laser.thickness_m / _FWHM
        # Relative to the mean height, on which the sensor is focused.
        parallax = (1.0 / laser.height_m - 1.0 / heights) / lambda_over_d
        from_launcher = subaperture_m * (np.arange(n) - (n - 1) / 2)[:, None] - laser.launcher_m
        aside = from_launcher[:, :, None] * parallax  # (n, 2, n_sheets)
        pixel = wfs.pixel_lambda_over_d(subaperture_m)
        borders = pixel * (np.arange(m + 1) - m / 2)
        beyond = _BEYOND_SIGMA * math.hypot(across, float(np.abs(aside).max()) / 2.0) + 0.5
        n_angles = math.ceil((m * pixel / 2 + beyond) / ANGLE_STEP)
        self.angles = ANGLE_STEP * np.arange(-n_angles, n_angles + 1)
        """``(n_angles,)`` along an axis where the light of a point is wanted, λ/d."""

        past = borders[:, None] - self.angles - aside[..., None, None]
        shares = np.diff(scipy.special.ndtr(past / across), axis=-2)
        self._from_x = shares[:, 0].astype(np.float32)
        """``(n, n_sheets, m, n_angles)``: what pixels of a column of lenslets get of each sheet."""

        weighted = shares[:, 1] * (light / light.sum())[:, None, None]
        self._from_y = weighted.astype(np.float32).reshape(n, _SHEETS * m, -1)

    def on_pixels(self, light: Array) -> Array:
        """Return ``(n, m, n, m)`` of the light of a point ``(n, n_angles, n, n_angles)``."""
        n, n_sheets, m, _ = self._from_x.shape
        along = self._from_y @ light.reshape(n, light.shape[1], -1)
        along = along.reshape(n, n_sheets, m, n, -1).transpose(3, 1, 0, 2, 4)
        seen = along.reshape(n, n_sheets, n * m, -1) @ self._from_x.swapaxes(2, 3)
        return np.asarray(seen.sum(axis=1).reshape(n, n, m, m).transpose(1, 2, 0, 3))
