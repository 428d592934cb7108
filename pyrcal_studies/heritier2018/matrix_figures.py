"""Figures of the measured matrix beside the synthetic one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page
from pyrcal_studies.heritier2018.store import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SHOWN_MODES = (1, 5, 10, 50, 100, 200, 300, 350, 400)
"""Numbered from 1, as in the paper."""


def spectra_figure(record: Record) -> Figure:
    """Draw singular values and the RMS of slopes by mode."""
    figure = page.canvas(10.5, 3.6)
    left, right = figure.subplots(1, 2)
    for name, style in (("measured", "-"), ("synthetic", "--")):
        values = record[f"singular_{name}"]
        left.plot(np.arange(1, len(values) + 1), values / values[0], style, label=name)
        rms = record[f"rms_{name}"] * 1e-9
        right.plot(np.arange(1, len(rms) + 1), rms, style, label=name, linewidth=0.9)
    right.plot(np.arange(1, len(rms) + 1), record["rms_left"] * 1e-9, ":", label="left over")
    left.set(xlabel="singular value", ylabel="over the largest", yscale="log")
    right.set(xlabel="mode", ylabel="RMS slope per nm of wavefront", ylim=(0.0, None))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure


def gains_figure(record: Record) -> Figure:
    """Draw the modal gains before and after tuning."""
    figure = page.canvas(10.5, 3.2)
    axes = figure.subplots()
    for name, colour in (("before", "#b3261e"), ("after", "#0757ae")):
        gains = record[f"gains_{name}"]
        axes.plot(np.arange(1, len(gains) + 1), gains, ".", color=colour, label=f"{name} tuning")
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="mode", ylabel="modal gain", ylim=(-1.3, 1.6))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    return figure


def maps_figure(fit: Record) -> Figure:
    """Draw slopes along x of a few modes."""
    modes = [mode for mode in SHOWN_MODES if mode <= fit["measured"].shape[1]]
    figure = page.canvas(11, 4.0)
    panels = figure.subplots(3, len(modes), squeeze=False)
    synthetic = fit["synthetic"] * fit["gains"]
    for column, mode in enumerate(modes):
        own = [synthetic[:, mode - 1], fit["measured"][:, mode - 1]]
        own.append(own[1] - own[0])
        largest = 2.5 * float(np.std(own[1]))
        for axes, slopes in zip(panels[:, column], own, strict=True):
            axes.imshow(
                slope_maps(slopes, fit["valid"])[0],
                origin="lower",
                cmap="RdBu_r",
                vmin=-largest,
                vmax=largest,
            )
            axes.set(xticks=[], yticks=[])
        panels[0, column].set_title(f"mode {mode}", fontsize="small")
    for axes, name in zip(panels[:, 0], ("synthetic", "measured", "difference"), strict=True):
        axes.set_ylabel(name, fontsize="small")
    return figure


def variance_figure(fit: Record) -> Figure:
    """Draw the variance of the slopes of each subaperture."""
    scale = np.sqrt(np.mean(fit["measured"].astype(np.float64) ** 2, axis=0))
    measured = fit["measured"] / scale
    synthetic = fit["synthetic"] * fit["gains"] / scale
    figure = page.canvas(9.5, 5.6)
    panels = figure.subplots(2, 3)
    rows = (synthetic, measured, measured - synthetic)
    names = ("synthetic", "measured", "difference")
    for k, (name, matrix) in enumerate(zip(names, rows, strict=True)):
        maps = slope_maps(np.mean(matrix**2, axis=1), fit["valid"])
        largest = None if name == "difference" else 2.5
        for axes, values, direction in zip(panels[:, k], maps, "xy", strict=True):
            image = axes.imshow(values, origin="lower", cmap="viridis", vmin=0.0, vmax=largest)
            axes.set(xticks=[], yticks=[])
            axes.set_title(f"{name}, S{direction}", fontsize="small")
            figure.colorbar(image, ax=axes, shrink=0.8)
    return figure


def slope_maps(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> Array:
    """Return ``(2, n, n)`` maps of x and y slopes, NaN outside the mask."""
    maps = np.full((2, *valid.shape), np.nan)
    maps[:, valid] = slopes.reshape(2, -1)
    return maps
