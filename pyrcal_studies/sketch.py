"""Picture of a misregistration: nominal and actual positions of the actuators on the sensor.

Run: ``python -m pyrcal_studies.sketch``, which writes ``docs/pictures/misregistration.png``; the
registration drawn is that of ``OFF``, on the packaged instrument.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from service.instrument import packaged_instrument
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "misregistration.png"
OFF = (0.4, -0.1, 2.5, 1.01)
"""Subapertures, degrees, ratio: rotated more than in a night, so that it is visible."""

EXPECTED, TRUE = "#9aa4ad", "#1f6fb2"
Points = NDArray[np.float64]


def main() -> None:
    """Draw the picture."""
    PICTURE.parent.mkdir(exist_ok=True)
    instrument = packaged_instrument("flao-lbt")
    alpha = Misregistration.from_vector(np.array(OFF) / BOUNDARY_SCALE)
    expected = instrument.analytic_mirror.positions_m / instrument.subaperture_m
    true = on_sensor(expected, alpha)
    figure, (whole, part) = plt.subplots(1, 2, figsize=(6.2, 3.1), layout="constrained")
    half = instrument.wfs.n_subapertures / 2
    for axes, middle, reach in ((whole, (0.0, 0.0), half + 1.0), (part, (9.0, 6.0), 3.2)):
        _grid(axes, instrument)
        size = 1.5 if axes is whole else 60.0
        axes.scatter(*expected.T, s=size, facecolors="none", edgecolors=EXPECTED, lw=0.8)
        axes.scatter(*true.T, s=size, color=TRUE, lw=0.0)
        axes.set(xlim=(middle[0] - reach, middle[0] + reach), xticks=[], yticks=[])
        axes.set(ylim=(middle[1] - reach, middle[1] + reach), aspect="equal")
        axes.spines[:].set_visible(False)
    near = np.max(np.abs(expected - (9.0, 6.0)), axis=1) < 3.0
    for begin, end in zip(expected[near], true[near], strict=True):
        style = {"arrowstyle": "->", "color": "#c0392b", "lw": 1.2}
        part.annotate("", xy=tuple(end), xytext=tuple(begin), arrowprops=style)
    whole.set_title("663 actuators on the sensor's subapertures", fontsize=8)
    part.set_title("grey: nominal, blue: actual (a part)", fontsize=8)
    figure.savefig(PICTURE, dpi=100)


def on_sensor(points: Points, alpha: Misregistration) -> Points:
    """Return the positions on the sensor of points of the mirror, in subapertures."""
    cosine, sine = np.cos(alpha.rotation_rad), np.sin(alpha.rotation_rad)
    turned = points @ np.array([[cosine, sine], [-sine, cosine]])
    moved = alpha.magnification * turned + (alpha.shift_x_subap, alpha.shift_y_subap)
    return np.asarray(moved)


def _grid(axes: Axes, instrument: Instrument) -> None:
    """Draw the subapertures whose middle the pupil covers."""
    n, radius = instrument.wfs.n_subapertures, instrument.wfs.pupil_diameter / 2
    middles = np.arange(n) - (n - 1) / 2
    for x in middles:
        for y in middles:
            if instrument.obscuration_ratio * radius < np.hypot(x, y) < radius:
                axes.add_patch(
                    Rectangle((x - 0.5, y - 0.5), 1.0, 1.0, fc="#f4f1e8", ec="#d8d2c0", lw=0.5)
                )


if __name__ == "__main__":
    main()
