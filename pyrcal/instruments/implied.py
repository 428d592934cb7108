"""Derived properties of an instrument: size, memory, computing time and condition of its matrix."""

from __future__ import annotations

import time
from dataclasses import dataclass

from pyrcal.terminal import span
from service.control.reconstructor import MAX_CONDITION, invert
from service.model.instrument import Instrument
from service.model.interaction import RtcInteractionModel
from service.model.kinds import SignalKind
from service.model.memory import GB, work_of
from service.model.modes import modal_basis
from service.model.pupil import instrument_pupil, rtc_valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness

SAMPLING = NODES = 3
"""Pupil points per subaperture, and detector nodes, of the model; the same as in a fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Implied:
    """Derived properties of an instrument, with those of its matrix if it was computed."""

    n_valid: int
    """Valid subapertures."""

    n_slopes: int
    n_modes: int
    expected_gb: float
    """Expected peak memory of the matrix and its derivatives, program included, GB."""

    seconds: float | None = None
    """Computing time of modes and matrix, seconds; None if they were not computed."""

    condition_number: float | None = None
    """Condition number of the whole matrix at the nominal registration; None if it was not computed
    or has more modes than slopes."""

    n_weak: int = 0
    """Number of singular values that a reconstructor truncates."""


def derive_properties(instrument: Instrument, most_gb: float) -> Implied:
    """Return the properties; the matrix is computed if it needs at most ``most_gb`` of memory.

    Raises
    ------
    ModelError
        If the model cannot work with it.
    """
    pupil = instrument_pupil(instrument, SAMPLING * instrument.binning)
    fineness = Fineness(n_nodes=NODES * instrument.binning)
    sensor = kind_of(instrument).sensor(instrument, pupil, fineness)
    n_valid = int(rtc_valid_subapertures(instrument).sum())
    known = Implied(
        n_valid=n_valid,
        n_slopes=sensor.n_signals,
        n_modes=instrument.modes.n_modes,
        expected_gb=work_of(instrument, sensor, pupil).memory_bytes / GB,
    )
    return known if known.expected_gb > most_gb else _compute_matrix(instrument, known)


def _compute_matrix(instrument: Instrument, known: Implied) -> Implied:
    begun = time.perf_counter()
    model = RtcInteractionModel(
        instrument, modal_basis(instrument), pupil_sampling=SAMPLING, detector_nodes=NODES
    )
    matrix = model.interaction_matrix(instrument.start)
    seconds = time.perf_counter() - begun
    # an underdetermined matrix has no condition that a reconstructor could use
    inversion = None
    if known.n_modes <= known.n_slopes:
        inversion = invert(matrix, known.n_modes, max_condition=MAX_CONDITION)
    return Implied(
        n_valid=known.n_valid,
        n_slopes=known.n_slopes,
        n_modes=known.n_modes,
        expected_gb=known.expected_gb,
        seconds=seconds,
        condition_number=None if inversion is None else inversion.condition_number,
        n_weak=0 if inversion is None else inversion.n_truncated,
    )


def describe_properties(instrument: Instrument, found: Implied) -> tuple[str, ...]:
    """Return it in lines for a person."""
    n, kind = instrument.wfs.n_subapertures, instrument.wfs.kind
    signals = "slopes" if instrument.slopes.kind is SignalKind.XY else "pixels"
    megabytes = 4.0 * found.n_slopes * found.n_modes / 1e6
    lines = [
        f"sensor      {kind}, {n} by {n} subapertures, {found.n_valid} of them valid: "
        f"{found.n_slopes} {signals}",
        f"modes       {found.n_modes}",
        f"matrix      {megabytes:.2g} MB; a fit takes {found.expected_gb:.2g} GB at most",
    ]
    if found.seconds is None:
        lines.append("condition   not computed: --memory-gb allows more")
    elif found.condition_number is None:
        lines.append("condition   none: there are more modes than slopes, so not all can be seen")
    else:
        lines.append(
            f"condition   {found.condition_number:.3g} of all modes where the mirror belongs; "
            f"{found.n_weak} of them are too weak for a reconstructor of condition "
            f"{MAX_CONDITION:g}"
        )
    if found.seconds is not None:
        lines.append(f"time        {span(found.seconds)} for modes and matrix")
    return tuple(lines)
