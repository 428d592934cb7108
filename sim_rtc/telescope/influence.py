"""Influence functions from a file.

The cube contains one map per actuator. Between its points the surface is a cubic B-spline. Beyond
its edge, where the mirror is unknown, it continues at the height of the edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import h5py
import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.files.toml import read_dataset
from service.files.whole import open_hdf5
from service.model.instrument import Instrument

Array = NDArray[np.float64]

_OPTION = "--influence"
_REACH = np.arange(-1, 3)
"""Knots of a cubic spline around a point, from the one below it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InfluenceCube:
    """The mirror's surface for each actuator, centred in the arrays."""

    maps: Array
    """``(n_actuators, ny, nx)`` OPD per OPD commanded to the actuator; a row is along x."""

    pitch_m: float
    """Distance of neighbouring points in the pupil plane."""

    def surface(self, positions_m: Array, moved_m: Array, subaperture_m: float) -> TabulatedSurface:
        """Return the surface in coordinates of subapertures.

        Parameters
        ----------
        positions_m
            ``(n_actuators, 2)`` where the actuators are in the file.
        moved_m
            ``(n_actuators, 2)`` where they are to be: each takes its function along.
        subaperture_m
            Width of a subaperture.
        """
        steps = (moved_m - positions_m)[:, ::-1] / self.pitch_m
        maps = self.maps
        if steps.any():
            maps = np.stack(
                [
                    scipy.ndimage.shift(f, d, mode="nearest")
                    for f, d in zip(maps, steps, strict=True)
                ]
            )
        return TabulatedSurface(
            maps=maps,
            pitch=self.pitch_m / subaperture_m,
            reach=float(np.hypot(*positions_m.T).max()) / subaperture_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TabulatedSurface:
    """A mirror whose shape is the sum of tabulated functions."""

    maps: Array
    """``(n_actuators, ny, nx)``."""

    pitch: float
    """Distance of neighbouring points, in the units of the points to be evaluated."""

    reach: float
    """Distance of the outermost actuator from the middle: there the plate ends."""

    def coefficients(self, strokes: Array, free: tuple[int, ...] = ()) -> Array:
        """Return ``(n_knots, n_shapes)`` spline coefficients of the shapes with these strokes.

        Actuators that are ``free`` go where the surface bends least, the others held: the file
        knows no stiffness, and a plate's energy is that of its curvature.
        """
        if free:
            strokes = strokes.copy()
            strokes[list(free)] = 0.0
            curved = np.column_stack([self._curvature(self.maps[index]) for index in free])
            bent = self._curvature(np.tensordot(strokes.T, self.maps, 1))
            strokes[list(free)] = -np.linalg.lstsq(curved, bent.T, rcond=None)[0]
        shapes = np.tensordot(strokes.T, self.maps, 1)
        return np.stack([scipy.ndimage.spline_filter(shape).ravel() for shape in shapes], axis=1)

    def basis(self, points: Array) -> scipy.sparse.csr_array:
        """Return ``(n_points, n_knots)`` weights of the knots at ``points`` ``(n_points, 2)``."""
        _, n_y, n_x = self.maps.shape
        columns, weights_x = _knots(points[:, 0] / self.pitch, n_x)
        rows, weights_y = _knots(points[:, 1] / self.pitch, n_y)
        knots = rows[:, :, None] * n_x + columns[:, None, :]
        weights = weights_y[:, :, None] * weights_x[:, None, :]
        of_point = np.repeat(np.arange(len(points)), knots[0].size)
        return scipy.sparse.csr_array(
            (weights.ravel(), (of_point, knots.ravel())), shape=(len(points), n_y * n_x)
        )

    def _curvature(self, maps: Array) -> Array:
        """Return the Laplacian of maps ``(..., ny, nx)`` inside the mirror, ``(..., n_inside)``."""
        y, x = (np.arange(n) - (n - 1) / 2 for n in self.maps.shape[1:])
        inside = np.hypot(x, y[:, None]) * self.pitch <= self.reach
        along_y = maps[..., 2:, 1:-1] + maps[..., :-2, 1:-1]
        along_x = maps[..., 1:-1, 2:] + maps[..., 1:-1, :-2]
        return np.asarray((along_x + along_y - 4 * maps[..., 1:-1, 1:-1])[..., inside[1:-1, 1:-1]])


def read_influence(
    reference: str, instrument: Instrument, pitch_m: float | None = None
) -> InfluenceCube:
    """Return the influence functions of a dataset, ``FILE:/dataset``.

    ``pitch_m`` is the distance of neighbouring points in the pupil plane; None: the dataset's own.

    Raises
    ------
    ConfigurationError
        If there are none, or not those of this mirror: one line that names the option.
    """
    maps = read_dataset(reference, Path(), _OPTION)
    mirror = instrument.analytic_mirror
    n_actuators = len(mirror.positions_m)
    if maps.ndim != 3 or len(maps) != n_actuators:
        _refuse(f"shape {maps.shape}", f"({n_actuators}, ny, nx): a map for each actuator")
    if not np.isfinite(maps).all():
        _refuse("values that are not finite", "a surface that goes on smoothly past the mirror")
    pitch_m = _pitch_m(reference) if pitch_m is None else pitch_m
    cube = InfluenceCube(maps=maps.astype(np.float64), pitch_m=pitch_m)
    if pitch_m > mirror.pitch_m:
        _refuse(
            f"{pitch_m:g} m from point to point",
            f"at most the actuators' pitch of {mirror.pitch_m:g} m",
        )
    half_m = pitch_m * (min(maps.shape[1:]) - 1) / 2
    if half_m < instrument.diameter_m / 2:
        _refuse(
            f"{maps.shape[1]} x {maps.shape[2]} points over {2 * half_m:.3g} m",
            f"the whole pupil, {instrument.diameter_m:g} m",
        )
    _refuse_holes(cube, instrument)
    return cube


def _refuse_holes(cube: InfluenceCube, instrument: Instrument) -> None:
    """Refuse maps that end with the pupil: the mirror's image moves, and nothing is no surface."""
    y, x = (cube.pitch_m * (np.arange(n) - (n - 1) / 2) for n in cube.maps.shape[1:])
    radius_m = np.hypot(x, y[:, None])
    outer_m = instrument.diameter_m / 2
    seen = (radius_m <= outer_m) & (radius_m >= outer_m * instrument.obscuration_ratio)
    n_empty = int(np.count_nonzero(~cube.maps.any(axis=0) & seen))
    if n_empty:
        _refuse(
            f"{n_empty} points of the pupil where every function is 0",
            "a surface that goes on smoothly past the mirror",
        )


def _pitch_m(reference: str) -> float:
    """Return the dataset's own pitch."""
    name, _, dataset = reference.rpartition(":/")
    found = None
    if h5py.is_hdf5(name):
        with open_hdf5(name) as opened:
            found = opened[dataset].attrs.get("pitch_m")
    try:
        pitch_m = float(np.asarray(found).item())
    except (TypeError, ValueError):
        _refuse(f"no number in the attribute pitch_m of {reference}", "one, or --influence-pitch")
    if not 0.0 < pitch_m < np.inf:
        _refuse(f"the attribute pitch_m = {pitch_m:g}", "metres, above 0")
    return pitch_m


def _knots(places: Array, n: int) -> tuple[NDArray[np.intp], Array]:
    """Return the four knots around every place and their weights, each ``(n_points, 4)``.

    Places count from the middle of ``n`` points; knots outside are mirrored at the outermost ones,
    as the prefilter takes them.
    """
    index = np.clip(places + (n - 1) / 2, 0.0, n - 1.0)
    below = np.floor(index).astype(np.intp)
    t = (index - below)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 1 + 3 * t * (1 + t - t**2), t**3])
    knots = np.abs(below[:, None] + _REACH)
    return np.where(knots > n - 1, 2 * (n - 1) - knots, knots), weights / 6.0


def _refuse(found: str, expected: str) -> NoReturn:
    raise ConfigurationError(f"{_OPTION}: found {found}; expected {expected}")
