"""What the service does by itself next: fetch, dither, judge, compute, from what it knows."""

from __future__ import annotations

from dataclasses import replace

from service.events import Effect, FetchMatrix
from service.reactions.activity import ramping
from service.reactions.alarms import Act, forbidding
from service.reactions.dither_schedule import choose_dither
from service.reactions.dither_unwanted import without_unwanted
from service.reactions.matrices import Step
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.update_choice import choose_update, judge_in_use
from service.state import RtcView, TrackerState

ASK_FIRST_S = 3.0
"""For the RTC's matrix to come before it is asked for again."""

ASK_AGAIN_S = 10.0
"""Between two questions for a matrix that was not to be had, or has no name."""


def decide(state: TrackerState, policy: Policy, now_ns: int) -> Step:
    """Return what is to be done now, and the state that remembers having asked for it."""
    if state.rtc is None or forbidding(state, Act.ASK) is not None:
        return state, ()
    chosen = [_fetch, choose_dither, judge_in_use, choose_update]
    if forbidding(state, Act.DECIDE) is not None or ramping(state, now_ns) is not None:
        chosen = [without_unwanted] if state.wrong_matrix is None else [_fetch, without_unwanted]
    effects: list[Effect] = []
    for choose in chosen:
        state, wanted = choose(state, state.rtc, policy, now_ns)
        effects += wanted
    return state, tuple(effects)


def _fetch(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Ask for the matrix in use when nobody here has it, its name, or a reason to trust it."""
    known = rtc.cm_id is not None and state.reconstructor(rtc.cm_id) is not None
    if known and state.wrong_matrix is None:
        return state, ()
    anew = rtc.cm_id is not None and not state.unfetched and state.wrong_matrix is None
    every_s = ASK_FIRST_S if anew else ASK_AGAIN_S
    if now_ns - state.applied_asked_ns_utc < every_s * SECOND_NS:
        return state, ()
    return replace(state, applied_asked_ns_utc=now_ns), (FetchMatrix(id=rtc.cm_id),)
