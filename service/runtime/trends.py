"""What is kept of every moment, not only of measurements: for a chart of the whole night."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

import numpy as np
import structlog
from numpy.typing import NDArray

from service.archive.trends import TREND_S, TrendSample
from service.errors import PyrcalError
from service.estimation.frames import FrameBlock
from service.tracking.state import TrackerState

LOOKED_AT = 100
"""Frames of which the residual is taken: a tenth of a second at 1 kHz."""


class TrendSampler:
    """Takes a sample every ``TREND_S``, in a thread.

    Parameters
    ----------
    state
        Returns what is known now.
    frames
        Returns the last telemetry that came; None: none has.
    matrix
        Returns a reconstructor by its id; may wait for the disk.
    keep
        Takes each sample.
    """

    def __init__(
        self,
        *,
        state: Callable[[], TrackerState],
        frames: Callable[[], FrameBlock | None],
        matrix: Callable[[str], NDArray[np.float32]],
        keep: Callable[[TrendSample], None],
    ) -> None:
        self._state = state
        self._frames = frames
        self._matrix = matrix
        self._keep = keep
        self._seen_ns: int | None = None

    async def run(self) -> None:
        """Take samples until cancelled."""
        while True:
            try:
                self._keep(await asyncio.to_thread(self._take))
            except Exception:  # noqa: BLE001 - a bug must not end the service
                structlog.get_logger().exception("trend.not-taken")
            await asyncio.sleep(TREND_S)

    def _take(self) -> TrendSample:
        state, frames = self._state(), self._frames()
        end_ns = None if frames is None else frames.t0_ns_utc + frames.n_frames * frames.dt_ns
        is_new, self._seen_ns = end_ns != self._seen_ns, end_ns
        residual_m = None
        if (
            frames is not None
            and is_new
            and frames.cm_id
            and state.loop.rtc
            and state.loop.rtc.in_loop
        ):
            try:
                residual_m = residual_of(frames, self._matrix(frames.cm_id))
            except PyrcalError:  # nobody has its numbers
                residual_m = None
        return sample_of(state, time.time_ns(), end_ns if is_new else None, residual_m)


def sample_of(
    state: TrackerState, now_ns: int, telemetry_ns: int | None, residual_m: float | None
) -> TrendSample:
    """Return what is known at this moment of what goes into a chart."""
    registration, rtc, margin, pointing = (
        state.alpha.registration,
        state.loop.rtc,
        state.matrices.margin,
        state.alpha.pointing,
    )
    gains = () if registration is None else registration.optical_gains
    flux = None if rtc is None else rtc.flux_images
    return TrendSample(
        t_ns_utc=now_ns,
        telemetry_ns_utc=telemetry_ns,
        alpha=None if registration is None else registration.alpha,
        sigma=None if registration is None else registration.sigma,
        wavefront_m=_wavefront_m(state),
        residual_m=residual_m,
        margin=None if margin is None else _finite(margin.worst_pole_radius / margin.bound),
        optical_gain=float(np.mean([one.gain for one in gains])) if gains else None,
        n_controlled=None if rtc is None else rtc.n_controlled,
        magnitude=None if rtc is None else rtc.magnitude,
        flux=None if flux is None else _finite(float(np.mean(flux))),
        elevation_deg=None if pointing is None else pointing.elevation_deg,
        azimuth_deg=None if pointing is None else pointing.azimuth_deg,
    )


def residual_of(frames: FrameBlock, matrix: NDArray[np.float32]) -> float | None:
    """Return what a reconstructor reads in the last of these slopes, metres RMS over its modes."""
    slopes = frames.slopes[-LOOKED_AT:]
    if slopes.shape[1] != matrix.shape[1]:
        return None
    modes_m = slopes @ matrix.T
    return _finite(math.sqrt(np.square(modes_m, dtype=np.float64).sum() / len(slopes)))


def _wavefront_m(state: TrackerState) -> float | None:
    found = state.matrices.assessment
    if found is None or found.id != state.matrices.in_use:
        return None
    return _finite(found.expected.wavefront_m + found.expected.loss_m)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
