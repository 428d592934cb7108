"""A picture of an instrument: pupil, subapertures, actuators."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pyrcal.fitting.figures import check_plots, map_to_sensor, mirror_outline
from service.errors import ConfigurationError
from service.model.instrument import Instrument
from service.model.pupil import instrument_pupil, valid_subapertures

_POINTS = 6
"""Number of pupil points per subaperture."""

_SENSOR, _MIRROR = "tab:blue", "tab:red"


def write_drawing(instrument: Instrument, path: Path) -> None:
    """Write the picture as an image of the kind the file's name says.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed, or the file cannot be written.
    """
    check_plots("a picture")
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 8.4), layout="constrained")
    axes = figure.subplots()
    pupil = instrument_pupil(instrument, _POINTS)
    half = len(pupil.coordinates) / 2 / pupil.sampling
    extent = (-half, half, -half, half)
    axes.imshow(pupil.amplitude, origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=3.0)
    valid = valid_subapertures(instrument)
    corners = np.argwhere(valid)[:, ::-1] - len(valid) / 2
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    axes.add_collection(
        PolyCollection(
            corners[:, None] + square, facecolor="none", edgecolor=_SENSOR, linewidth=0.6
        )
    )
    points, style = mirror_outline(instrument)
    here = map_to_sensor(points, instrument.start)
    axes.plot(here[:, 0], here[:, 1], style, color=_MIRROR, markersize=5.0, linewidth=1.0)
    reach = 1.05 * max(half, float(np.abs(here).max()))
    axes.set(
        title=f"{instrument.name}: pupil (grey), valid subapertures (blue), mirror (red)",
        xlabel="x, subapertures",
        ylabel="y, subapertures",
        xlim=(-reach, reach),
        ylim=(-reach, reach),
        aspect="equal",
    )
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"cannot write {path}: {error}") from error
