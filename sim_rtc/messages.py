"""What the RTC sends at regular times: frames and status, from what the computer says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.wire import FrameHeader, PointingStatus, Status
from sim_rtc.clock import FrameClock
from sim_rtc.detector import Detector
from sim_rtc.telemetry import Batch, Identity, Snapshot


def frames_of(
    batch: Batch, identity: Identity, t0_ns: int, dt_ns: int
) -> tuple[FrameHeader, NDArray[np.float32]]:
    """Return header and rows of a batch whose first exposure ended at ``t0_ns``."""
    columns = [batch.slopes, batch.commands_m]
    if batch.dither_m is not None:
        columns.append(batch.dither_m)
    header = FrameHeader(
        session=batch.session,
        seq0=batch.seq0,
        n=len(batch.slopes),
        t0_ns=t0_ns,
        dt_ns=dt_ns,
        n_slopes=batch.slopes.shape[1],
        n_modes=batch.commands_m.shape[1],
        dither=batch.dither_m is not None,
        cm_id=batch.cm_id,
        basis_id=identity.basis_id,
        config_id=identity.config_id,
    )
    return header, np.hstack(columns)


def status_of(
    snapshot: Snapshot,
    *,
    identity: Identity,
    clock: FrameClock,
    detector: Detector,
    magnitude: float,
    basis_id: str,
    pointing: PointingStatus | None = None,
) -> Status:
    """Return the status; ``basis_id`` is the one to be named, which a fault may have changed."""
    settings, manifest = snapshot.settings, snapshot.reconstructor.manifest
    n_controlled, n_slopes = manifest.layout.shape
    return Status(
        session=snapshot.session,
        seq=snapshot.seq,
        t_ns=clock.end_of_exposure_ns(snapshot.seq),
        loop=snapshot.loop,
        frame_rate_hz=settings.frame_rate_hz,
        delay_frames=float(settings.delay_frames),
        gains=snapshot.gains,
        leak=settings.leak,
        n_slopes=n_slopes,
        n_modes=len(snapshot.gains),
        n_controlled=n_controlled,
        cm_id=manifest.id,
        basis_id=basis_id,
        config_id=identity.config_id,
        dither=snapshot.dither,
        max_dither_m=snapshot.limits.largest_m,
        max_dither_modes=snapshot.limits.most_modes,
        magnitude=magnitude,
        flux=detector.counts(snapshot.images).astype("<f4").tobytes(),
        pointing=pointing,
    )
