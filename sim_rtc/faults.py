"""Faults on request: what an RTC, a sensor or a network does at its worst, on a schedule.

``KIND@T[:ARGUMENTS]`` begins a fault at T seconds of loop time. The plan only knows what is to
happen when; the wire's faults are carried out in :mod:`sim_rtc.wire_faults`, the computer's in
:mod:`sim_rtc.sabotage`, those of reconstructors in :mod:`sim_rtc.intake`.
"""

from __future__ import annotations

import argparse
import textwrap
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from typing_extensions import override


class FaultKind(StrEnum):
    """What goes wrong."""

    LOST = "lost"
    LATE = "late"
    DUPLICATED = "duplicated"
    REORDERED = "reordered"
    NAN = "nan"
    FROZEN = "frozen"
    GARBAGE = "garbage"
    SHAPE = "shape"
    BASIS = "basis"
    SECOND = "second"
    CLOCK = "clock"
    STALL = "stall"
    PAUSE = "pause"
    RESTART = "restart"
    OPEN = "open"
    SATURATION = "saturation"
    REFUSE = "refuse"
    MUTE = "mute"
    DEAF = "deaf"
    LATE_SWAP = "late-swap"
    DITHER_LOST = "dither-lost"
    DITHER_LATE = "dither-late"


@dataclass(frozen=True, slots=True)
class Argument:
    """One number behind the colon."""

    name: str
    default: float
    low: float
    high: float


_FOREVER = 1e9
_SHARE: Final = Argument("SHARE", 1.0, 0.0, 1.0)
_SECONDS: Final = Argument("SECONDS", 1.0, 0.001, _FOREVER)
_DELAY: Final = Argument("DELAY", 0.3, 0.001, 60.0)

FORMS: Final[dict[FaultKind, tuple[tuple[Argument, ...], str]]] = {
    FaultKind.LOST: ((_SHARE, _SECONDS), "a share of the batches is never sent; 1 is a gap"),
    FaultKind.LATE: ((_DELAY, _SECONDS), "batches are sent DELAY seconds of loop time late"),
    FaultKind.DUPLICATED: ((_SHARE, _SECONDS), "a share of the batches is sent twice"),
    FaultKind.REORDERED: ((_SHARE, _SECONDS), "a share of the batches changes place with the next"),
    FaultKind.NAN: ((_SHARE, _SECONDS), "a share of the frames has a slope that is not a number"),
    FaultKind.FROZEN: ((_SECONDS,), "the slopes sent repeat; the loop itself goes on"),
    FaultKind.GARBAGE: (
        (_SHARE, _SECONDS),
        "a share of the batches is cut short or, every other one, has a nonsense header",
    ),
    FaultKind.SHAPE: ((_SECONDS,), "the last slope of every frame is missing, header included"),
    FaultKind.BASIS: ((_SECONDS,), "frames and status name another modal basis"),
    FaultKind.SECOND: ((_SECONDS,), "a second RTC sends a session of its own in between"),
    FaultKind.CLOCK: (
        (Argument("STEP", 0.5, -3600.0, 3600.0),),
        "timestamps step by STEP seconds, for good",
    ),
    FaultKind.STALL: ((_SECONDS,), "nothing for SECONDS of wall-clock time, then all in a burst"),
    FaultKind.PAUSE: ((_SECONDS,), "nothing for SECONDS; the sequence goes on, timestamps step"),
    FaultKind.RESTART: (
        (_SECONDS,),
        "gone for SECONDS; then a new session from frame 0 with the first matrix",
    ),
    FaultKind.OPEN: ((_SECONDS,), "the loop opens (a new session) and closes again"),
    FaultKind.SATURATION: (
        (Argument("STROKE_NM", 50.0, 1.0, 1e5), _SECONDS),
        "no mode gets more than STROKE_NM nanometres RMS",
    ),
    FaultKind.REFUSE: (
        (Argument("COUNT", 1.0, 1.0, 1e6),),
        "so many reconstructors are rejected, with a reason",
    ),
    FaultKind.MUTE: ((_SECONDS,), "reconstructors are applied and never acknowledged"),
    FaultKind.DEAF: ((_SECONDS,), "reconstructors are neither applied nor acknowledged"),
    FaultKind.LATE_SWAP: (
        (Argument("DELAY", 4.0, 0.001, 600.0), _SECONDS),
        "reconstructors are staged, and applied DELAY seconds later",
    ),
    FaultKind.DITHER_LOST: ((_SECONDS,), "dithers are accepted and never reach the mirror"),
    FaultKind.DITHER_LATE: ((_DELAY, _SECONDS), "dithers begin DELAY after the announced frame"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault of the schedule."""

    kind: FaultKind
    time_s: float
    """When it begins, seconds of loop time."""

    values: tuple[float, ...]
    """One for each argument of its form, defaults filled in."""

    def value(self, name: str) -> float:
        """Return the argument of this name."""
        names = [argument.name for argument in FORMS[self.kind][0]]
        return self.values[names.index(name)]

    @property
    def end_s(self) -> float:
        """When it is over; a fault without a duration lasts until the next of its kind."""
        names = [argument.name for argument in FORMS[self.kind][0]]
        return self.time_s + (self.value("SECONDS") if "SECONDS" in names else _FOREVER)

    @override
    def __str__(self) -> str:
        """Return the text it was read from, defaults filled in."""
        return f"{self.kind}@{self.time_s:g}:{','.join(f'{value:g}' for value in self.values)}"


class FaultPlan:
    """The faults of a run and the loop time; read by any thread, ``now_s`` set by the loop's."""

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self.faults = tuple(sorted(faults, key=lambda fault: fault.time_s))
        self.now_s = 0.0
        """Loop time of the batch under way, seconds."""

    def active(self, kind: FaultKind, time_s: float | None = None) -> Fault | None:
        """Return the latest fault of a kind that lasts at ``time_s`` (None: now), or None."""
        at_s = self.now_s if time_s is None else time_s
        found = [f for f in self.faults if f.kind is kind and f.time_s <= at_s < f.end_s]
        return found[-1] if found else None


def read_fault(text: str) -> Fault:
    """Read a fault, ``KIND@T[:ARGUMENTS]``.

    Raises
    ------
    argparse.ArgumentTypeError
        If the kind is unknown or a number is missing its range; the text says what was expected.
    """
    name, _, rest = text.partition("@")
    if name not in FORMS:
        raise _refusal(text, f"KIND@T[:ARGUMENTS] with KIND one of {', '.join(FORMS)}")
    kind = FaultKind(name)
    form = FORMS[kind][0]
    expected = f"{kind}@T[:{','.join(a.name for a in form)}], T >= 0 seconds"
    time_text, _, arguments = rest.partition(":")
    try:
        time_s = float(time_text)
        given = [float(part) for part in arguments.split(",")] if arguments else []
    except ValueError:
        raise _refusal(text, expected) from None
    if not 0.0 <= time_s < _FOREVER or len(given) > len(form):
        raise _refusal(text, expected)
    values = (*given, *(argument.default for argument in form[len(given) :]))
    for value, argument in zip(values, form, strict=True):
        if not argument.low <= value <= argument.high:
            raise _refusal(text, f"{argument.name} from {argument.low:g} to {argument.high:g}")
    return Fault(kind=kind, time_s=time_s, values=values)


def manual() -> str:
    """Return the chapter of ``--help`` on faults."""
    lines = [
        "faults",
        "  --fault KIND@T[:ARGUMENTS], repeatable, begins at T seconds of loop time. Arguments, in",
        "  this order and with these defaults when left out:",
    ]
    for kind, (form, text) in FORMS.items():
        arguments = ",".join(f"{a.name}={a.default:g}" for a in form)
        head = f"    {kind + ' ' + arguments:<35}"
        lines += textwrap.wrap(text, 96, initial_indent=head, subsequent_indent=" " * 39)
    return "\n".join(lines) + "\n"


def _refusal(text: str, expected: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(f"found {text!r}; expected {expected}")
