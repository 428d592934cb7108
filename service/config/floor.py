"""How far the model itself leads astray: the 1 σ that no integration removes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.config.settings import Settings

FLAT = (0.004, 0.01, 0.001)
"""Shift in subapertures, rotation in degrees, magnification: where telemetry of a working pyramid
is compared with the response to a flat wavefront. What a window's misfit tells comes on top."""

AT_WORK = (0.001, 0.005, 0.0005)
"""The same where it is compared with the response at the working point."""


def floor_of(settings: Settings) -> NDArray[np.float64]:
    """Return the model-error floor ``(4,)`` in boundary units: subapertures, degrees, ratio.

    What the settings leave open is what campaigns on the diffractive telescope found
    (docs/results/night.md).
    """
    tracking = settings.tracking
    flat = settings.compute.working_point_modes is None
    shift, rotation, magnification = FLAT if flat else AT_WORK
    given = (tracking.floor_shift_subap, tracking.floor_rotation_deg, tracking.floor_magnification)
    shift, rotation, magnification = (
        found if asked is None else asked
        for found, asked in zip((shift, rotation, magnification), given, strict=True)
    )
    return np.array([shift, shift, rotation, magnification])
