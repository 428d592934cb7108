"""The figures about all modes at once, each drawn into axes it is given."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from service.fit.options import Fit
from service.model.instrument import Instrument, TabulatedModes
from service.model.interaction import rotation
from service.model.misregistration import Misregistration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

MEASURED = "tab:red"
SYNTHETIC = "tab:blue"


def singular_values(axes: Axes, fit: Fit) -> None:
    """Draw the singular values of both matrices, each over its largest, and their conditions."""
    for matrix, name, colour, style in (
        (fit.synthetic * fit.gains, "synthetic", SYNTHETIC, "-"),
        (fit.measured, "measured", MEASURED, "--"),
    ):
        values = scipy.linalg.svdvals(np.asarray(matrix, dtype=np.float64))
        condition = values[0] / values[-1]
        label = f"{name}, condition {condition:.2f}"
        axes.semilogy(values / values[0], style, color=colour, label=label)
    axes.set(title="singular values", xlabel="number", ylabel="over the largest")
    axes.legend(fontsize="small")


def gains(axes: Axes, fit: Fit) -> None:
    """Draw the gain of every mode, measured over synthetic."""
    axes.plot(fit.modes, fit.gains, ".", color=MEASURED, markersize=3.0)
    axes.axhline(float(np.median(fit.gains)), color="0.5", linewidth=0.8)
    axes.set(title="gain of each mode", xlabel="mode", ylabel="measured / synthetic")


def slopes_rms(axes: Axes, fit: Fit) -> None:
    """Draw the RMS of every column: measured, synthetic, and what is left."""
    measured = np.sqrt(np.mean(np.square(fit.measured, dtype=np.float64), axis=0)) * 1e-9
    synthetic = np.sqrt(np.mean(np.square(fit.synthetic, dtype=np.float64), axis=0)) * 1e-9
    axes.semilogy(fit.modes, synthetic, color=SYNTHETIC, label="synthetic, gains not applied")
    axes.semilogy(fit.modes, measured, ".", color=MEASURED, markersize=3.0, label="measured")
    left = fit.residual_by_mode * measured
    axes.semilogy(fit.modes, left, ".", color="0.6", markersize=2.0, label="left over")
    axes.set(title="slopes RMS", xlabel="mode", ylabel="per nm OPD RMS")
    axes.legend(fontsize="small")


def registration(axes: Axes, fit: Fit, instrument: Instrument) -> None:
    """Draw the actuators, or the edge of a table of modes, over the valid subapertures."""
    n = len(fit.valid)
    edge = n / 2
    axes.imshow(
        np.where(fit.valid, 0.85, 1.0),
        origin="lower",
        extent=(-edge, edge, -edge, edge),
        cmap="gray",
        vmin=0.0,
        vmax=1.0,
    )
    points, style = _outline(instrument)
    here = landed(points, fit.alpha)
    axes.plot(here[:, 0], here[:, 1], style, color=MEASURED, markersize=3.0, linewidth=1.0)
    centre = landed(np.zeros((1, 2)), fit.alpha)[0]
    arm = landed(np.array([[edge / 2, 0.0]]), fit.alpha)[0]
    axes.annotate("", xy=arm, xytext=centre, arrowprops={"arrowstyle": "->", "color": "black"})
    axes.set(
        title="mirror over subapertures; its x axis as arrow",
        xlabel="x, subapertures",
        ylabel="y, subapertures",
    )
    reach = 1.05 * max(edge, float(np.abs(here).max()))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")


def landed(points: Array, alpha: Misregistration) -> Array:
    """Return where points of the mirror ``(n, 2)`` fall on the sensor, in subapertures."""
    turned = points @ rotation(alpha.rotation_rad).T
    return np.asarray(alpha.magnification * turned + alpha.vector[:2])


def residual(axes: Axes, fit: Fit) -> None:
    """Draw what is left over in every subaperture, Sx beside Sy."""
    image = axes.imshow(
        100.0 * np.hstack(list(fit.residual_map)), origin="lower", cmap="viridis", vmin=0.0
    )
    axes.set(title="left over: Sx | Sy, % of the measured RMS", xticks=[], yticks=[])
    axes.figure.colorbar(image, ax=axes, shrink=0.7)


def residual_by_mode(axes: Axes, fit: Fit) -> None:
    """Draw what is left over of every mode."""
    axes.semilogy(fit.modes, 100.0 * fit.residual_by_mode, ".", color="0.4", markersize=3.0)
    axes.axhline(100.0 * fit.residual_fraction, color=MEASURED, linewidth=0.8)
    axes.set(title="left over by mode", xlabel="mode", ylabel="% of the mode's own RMS")


def _outline(instrument: Instrument) -> tuple[Array, str]:
    """Return what is known of the mirror's layout, in subapertures, and how to draw it."""
    mirror = instrument.mirror
    parity = np.array([1.0, mirror.y_sign])
    if isinstance(mirror, TabulatedModes):
        half = (np.array(mirror.cube.shape[:0:-1]) - 1) / 2 * mirror.pitch_m
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
        return corners / instrument.subaperture_m * parity, "-"
    return mirror.positions_m / instrument.subaperture_m * parity, "+"
