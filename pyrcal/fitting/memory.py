"""Reject work that would exceed the memory, before it is started."""

from __future__ import annotations

from pyrcal.fitting.models import choose_sampling
from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.memory import GB, PROGRAM_BYTES, work_of
from service.model.pupil import instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness


def bytes_of_reconstruction(instrument: Instrument, n_modes: int, sampling: int) -> float:
    """Return the peak memory of D of all modes and the inverse of ``n_modes`` columns.

    The program is included; the sensor is modelled with this sampling.
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
    """Raise if a reconstruction takes more than ``most_gb``.

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


def bytes_of_fit(instrument: Instrument, n_modes: int, *, gain_map: bool = False) -> float:
    """Return the peak memory of a fit of ``n_modes`` columns, the program included."""
    kind = kind_of(instrument)
    sampling = choose_sampling(instrument) * instrument.binning
    pupil, fineness = instrument_pupil(instrument, sampling), Fineness(n_nodes=sampling)
    sensor = kind.sensor(instrument, pupil, fineness)
    made = work_of(instrument, sensor, pupil, n_matrices=1).memory_bytes
    n_unknowns = _USUAL_UNKNOWNS + _OF_GAIN_MAP * gain_map
    column_bytes = 8.0 * sensor.n_signals * n_modes
    of_unknowns = column_bytes * n_unknowns
    modelling = _MODELS * (made - PROGRAM_BYTES) + _KEPT * of_unknowns
    return PROGRAM_BYTES + max(modelling, _PROJECTED * of_unknowns)


_USUAL_UNKNOWNS = 9
"""Number of unknowns: registration, rotation of the axes, anamorphosis, coupling and modulation."""

_OF_GAIN_MAP = 9
"""Unknowns of the gain map as they count in memory: 14 coefficients, kept in single precision.

Peaks of 100, 200 and 350 modes were within 10 % of the estimate.
"""

_KEPT = 3.8
"""Copies of each unknown's derivatives, float64, while a model is computed."""

_PROJECTED = 7.8
"""Copies of each unknown's derivatives while they are projected."""

_MODELS = 1.15
"""Memory of all models over that of the fine one; peaks of 100 to 350 modes were within 8 %."""


def check_fit(
    instrument: Instrument, n_modes: int, most_gb: float, *, gain_map: bool = False
) -> None:
    """Raise if a fit takes more than ``most_gb``.

    Raises
    ------
    ModelError
        In one line with what it takes.
    """
    expected_gb = bytes_of_fit(instrument, n_modes, gain_map=gain_map) / GB
    if expected_gb > most_gb:
        raise ModelError(
            f"{instrument.name}: found {n_modes} modes, whose fit takes {expected_gb:.1f} GB; "
            f"expected at most --memory-gb {most_gb:g}: allow more, or fit fewer (--modes)"
        )
