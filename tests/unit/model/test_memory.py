"""What an instrument takes is known before it is begun."""

from __future__ import annotations

import tracemalloc

import pytest

from service.model.interaction import InteractionModel
from service.model.kinds import Influence
from service.model.memory import PROGRAM_BYTES, work_of
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from tests.support.memory import instrument_of


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
