"""Modes of the sensor: the same mirror in other subapertures."""

from __future__ import annotations

from dataclasses import replace

from service.model.instrument import Instrument
from service.model.modes import Basis, ModalBasis
from service.model.surface import mirror_surface


def in_subapertures(basis: Basis, instrument: Instrument) -> Basis:
    """Return the mirror's modes in coordinates of the subapertures that an instrument has now.

    The modes are those that were found with the finest ones: coarser ones cannot tell them apart.
    """
    if isinstance(basis, ModalBasis):
        surface = mirror_surface(instrument.analytic_mirror, instrument.subaperture_m)
        return basis.of_surface(surface)
    wider = instrument.subaperture_m / basis.instrument.subaperture_m
    return replace(basis, instrument=instrument, step_subap=basis.step_subap / wider)
