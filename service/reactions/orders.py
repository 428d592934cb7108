"""What an operator has ordered, and what of it a restart of the service leaves standing.

What was said last counts: an order outlives the service, and ends with the next one, or when the
settings say something else than they did when it was given.
"""

from __future__ import annotations

from dataclasses import replace

from service.reactions.journal import logged
from service.state import Level, Mode, Orders, TrackerState


def with_mode(state: TrackerState, mode: Mode) -> TrackerState:
    """Return the state in the mode an operator orders."""
    of_settings = state.settings_mode or state.mode
    return replace(state, mode=mode, settings_mode=None if mode is of_settings else of_settings)


def orders_of(state: TrackerState) -> Orders:
    """Return what the next service has to obey; the default is nothing."""
    return Orders(
        mode=None if state.settings_mode is None else state.mode,
        settings_mode=state.settings_mode,
        dither_stopped=state.dither_stopped,
    )


def obeyed(state: TrackerState, orders: Orders, now_ns: int) -> TrackerState:
    """Return the state of a fresh service, its mode the settings', that obeys what was ordered."""
    if orders.dither_stopped:
        text = "by an operator before the restart; POST /v1/dither with start lets it dither again"
        state = replace(state, dither_stopped=True)
        state = logged(state, "dither.stopped", text, now_ns, Level.WARNING)
    of_settings, ordered = state.mode, orders.mode
    if ordered is None or ordered is of_settings:
        return state
    if of_settings is not orders.settings_mode:
        text = (
            f"mode is {of_settings}: the settings, which said {orders.settings_mode} when an "
            f"operator set {ordered}, have been changed since"
        )
        return logged(state, "mode", text, now_ns, Level.WARNING)
    text = (
        f"mode is {ordered}, as an operator set it before the restart, and not {of_settings} as "
        "the settings say: PUT /v1/mode changes it"
    )
    state = replace(state, mode=ordered, settings_mode=of_settings)
    return logged(state, "mode", text, now_ns, Level.WARNING)
