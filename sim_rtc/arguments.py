"""Command-line values: text to numbers in range, or one line that says what was expected."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import ModelError
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from sim_rtc.telescope.atmosphere import Layer
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.registration import Drift, Flexure, Jump, Walk
from sim_rtc.telescope.scene import Elevation, Spiders
from sim_rtc.telescope.sky import Shape, VibrationLine

Reader = Callable[[str], Any]
"""Turns what was given into a value, or raises an ``argparse.ArgumentTypeError``."""

_LARGEST_STUCK_M = 1e-4
_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/.+:\d{1,5}|unixsock-stream/.+")


def refusal(text: str, expected: str) -> argparse.ArgumentTypeError:
    """Return the error that says what was found and what was expected."""
    return argparse.ArgumentTypeError(f"found {text!r}; expected {expected}")


def numbers(
    layout: str, expected: str, make: Callable[..., Any], ok: Callable[..., bool] | None = None
) -> Reader:
    """Return a reader of finite numbers, with commas between them and colons between groups.

    Parameters
    ----------
    layout
        How many numbers each group has: ``"1:4"``, or ``"2|3"`` where there is a choice.
    expected
        For whoever gave something else.
    make
        Makes the value of the numbers.
    ok
        Whether the numbers are possible.
    """
    counts = [[int(n) for n in group.split("|")] for group in layout.split(":")]

    def read(text: str) -> Any:  # noqa: ANN401 - whatever make returns
        groups = [group.split(",") for group in text.split(":")]
        fits = len(groups) == len(counts)
        try:
            found = [float(part) for group in groups for part in group]
            if not fits or any(len(g) not in n for g, n in zip(groups, counts, strict=True)):
                raise refusal(text, expected)
            if not np.isfinite(found).all() or not (ok is None or ok(*found)):
                raise refusal(text, expected)
            return make(*found)
        except (ValueError, ModelError):
            raise refusal(text, expected) from None

    return read


def within(low: float, high: float) -> Reader:
    """Return a reader of one number from ``low`` to ``high``."""
    expected = f"a number from {low:g} to {high:g}"
    return numbers("1", expected, float, lambda value: low <= value <= high)


def count(low: int, high: int | None = None) -> Reader:
    """Return a reader of one whole number from ``low`` to ``high``."""
    expected = f"a whole number from {low}" + ("" if high is None else f" to {high}")

    def read(text: str) -> int:
        whole = text.isascii() and text.isdecimal()
        if not whole or int(text) < low or (high is not None and int(text) > high):
            raise refusal(text, expected)
        return int(text)

    return read


def indices(text: str) -> tuple[int, ...]:
    """Read a list of whole numbers from 0."""
    parts = text.split(",")
    if not all(part.isascii() and part.isdecimal() for part in parts):
        raise refusal(text, "whole numbers from 0, like 12,40")
    return tuple(int(part) for part in parts)


def vibration(text: str) -> VibrationLine | None:
    """Read a line of the vibration spectrum, ``SHAPE:HZ:NM[:DAMPING]``; None: no line."""
    if text == "none":
        return None
    expected = "tip, tilt or focus:HZ:NM[:DAMPING], HZ > 0, NM >= 0, damping 0 to 0.5; or none"
    shape, _, rest = text.partition(":")
    if shape not in list(Shape):
        raise refusal(text, expected)

    def line(frequency_hz: float, rms_nm: float, *damping: float) -> VibrationLine:
        found = VibrationLine(shape=Shape(shape), frequency_hz=frequency_hz, rms_m=rms_nm * 1e-9)
        return replace(found, damping=damping[0]) if damping else found

    def possible(frequency_hz: float, rms_nm: float, damping: float = 0.0) -> bool:
        return frequency_hz > 0.0 <= rms_nm and 0.0 <= damping <= 0.5

    try:
        return numbers("2|3", expected, line, possible)(rest.replace(":", ","))  # type: ignore[no-any-return]
    except argparse.ArgumentTypeError:
        raise refusal(text, expected) from None


def dataset(text: str) -> str:
    """Read the place of an array in an HDF5 file."""
    name, colon, inside = text.rpartition(":/")
    if not (name and colon and inside):
        raise refusal(text, "FILE:/DATASET of an HDF5 file")
    return text


def truth(text: str) -> Path | str:
    """Read the name of a set of imperfections, or else of a file."""
    return text if text in SETS else Path(text)


def endpoint(text: str) -> str:
    """Read a zenoh endpoint; a wrong one would only ever look like a service that does not come."""
    if _ENDPOINT.fullmatch(text) is None:
        raise refusal(text, "PROTOCOL/ADDRESS like tcp/127.0.0.1:7447")
    return text


alpha = numbers(
    "4",
    "X,Y,ROT_DEG,MAG, subapertures, degrees and a ratio > 0",
    lambda *boundary: Misregistration.from_vector(np.array(boundary) / BOUNDARY_SCALE),
)
jump = numbers(
    "1:4",
    "T:DX,DY,DROT_DEG,DMAG, T > 0 seconds",
    lambda time_s, *change: Jump.of(change, time_s=time_s),
    lambda time_s, *_: time_s > 0.0,
)
drift = numbers("4", "DX,DY,DROT_DEG,DMAG per minute", lambda *change: Drift.of(change))
flexure = numbers(
    "4:1",
    "DX,DY,DROT_DEG,DMAG:PERIOD_S, 120 to 86400 seconds",
    lambda *found: Flexure.of(found[:4], period_s=found[4]),
    lambda *found: 120.0 <= found[4] <= 86400.0,
)
walk = numbers(
    "4",
    "X,Y,ROT_DEG,MAG after a minute, none negative",
    lambda *sigma: Walk.of(sigma),
    lambda *sigma: min(sigma) >= 0.0,
)
elevation = numbers(
    "1|2",
    "DEG or DEG,DEG_PER_MIN, 0 to 90 degrees and at most 10 per minute either way",
    lambda start, rate=0.0: Elevation(start_deg=start, rate_deg_per_minute=rate),
    lambda start, rate=0.0: 0.0 <= start <= 90.0 and abs(rate) <= 10.0,
)
slew = numbers(
    "1:1",
    "T:DEG, T > 0 seconds and at most 90 degrees either way",
    lambda *found: found,
    lambda time_s, by_deg: time_s > 0.0 and abs(by_deg) <= 90.0,
)
layer = numbers(
    "2|3",
    "SPEED,DIR_DEG or SPEED,DIR_DEG,SHARE, speed > 0 m/s and share > 0",
    lambda speed, direction, share=1.0: Layer(
        fraction=share, speed_m_s=speed, direction_deg=direction
    ),
    lambda speed, _, share=1.0: speed > 0.0 < share,
)
seeing_at = numbers(
    "1:1",
    "T:ARCSEC, T > 0 seconds and 0.05 to 5 arcseconds",
    lambda *found: found,
    lambda time_s, arcsec: time_s > 0.0 and 0.05 <= arcsec <= 5.0,
)
spiders = numbers(
    "1:1",
    "N:WIDTH_M, 1 to 12 arms of 0.001 to 1 m",
    lambda n_arms, width_m: Spiders(n_arms=int(n_arms), width_m=width_m),
    lambda n_arms, width_m: n_arms in range(1, 13) and 0.001 <= width_m <= 1.0,
)
gain_range = numbers(
    "2",
    "LOW,HIGH, each > 0 and at most 1",
    lambda *gains: gains,
    lambda *gains: min(gains) > 0.0 and max(gains) <= 1.0,
)
group_gains = numbers(
    "3",
    "TIP_TILT,TO_100,REST, each 0 to 2",
    lambda *gains: gains,
    lambda *gains: min(gains) >= 0.0 and max(gains) <= 2.0,
)
stuck_actuator = numbers(
    "1:1",
    "N:METRES, an actuator from 0 and at most 1e-4 m of OPD either way",
    lambda index, opd_m: (int(index), opd_m),
    lambda index, opd_m: index >= 0.0 and index % 1 == 0.0 and abs(opd_m) <= _LARGEST_STUCK_M,
)
