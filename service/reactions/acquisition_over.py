"""An acquisition that is over: what of it still matters, and when it is forgotten."""

from __future__ import annotations

from dataclasses import replace

from service.events import Event, SetMode
from service.reactions.acquisition_closed import ENOUGH_WINDOWS
from service.reactions.journal import logged, without_alarm
from service.state import Acquisition, AcquisitionStage, TrackerState


def forgotten(state: TrackerState, event: Event, now_ns: int) -> TrackerState:
    """Return the state without an acquisition that holds back the next, once it need not.

    One that had failed: when α is known without it, for whoever closed the loop has mended what it
    could not, and the next trouble is another one. One that an operator ended: then too, or when an
    operator sets the mode, which is to say what the service may do by itself.
    """
    acquisition = state.acquisition
    failed = acquisition.stage is AcquisitionStage.FAILED
    if not failed and not acquisition.held_off:
        return state
    if acquisition.held_off and isinstance(event, SetMode):
        text = f"an operator has set the mode, {event.mode}, since the last was ended"
    elif _followed(state):
        text = f"{ENOUGH_WINDOWS} windows agree in the closed loop: none is needed any more"
    else:
        return state
    idle = Acquisition(text=text, since_ns_utc=now_ns)
    state = without_alarm(replace(state, acquisition=idle), "acquisition", now_ns)
    return logged(state, "acquisition.idle", text, now_ns)


def _followed(state: TrackerState) -> bool:
    """Return whether windows that came since agree on α, in a closed loop."""
    rtc, known = state.rtc, state.registration
    if rtc is None or not rtc.in_loop or known is None:
        return False
    since = state.windows_accepted - state.acquisition.windows
    believed = known.usable and known.candidate is None
    return believed and min(since, known.n_windows) >= ENOUGH_WINDOWS
