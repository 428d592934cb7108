"""The kinds of sensors, one line each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from service.model.sensors.kind import SensorKind
from service.model.sensors.pyramid.kind import PyramidKind
from service.model.sensors.shack_hartmann.kind import ShackHartmannKind

if TYPE_CHECKING:
    from service.model.instrument import Instrument
    from service.model.sensors.model import SensorModel

KINDS: Mapping[str, SensorKind] = {kind.name: kind for kind in (PyramidKind(), ShackHartmannKind())}
"""Sensor kinds by ``wfs.kind`` of an instrument file; the first one is the default."""


def kind_of(instrument: Instrument) -> SensorModel:
    """Return the model of an instrument's kind of sensor."""
    return KINDS[instrument.wfs.kind].model
