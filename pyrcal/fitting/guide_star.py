"""A guide star, and where along its light a mirror at an altitude is seen on the pupil.

The one rule of parallax and cone. The light that a star at height H sends through the point p of
the pupil crosses the altitude h at ``q = (1 - h / H) p + h θ``, θ the star's direction. So a point
q of a mirror there is seen at ``p = (q - h θ) / (1 - h / H)``: shifted by the parallax, and
magnified because a cone narrows towards its tip. Heights and altitudes are distances from the
pupil along the line of sight, and may be negative.

References
----------
Agapito, Plantet & Heritier 2024, Proc. SPIE 13097, 130975P, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.misregistration import Misregistration


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """A map of the plane that turns, scales and shifts: ``p -> turn * p + shift``, p = x + iy."""

    turn: complex = 1 + 0j
    """Its size scales, its phase turns from +x towards +y."""

    shift: complex = 0j
    """Image of the origin."""

    @classmethod
    def of(cls, alpha: Misregistration) -> Similarity:
        """Return the map that a registration is; lengths in subapertures."""
        x, y, angle_rad, magnification = alpha.vector
        return cls(turn=magnification * complex(np.exp(1j * angle_rad)), shift=complex(x, y))

    @property
    def alpha(self) -> Misregistration:
        """The registration that this map is, if its lengths are subapertures."""
        return Misregistration(
            shift_x_subap=self.shift.real,
            shift_y_subap=self.shift.imag,
            rotation_rad=float(np.angle(self.turn)),
            magnification=abs(self.turn),
        )

    def after(self, first: Similarity) -> Similarity:
        """Return the map that does ``first``, then this."""
        return Similarity(turn=self.turn * first.turn, shift=self.turn * first.shift + self.shift)

    @property
    def inverse(self) -> Similarity:
        """The map back."""
        return Similarity(turn=1.0 / self.turn, shift=-self.shift / self.turn)

    def scale_unit(self, unit: float) -> Similarity:
        """Return the same map of lengths in another unit, ``unit`` of the old ones long."""
        return Similarity(turn=self.turn, shift=self.shift / unit)

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where points ``(n, 2)`` land."""
        landed = self.turn * (points[:, 0] + 1j * points[:, 1]) + self.shift
        return np.column_stack([landed.real, landed.imag])


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideStar:
    """Direction and height of a guide star."""

    direction_rad: complex = 0j
    """Direction x + iy on the sky, radians, in the pupil's axes: light from +x at an altitude is
    displaced towards +x."""

    height_m: float = inf
    """Height of a laser guide star along the line of sight, metres; infinite for a natural star."""

    def project_plane(self, altitude_m: float) -> Similarity:
        """Return where points of a plane at this altitude are seen on the pupil, metres.

        Raises
        ------
        ModelError
            If the plane is not below the star: none of its light comes through it.
        """
        if not altitude_m < self.height_m:
            raise ModelError(
                f"found a mirror at an altitude of {altitude_m:g} m and a star at "
                f"{self.height_m:g} m, expected the mirror below the star"
            )
        magnification = 1.0 / (1.0 - altitude_m / self.height_m)
        return Similarity(
            turn=complex(magnification), shift=-magnification * altitude_m * self.direction_rad
        )
