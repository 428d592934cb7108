"""The RTC's loop as an operator changes it: opened, closed, its gains set or tried."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from service.control.gains import GainTable, gain_table
from service.errors import CommandError
from service.tracking import events as ev
from service.tracking.loop import CommandState, LoopCommand
from service.tracking.policy import SECOND_NS
from service.tracking.reconstructors import extended_gains
from service.tracking.registration import ModeGain
from service.tracking.state import Level
from service.tracking.turn import Turn
from service.wire import Loop, LoopRequest, RampRequest, Status

RAMP_GROUPS = ((0, 1), (2, 99), (100, None))
"""Tip and tilt, to mode 100, the rest: the paper's groups (Heritier et al. 2018, section 5)."""

RAMP_GAINS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
RAMP_STEP_S = 1.0
"""At each gain: an integrator settles in a tenth of it."""

CLOSE_AGAIN_EVERY_S = 5.0
"""An RTC that still measures refuses; it is asked again."""

CLOSE_AGAIN_FOR_S = 3600.0
"""Then somebody wants the loop open."""


_LOOP = {None: None, True: Loop.CLOSED, False: Loop.OPEN}


def table_of(measured: tuple[ModeGain, ...], n_modes: int) -> GainTable:
    """Return the table of the first ``n_modes`` modes; nothing measured: what is expected."""
    return gain_table(
        np.array([gain.mode for gain in measured], dtype=np.intp),
        np.array([gain.gain for gain in measured]),
        np.array([gain.sigma for gain in measured]),
        n_modes,
    )


def set_loop(turn: Turn, command: ev.SetLoop) -> None:
    """Ask the RTC to change its loop.

    Raises
    ------
    CommandError
        If it makes no sense in this state.
    """
    rtc = _there(turn, "loop")
    n_controlled = command.n_controlled
    if n_controlled is not None and not 1 <= n_controlled <= rtc.n_modes:
        raise CommandError(f"loop: found {n_controlled} modes; expected 1 to {rtc.n_modes}")
    groups, n_modes = command.gains, n_controlled or rtc.n_controlled
    gains = None if groups is None else _gains(rtc, groups, n_modes)
    if command.effective_gain is not None:
        gains = _compensated(turn, rtc, command.effective_gain, n_modes)
    if command.closed is not None:
        turn.state = replace(turn.state, close_since_ns_utc=None)
    _ask(
        turn,
        LoopRequest(
            id=f"loop-{turn.now_ns}",
            loop=_LOOP[command.closed],
            gains=gains,
            leak=command.leak,
            n_controlled=n_controlled,
        ),
        _said(command),
        judged=command.effective_gain is not None,
    )


def ramp(turn: Turn, command: ev.Ramp) -> None:
    """Ask the RTC to try gains on groups of modes.

    Raises
    ------
    CommandError
        If it makes no sense in this state.
    """
    rtc = _there(turn, "ramp")
    if rtc.loop == "open":
        raise CommandError("ramp: found the loop open; expected it closed, to see its residual")
    groups = command.groups or _paper_groups(rtc.n_controlled)
    _check_ranges("ramp", groups, rtc.n_controlled)
    gains = command.gains or RAMP_GAINS
    n_frames = max(1, round((command.step_s or RAMP_STEP_S) * rtc.frame_rate_hz))
    lasts_s = len(groups) * len(gains) * n_frames / rtc.frame_rate_hz
    spans = ", ".join(f"{first} to {last}" for first, last in groups)
    text = f"{len(gains)} gains on modes {spans}: {lasts_s:.0f} s"
    name = f"ramp-{turn.now_ns}"
    request = RampRequest(id=name, groups=groups, gains=gains, frames_per_gain=n_frames)
    _ask(turn, request, text, lasts_s)


def on_answer(turn: Turn, command: str, outcome: CommandState, reason: str) -> None:
    """Note what became of a command; one that a later one has replaced is only logged."""
    asked, text = turn.state.loop_command, command
    if asked is not None and asked.id == command:
        until_ns = turn.now_ns + round(asked.lasts_s * SECOND_NS)
        ended = replace(asked, state=outcome, reason=reason, until_ns_utc=until_ns)
        turn.state = replace(turn.state, loop_command=ended)
        text = asked.text
    level = Level.INFO if outcome is CommandState.ACCEPTED else Level.WARNING
    turn.log(f"loop.{outcome}", f"{text}: {reason}" if reason else text, level)


def end_ramp(turn: Turn) -> None:
    """Note that no ramp can be under way: the RTC has begun a new session."""
    asked = turn.state.loop_command
    turn.state = replace(turn.state, loop_command=asked and replace(asked, lasts_s=0.0))


def begin_closing(turn: Turn) -> None:
    """Close the loop again that a measurement has opened which was given up."""
    turn.state = replace(turn.state, close_since_ns_utc=turn.now_ns)
    close_again(turn)


def close_again(turn: Turn) -> None:
    """Close the loop that a measurement opened which was then given up, as often as it takes."""
    since_ns, rtc = turn.state.close_since_ns_utc, turn.rtc
    if since_ns is None or rtc is None:
        return
    waited_s = (turn.now_ns - since_ns) / SECOND_NS
    # a measurement only just asked for may open it yet
    closed = rtc.loop != "open"
    if waited_s > (CLOSE_AGAIN_EVERY_S if closed else CLOSE_AGAIN_FOR_S):
        turn.state = replace(turn.state, close_since_ns_utc=None)
        return
    last = turn.state.loop_command
    recent = last is not None and turn.now_ns - last.asked_ns_utc < CLOSE_AGAIN_EVERY_S * SECOND_NS
    if not closed and not recent:
        request = LoopRequest(id=f"loop-{turn.now_ns}", loop=Loop.CLOSED)
        _ask(turn, request, "close again after a measurement given up")


def _gains(rtc: Status, groups: tuple[ev.GainGroup, ...], n_modes: int) -> tuple[float, ...]:
    """Return a gain for each mode of the basis: those in force, but for the groups.

    The status of an open loop does not tell the gains it will close with.
    """
    ranges = tuple((group.first, group.last) for group in groups)
    _check_ranges("loop", ranges, n_modes)
    named = sum(last - first + 1 for first, last in ranges)
    if rtc.loop == "open" and named < n_modes:
        raise CommandError(
            f"loop: found gains for {named} modes; expected all {n_modes} while the loop is open, "
            "for its status does not tell the others"
        )
    gains = list(extended_gains(rtc, n_modes))
    for group in groups:
        gains[group.first : group.last + 1] = [group.gain] * (group.last - group.first + 1)
    return tuple(gains)


def _compensated(turn: Turn, rtc: Status, in_effect: float, n_modes: int) -> tuple[float, ...]:
    """Return the gains that act alike on every controlled mode; the others stay at 0."""
    known = turn.known
    if known is None or not known.optical_gains:
        raise CommandError(
            "loop: found no measured optical gain; expected a dithered window before gains are "
            "compensated for it"
        )
    gains = table_of(known.optical_gains, n_modes).loop_gains(in_effect)
    return (*gains.tolist(), *(0.0,) * (rtc.n_modes - n_modes))


def _paper_groups(n_controlled: int) -> tuple[tuple[int, int], ...]:
    end = n_controlled - 1
    return tuple(
        (first, end if last is None else min(last, end))
        for first, last in RAMP_GROUPS
        if first <= end
    )


def _check_ranges(what: str, ranges: tuple[tuple[int, int], ...], n_modes: int) -> None:
    for first, last in ranges:
        if not 0 <= first <= last < n_modes:
            raise CommandError(
                f"{what}: found modes {first} to {last}; expected a range within 0 to {n_modes - 1}"
            )
    for before, after in pairwise(sorted(ranges)):
        if after[0] <= before[1]:
            raise CommandError(f"{what}: found mode {after[0]} in two groups; expected it in one")


def _said(command: ev.SetLoop) -> str:
    said = {True: ["close"], False: ["open"], None: []}[command.closed]
    said += [f"gain {g.gain:g} on modes {g.first} to {g.last}" for g in command.gains or ()]
    if command.effective_gain is not None:
        said.append(f"gain {command.effective_gain:g} in effect on every mode, by the gain table")
    if command.leak is not None:
        said.append(f"leak {command.leak:g}")
    if command.n_controlled is not None:
        said.append(f"{command.n_controlled} modes from the next reconstructor on")
    return ", ".join(said) or "no change"


def _ask(
    turn: Turn,
    request: LoopRequest | RampRequest,
    text: str,
    lasts_s: float = 0.0,
    *,
    judged: bool = False,
) -> None:
    asked = LoopCommand(
        id=request.id,
        text=text,
        state=CommandState.ASKED,
        asked_ns_utc=turn.now_ns,
        lasts_s=lasts_s,
    )
    turn.state = replace(turn.state, loop_command=asked)
    turn.log("loop.asked", text)
    turn.ask(ev.Ask(request=request, judged=judged))


def _there(turn: Turn, what: str) -> Status:
    if turn.rtc is None:
        raise CommandError(f"{what}: no RTC is there")
    return turn.rtc
