"""Where the telescope looks: gravity bends it differently there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Pointing:
    """A direction of the telescope."""

    elevation_deg: float
    """Above the horizon, degrees."""

    azimuth_deg: float
    """From north over east, degrees; only differences count."""

    def separation_deg(self, other: Pointing) -> float:
        """Return the angle on the sky between two directions, degrees."""
        return float(np.rad2deg(np.arccos(np.clip(self._unit() @ other._unit(), -1.0, 1.0))))

    def _unit(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        elevation, azimuth = np.deg2rad([self.elevation_deg, self.azimuth_deg])
        return np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
