"""Refuse a reconstructor that would not fit in memory, before anything of it is computed."""

from __future__ import annotations

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.memory import GB, PROGRAM_BYTES, work_of
from service.model.pupil import instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness


def bytes_of_reconstruction(instrument: Instrument, n_modes: int, sampling: int) -> float:
    """Return what D of all modes, and the inverse of its first ``n_modes`` columns, take.

    At their largest, the program included; the sensor as a model of this sampling has it.
    """
    pupil = instrument_pupil(instrument, sampling * instrument.binning)
    fineness = Fineness(n_nodes=sampling * instrument.binning)
    sensor = kind_of(instrument).sensor(instrument, pupil, fineness)
    made = work_of(instrument, sensor, pupil, n_matrices=1).memory_bytes
    n_slopes, n_all = float(sensor.n_signals), instrument.modes.n_modes
    # D and the inverse in float32, the columns in float64, their normal equations twice
    inverted = 4.0 * n_slopes * n_all + 12.0 * n_slopes * n_modes + 16.0 * float(n_modes) ** 2
    return max(made, PROGRAM_BYTES + inverted)


def check_reconstruction(
    instrument: Instrument, n_modes: int, sampling: int, most_gb: float
) -> None:
    """Refuse what takes more than ``most_gb``.

    Raises
    ------
    ModelError
        In one line with what it takes.
    """
    expected_gb = bytes_of_reconstruction(instrument, n_modes, sampling) / GB
    if expected_gb > most_gb:
        raise ModelError(
            f"{instrument.name}: found {instrument.modes.n_modes} modes, whose D and the inverse "
            f"of {n_modes} of them take {expected_gb:.1f} GB; expected at most --memory-gb "
            f"{most_gb:g}: allow more, or ask for fewer modes"
        )
