"""Where a fit leaves something over: in which subapertures, at the border, in which modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.alternatives import border_of

Array = NDArray[np.float64]

STRANGE = 5.0
"""A subaperture, or a mode, that leaves so many times the median is named, ..."""

LEAST = 0.1
"""... from this RMS share of the signal on."""

LARGE = 3.0
"""... and in slopes so many times the median."""

NAMED = 8
"""At most so many are named."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeftOver:
    """Where the residual of a fit is."""

    border: float | None
    """RMS at the border of the pupil over that inside; None: there is no inside."""

    subapertures: tuple[tuple[int, int, float], ...]
    """Row, column and RMS share left over of subapertures that stand out, largest first; axes and
    shares as ``Fit.residual_map`` has them."""

    modes: tuple[tuple[int, float], ...]
    """Basis index and RMS share left over of modes that stand out, largest first."""

    @property
    def words(self) -> str:
        """Where something stands out; empty: nowhere."""
        parts = []
        if self.subapertures:
            named = ", ".join(f"row {y} column {x}" for y, x, _ in self.subapertures)
            parts.append(
                f"subapertures that answer unlike the model ({named}, counted from 0 in the axes "
                f"found) leave up to {self.subapertures[0][2]:.0%}: dead or noisy pixels, dust?"
            )
        if self.modes:
            named = ", ".join(f"{mode} ({share:.0%})" for mode, share in self.modes)
            parts.append(f"modes that fit worse than the others: {named} left over")
        return "; ".join(parts)


def left_over(
    planes: Array, by_mode: Array, *, valid: NDArray[np.bool_], modes: NDArray[np.intp], size: Array
) -> LeftOver:
    """Return where the residual of a fit is.

    Parameters
    ----------
    planes
        ``(n_planes, n, n)`` RMS of what is left over, over the measured RMS.
    by_mode
        ``(n_used,)`` the same of each mode.
    valid
        ``(n, n)`` subapertures that give signals.
    modes
        ``(n_used,)`` basis indices.
    size
        ``(n_used,)`` of the measured columns.
    """
    known = np.isfinite(planes).any(axis=0)
    squares = np.where(np.isfinite(planes), planes, 0.0) ** 2
    by_place = np.full(known.shape, np.nan)
    by_place[known] = np.sqrt(np.mean(squares, axis=0))[known]
    border = border_of(valid)
    at_border, inside = by_place[known & border], by_place[known & ~border]
    return LeftOver(
        border=float(_rms(at_border) / _rms(inside)) if inside.any() and at_border.any() else None,
        subapertures=tuple(_strange_places(by_place, border)),
        modes=tuple(_strange_modes(by_mode, size, modes)),
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _strange_places(by_place: Array, border: NDArray[np.bool_]) -> list[tuple[int, int, float]]:
    """Return subapertures that stand out among those at the border, or inside."""
    found = []
    for part in (border, ~border):
        values = np.where(part & np.isfinite(by_place), by_place, 0.0)
        typical = float(np.median(values[values > 0.0])) if values.any() else 0.0
        places = np.argwhere(values > max(STRANGE * typical, LEAST))
        found += [(int(y), int(x), float(by_place[y, x])) for y, x in places]
    return sorted(found, key=lambda one: -one[2])[:NAMED]


def _strange_modes(shares: Array, size: Array, modes: NDArray[np.intp]) -> list[tuple[int, float]]:
    if not np.isfinite(shares).all():
        return []
    # actuators beyond the pupil hardly move a slope: noise is much of them and strange in none
    left = shares * size
    large = left > LARGE * float(np.median(left))
    places = np.flatnonzero(large & (shares > max(STRANGE * float(np.median(shares)), LEAST)))
    found = [(int(modes[k]), float(shares[k])) for k in places]
    return sorted(found, key=lambda one: -one[1])[:NAMED]
