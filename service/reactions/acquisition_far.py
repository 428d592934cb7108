"""The stages of an acquisition with the loop open: from where the mirror may be to where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service import events as ev
from service.model.misregistration import Misregistration
from service.reactions.acquisition_ends import again, entered, fail, told, without_dither
from service.reactions.acquisition_plan import far_dither, reach_of, sigma_of
from service.reactions.evidence import taken, why_void
from service.reactions.matrices import Step
from service.reactions.policy import SECOND_NS, Policy
from service.state import AcquisitionStage, Registration, RtcView, TrackerState

AGREE = 23.5
"""χ² of the difference of two estimates (4 degrees of freedom) that one in 10^4 exceeds."""

MOST_MISSES = 4
"""Windows of a stage that lead nowhere before the loop is opened anew."""

STOPS_WITHIN_S = 2.0
"""A dither that was told to stop, by the status."""


def far_stage(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Open the loop, then keep the dither of the stage running."""
    acquisition = state.acquisition
    if acquisition.stage is AcquisitionStage.OPENING:
        if rtc.loop != "open":
            if acquisition.command is not None:
                return state, ()
            return told(state, ev.SetLoop(closed=False), now_ns)
        text = "looking for the registration with the loop open, on smooth modes"
        state = entered(state, AcquisitionStage.COARSE, text, now_ns)
    elif rtc.loop != "open":
        return again(state, "somebody closed the loop", now_ns)
    return _dithered(state, rtc, policy, now_ns)


def on_far(state: TrackerState, event: ev.FarFitted, policy: Policy, now_ns: int) -> Step:
    """Take over where a window puts the mirror, or hold it against where another one did."""
    rtc, acquisition, estimate = state.rtc, state.acquisition, event.found.estimate
    if why_void(state, taken(event.began_ns_utc, estimate.t_ns_utc)) is not None:
        return state, ()
    if acquisition.stage not in {AcquisitionStage.COARSE, AcquisitionStage.CONFIRMING}:
        return state, ()
    if (
        rtc is None
        or estimate.session != rtc.session
        or not _of_stage(state, rtc, policy, estimate.modes)
    ):
        return state, ()
    covariance = estimate.covariance + np.diag(reach_of(acquisition.stage).floor ** 2)
    before = acquisition
    acquisition = replace(acquisition, alpha=estimate.alpha, covariance=covariance)
    if before.stage is AcquisitionStage.COARSE or before.alpha is None or before.covariance is None:
        state, effects = without_dither(replace(state, acquisition=acquisition))
        text = f"{_said(estimate.alpha)} +- {sigma_of(acquisition)}: other modes must confirm it"
        return entered(state, AcquisitionStage.CONFIRMING, text, now_ns), effects
    difference = estimate.alpha.vector - before.alpha.vector
    chi2 = float(difference @ np.linalg.solve(covariance + before.covariance, difference))
    if chi2 > AGREE:
        reason = (
            f"two sets of modes disagree: {_said(before.alpha)} and {_said(estimate.alpha)}, "
            f"chi2 {chi2:.0f}, expected at most {AGREE}"
        )
        return again(state, reason, now_ns)
    registration = Registration(
        alpha=estimate.alpha,
        covariance=covariance,
        floor=policy.floor,
        t_ns_utc=estimate.t_ns_utc,
        arrived_ns_utc=now_ns,
        n_windows=1,
        basis_id=state.basis_id,
        config_id=state.config_id,
    )
    state = replace(state, acquisition=acquisition, registration=registration)
    state, effects = without_dither(state)
    text = f"{_said(estimate.alpha)} +- {sigma_of(acquisition)}: closing the loop"
    return entered(state, AcquisitionStage.PARTIAL, text, now_ns), effects


def on_missed(state: TrackerState, reason: str, now_ns: int) -> Step:
    """Count a window that led nowhere; after a few begin anew."""
    misses = state.acquisition.misses + 1
    if misses >= MOST_MISSES:
        return again(state, reason, now_ns)
    return replace(state, acquisition=replace(state.acquisition, misses=misses)), ()


def _dithered(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Ask for the dither of the stage once no other one runs."""
    if state.dither is not None:
        return state, ()
    if rtc.dither_id is not None:
        stopping = rtc.dither_id == state.dithering.stopped_id
        since_s = (now_ns - state.acquisition.since_ns_utc) / SECOND_NS
        if now_ns < state.retries.dither_ns_utc or (stopping and since_s < STOPS_WITHIN_S):
            return state, ()
        retry_ns = now_ns + round(STOPS_WITHIN_S * SECOND_NS)
        retries = state.retries.later(dither_ns_utc=retry_ns)
        return replace(state, retries=retries), (ev.AskNoDither(),)
    if now_ns < state.retries.dither_ns_utc:
        return state, ()
    dither = far_dither(state.acquisition.stage, rtc, policy, now_ns)
    if isinstance(dither, str):
        return fail(state, dither, now_ns)
    return replace(state, dither=dither), (ev.AskDither(dither=dither),)


def _of_stage(state: TrackerState, rtc: RtcView, policy: Policy, modes: tuple[int, ...]) -> bool:
    """Return whether these are the modes of the present stage."""
    dither = far_dither(state.acquisition.stage, rtc, policy, 0)
    return not isinstance(dither, str) and dither.modes == modes


def _said(alpha: Misregistration) -> str:
    x, y, rotation, magnification = alpha.to_boundary().values()
    return f"({x:+.2f}, {y:+.2f} subap, {rotation:+.2f} deg, {magnification:.4f})"
