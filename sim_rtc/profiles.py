"""Layer profiles with a name: how the turbulence is shared out, and how fast it moves."""

from __future__ import annotations

from sim_rtc.atmosphere import Layer


def _layers(*rows: tuple[float, float, float]) -> tuple[Layer, ...]:
    return tuple(
        Layer(fraction=share, speed_m_s=speed, direction_deg=direction)
        for share, speed, direction in rows
    )


PROFILES = {
    "single": _layers((1.0, 12.0, 35.0)),
    "three-layer": _layers((0.6, 7.0, 20.0), (0.25, 12.0, 75.0), (0.15, 22.0, 140.0)),
    "paranal-like": _layers(
        (0.66, 6.0, 10.0),
        (0.12, 5.0, 50.0),
        (0.09, 10.0, 95.0),
        (0.08, 28.0, 120.0),
        (0.05, 18.0, 130.0),
    ),
}
"""Share of the strength, wind speed in m/s and direction in degrees, from the ground upwards.

``paranal-like`` has what a median night at Paranal has: two thirds of the turbulence slow and near
the ground, a tenth in a fast jet stream. The work of a linear plant grows with the sum of the
speeds (12, 41 and 67 m/s): every row of a screen that passes is seen through the sensor once.
"""
