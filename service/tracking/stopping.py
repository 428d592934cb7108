"""Stop everything, until it is released: whatever runs is ended, nothing else begun or sent."""

from __future__ import annotations

from dataclasses import replace

from service.errors import CommandError
from service.tracking import commands as cmd
from service.tracking.acquisition_stages import abort
from service.tracking.activity import ramping
from service.tracking.alarms import STOPPED, Act
from service.tracking.dither import drop, make_way, stop_unwanted
from service.tracking.measuring import give_up
from service.tracking.state import Orders
from service.tracking.turn import Turn


def stop(turn: Turn, command: cmd.StopEverything) -> None:
    """End what runs as its own command would; from then on ask only for dithers to end.

    An acquisition gives back the loop as it was found, now. One that a measurement has opened is
    closed again when all is released: the RTC is busy until then. A gain ramp is the RTC's, and
    ends by itself; only opening the loop would end it sooner.
    """
    if not turn.state.stopped_because:
        ramp = ramping(turn.state, turn.now_ns)
        left = "" if ramp is None else f"; {ramp.id} is the RTC's and ends by itself"
        _stay(turn, f"everything was stopped {command.signed}{left}")
    if turn.acquisition.under_way:
        abort(turn, "by the operator", held_off=True)
    for record in (turn.state.measuring, turn.state.gathering):
        if record is not None:
            give_up(turn, record.id)
    if turn.rtc is None or turn.forbidden(Act.ASK) is not None:
        drop(turn)
    else:
        make_way(turn)


def resume(turn: Turn, command: cmd.Resume) -> None:
    """Go on in the mode and with the dither that were ordered before, or meanwhile.

    Raises
    ------
    CommandError
        If nothing is stopped.
    """
    if not turn.state.stopped_because:
        raise CommandError("resume: nothing is stopped")
    turn.state = replace(turn.state, stopped_because="")
    turn.calm(STOPPED)
    turn.log("resumed", command.signed)


def stay_stopped(turn: Turn, orders: Orders) -> None:
    """Stay stopped though the service was started again."""
    if orders.stopped:
        _stay(turn, orders.stopped)


def keep_stopped(turn: Turn) -> None:
    """Have no dither of the service's own on the mirror while everything is stopped."""
    if turn.rtc is not None and turn.forbidden(Act.ASK) is None:
        stop_unwanted(turn, turn.rtc)


def _stay(turn: Turn, text: str) -> None:
    turn.state = replace(turn.state, stopped_because=text)
    turn.alarm(STOPPED, f"{text}: nothing is dithered, made or sent until the stop is released")
