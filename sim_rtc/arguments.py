"""Command-line values: text to numbers in range, or one line that says what was expected."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from service.errors import ModelError
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from sim_rtc.atmosphere import Layer
from sim_rtc.elevation import Elevation
from sim_rtc.imperfections import SETS
from sim_rtc.scene import Spiders
from sim_rtc.schedule import Drift, Flexure, Jump, Walk
from sim_rtc.vibration import Shape, VibrationLine

_LARGEST_STUCK_M = 1e-4
_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/.+:\d{1,5}|unixsock-stream/.+")


def within(low: float, high: float) -> Callable[[str], float]:
    """Return a reader of one number from ``low`` to ``high``."""

    def read(text: str) -> float:
        expected = f"a number from {low:g} to {high:g}"
        (value,) = _numbers(text, (1,), expected)
        if not low <= value <= high:
            raise _refusal(text, expected)
        return value

    return read


def count(low: int, high: int | None = None) -> Callable[[str], int]:
    """Return a reader of one whole number from ``low`` to ``high``."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdecimal()):
            raise _refusal(text, expected)
        if int(text) < low or (high is not None and int(text) > high):
            raise _refusal(text, expected)
        return int(text)

    expected = f"a whole number from {low}" + ("" if high is None else f" to {high}")
    return read


def alpha(text: str) -> Misregistration:
    """Read a registration: X,Y in subapertures, rotation in degrees, magnification as a ratio."""
    expected = "X,Y,ROT_DEG,MAG, subapertures, degrees and a ratio > 0"
    values = _numbers(text, (4,), expected)
    try:
        return Misregistration.from_vector(np.array(values) / BOUNDARY_SCALE)
    except ModelError:
        raise _refusal(text, expected) from None


def drift(text: str) -> Drift:
    """Read a drift per minute."""
    dx, dy, rotation_deg, magnification = _numbers(text, (4,), "DX,DY,DROT_DEG,DMAG per minute")
    return Drift(
        shift_x_subap=dx,
        shift_y_subap=dy,
        rotation_deg=rotation_deg,
        magnification=magnification,
    )


def jump(text: str) -> Jump:
    """Read a jump, ``T:dx,dy,drot_deg,dmag``."""
    expected = "T:DX,DY,DROT_DEG,DMAG, T > 0 seconds"
    time_s, *change = _numbers(text.replace(":", ",", 1), (5,), expected)
    if ":" not in text or time_s <= 0.0:
        raise _refusal(text, expected)
    dx, dy, rotation_deg, magnification = change
    return Jump(
        time_s=time_s,
        shift_x_subap=dx,
        shift_y_subap=dy,
        rotation_deg=rotation_deg,
        magnification=magnification,
    )


def layer(text: str) -> Layer:
    """Read a layer of turbulence; without a share it gets as much as any other."""
    expected = "SPEED,DIR_DEG or SPEED,DIR_DEG,SHARE, speed > 0 m/s and share > 0"
    speed_m_s, direction_deg, *share = _numbers(text, (2, 3), expected)
    fraction = share[0] if share else 1.0
    if speed_m_s <= 0.0 or fraction <= 0.0:
        raise _refusal(text, expected)
    return Layer(fraction=fraction, speed_m_s=speed_m_s, direction_deg=direction_deg)


def indices(text: str) -> tuple[int, ...]:
    """Read a list of whole numbers from 0."""
    parts = text.split(",")
    if not all(part.isascii() and part.isdecimal() for part in parts):
        raise _refusal(text, "whole numbers from 0, like 12,40")
    return tuple(int(part) for part in parts)


def stuck_actuator(text: str) -> tuple[int, float]:
    """Read an actuator and the OPD at which it is stuck."""
    expected = "N:METRES, an actuator from 0 and at most 1e-4 m of OPD either way"
    index, colon, opd = text.partition(":")
    if not (colon and index.isascii() and index.isdecimal()):
        raise _refusal(text, expected)
    (opd_m,) = _numbers(opd, (1,), expected)
    if abs(opd_m) > _LARGEST_STUCK_M:
        raise _refusal(text, expected)
    return int(index), opd_m


def flexure(text: str) -> Flexure:
    """Read a sinusoid, ``dx,dy,drot_deg,dmag:period_s``."""
    expected = "DX,DY,DROT_DEG,DMAG:PERIOD_S, 120 to 86400 seconds"
    amplitude, _, period = text.partition(":")
    dx, dy, rotation_deg, magnification = _numbers(amplitude, (4,), expected)
    (period_s,) = _numbers(period, (1,), expected)
    if not 120.0 <= period_s <= 86400.0:
        raise _refusal(text, expected)
    return Flexure(
        shift_x_subap=dx,
        shift_y_subap=dy,
        rotation_deg=rotation_deg,
        magnification=magnification,
        period_s=period_s,
    )


def walk(text: str) -> Walk:
    """Read the standard deviations of a random walk after a minute."""
    expected = "X,Y,ROT_DEG,MAG after a minute, none negative"
    values = _numbers(text, (4,), expected)
    if min(values) < 0.0:
        raise _refusal(text, expected)
    dx, dy, rotation_deg, magnification = values
    return Walk(
        shift_x_subap=dx,
        shift_y_subap=dy,
        rotation_deg=rotation_deg,
        magnification=magnification,
    )


def elevation(text: str) -> Elevation:
    """Read an elevation, and its change per minute where it has one."""
    expected = "DEG or DEG,DEG_PER_MIN, 0 to 90 degrees and at most 10 per minute either way"
    start_deg, *rate = _numbers(text, (1, 2), expected)
    rate_deg_per_minute = rate[0] if rate else 0.0
    if not 0.0 <= start_deg <= 90.0 or abs(rate_deg_per_minute) > 10.0:
        raise _refusal(text, expected)
    return Elevation(start_deg=start_deg, rate_deg_per_minute=rate_deg_per_minute)


def slew(text: str) -> tuple[float, float]:
    """Read when a slew begins and how far up it goes, ``T:DEG``."""
    expected = "T:DEG, T > 0 seconds and at most 90 degrees either way"
    time_s, by_deg = _numbers(text.replace(":", ",", 1), (2,), expected)
    if ":" not in text or time_s <= 0.0 or abs(by_deg) > 90.0:
        raise _refusal(text, expected)
    return time_s, by_deg


def seeing_at(text: str) -> tuple[float, float]:
    """Read a time and the seeing then, ``T:ARCSEC``."""
    expected = "T:ARCSEC, T > 0 seconds and 0.05 to 5 arcseconds"
    time_s, arcsec = _numbers(text.replace(":", ",", 1), (2,), expected)
    if ":" not in text or time_s <= 0.0 or not 0.05 <= arcsec <= 5.0:
        raise _refusal(text, expected)
    return time_s, arcsec


def vibration(text: str) -> VibrationLine | None:
    """Read a line of the vibration spectrum, ``SHAPE:HZ:NM[:DAMPING]``; None: no line."""
    if text == "none":
        return None
    expected = "tip, tilt or focus:HZ:NM[:DAMPING], HZ > 0, NM >= 0, damping 0 to 0.5; or none"
    shape, *rest = text.split(":")
    if shape not in list(Shape) or not rest:
        raise _refusal(text, expected)
    frequency_hz, rms_nm, *damping = _numbers(",".join(rest), (2, 3), expected)
    line = VibrationLine(shape=Shape(shape), frequency_hz=frequency_hz, rms_m=rms_nm * 1e-9)
    if damping:
        line = replace(line, damping=damping[0])
    if frequency_hz <= 0.0 or rms_nm < 0.0 or not 0.0 <= line.damping <= 0.5:
        raise _refusal(text, expected)
    return line


def spiders(text: str) -> Spiders:
    """Read the arms in front of the pupil, ``N:WIDTH_M``."""
    expected = "N:WIDTH_M, 1 to 12 arms of 0.001 to 1 m"
    n_arms, width_m = _numbers(text.replace(":", ",", 1), (2,), expected)
    if ":" not in text or n_arms not in range(1, 13) or not 0.001 <= width_m <= 1.0:
        raise _refusal(text, expected)
    return Spiders(n_arms=int(n_arms), width_m=width_m)


def gain_range(text: str) -> tuple[float, float]:
    """Read the optical gain of the first and the last mode."""
    expected = "LOW,HIGH, each > 0 and at most 1"
    low, high = _numbers(text, (2,), expected)
    if not (0.0 < low <= 1.0 and 0.0 < high <= 1.0):
        raise _refusal(text, expected)
    return low, high


def group_gains(text: str) -> tuple[float, float, float]:
    """Read the loop gains of tip and tilt, of the modes to 100, and of the rest."""
    expected = "TIP_TILT,TO_100,REST, each 0 to 2"
    low, middle, high = _numbers(text, (3,), expected)
    if not all(0.0 <= gain <= 2.0 for gain in (low, middle, high)):
        raise _refusal(text, expected)
    return low, middle, high


def dataset(text: str) -> str:
    """Read the place of an array in an HDF5 file."""
    name, colon, inside = text.rpartition(":/")
    if not (name and colon and inside):
        raise _refusal(text, "FILE:/DATASET of an HDF5 file")
    return text


def truth(text: str) -> Path | str:
    """Read the name of a set of imperfections, or else of a file."""
    return text if text in SETS else Path(text)


def endpoint(text: str) -> str:
    """Read a zenoh endpoint; a wrong one would only ever look like a service that does not come."""
    if _ENDPOINT.fullmatch(text) is None:
        raise _refusal(text, "PROTOCOL/ADDRESS like tcp/127.0.0.1:7447")
    return text


def _numbers(text: str, counts: tuple[int, ...], expected: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise _refusal(text, expected) from None
    if len(values) not in counts or not np.all(np.isfinite(values)):
        raise _refusal(text, expected)
    return values


def _refusal(text: str, expected: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(f"found {text!r}; expected {expected}")
