"""What an acquisition asks for: its dithers, its gains, when one is needed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.control.continuation import (
    FEWEST_LINES,
    FINER,
    SMOOTH,
    Reach,
    first_closed,
    lines_of,
    modes_of,
)
from service.reactions.alarms import Act, forbidding, forbids
from service.reactions.dither_choice import ACQUIRING_DITHER
from service.reactions.evidence import voided
from service.reactions.policy import SECOND_NS, Policy
from service.state import (
    Acquisition,
    AcquisitionStage,
    DitherView,
    LoopFound,
    Mode,
    RtcView,
    TrackerState,
)

WINDOW_S = 2.0
"""Of telemetry in one far estimate."""

DITHER_S = 6.0
"""Two windows and the time until they are fitted: a dead service leaves no dither behind."""

CLOSING_GAIN = 0.3
"""Of every mode of a loop that was found open: its status does not tell the gains."""

OUT_OF_HAND_S = 2.0
"""For so long before the loop is opened by the service itself."""

MISSES_BEFORE = 3
"""Windows in a row that found no registration, before the service acquires by itself."""

MISSES_DESPITE = 10
"""The same while α is known: what comes may only be bad telemetry, which opens no loop."""

NOT_CAPTURED = ("the fit did not settle", "outside the capture range")
"""How the reasons of such windows begin."""


def reach_of(stage: AcquisitionStage) -> Reach:
    """Return the band of modes that is dithered in a stage with the loop open."""
    return SMOOTH if stage is AcquisitionStage.COARSE else FINER


def far_dither(
    stage: AcquisitionStage, rtc: RtcView, policy: Policy, now_ns: int
) -> DitherView | str:
    """Return the dither of a stage with the loop open, or why there is none.

    It is strong: an open loop leaves the pyramid little response, and nothing is observed
    meanwhile that could be spoilt.
    """
    lines = lines_of(rtc.frame_rate_hz, WINDOW_S, rtc.max_dither_modes)
    modes = modes_of(reach_of(stage), rtc.n_modes, len(lines)) if lines else ()
    if len(modes) < FEWEST_LINES:
        return (
            f"found room for {len(modes)} dithered modes; expected at least {FEWEST_LINES}: the "
            f"RTC plays {rtc.max_dither_modes} at once, at {rtc.frame_rate_hz:g} Hz, and its basis "
            f"has {rtc.n_modes}"
        )
    return DitherView(
        id=f"{ACQUIRING_DITHER}{now_ns}",
        modes=modes,
        amplitude_m=(min(policy.acquisition_amplitude_m, rtc.max_dither_m),) * len(modes),
        frequency_hz=lines[: len(modes)],
        duration_s=DITHER_S,
        start_seq=None,
        asked_ns_utc=now_ns,
        window_s=WINDOW_S,
    )


def loop_found(state: TrackerState, rtc: RtcView, policy: Policy) -> LoopFound:
    """Return the loop as it is, and as it shall be closed again."""
    closed = rtc.loop != "open"
    out_of_hand = forbidding(state, Act.HOLD) is not None
    goal = rtc.n_controlled or min(policy.n_modes_target, rtc.n_modes)
    gains = rtc.gains if closed else (CLOSING_GAIN,) * goal
    return LoopFound(
        closed=closed,
        gains=gains,
        n_controlled=goal,
        leak=rtc.leak,
        held=closed and not out_of_hand,
    )


def left_open(state: TrackerState, rtc: RtcView) -> Acquisition | None:
    """Return the acquisition that was cut off, if the loop is as it left it.

    Opening a loop begins a session: the same one means that nobody has closed it in between.
    """
    left = state.acquisition.interruption
    if left is None or left.session != rtc.session or rtc.loop != "open":
        return None
    return state.acquisition


def gains_for(found: LoopFound, n_modes: int, of_basis: int) -> tuple[float, ...]:
    """Return the gains ``(of_basis,)`` with which so many modes are closed."""
    return (*found.gains[:n_modes], *(0.0,) * (of_basis - n_modes))


def begun(
    state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int, *, why: str, commanded: bool
) -> TrackerState:
    """Return the state in which an acquisition begins: nothing is known of α any more."""
    left = left_open(state, rtc)
    found = left.found if left is not None else None
    found = found or loop_found(state, rtc, policy)
    acquisition = Acquisition(
        stage=AcquisitionStage.OPENING,
        text=f"opening the loop: {why}",
        started_ns_utc=now_ns,
        since_ns_utc=now_ns,
        commanded=commanded,
        attempt=1,
        found=found,
        n_modes=first_closed(found.n_controlled),
        sent=left is not None and left.sent,
    )
    state = voided(state, "the acquisition had not begun")
    return replace(state, acquisition=acquisition, registration=None, margin=None)


def why_needed(state: TrackerState, policy: Policy, now_ns: int) -> str | None:
    """Return why the service should acquire by itself, or None."""
    rtc, acquisition = state.rtc, state.acquisition
    if not policy.acquires or state.mode is not Mode.AUTO or rtc is None or rtc.loop == "open":
        return None
    if not policy.dither_enabled or state.dither_stopped or state.measuring is not None:
        return None
    failed = acquisition.stage is AcquisitionStage.FAILED
    if failed or acquisition.held_off or forbidding(state, Act.SEND_NEW) is not None:
        return None
    for alarm in state.alarms:
        lasted_ns = now_ns - alarm.since_ns_utc
        if forbids(alarm, Act.HOLD) and lasted_ns >= OUT_OF_HAND_S * SECOND_NS:
            return f"{alarm.name} for {lasted_ns / SECOND_NS:.0f} s"
    known = state.registration is not None and state.registration.usable
    if acquisition.misses >= (MISSES_DESPITE if known else MISSES_BEFORE):
        return f"{acquisition.misses} windows in a row found no registration"
    return None


def missed(state: TrackerState, reason: str) -> TrackerState:
    """Return the state that has counted a refused window, if α was out of its reach."""
    acquisition = state.acquisition
    if acquisition.under_way or not reason.startswith(NOT_CAPTURED):
        return state
    return replace(state, acquisition=replace(acquisition, misses=acquisition.misses + 1))


def why_not_now(state: TrackerState, policy: Policy) -> str | None:
    """Return why an operator cannot have an acquisition now, or None."""
    if state.rtc is None:
        return "no RTC is there"
    if not policy.dither_enabled:
        return "the settings forbid any dither"
    alarm = forbidding(state, Act.SEND_NEW)
    if alarm is not None:
        return f"{alarm.name}: {alarm.text}"
    dither = far_dither(AcquisitionStage.COARSE, state.rtc, policy, 0)
    return dither if isinstance(dither, str) else None


def sigma_of(acquisition: Acquisition) -> str:
    """Return 1 σ of the α found, for a person."""
    if acquisition.covariance is None:
        return "not known"
    x, y, rotation, magnification = np.sqrt(np.diag(acquisition.covariance))
    return f"{x:.3f}, {y:.3f} subap, {np.rad2deg(rotation):.2f} deg, {magnification:.3f} (1 sigma)"
