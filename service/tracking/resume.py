"""What a restart of the service leaves standing: the registration, an acquisition, orders.

What was said last counts: an order outlives the service, and ends with the next one, or when the
settings say something else than they did when it was given.
"""

from __future__ import annotations

from dataclasses import replace

from service.tracking.acquisition import inherited, left_behind
from service.tracking.alarms import logged
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.state import Level, Mode, Orders, Saved, TrackerState
from service.tracking.validity import aged


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


CLOCKS_AGREE_S = 60.0
"""A state from further in the future than this was saved under another clock."""


def saved_of(state: TrackerState, now_ns: int) -> Saved | None:
    """Return what is worth keeping of a state; None: nothing is known yet, nor ordered."""
    known, acquisition, orders = state.registration, left_behind(state), orders_of(state)
    if known is not None:
        bias = known.bias and replace(known.bias, earlier=None)
        known = replace(known, bias=bias, candidate=None, earlier=None)
    elif acquisition is None and orders == Orders():
        return None
    return Saved(
        system=state.system,
        saved_ns_utc=now_ns,
        session=state.rtc.session if state.rtc is not None else None,
        in_use=state.in_use,
        pointing=state.pointing,
        registration=known,
        acquisition=acquisition,
        orders=None if orders == Orders() else orders,
    )


def with_orders(left: Saved, state: TrackerState) -> Saved | None:
    """Return what was saved before, with what has been ordered since; None: it is that already.

    While nothing is known of α, what another night has left of it stays.
    """
    orders = orders_of(state)
    return None if (left.orders or Orders()) == orders else replace(left, orders=orders)


def resumed(state: TrackerState, saved: Saved, policy: Policy, now_ns: int) -> TrackerState:
    """Return the state with α taken over, σ grown by the time away, and no window to confirm it.

    It is a start for the fit and something to judge the matrix in use with; until windows of this
    run agree with it nothing is made from it. An acquisition that was under way comes with it, and
    what an operator has ordered stands, whatever becomes of α.
    """
    if saved.orders is not None and saved.system == state.system:
        state = obeyed(state, saved.orders, now_ns)
    reason = _why_not(state, saved, now_ns)
    if reason is not None:
        text = f"the α saved before the restart is not taken over: {reason}"
        return logged(state, "registration.not-restored", text, now_ns, Level.WARNING)
    if saved.acquisition is not None:
        state = inherited(state, saved.acquisition, now_ns)
    known = saved.registration
    if known is None:
        return state
    away_s = max(now_ns - known.arrived_ns_utc, 0) / SECOND_NS
    known = replace(known, n_windows=0, restored_ns_utc=now_ns)
    text = f"α of {away_s:.0f} s ago; {saved.in_use or 'no known matrix'} was in use then"
    state = logged(replace(state, registration=known), "registration.restored", text, now_ns)
    return aged(state, policy, now_ns)


def _why_not(state: TrackerState, saved: Saved, now_ns: int) -> str | None:
    if saved.system != state.system:
        return f"it is of system {saved.system}, this is {state.system}"
    ahead_s = (saved.saved_ns_utc - now_ns) / SECOND_NS
    if ahead_s > CLOCKS_AGREE_S:
        return f"it was saved {ahead_s:.0f} s in the future: is this machine's clock right?"
    known = saved.registration
    if known is None:
        return None
    for name, found, expected in (
        ("basis", known.basis_id, state.basis_id),
        ("configuration", known.config_id, state.config_id),
    ):
        if expected is not None and found != expected:
            return f"it is of {name} {found}, the instrument file has {expected}"
    return None
