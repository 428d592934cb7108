"""Locate the residual of a fit: subapertures, border, spider arms and modes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OUTLIER_RATIO = 5.0
"""Residual of a subaperture or mode, over the median, above which it is listed."""

MIN_RESIDUAL = 0.1
"""Smallest residual that is listed, as RMS share of the signal."""

MIN_SLOPE_RATIO = 3.0
"""Residual of a mode in slopes, over the median, above which the mode is listed."""

MAX_LISTED = 8
"""Largest number of subapertures or modes listed."""


RIM_RATIO = 1.8
"""Residual at the border over that inside, above which it is reported."""

PLANE_RATIO = 1.25
"""Residual of one slope component over the mean of both, above which it is reported."""

MIN_GRADIENT = 0.6
"""Change of the residual across the pupil over its mean, above which it is reported."""

ARM_EXCESS = 1.35
"""Residual along an arm over that elsewhere at the same radius, above which it is reported."""

ARM_SIGMA = 6.0
"""Significance of the excess along an arm above which it is reported, σ of the mean."""

MIN_ARMS, MAX_ARMS = 2, 4

_ARM_ANGLES = np.arange(0.0, 360.0, 3.0)

_ARM_OFFSETS = np.arange(-0.25, 0.2501, 0.0625)
"""Trial distances of an arm's line from the centre, pupil radii: not all arms are radial."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """A line outwards from the centre of the pupil with an increased residual."""

    angle_deg: float
    """Direction from +x towards +y in the fitted axes, degrees."""

    offset_subap: float
    """Distance of the line from the centre, positive to its left, subapertures; 0 is radial."""

    excess: float
    """Residual along the line over that elsewhere at the same radius."""

    @property
    def words(self) -> str:
        """Position and size as text."""
        off = f", {self.offset_subap:+.1f} subapertures off" if self.offset_subap else ""
        return f"{self.angle_deg:.0f} deg{off} ({self.excess:.1f} times as much)"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualLocation:
    """Location of the residual of a fit."""

    border: float | None
    """RMS at the border of the pupil over that inside; None if there is no inside."""

    subapertures: tuple[tuple[int, int, float], ...]
    """Row, column and RMS share of subapertures with an outlying residual, largest first; axes and
    shares as in ``Fit.residual_map``."""

    modes: tuple[tuple[int, float], ...]
    """Basis index and RMS share of modes with an outlying residual, largest first."""

    level: float = 1.0
    """RMS share of the signal in the residual of all subapertures."""

    arms: tuple[Arm, ...] = ()
    """Lines outwards from the centre with an increased residual, the clearest first."""

    planes: tuple[float, ...] = ()
    """Residual RMS of each signal plane (Sx and Sy, or the four images) over the mean."""

    gradient: tuple[float, float] = (0.0, 0.0)
    """Change of the residual across the pupil along x and along y, over its mean."""

    @property
    def _shape_words(self) -> Iterator[str]:
        """Sentences on arms, rim, planes and gradient."""
        if self.arms:
            named = ", ".join(arm.words for arm in self.arms)
            yield (
                f"lines from the middle outwards, as the arms of a secondary make: {named} "
                "(spiders_m, spiders_deg)"
            )
        if self.border is not None and self.border > RIM_RATIO:
            yield (
                f"the rim leaves {self.border:.1f} times as much as the inside "
                "(pupil_diameter_subap, valid_subapertures)"
            )
        # Planes of pixels are the images of a pyramid, which have no x and y.
        if len(self.planes) == 2 and max(self.planes) > PLANE_RATIO:
            worse = "x" if self.planes[0] > self.planes[1] else "y"
            yield (
                f"S{worse} leaves {max(self.planes) / min(self.planes):.1f} times as much as the "
                "other component"
            )
        if np.hypot(*self.gradient) > MIN_GRADIENT:
            angle = np.rad2deg(np.arctan2(self.gradient[1], self.gradient[0]))
            yield (
                f"it grows by {np.hypot(*self.gradient):.0%} of its mean across the pupil towards "
                f"{angle:.0f} deg: light that is uneven (--flux-map, --gain-map)"
            )

    @property
    def words(self) -> str:
        """Sentence on outlying parts of the residual; empty if there are none."""
        parts = list(self._shape_words) if self.level > MIN_RESIDUAL else []
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


def locate_residual(
    planes: Array, by_mode: Array, *, valid: NDArray[np.bool_], modes: NDArray[np.intp], size: Array
) -> ResidualLocation:
    """Return the location of a fit's residual.

    Parameters
    ----------
    planes
        ``(n_planes, n, n)`` RMS of the residual over the measured RMS.
    by_mode
        ``(n_used,)`` the same for each mode.
    valid
        ``(n, n)`` valid subapertures.
    modes
        ``(n_used,)`` basis indices.
    size
        ``(n_used,)`` norms of the measured columns.
    """
    by_place = _combine_planes(planes)
    known, border = np.isfinite(by_place), find_border(valid)
    at_border, inside = by_place[known & border], by_place[known & ~border]
    return ResidualLocation(
        border=float(_rms(at_border) / _rms(inside)) if inside.any() and at_border.any() else None,
        subapertures=tuple(_find_outlying_places(by_place, border)),
        modes=tuple(_find_outlying_modes(by_mode, size, modes)),
        level=_rms(by_place[known]),
        arms=tuple(_find_arms(by_place)),
        planes=_by_plane(planes),
        gradient=_gradient(by_place),
    )


def find_border(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the valid subapertures ``(n, n)`` that have an invalid neighbour."""
    # Padded with False: subapertures at the edge of the grid are at the border.
    wide = np.pad(valid, 1)
    inside = wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:]
    return np.asarray(valid & ~inside)


def _by_plane(planes: Array) -> tuple[float, ...]:
    """Return the RMS of each plane over the mean of all; 1 if there is no residual."""
    each = np.sqrt(np.nanmean(planes**2, axis=(1, 2)))
    mean = float(np.mean(each))
    return tuple(float(one / mean) if mean > 0.0 else 1.0 for one in each)


def _gradient(by_place: Array) -> tuple[float, float]:
    """Return the change of the residual across the pupil along x and y over the mean."""
    rows, columns = np.nonzero(np.isfinite(by_place))
    values = by_place[rows, columns]
    if len(values) < _FEWEST_PLACES or not values.mean() > 0.0:
        return 0.0, 0.0
    half = max(np.ptp(rows), np.ptp(columns)) / 2.0
    plane = np.column_stack([np.ones(len(values)), columns - columns.mean(), rows - rows.mean()])
    _, x, y = np.linalg.lstsq(plane, values, rcond=None)[0] * 2.0 * half / values.mean()
    return float(x), float(y)


def _combine_planes(planes: Array) -> Array:
    """Return the RMS residual of each subaperture ``(n, n)``, of all signal planes."""
    known = np.isfinite(planes)
    rms = np.sqrt(np.mean(np.where(known, planes, 0.0) ** 2, axis=0))
    return np.where(known.any(axis=0), rms, np.nan)


def find_arms(planes: Array) -> tuple[Arm, ...]:
    """Return the arms in a residual map ``(n_planes, n, n)``, the clearest first."""
    by_place = _combine_planes(planes)
    level = _rms(by_place[np.isfinite(by_place)])
    return tuple(_find_arms(by_place)) if level > MIN_RESIDUAL else ()


def _find_arms(by_place: Array) -> list[Arm]:
    """Return lines with an increased residual, the clearest first."""
    rows, columns = np.nonzero(np.isfinite(by_place))
    if len(rows) < _FEWEST_PLACES:
        return []
    middle = (np.array(by_place.shape) - 1) / 2
    x, y = columns - middle[1], rows - middle[0]
    radius = float(np.hypot(x, y).max())
    excess = _excess(by_place[rows, columns], np.hypot(x, y) / radius)
    # Robust, so that the arms themselves do not widen the scatter that they are compared with.
    scatter = 1.4826 * float(np.median(np.abs(excess - np.median(excess))))
    found: list[tuple[float, Arm]] = []
    for angle in _ARM_ANGLES:
        along, across = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        forward, left = along * x + across * y, along * y - across * x
        for offset in _ARM_OFFSETS * radius:
            on = (np.abs(left - offset) < _ARM_WIDTH) & (forward > 0.35 * radius)
            if on.sum() < _FEWEST_ALONG:
                continue
            # the median, so that a single bad subaperture does not look like an arm
            mean = float(np.median(excess[on]))
            significance = (mean - 1.0) / max(scatter * 1.25 / np.sqrt(on.sum()), 1e-9)
            if mean <= ARM_EXCESS or significance <= ARM_SIGMA:
                continue
            neighbours = (np.abs(np.abs(left - offset) - 3.0 * _ARM_WIDTH) < _ARM_WIDTH) & (
                forward > 0.35 * radius
            )
            if not neighbours.any() or mean < ARM_EXCESS * float(
                np.quantile(excess[neighbours], 0.7)
            ):
                continue  # a broad feature, such as uneven light, is not an arm
            arm = Arm(angle_deg=float(angle), offset_subap=round(float(offset), 1), excess=mean)
            found.append((significance, arm))
    return _select_directions(found)


def _excess(values: Array, away: Array) -> Array:
    """Return values over the median of their ring; ``away`` is 1 at the edge."""
    ring = np.minimum((away * _RINGS).astype(int), _RINGS - 1)
    typical = np.ones(_RINGS)
    # Ring by ring, because the border leaves more than the inside without any arm.
    for k in np.unique(ring):
        typical[k] = np.median(values[ring == k])
    return np.asarray(values / np.where(typical > 0.0, typical, 1.0)[ring])


def _select_directions(found: list[tuple[float, Arm]]) -> list[Arm]:
    """Return the clearest of lines with similar direction; a single line is not a spider."""
    chosen: list[Arm] = []
    for _, arm in sorted(found, key=lambda one: -one[0]):
        apart = [abs((arm.angle_deg - other.angle_deg + 180.0) % 360.0 - 180.0) for other in chosen]
        # neighbouring trial lines cover the same subapertures
        if all(one > _ARMS_APART_DEG for one in apart):
            chosen.append(arm)
    return chosen[:MAX_ARMS] if len(chosen) >= MIN_ARMS else []


_FEWEST_PLACES, _FEWEST_ALONG, _RINGS = 100, 5, 6

_ARM_WIDTH = 0.75
"""Half width of a line, subapertures."""

_ARMS_APART_DEG = 35.0


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _find_outlying_places(
    by_place: Array, border: NDArray[np.bool_]
) -> list[tuple[int, int, float]]:
    """Return outlying subapertures, compared separately at the border and inside."""
    found = []
    # The border leaves more in general: a common median would list all of it.
    for part in (border, ~border):
        values = np.where(part & np.isfinite(by_place), by_place, 0.0)
        typical = float(np.median(values[values > 0.0])) if values.any() else 0.0
        places = np.argwhere(values > max(OUTLIER_RATIO * typical, MIN_RESIDUAL))
        found += [(int(y), int(x), float(by_place[y, x])) for y, x in places]
    return sorted(found, key=lambda one: -one[2])[:MAX_LISTED]


def _find_outlying_modes(
    shares: Array, size: Array, modes: NDArray[np.intp]
) -> list[tuple[int, float]]:
    if not np.isfinite(shares).all():
        return []
    # actuators outside the pupil hardly change a slope, so their large relative residual is noise
    left = shares * size
    large = left > MIN_SLOPE_RATIO * float(np.median(left))
    places = np.flatnonzero(
        large & (shares > max(OUTLIER_RATIO * float(np.median(shares)), MIN_RESIDUAL))
    )
    found = [(int(modes[k]), float(shares[k])) for k in places]
    return sorted(found, key=lambda one: -one[1])[:MAX_LISTED]
