"""Maps of the plane that turn, scale and shift, as complex numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """``p -> turn * p + shift``, a point being x + iy."""

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
