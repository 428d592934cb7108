"""Read and check the values of command-line options."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import field, replace
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import ModelError
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.sky import Shape, VibrationLine

Reader = Callable[[str], Any]
"""Turns what was given into a value, or raises an ``argparse.ArgumentTypeError``."""

_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/.+:\d{1,5}|unixsock-stream/.+")


def option(
    usage: str,
    text: str,
    reader: Reader | None = None,
    default: object = None,
    *,
    many: bool = False,
    absent: object = None,
    chapter: str | None = None,
    **more: object,
) -> Any:  # noqa: ANN401 - a field of any type
    """Return a field that is read from the command line.

    Parameters
    ----------
    usage, text
        What ``--help`` shows: flags and what comes after them, and what it is for.
    reader, default, more
        Argparse's.
    many
        Whether it may be given more than once: the field has all its values.
    absent
        Value of an option without a default that was not given.
    chapter
        Of ``--help``, which begins here.
    """
    if many:
        text, more["action"] = f"{text}; may be repeated", "append"
    if default is not None and "default" not in text:
        text += f" (default: %(default){'g' if isinstance(default, float) else 's'})"
    flags = [word for word in usage.split() if word.startswith("-")]
    metavar = usage.split()[-1] if len(usage.split()) > len(flags) else None
    keywords = {"help": text, "metavar": metavar, "type": reader, "default": default, **more}
    given = {name: value for name, value in keywords.items() if value is not None}
    metadata = {"flags": flags, "argparse": given, "absent": absent, "chapter": chapter}
    return field(metadata=metadata)


def several(
    usage: str,
    text: str,
    make: Callable[..., Any],
    ok: Callable[..., bool] | None = None,
    limits: str = "",
    **more: Any,  # noqa: ANN401 - as option has them
) -> Any:  # noqa: ANN401 - a field of any type
    """Return a field made of several numbers; ``limits`` say when they are ``ok``."""
    return option(usage, text, numbers(usage.split()[-1], make, ok, limits), **more)


def as_they_are(*found: float) -> tuple[float, ...]:
    """Return the numbers unchanged."""
    return found


def refusal(text: str, expected: str) -> argparse.ArgumentTypeError:
    """Return the error that says what was found and what was expected."""
    return argparse.ArgumentTypeError(f"found {text!r}; expected {expected}")


def numbers(
    form: str,
    make: Callable[..., Any],
    ok: Callable[..., bool] | None = None,
    limits: str = "",
) -> Reader:
    """Return a reader of finite numbers, with commas between them and colons between groups.

    Parameters
    ----------
    form
        One word a number, as ``--help`` shows them: ``T:DX,DY``; in brackets what may be left out.
    make
        Makes the value of the numbers.
    ok
        Whether the numbers are possible.
    limits
        When they are, in words.
    """
    counts = [
        range(1 + group.split("[")[0].count(","), 2 + group.count(",")) for group in form.split(":")
    ]
    short, full = re.sub(r"\[.*]", "", form), re.sub(r"[\[\]]", "", form)
    expected = (form if short == full else f"{short} or {full}") + limits

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
    return numbers(expected, float, lambda value: low <= value <= high)


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
        return numbers("HZ,NM[,DAMPING]", line, possible)(rest.replace(":", ","))  # type: ignore[no-any-return]
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
    """Read a zenoh endpoint; a wrong one would only look like a missing service."""
    if _ENDPOINT.fullmatch(text) is None:
        raise refusal(text, "PROTOCOL/ADDRESS like tcp/127.0.0.1:7447")
    return text
