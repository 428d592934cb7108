"""Windows of telemetry become the registration, or a reason why not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service import events as ev
from service.estimation.instrumental import MAX_LAG_FRAMES, WindowEstimate
from service.estimation.kalman import begin, update
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.reactions.dither import found_again
from service.reactions.journal import OFF_LOOP, logged, with_alarm, without_alarm
from service.reactions.policy import SECOND_NS, Policy
from service.state import HistoryEntry, Level, Registration, TrackerState, Watchdog

HISTORY_LENGTH = 5000

CAPTURE_RANGE = np.array([0.8, 0.8, np.deg2rad(2.0), 0.02])
"""Beyond this, one linearised fit with high modes cannot be trusted (numeric units)."""

USEFUL_SIGMA = np.array([0.1, 0.1, np.deg2rad(0.3), 0.01])
"""A window less certain than this says nothing worth keeping (numeric units)."""

EXPECTED = ("the reconstructor changed", "the dither ended")
"""What cuts a window short when all is well."""

GAIN_RANGE = (0.1, 3.0)
"""Gains outside this are no pyramid seeing the dither: about 0.4 to 0.9 on sky, twice that when the
mirror is seen twice."""


_OUT_OF_HAND = {
    "loop-diverging": "the loop was diverging",
    "edge-slip": "the edge had slipped",
    OFF_LOOP: "the commands were off the loop equation",
}
"""Alarms under which no window is believed."""


def on_window(
    state: TrackerState, estimate: WindowEstimate, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold one window's estimate into the registration, or refuse it with its reason."""
    reason = _why_useless(state, estimate)
    if reason is not None:
        return refuse_window(state, reason, now_ns)
    state = found_again(state, now_ns)
    for alarm in ("columns-misaligned", "estimate-stale"):
        state = without_alarm(state, alarm, now_ns)
    measured, noise = estimate.alpha.vector, estimate.covariance
    known = state.registration
    if known is None:
        filtered = begin(measured, noise)
    else:
        filtered = update(
            known.alpha.vector,
            known.covariance,
            measured,
            noise,
            drift_rate=policy.drift_rate,
            elapsed_s=(estimate.t_ns_utc - known.t_ns_utc) / SECOND_NS,
        )
    registration = Registration(
        alpha=Misregistration.from_vector(filtered.mean),
        covariance=filtered.covariance,
        floor=policy.floor,
        t_ns_utc=estimate.t_ns_utc,
        arrived_ns_utc=now_ns,
        n_windows=1 if known is None or filtered.jumped else known.n_windows + 1,
        optical_gain=float(np.abs(estimate.optical_gain).mean()),
    )
    entry = HistoryEntry(
        t_ns_utc=estimate.t_ns_utc,
        measured=estimate.alpha,
        measured_sigma=np.sqrt(np.diag(noise)),
        filtered=registration.alpha,
        filtered_sigma=registration.sigma,
        innovation=filtered.innovation,
    )
    state = replace(
        state,
        registration=registration,
        history=(*state.history, entry)[-HISTORY_LENGTH:],
        windows_accepted=state.windows_accepted + 1,
    )
    if known is not None and filtered.jumped:
        jump = (measured - known.alpha.vector) * BOUNDARY_SCALE
        text = (
            f"jumped by {jump[0]:+.3f}, {jump[1]:+.3f} subap, {jump[2]:+.3f} deg, {jump[3]:+.4f} "
            f"(innovation {filtered.innovation:.0f}, expected 4)"
        )
        return logged(state, "registration.jump", text, now_ns, Level.WARNING)
    return state


def _why_useless(state: TrackerState, estimate: WindowEstimate) -> str | None:
    """Return why a window's estimate must not be used, or None."""
    if state.rtc is None or estimate.session != state.rtc.session:
        return "the RTC has restarted since"
    out_of_hand = next((_OUT_OF_HAND[a.name] for a in state.alarms if a.name in _OUT_OF_HAND), None)
    if out_of_hand is not None:
        return f"{out_of_hand}: its telemetry is no measurement"
    lag = float(np.median(estimate.lag_frames))
    if abs(lag) > MAX_LAG_FRAMES:
        return f"columns misaligned: slopes lag commands by {lag:+.2f} frame, 0 is expected"
    gains = np.abs(estimate.optical_gain)
    if gains.min() < GAIN_RANGE[0] or gains.max() > GAIN_RANGE[1]:
        return (
            f"optical gains of {gains.min():.2f} to {gains.max():.2f}, expected {GAIN_RANGE[0]} "
            f"to {GAIN_RANGE[1]}: wrong instrument file, or the dither is not on the mirror"
        )
    sigma = np.sqrt(np.diag(estimate.covariance))
    if np.any(sigma > USEFUL_SIGMA):
        return "too uncertain: raise the dither's amplitude or the window's length"
    distance = np.abs(estimate.alpha.vector - [0.0, 0.0, 0.0, 1.0])
    if np.any(distance > CAPTURE_RANGE):
        return f"outside the capture range: {estimate.alpha.to_boundary()}"
    return None


def refuse_window(state: TrackerState, reason: str, now_ns: int) -> TrackerState:
    """Count a window that gave nothing, and say why."""
    state = replace(state, windows_refused=state.windows_refused + 1)
    if reason.startswith("columns misaligned"):
        state = with_alarm(state, "columns-misaligned", reason, now_ns)
    level = Level.INFO if reason.startswith(EXPECTED) else Level.WARNING
    return logged(state, "window.refused", reason, now_ns, level)


def on_watchdog(state: TrackerState, event: ev.Watched, now_ns: int) -> TrackerState:
    """Compare the passive estimate with the dithered one."""
    estimate, known = event.estimate, state.registration
    consistent, text = True, "no dithered estimate to compare with yet"
    if known is not None:
        distance = np.abs(estimate.alpha.vector - known.alpha.vector)
        sigma = np.hypot(estimate.sigma, known.sigma)
        consistent = bool(np.all(distance < 3.0 * sigma))
        text = (
            "agrees with the dithered estimate"
            if consistent
            else "disagrees with the dithered estimate: dither again before trusting either"
        )
    watchdog = Watchdog(
        alpha=estimate.alpha,
        sigma=estimate.sigma,
        t_ns_utc=event.t_ns_utc,
        consistent=consistent,
        text=text,
    )
    state = replace(state, watchdog=watchdog)
    if consistent:
        return without_alarm(state, "watchdog", now_ns)
    return with_alarm(state, "watchdog", text, now_ns)
