"""What tests of several modules share of unit.model.test_memory."""

from __future__ import annotations

from dataclasses import replace

from service.instrument.mirrors import grid
from service.model.kinds import Influence, Stop
from tests.support.numerics import small_instrument


def instrument_of(influence: Influence, n_modes: int):
    """24 subapertures and 437 actuators."""
    pitch_m = 8.0 / 23
    plain = small_instrument(
        grid(25, pitch_m, 8.2), influence=influence, n_modes=n_modes, stop=Stop.TELESCOPE
    )
    return replace(
        plain,
        wfs=replace(plain.wfs, n_subapertures=24, pupil_separation_subap=30.0),
        mirror=replace(plain.mirror, pitch_m=pitch_m),
    )
