"""What the frames hold of a dither: whether it is what was asked for, whatever a status says.

The telemetry has the dither's part of every command in columns of its own, and modes outside the
loop move by nothing else. Once a second the strength of each mode, on its line, is compared with
what was asked for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock

Array = NDArray[Any]

CHECK_S = 1.0
"""Of frames that hold the dither, between two findings."""

LEAST_FRAMES = 50

LOUDER, WEAKER = 1.25, 0.5
"""Of what was asked for: a mode that is beyond is named."""

STRAY = 0.2
"""Share of what was asked for in all that modes nobody asked for may carry together."""

_NAMED = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """A dither as the service asked for it."""

    modes: tuple[int, ...]
    """0-based basis indices."""

    amplitude_m: tuple[float, ...]
    """RMS of each, metres OPD."""

    frequency_hz: tuple[float, ...]
    """One for each mode of a sine; random signs have none."""

    frame_rate_hz: float
    first_seq: int
    stop_seq: int
    """First frame that holds it, and the first that holds it no more."""

    own: tuple[bool, ...]
    """Whether a mode is outside the loop: all that its command does is the dither."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a second of frames holds of a dither."""

    found_m: float
    """RMS of all modes together, metres OPD."""

    asked_m: float
    text: str
    """What is otherwise than it was asked for; empty: nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Meter:
    """Sums over the frames of a dither: feed it blocks with ``measured``."""

    asked: Asked
    n_frames: int = 0
    """Summed so far."""

    squares: Array | None = None
    """``(n_modes,)`` sum of the squares of the dither columns, metres²."""

    lines: Array | None = None
    """``(2, n_asked)`` dither columns and steps of the commands of the asked modes, demodulated."""

    last_m: Array | None = None
    """``(n_asked,)`` commands of the frame before the next block; None: it is not known."""

    next_seq: int = 0
    """The frame those are followed by."""


def measured(meter: Meter, block: FrameBlock) -> tuple[Meter, Finding | None]:
    """Add a block of frames; return what was found if a second of them is full."""
    if block.dither_m is None:
        return meter, None
    asked = meter.asked
    rows = slice(
        max(asked.first_seq - block.first_seq, 0),
        max(min(asked.stop_seq - block.first_seq, block.n_frames), 0),
    )
    dither = block.dither_m[rows]
    if not dither.any():
        return meter, None
    squares = np.einsum("km,km->m", dither, dither).astype(float)
    meter, lines = _demodulated(meter, block, rows, dither[:, list(asked.modes)])
    meter = replace(
        meter,
        n_frames=meter.n_frames + len(dither),
        squares=squares if meter.squares is None else meter.squares + squares,
        lines=lines if meter.lines is None else meter.lines + lines,
    )
    if meter.n_frames < max(round(CHECK_S * asked.frame_rate_hz), LEAST_FRAMES):
        return meter, None
    begun = Meter(asked=asked, last_m=meter.last_m, next_seq=meter.next_seq)
    return begun, _found(meter)


def _demodulated(
    meter: Meter, block: FrameBlock, rows: slice, dither: Array
) -> tuple[Meter, Array]:
    """Return ``(2, n_asked)`` sums at the lines; random signs have none and are left out.

    Of the commands the steps from frame to frame: turbulence that is played on the mirror is slow.
    """
    asked = meter.asked
    if not asked.frequency_hz:
        return meter, np.zeros((2, len(asked.modes)), complex)
    commands = block.commands_m[rows][:, list(asked.modes)].astype(float)
    first_seq = block.first_seq + rows.start
    follows = meter.last_m is not None and meter.next_seq == first_seq
    before = meter.last_m if follows else commands[0]
    steps = np.diff(commands, axis=0, prepend=np.asarray(before)[None])
    seq = first_seq + np.arange(len(commands))
    phasors = np.exp(-2j * np.pi * np.outer(seq / asked.frame_rate_hz, asked.frequency_hz))
    meter = replace(meter, last_m=commands[-1], next_seq=first_seq + len(commands))
    return meter, np.stack([(phasors * dither).sum(axis=0), (phasors * steps).sum(axis=0)])


def _found(meter: Meter) -> Finding:
    asked = meter.asked
    if meter.squares is None or meter.lines is None:
        raise ValueError("no frame has been summed")
    rms = np.sqrt(meter.squares / meter.n_frames)
    wanted, modes = np.array(asked.amplitude_m), list(asked.modes)
    told, moved = np.abs(meter.lines) * np.sqrt(2.0) / meter.n_frames
    carried, rate_hz = rms[modes], asked.frame_rate_hz
    if asked.frequency_hz:
        moved = moved / np.abs(2.0 * np.sin(np.pi * np.array(asked.frequency_hz) / rate_hz))
        # a mode of the loop answers the dither: there its column alone tells how strong it is
        carried = np.maximum(carried, np.where(asked.own, moved, 0.0))
    stray = rms.copy()
    stray[modes] = 0.0
    total = float(np.sqrt(np.sum(carried**2) + np.sum(stray**2)))
    wanted_total = float(np.sqrt(np.sum(wanted**2)))
    said = [
        *_off(asked, carried, wanted, told),
        *_strays(stray, wanted_total),
        *_hidden(asked, told, moved),
    ]
    head = f"the frames hold {1e9 * total:.3g} nm RMS of dither in all, {1e9 * wanted_total:.3g} nm"
    text = f"{head} were asked for: {'; '.join(said)}" if said else ""
    return Finding(found_m=total, asked_m=wanted_total, text=text)


def _off(asked: Asked, carried: Array, wanted: Array, told: Array) -> list[str]:
    """Return which of the modes asked for are too strong, too weak, or at another frequency."""
    ratio, said = carried / wanted, []
    for k in np.flatnonzero((ratio > LOUDER) | (ratio < WEAKER))[:_NAMED]:
        found = f"mode {asked.modes[k]} carries {1e9 * carried[k]:.3g} nm"
        said.append(f"{found} instead of {1e9 * wanted[k]:.3g} nm")
    if not asked.frequency_hz:
        return said
    for k in np.flatnonzero((ratio >= WEAKER) & (told < WEAKER * carried))[:_NAMED]:
        line = f"{asked.frequency_hz[k]:g} Hz"
        said.append(f"mode {asked.modes[k]} moves at another frequency than {line}")
    return said


def _strays(stray: Array, wanted_m: float) -> list[str]:
    """Return which modes carry a dither that nobody asked for."""
    together = float(np.sqrt(np.sum(stray**2)))
    if together <= STRAY * wanted_m:
        return []
    worst = np.argsort(stray)[::-1]
    worst = worst[stray[worst] > 0.0]
    named = ", ".join(str(mode) for mode in sorted(worst[:_NAMED].tolist()))
    more = ", ..." if len(worst) > _NAMED else ""
    return [f"modes nobody asked for ({named}{more}) carry {1e9 * together:.3g} nm"]


def _hidden(asked: Asked, told: Array, moved: Array) -> list[str]:
    """Return which modes outside the loop move more than the columns of the dither say."""
    if not asked.frequency_hz:
        return []
    much = moved > LOUDER * told + WEAKER * np.array(asked.amplitude_m)
    hidden = np.flatnonzero(np.array(asked.own) & much)
    return [
        f"the commands of mode {asked.modes[k]} hold {1e9 * moved[k]:.3g} nm at "
        f"{asked.frequency_hz[k]:g} Hz, its dither column {1e9 * told[k]:.3g} nm"
        for k in hidden[:_NAMED]
    ]
