"""The true registration in motion: constant, drifting, jumping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, Misregistration

_LARGEST_SHIFT_SUBAP = 0.2
_LARGEST_ROTATION_DEG = 0.3
_LARGEST_MAGNIFICATION = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class Jump:
    """A sudden change of the registration."""

    time_s: float
    """When, seconds of loop time."""

    shift_x_subap: float = 0.0
    shift_y_subap: float = 0.0
    rotation_deg: float = 0.0
    magnification: float = 0.0
    """Change of the ratio: 0.002 makes the image 0.2 % of its nominal size larger."""

    @property
    def vector(self) -> NDArray[np.float64]:
        """The change in numeric units: shifts in subapertures, rotation in radians, ratio."""
        boundary = (self.shift_x_subap, self.shift_y_subap, self.rotation_deg, self.magnification)
        return np.asarray(np.array(boundary) / BOUNDARY_SCALE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """A steady change of the registration, per minute."""

    shift_x_subap: float = 0.0
    shift_y_subap: float = 0.0
    rotation_deg: float = 0.0
    magnification: float = 0.0

    @property
    def vector(self) -> NDArray[np.float64]:
        """The rate in numeric units per second."""
        boundary = (self.shift_x_subap, self.shift_y_subap, self.rotation_deg, self.magnification)
        return np.asarray(np.array(boundary) / BOUNDARY_SCALE / 60.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """Where the mirror lies on the sensor at any time of the run."""

    start: Misregistration
    """At time 0."""

    drift: Drift = Drift()
    jumps: tuple[Jump, ...] = ()
    """In any order."""

    @property
    def drifts(self) -> bool:
        """Whether the registration changes between the jumps."""
        return bool(np.any(self.drift.vector))

    def alpha_at(self, time_s: float) -> Misregistration:
        """Return the registration at this time; a jump belongs to the time after it."""
        vector = self.start.vector + self.drift.vector * time_s
        for jump in self.jumps:
            if jump.time_s <= time_s:
                vector = vector + jump.vector
        return Misregistration.from_vector(vector)

    def alpha_before(self, time_s: float) -> Misregistration:
        """Return the registration as this time is reached, a jump at that very time left out."""
        earlier = tuple(jump for jump in self.jumps if jump.time_s < time_s)
        return Schedule(start=self.start, drift=self.drift, jumps=earlier).alpha_at(time_s)

    def next_jump_after(self, time_s: float) -> float:
        """Return the time of the next jump, infinity when there is none."""
        return min((j.time_s for j in self.jumps if j.time_s > time_s), default=float("inf"))


def random_registration(rng: np.random.Generator) -> Misregistration:
    """Draw a registration a 400-mode loop can hold: |shift| <= 0.2 subap, 0.3 deg, 0.5 %."""
    radius = _LARGEST_SHIFT_SUBAP * np.sqrt(rng.uniform())
    angle = rng.uniform(0.0, 2 * np.pi)
    return Misregistration.from_vector(
        np.array(
            [
                radius * np.cos(angle),
                radius * np.sin(angle),
                np.deg2rad(rng.uniform(-_LARGEST_ROTATION_DEG, _LARGEST_ROTATION_DEG)),
                1.0 + rng.uniform(-_LARGEST_MAGNIFICATION, _LARGEST_MAGNIFICATION),
            ]
        )
    )
