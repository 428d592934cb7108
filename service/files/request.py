"""What a user asks of a fit, in the words of the command line and of REST."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from service.fit.pupil_rotation import Arms
from service.model.misregistration import PARAMETERS, Misregistration

MOST_MODES = 100_000

_PART = re.compile(r"(\d+)(?::(\d+)(?::(\d+))?)?")


def parse_modes(text: str) -> NDArray[np.intp]:
    """Return the basis indices that ``0:400``, ``0:400:2``, ``3,5,9`` or a list of these mean.

    A range ends before its second number, as in Python.

    Raises
    ------
    ValueError
        If the text means something else, nothing, or a mode twice.
    """
    expected = "expected first:end, first:end:step, or numbers with commas, like 0:400 or 3,5,9"
    indices: list[int] = []
    for part in text.replace(" ", "").split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise ValueError(f"found {text!r}, {expected}")
        first, end, step = match.groups()
        last = int(end) if end is not None else int(first) + 1
        if last > MOST_MODES or step == "0":
            raise ValueError(
                f"found {text!r}, expected modes below {MOST_MODES} and a step above 0"
            )
        indices.extend(range(int(first), last, int(step or 1)))
    if not indices:
        raise ValueError(f"found {text!r}, which is no mode at all; {expected}")
    if len(set(indices)) < len(indices):
        raise ValueError(f"found {text!r}, expected no mode twice")
    return np.array(indices, dtype=np.intp)


def parse_alpha(text: str) -> Misregistration:
    """Return the registration ``X,Y,ROT,MAG``: subapertures, degrees, ratio.

    Raises
    ------
    ValueError
        If it is not four finite numbers, or the magnification is not positive.
    """
    expected = "expected X,Y,ROT,MAG: subapertures, degrees, ratio, like 0.3,-0.1,65,0.98"
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"found {text.strip()!r}, {expected}") from None
    if len(values) != len(PARAMETERS) or not np.all(np.isfinite(values)) or values[3] <= 0.0:
        raise ValueError(f"found {text.strip()!r}, {expected}")
    return Misregistration.from_boundary(dict(zip(PARAMETERS, values, strict=True)))


def parse_arms(text: str) -> Arms:
    """Return the spider's arms ``WIDTH:DEG,DEG,...``: subapertures, degrees from +x towards +y.

    Raises
    ------
    ValueError
        If it is not a width above 0 and at least one finite angle.
    """
    expected = "expected WIDTH:DEG,DEG,... of the spider's arms, like 0.9:90,210,330"
    width, _, angles = text.partition(":")
    try:
        arms = Arms(
            angles_rad=tuple(np.deg2rad([float(angle) for angle in angles.split(",")]).tolist()),
            width_subap=float(width),
        )
    except ValueError:
        raise ValueError(f"found {text.strip()!r}, {expected}") from None
    if not (0.0 < arms.width_subap < np.inf and np.all(np.isfinite(arms.angles_rad))):
        raise ValueError(f"found {text.strip()!r}, {expected}")
    return arms
