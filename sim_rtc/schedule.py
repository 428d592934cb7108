"""The true registration in motion: constant, drifting, flexing, wandering, jumping."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, Misregistration

_LARGEST_SHIFT_SUBAP = 0.2
_LARGEST_ROTATION_DEG = 0.3
_LARGEST_MAGNIFICATION = 0.005

_WALK_STEP_S = 20.0
"""Between two knots of a random walk: about what exact optics take to compute, with a margin."""

_LONGEST_SEGMENT_S = 20.0
_SEGMENTS_PER_PERIOD = 12
"""Straight pieces of a sine: they leave it by 3 % of its amplitude at most."""


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
class Flexure:
    """A sinusoid, as the telescope's elevation makes: 0 at time 0, then up to the amplitude."""

    shift_x_subap: float = 0.0
    shift_y_subap: float = 0.0
    rotation_deg: float = 0.0
    magnification: float = 0.0
    period_s: float = 600.0

    def offset(self, time_s: float) -> NDArray[np.float64]:
        """Return the departure at this time, in numeric units."""
        boundary = (self.shift_x_subap, self.shift_y_subap, self.rotation_deg, self.magnification)
        amplitude = np.array(boundary) / BOUNDARY_SCALE
        return np.asarray(amplitude * np.sin(2 * np.pi * time_s / self.period_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """A random walk; the same seed takes the same one, however it is asked for."""

    shift_x_subap: float = 0.0
    """Standard deviation after a minute; it grows with the square root of time."""

    shift_y_subap: float = 0.0
    rotation_deg: float = 0.0
    magnification: float = 0.0
    seed: int = 0

    def offset(self, time_s: float) -> NDArray[np.float64]:
        """Return the departure at this time, in numeric units: straight between knots."""
        boundary = (self.shift_x_subap, self.shift_y_subap, self.rotation_deg, self.magnification)
        sigma = np.array(boundary) / BOUNDARY_SCALE * np.sqrt(_WALK_STEP_S / 60.0)
        position = time_s / _WALK_STEP_S
        n_whole = int(position)
        # A generator's first numbers do not depend on how many are drawn.
        steps = np.random.default_rng(self.seed).standard_normal((n_whole + 1, 4)) * sigma
        return np.asarray(steps[:n_whole].sum(axis=0) + (position - n_whole) * steps[n_whole])


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """Where the mirror lies on the sensor at any time of the run."""

    start: Misregistration
    """At time 0."""

    drift: Drift = Drift()
    flexure: Flexure = Flexure()
    walk: Walk = Walk()
    jumps: tuple[Jump, ...] = ()
    """In any order."""

    @property
    def drifts(self) -> bool:
        """Whether the registration changes between the jumps."""
        moved = [
            self.drift.vector,
            self.flexure.offset(self.flexure.period_s / 4),
            self.walk.offset(_WALK_STEP_S),
        ]
        return bool(np.any(moved))

    @property
    def segment_s(self) -> float:
        """Longest stretch over which the movement between the jumps is as good as straight."""
        if np.any(self.flexure.offset(self.flexure.period_s / 4)):
            return min(_LONGEST_SEGMENT_S, self.flexure.period_s / _SEGMENTS_PER_PERIOD)
        return _LONGEST_SEGMENT_S

    def alpha_at(self, time_s: float) -> Misregistration:
        """Return the registration at this time; a jump belongs to the time after it."""
        vector = self.start.vector + self.drift.vector * time_s
        vector = vector + self.flexure.offset(time_s) + self.walk.offset(time_s)
        for jump in self.jumps:
            if jump.time_s <= time_s:
                vector = vector + jump.vector
        return Misregistration.from_vector(vector)

    def alpha_before(self, time_s: float) -> Misregistration:
        """Return the registration as this time is reached, a jump at that very time left out."""
        earlier = tuple(jump for jump in self.jumps if jump.time_s < time_s)
        return replace(self, jumps=earlier).alpha_at(time_s)

    def next_jump_after(self, time_s: float) -> float:
        """Return the time of the next jump, infinity when there is none."""
        return min((j.time_s for j in self.jumps if j.time_s > time_s), default=float("inf"))


def random_registration(rng: np.random.Generator, nominal_rad: float = 0.0) -> Misregistration:
    """Draw a registration a 400-mode loop can hold: |shift| <= 0.2 subap, 0.3 deg, 0.5 %.

    The rotation is that far from the nominal one.
    """
    radius = _LARGEST_SHIFT_SUBAP * np.sqrt(rng.uniform())
    angle = rng.uniform(0.0, 2 * np.pi)
    return Misregistration.from_vector(
        np.array(
            [
                radius * np.cos(angle),
                radius * np.sin(angle),
                nominal_rad
                + np.deg2rad(rng.uniform(-_LARGEST_ROTATION_DEG, _LARGEST_ROTATION_DEG)),
                1.0 + rng.uniform(-_LARGEST_MAGNIFICATION, _LARGEST_MAGNIFICATION),
            ]
        )
    )
