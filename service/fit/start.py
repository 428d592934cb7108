"""Where to begin looking for the mirror, from light alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from service.errors import ModelError
from service.fit.flux import PupilPosition, find_pupil
from service.model.instrument import Instrument, Stop
from service.model.misregistration import Misregistration
from service.model.slopes import Orientation

FARTHEST_SUBAP = 3.0
"""Pupil images further off than this are another instrument's."""

_TURNS_RAD = np.deg2rad([5.0, -5.0])


def far_starts(instrument: Instrument, flux: bytes | None) -> tuple[Misregistration, ...]:
    """Return where to start from when nothing is known, the likeliest first.

    With the mirror as stop the pupil images move with it, so that their mean light tells the
    shift; rotation and magnification it does not tell. ``flux`` is as the RTC sends it, ``<f4``
    ``[4, n, n]``, in its own axes: it is used where these are the conventions'.
    """
    nominal = instrument.start
    turned = [replace(nominal, rotation_rad=nominal.rotation_rad + turn) for turn in _TURNS_RAD]
    lit = _lit_start(instrument, nominal, flux)
    return (*(() if lit is None else (lit,)), nominal, *turned)


def _lit_start(
    instrument: Instrument, nominal: Misregistration, flux: bytes | None
) -> Misregistration | None:
    own_axes = instrument.slopes.assumed_orientation == Orientation()
    if flux is None or instrument.stop is not Stop.MIRROR or not own_axes:
        return None
    side = math.isqrt(len(flux) // 16)
    try:
        seen = find_pupil(np.frombuffer(flux, "<f4").reshape(4, side, side), instrument)
    except ModelError:
        return None
    if not isinstance(seen, PupilPosition):
        return None
    if max(abs(seen.x_subap), abs(seen.y_subap)) > FARTHEST_SUBAP:
        return None
    return replace(nominal, shift_x_subap=seen.x_subap, shift_y_subap=seen.y_subap)
