"""Command-line values: text to numbers in range, or one line that says what was expected."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable

import numpy as np

from service.errors import ModelError
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from sim_rtc.atmosphere import Layer
from sim_rtc.schedule import Drift, Jump

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
