"""An acquisition that is over: what of it still matters, and when it is forgotten."""

from __future__ import annotations

from dataclasses import replace

from service.reactions.acquisition_closed import ENOUGH_WINDOWS
from service.reactions.journal import logged, without_alarm
from service.state import Acquisition, AcquisitionStage, TrackerState


def forgotten(state: TrackerState, now_ns: int) -> TrackerState:
    """Return the state without an acquisition that had failed, once α is known without it.

    Whoever closed the loop has mended what it could not; the next trouble is another one.
    """
    if state.acquisition.stage is not AcquisitionStage.FAILED or not _followed(state):
        return state
    text = f"{ENOUGH_WINDOWS} windows agree in the closed loop: none is needed any more"
    idle = Acquisition(text=text, since_ns_utc=now_ns)
    state = without_alarm(replace(state, acquisition=idle), "acquisition", now_ns)
    return logged(state, "acquisition.idle", text, now_ns)


def _followed(state: TrackerState) -> bool:
    """Return whether windows that came since agree on α, in a closed loop."""
    rtc, known = state.rtc, state.registration
    if rtc is None or rtc.loop != "closed" or known is None:
        return False
    since = state.windows_accepted - state.acquisition.windows
    believed = known.usable and known.candidate is None
    return believed and min(since, known.n_windows) >= ENOUGH_WINDOWS
