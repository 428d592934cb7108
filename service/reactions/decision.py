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


def decide(state: TrackerState, policy: Policy, now_ns: int) -> Step:
    """Return what is to be done now, and the state that remembers having asked for it."""
    if state.rtc is None or forbidding(state, Act.ASK) is not None:
        return state, ()
    if forbidding(state, Act.DECIDE) is not None or ramping(state, now_ns) is not None:
        return without_unwanted(state, state.rtc, policy, now_ns)
    effects: list[Effect] = []
    for choose in (_fetch, choose_dither, judge_in_use, choose_update):
        state, wanted = choose(state, state.rtc, policy, now_ns)
        effects += wanted
    return state, tuple(effects)


def _fetch(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Ask for the matrix in use when nobody here has it."""
    if rtc.cm_id is None or state.reconstructor(rtc.cm_id) is not None:
        return state, ()
    if now_ns < state.retry_ns_utc:
        return state, ()
    return replace(state, retry_ns_utc=now_ns + 3 * SECOND_NS), (FetchMatrix(id=rtc.cm_id),)
