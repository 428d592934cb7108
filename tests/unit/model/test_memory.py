"""What an instrument takes is known before it is begun."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import pytest

from service.instrument.mirrors import grid
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, Stop
from service.model.memory import PROGRAM_BYTES, work_of
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from tests.numerics import small_instrument


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


@pytest.mark.parametrize(
    ("influence", "n_modes", "kept_bytes"),
    [
        (Influence.THIN_PLATE, 400, 1e9),
        (Influence.GAUSSIAN, 400, 1e9),
        (Influence.GAUSSIAN, 400, 0.0),
        (Influence.GAUSSIAN, 30, 1e9),
    ],
    ids=["thin plate", "local", "streamed", "few modes"],
)
def test_the_estimate_is_within_a_fifth_of_the_measured_peak(influence, n_modes, kept_bytes):
    instrument = instrument_of(influence, n_modes)
    pupil = instrument_pupil(instrument, 3)
    sensor = kind_of(instrument).sensor(instrument, pupil, Fineness(kept_bytes=kept_bytes))
    expected = work_of(instrument, sensor, pupil).memory_bytes - PROGRAM_BYTES
    tracemalloc.start()
    try:
        model = InteractionModel(instrument, modal_basis(instrument), kept_bytes=kept_bytes)
        model.linearise(Misregistration(rotation_rad=0.1))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert expected == pytest.approx(peak, rel=0.2)
