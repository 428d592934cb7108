"""From few smooth modes to many fine ones: what is dithered, and how many modes are controlled.

A mode whose waves are long answers a mirror that is far out of place almost as it should, so that
steps lead home from afar; one whose waves are short says precisely where the mirror is once it is
near. The loop is the other way round: far from registration it holds a few modes at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.control.dithering import clear_of

MOST_LINES = 8
FEWEST_LINES = 3
"""Modes dithered at once: two fix neither four parameters nor whether they are right."""

BAND = (0.2, 0.4)
"""Of the frame rate: wind biases slower lines, and near half the rate there is no room beside."""

CLEARANCE_HZ = 21.0
"""Between two lines: the noise is measured within 20 Hz of each."""

FIRST_CLOSED = 150
"""Modes a loop is first closed on: those a registration known to some per cent will carry."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reach:
    """A band of modes that is dithered with the loop open."""

    first: int
    """Lowest mode, of a basis in which modes get finer."""

    last: int
    floor: NDArray[np.float64]
    """``(4,)`` 1 σ of the model's error with the loop open, numeric units: the response that an
    uncorrected wavefront leaves is not the model's."""


SMOOTH = Reach(
    first=0,
    last=28,
    floor=np.array([0.06, 0.06, np.deg2rad(0.25), 0.025]),
)
"""Leads from anywhere in the range."""

FINER = Reach(
    first=36,
    last=99,
    floor=np.array([0.02, 0.02, np.deg2rad(0.06), 0.008]),
)
"""Confirms with other modes, three times as precisely."""


def modes_of(reach: Reach, n_modes: int, n_lines: int) -> tuple[int, ...]:
    """Return the modes to dither, spread over a band; a short basis shares what it has.

    The bands of ``SMOOTH`` and ``FINER`` have no mode in common however short the basis is, as
    long as it has twice as many modes as lines.
    """
    scale = min(1.0, (n_modes - 1) / FINER.last)
    first, last = np.ceil(scale * reach.first), np.floor(scale * reach.last)
    spread = np.round(np.linspace(first, last, n_lines)).astype(int)
    return tuple(int(mode) for mode in np.unique(spread))


def lines_of(frame_rate_hz: float, window_s: float, most: int) -> tuple[float, ...]:
    """Return as many dither lines as the band has room for, at most ``most``; maybe too few.

    Each is a whole number of periods of a window, and none is what the pyramid makes of others.
    """
    low, high = (share * frame_rate_hz for share in BAND)
    for n_lines in range(min(most, MOST_LINES), FEWEST_LINES - 1, -1):
        found = clear_of(
            tuple(np.linspace(low, high, n_lines + 1)[:-1].tolist()),
            (),
            clearance_hz=CLEARANCE_HZ,
            step_hz=frame_rate_hz / round(window_s * frame_rate_hz),
            range_hz=(low, high),
        )
        if found is not None:
            return found
    return ()


def first_closed(goal: int) -> int:
    """Return with how many modes a loop is first closed, on its way to ``goal``."""
    return min(goal, FIRST_CLOSED)
