"""The loop as the gate and the expected gain see it: the RTC's settings, the sensor's gains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import Timing
from service.control.gate import LoopSettings
from service.telemetry.frames import Loop
from service.tracking.alarms import Act, forbidding
from service.tracking.loop import RtcView, same_gains
from service.tracking.loop_commands import table_of
from service.tracking.products import Judged
from service.tracking.registration import Registration
from service.tracking.state import TrackerState

GAIN_SAFETY = 1.1
"""Above a mean optical gain that nobody says which modes it is of."""


def loop_settings(
    rtc: RtcView,
    gains: tuple[float, ...],
    registration: Registration,
    *,
    n_holding: int | None = None,
) -> LoopSettings:
    """Return the loop the gate is to judge, with the largest optical gains it may have."""
    return LoopSettings(
        gains=np.array(gains),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        optical_gain=_highest(registration, len(gains)),
        n_holding=n_holding,
    )


def judged_now(rtc: RtcView, gains: tuple[float, ...], registration: Registration) -> Judged:
    """Return what a verdict that is asked for now will be of."""
    return Judged(
        session=rtc.session,
        gains=tuple(gains),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        alpha=registration.alpha,
        sigma=registration.sigma,
    )


def modes_that_hold(state: TrackerState, gains: tuple[float, ...]) -> int | None:
    """Return how many modes the loop holds with, if these are its gains; None: it does not."""
    rtc = state.rtc
    if rtc is None or rtc.loop == "open" or forbidding(state, Act.MEASURE) is not None:
        return None
    n_modes = rtc.n_controlled
    return n_modes if same_gains(gains[:n_modes], rtc.gains[:n_modes]) else None


def terms_of(rtc: RtcView, cm_id: str, matrix: NDArray[np.float32]) -> Loop | None:
    """Return the loop that a reconstructor closes; None: it is open, or another's."""
    fits = matrix.shape[1] == rtc.n_slopes and len(matrix) <= rtc.n_modes
    if rtc.loop == "open" or not fits:
        return None
    return Loop(
        cm_id=cm_id,
        reconstructor=matrix,
        gains=np.array(rtc.gains[: len(matrix)], np.float32),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        frame_rate_hz=rtc.frame_rate_hz,
    )


def timing(rtc: RtcView, n_controlled: int, registration: Registration) -> Timing:
    """Return the loop as it is expected to run."""
    optical_gain = np.full(rtc.n_modes, registration.optical_gain or 1.0)
    if registration.optical_gains:
        optical_gain = table_of(registration.optical_gains, rtc.n_modes).optical_gain
    return Timing(
        frame_rate_hz=rtc.frame_rate_hz,
        delay_frames=rtc.delay_frames,
        leak=rtc.leak,
        gains=np.array(rtc.gains[:n_controlled]),
        optical_gain=optical_gain,
    )


def _highest(registration: Registration, n_modes: int) -> float | NDArray[np.float64]:
    if registration.optical_gains:
        return table_of(registration.optical_gains, n_modes).highest
    mean = registration.optical_gain
    return 1.0 if mean is None else GAIN_SAFETY * mean
