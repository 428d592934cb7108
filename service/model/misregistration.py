"""The mis-registration α."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError

PARAMETERS = ("shift_x_subap", "shift_y_subap", "rotation_deg", "magnification")
"""Names of the four parameters at every boundary, in the order of every 4-vector and covariance."""

BOUNDARY_SCALE = np.array([1.0, 1.0, 180.0 / np.pi, 1.0])
"""Multiply a 4-vector in numeric units (rotation in radians) by this to get boundary units."""

COVARIANCE_SCALE = np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
"""The same for a covariance."""

METRE_DECADES = {"nanometres": 9, "micrometres": 6, "millimetres": 3}
"""Powers of ten by which numbers in these units are too large."""


def unit_like(too_large: float, within_decades: float) -> str:
    """Return in which unit numbers would be so many times too large; empty: in none of them."""
    decades = np.log10(too_large)
    unit = min(METRE_DECADES, key=lambda unit: abs(METRE_DECADES[unit] - decades))
    return unit if abs(METRE_DECADES[unit] - decades) < within_decades else ""


def wrap_angle(angle_rad: float) -> float:
    """Return the angle in -pi..pi."""
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


@dataclass(frozen=True, slots=True, kw_only=True)
class Misregistration:
    """Registration of the mirror's actuators on the sensor's subapertures.

    A mirror point ``p`` lands on the sensor at ``S(anamorphosis) magnification R(rotation) p +
    shift`` (Heritier et al. 2018, section 4.1, equation 6; S is ours, 1 where the image is not
    stretched). The default is perfect registration.
    """

    shift_x_subap: float = 0.0
    """Shift along sensor +x, in subaperture widths."""

    shift_y_subap: float = 0.0
    """Shift along sensor +y, in subaperture widths."""

    rotation_rad: float = 0.0
    """Rotation from sensor +x towards +y, in radians."""

    magnification: float = 1.0
    """Size of the mirror's image over its nominal size."""

    anamorphosis: tuple[float, float] | None = None
    """Stretch of the turned image along the sensor's x over the mean of both axes, ratio less 1,
    and along 45 deg; the axis across shrinks by as much. None: the instrument's nominal one."""

    def __post_init__(self) -> None:
        """Refuse numbers no registration can have.

        Raises
        ------
        ModelError
            If a parameter is not finite, the magnification is not positive, or a stretch leaves
            nothing of the image.
        """
        if not np.all(np.isfinite(self.vector)) or self.magnification <= 0.0:
            raise ModelError(f"a registration needs finite numbers and a magnification > 0: {self}")
        if not np.hypot(*self.stretches) < 1.0:
            raise ModelError(f"found anamorphosis = {self.anamorphosis}, expected less than 1")

    @override
    def __str__(self) -> str:
        """Return it for a person."""
        x, y, turned, size = self.to_boundary().values()
        return f"({x:+.2f}, {y:+.2f} subap, {turned:+.2f} deg, {size:.4f})"

    @property
    def rotation_deg(self) -> float:
        """Rotation from sensor +x towards +y, in degrees."""
        return float(np.rad2deg(self.rotation_rad))

    @property
    def vector(self) -> NDArray[np.float64]:
        """Numeric 4-vector: shifts in subapertures, rotation in radians, magnification."""
        return np.array(
            [self.shift_x_subap, self.shift_y_subap, self.rotation_rad, self.magnification]
        )

    @property
    def stretches(self) -> NDArray[np.float64]:
        """Anamorphosis, ``(2,)``; 0 if none is given."""
        return np.array(self.anamorphosis or (0.0, 0.0))

    @classmethod
    def from_vector(cls, vector: NDArray[np.float64]) -> Self:
        """Build from a numeric 4-vector (shape ``(4,)``, rotation in radians)."""
        x, y, turned, size = map(float, vector)
        return cls(shift_x_subap=x, shift_y_subap=y, rotation_rad=turned, magnification=size)

    def with_vector(self, vector: NDArray[np.float64]) -> Self:
        """Return the registration with another 4-vector; the anamorphosis stays."""
        return replace(self.from_vector(vector), anamorphosis=self.anamorphosis)

    def add_step(self, step: NDArray[np.float64]) -> Self:
        """Return the registration a step ``(4,)`` further, numeric units."""
        return self.with_vector(self.vector + step)

    def step_to(self, other: Self) -> NDArray[np.float64]:
        """Return the step ``(4,)`` to another registration, numeric units, by the shorter turn."""
        step = other.vector - self.vector
        step[2] = wrap_angle(float(step[2]))
        return step

    def with_anamorphosis(self, stretches: NDArray[np.float64]) -> Self:
        """Return the registration with another anamorphosis ``(2,)``."""
        return replace(self, anamorphosis=(float(stretches[0]), float(stretches[1])))

    def distance(self, other: Self) -> NDArray[np.float64]:
        """Return the absolute differences ``(4,)`` from another registration, numeric units.

        The difference in magnification includes that of the anamorphosis.
        """
        apart = np.abs(self.vector - other.vector)
        # A stretch displaces the rim as a magnification of the same size does.
        apart[3] += float(np.abs(self.stretches - other.stretches).max())
        return apart

    @property
    def image(self) -> NDArray[np.float64]:
        """``(2, 2)`` from a point of the mirror to the sensor, before the shift."""
        turned = self.magnification * rotation(self.rotation_rad)
        return turned if self.anamorphosis is None else stretch_matrix(self.stretches) @ turned

    def on_mirror(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return mirror positions of sensor points ``(n_points, 2)``, without the shift."""
        if self.anamorphosis is not None:
            # Undone first, because it acts last on the way from the mirror to the sensor.
            points = points @ np.linalg.inv(stretch_matrix(self.stretches))
        return points @ rotation(self.rotation_rad) / self.magnification

    @classmethod
    def from_boundary(cls, values: dict[str, float]) -> Self:
        """Build from the four named numbers used on the wire, in files and in REST (degrees)."""
        vector = np.array([values[name] for name in PARAMETERS]) / BOUNDARY_SCALE
        return cls.from_vector(vector)

    def to_boundary(self) -> dict[str, float]:
        """Return the four named numbers used on the wire, in files and in REST (degrees)."""
        return at_boundary(self.vector)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Determination:
    """A registration and its covariance."""

    alpha: Misregistration
    """The registration."""

    covariance: NDArray[np.float64]
    """``(4, 4)`` of it, numeric units (subapertures, radians, ratio)."""

    @property
    def sigma(self) -> NDArray[np.float64]:
        """``(4,)`` 1 σ, numeric units."""
        return np.sqrt(np.diag(self.covariance))

    def sigma_to_boundary(self) -> dict[str, float]:
        """Return 1 σ of the four named numbers used in files and in REST (degrees)."""
        return at_boundary(self.sigma)


def step_text(step: NDArray[np.float64]) -> str:
    """Return a change of α ``(4,)``, numeric units, for a person."""
    x, y, turned, size = step * BOUNDARY_SCALE
    return f"{x:+.3f}, {y:+.3f} subap, {turned:+.3f} deg, {size:+.4f}"


def at_boundary(four: NDArray[np.float64]) -> dict[str, float]:
    """Return α or its σ, ``(4,)`` in numeric units, as four named numbers in boundary units."""
    return dict(zip(PARAMETERS, (four * BOUNDARY_SCALE).tolist(), strict=True))


def stretch_matrix(stretches: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return S of an anamorphosis ``(2,)``: symmetric, so that rows are stretched by it, too."""
    along, askew = stretches
    return np.array([[1.0 + along, askew], [askew, 1.0 - along]])


def rotation(angle_rad: float) -> NDArray[np.float64]:
    """Return R with ``R @ p`` turned from +x towards +y; ``p @ R`` turns rows back."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])
