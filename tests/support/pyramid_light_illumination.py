"""What tests of several modules share of unit.model.sensors.test_pyramid_light_illumination."""

from __future__ import annotations

from service.model.sensors.sensor import PupilPosition


def at(x: float = 0.0, y: float = 0.0) -> PupilPosition:
    return PupilPosition(at=(x, y), sigma=(0.02, 0.02))
