"""α over time from the ``TRANSFORMATION_MATRIX`` of a mirror in an AOT file.

The standard has matrices ``(3, 3, t)`` that act on ``(x, y, 1)`` of the mirror, metres in the
pupil. Any of them without reflection is an α of six numbers: a symmetric stretch followed by a
rotation. One with reflection is the same with ``parity = -1``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation

Aot = Any
"""An object of aotpy, which has no types."""

LARGEST_STRETCH = 0.2
"""Largest anamorphosis that an instrument file accepts."""

NO_STRETCH = 1e-6
"""Largest stretch from rounding of the standard's numbers."""

SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Dated:
    """α with its time."""

    t_ns_utc: int | None
    """UTC, nanoseconds; None if the file does not give it."""

    alpha: Misregistration


@dataclass(frozen=True, slots=True, kw_only=True)
class Registrations:
    """Registration of a mirror over time from a file."""

    over_time: tuple[Dated, ...]
    """Values in the file's order, at least one."""

    parity: int
    """-1 if the mirror is seen from behind, at all times."""

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return α ``(t, 4)`` in boundary units, stretches ``(t, 2)``, and the times if known."""
        result = {
            "registration": np.array([at.alpha.vector for at in self.over_time]) * BOUNDARY_SCALE,
            "registration_anamorphosis": np.array([at.alpha.stretches for at in self.over_time]),
        }
        times = [at.t_ns_utc for at in self.over_time if at.t_ns_utc is not None]
        if times:
            result["registration_t_ns_utc"] = np.array(times, np.int64)
        return result

    @property
    def mirror(self) -> dict[str, Any]:
        """Return the keys of ``[mirror]`` that start a fit at the rotation of the last α."""
        alpha = self.over_time[-1].alpha
        return {
            "nominal_rotation_deg": float(np.rad2deg(alpha.rotation_rad)),
            "parity": self.parity,
        }

    @property
    def text(self) -> str:
        """Return a sentence on the values that were read."""
        last = self.over_time[-1].alpha
        stretch = (
            ""
            if last.anamorphosis is None
            else ", anamorphosis {:+.4f}, {:+.4f}".format(*last.anamorphosis)
        )
        behind = "; it is mirrored (parity = -1)" if self.parity < 0 else ""
        times = f"{len(self.over_time)} times, last " if len(self.over_time) > 1 else ""
        return f"the file's own alpha: {times}{last}{stretch}{behind}; a fit starts at its rotation"


def registrations_of(image: Aot, subaperture_m: float, where: str) -> Registrations:
    """Return α over time from aotpy's image of the matrices.

    Parameters
    ----------
    image
        ``aotpy.Image`` with data ``(3, 3, t)`` or ``(3, 3)``, metres, and perhaps a time.
    subaperture_m
        Width of a subaperture in the pupil.
    where
        What the messages begin with.

    Raises
    ------
    MatrixError
        If it is no such matrix, or none that an α can be: what was found and expected.
    """
    where = f"{where}: transformation_matrix"
    if image.unit not in {None, "", "m"}:
        raise MatrixError(f"{where}: found the unit {image.unit}, expected metres")
    found = np.asarray(image.data)
    if found.ndim == 2:
        found = found[..., np.newaxis]
    if found.ndim != 3 or found.shape[:2] != (3, 3) or not found.size:
        raise MatrixError(f"{where}: found shape {found.shape}, expected (3, 3, t)")
    each = np.moveaxis(found.astype(np.float64), -1, 0)
    if not np.isfinite(each).all():
        raise MatrixError(f"{where}: found a number that is not finite, expected none")
    if not np.allclose(each[:, 2], [0.0, 0.0, 1.0], rtol=0.0, atol=1e-6):
        raise MatrixError(
            f"{where}: found the last row {each[0, 2].tolist()}, expected 0 0 1: transposed, or of "
            "row vectors?"
        )
    # A mirror that is seen from behind stays so: one parity holds at all times.
    signs = np.sign(np.linalg.det(each[:, :2, :2]))
    if not (np.all(signs == 1.0) or np.all(signs == -1.0)):
        raise MatrixError(
            f"{where}: found matrices that mirror and such that do not, or one that leaves no "
            "image; expected one parity"
        )
    times = _times(image.time, len(each), where)
    parity = int(signs[0])
    alphas = [_alpha(matrix, parity, subaperture_m, where) for matrix in each]
    dated = (Dated(t_ns_utc=t, alpha=a) for t, a in zip(times, alphas, strict=True))
    return Registrations(over_time=tuple(dated), parity=parity)


def _alpha(
    matrix: NDArray[np.float64], parity: int, subaperture_m: float, where: str
) -> Misregistration:
    """Return the α of one matrix ``(3, 3)``."""
    # The reflection of y is in the parity of the mirror, not in α.
    alpha = decompose(matrix[:2, :2] * [1.0, parity], matrix[:2, 2] / subaperture_m)
    stretch = np.hypot(*alpha.stretches)
    if stretch > LARGEST_STRETCH:
        raise MatrixError(
            f"{where}: found an image stretched by {stretch:.2f}, expected at most "
            f"{LARGEST_STRETCH}"
        )
    return alpha


def decompose(linear: NDArray[np.float64], shift_subap: NDArray[np.float64]) -> Misregistration:
    """Return the α of an image ``(2, 2)`` of the mirror: a symmetric stretch times a rotation."""
    turn = float(np.arctan2(linear[1, 0] - linear[0, 1], np.trace(linear)))
    stretch = linear @ rotation(-turn)
    size = float(np.trace(stretch)) / 2.0
    alpha = Misregistration(
        shift_x_subap=float(shift_subap[0]),
        shift_y_subap=float(shift_subap[1]),
        rotation_rad=turn,
        magnification=size,
    ).with_anamorphosis(stretch[0] / size - [1.0, 0.0])
    # A rounding error must not turn an unstretched image into one with an anamorphosis of its own.
    return (
        alpha if np.abs(alpha.stretches).max() > NO_STRETCH else replace(alpha, anamorphosis=None)
    )


def affine(alpha: Misregistration, subaperture_m: float) -> NDArray[np.float64]:
    """Return ``(3, 3)``, from ``(x, y, 1)`` on the mirror to the sensor, metres in the pupil."""
    matrix = np.eye(3)
    matrix[:2, :2] = alpha.image
    matrix[:2, 2] = alpha.vector[:2] * subaperture_m
    return matrix


def _times(time: Aot, n: int, where: str) -> Sequence[int | None]:
    """Return UTC nanoseconds; times written from nanoseconds are restored to the same double."""
    # A Fraction, because seconds times 1e9 would be rounded to a multiple of 256 ns.
    stamps = [] if time is None else list(time.timestamps)
    if not stamps:
        return [None] * n
    if len(stamps) != n or not np.isfinite(stamps).all():
        raise MatrixError(f"{where}: found {len(stamps)} times of {n} matrices, expected one each")
    return [round(Fraction(float(stamp)) * SECOND_NS) for stamp in stamps]
