"""A contact sheet of the loop closing: pupil images, slopes, what is left to correct."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from sim_rtc.assembly import Telescope
from sim_rtc.diffractive_plant import DiffractiveOptics
from sim_rtc.feed import BATCH_FRAMES
from sim_rtc.telemetry import Batch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_MOMENTS = (0, 20, 60, 300)
"""Frames shown: open loop, closing, nearly closed, closed."""

_INCHES = 3.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """One frame of the loop, as maps ``[y, x]``; what is not lit is NaN."""

    frame: int
    """Number of the frame since the loop was closed."""

    images: Array
    """``(2 n, 2 n)`` light in the four pupil images, over that of a fully lit pixel."""

    slopes: tuple[Array, Array]
    """``(n, n)`` along x and along y."""

    residual_nm: Array
    """Wavefront left over, piston removed, nm."""

    error_nm: float
    """RMS of it over the pupil."""


def moments(telescope: Telescope) -> Iterator[Moment]:
    """Close the loop of a telescope that has not begun yet; yield the moments that are shown."""
    computer = telescope.computer(iter(telescope.feed.blocks()))
    for frame in range(0, _MOMENTS[-1] + 1, BATCH_FRAMES):
        batch = computer.next_batch()
        if frame in _MOMENTS:
            yield _moment(telescope, batch, frame)


def write_snapshot(telescope: Telescope, path: Path) -> None:
    """Write the contact sheet as an image of the kind the file's name says.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed, or the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigurationError(
            "--snapshot: needs matplotlib; expected pyrcal installed with its extra 'plots'"
        ) from error
    rows = list(moments(telescope))
    figure = Figure(figsize=(4 * _INCHES, len(rows) * _INCHES), layout="constrained")
    axes = figure.subplots(len(rows), 4, squeeze=False)
    slope = 3.0 * float(np.nanstd(rows[0].slopes))
    for moment, (images, along_x, along_y, left) in zip(rows, axes, strict=True):
        images.set_ylabel(f"frame {moment.frame}")
        _show(images, moment.images, "four pupil images, mean 1", (0.0, None), "inferno")
        for axis, values, name in zip((along_x, along_y), moment.slopes, "xy", strict=True):
            _show(axis, values, f"slopes along {name}", (-slope, slope), "RdBu_r")
        title = f"residual wavefront in nm, {moment.error_nm:.0f} RMS"
        largest = 3.0 * moment.error_nm
        _show(left, moment.residual_nm, title, (-largest, largest), "RdBu_r")
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--snapshot: cannot write {path}: {error}") from error


def _show(
    axes: Axes, values: Array, title: str, limits: tuple[float, float | None], colours: str
) -> None:
    low, high = limits
    image = axes.imshow(values, origin="lower", vmin=low, vmax=high, cmap=colours)
    axes.set_title(title, fontsize="small")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.figure.colorbar(image, ax=axes, shrink=0.75)


def _moment(telescope: Telescope, batch: Batch, frame: int) -> Moment:
    """Return what the first frame of a batch looks like."""
    optics, plant = batch.optics, telescope.plant
    opd_m = batch.phase_m + optics.opd_per_command @ batch.commands_m[0]
    light = optics.images
    if isinstance(optics, DiffractiveOptics):
        light = optics.light(opd_m.astype(np.float32)).astype(np.float64)
    n = len(plant.valid)
    share = light.sum(axis=(0, 2))[plant.valid].mean() / 4
    maps = np.full((2, n, n), np.nan)
    maps[:, plant.valid] = batch.slopes[0].reshape(2, -1)
    left_nm = (opd_m - plant.weights @ opd_m) * 1e9
    return Moment(
        frame=frame,
        images=light.reshape(2 * n, 2 * n) / share,
        slopes=(maps[0], maps[1]),
        residual_nm=_on_grid(plant.points_m / plant.pitch_m, left_nm),
        error_nm=float(np.sqrt(plant.weights @ left_nm**2)),
    )


def _on_grid(points: Array, values: Array) -> Array:
    """Return a map of values at points that are about a unit apart."""
    place = np.round(points - points.min(axis=0)).astype(np.intp)
    grid = np.full(tuple(place.max(axis=0)[::-1] + 1), np.nan)
    grid[place[:, 1], place[:, 0]] = values
    return grid
