"""Between the records of the wire and what the tracker knows."""

from __future__ import annotations

from service.link.events import LinkEvent, MeasuredMatrix
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.tracking import events as ev
from service.tracking.loop import DitherKind, DitherView, Pointing, RtcView
from service.tracking.products import (
    MatrixState,
    MeasurementRecord,
    MeasurePattern,
    MeasureState,
    ReconstructorRecord,
)
from service.tracking.state import TrackerState, Waiting
from service.wire import (
    TEXT_LIMIT,
    Acknowledgement,
    DitherStatus,
    Manifest,
    MatrixLayout,
    MeasuredManifest,
    MeasureRequest,
    Pattern,
    PointingStatus,
    StateMessage,
    Status,
)


def event_of(heard: LinkEvent) -> ev.Event | None:
    """Return what the tracker makes of something heard on the link; None: nothing."""
    match heard:
        case Status():
            return ev.StatusSeen(rtc=rtc_view(heard))
        case Acknowledgement():
            return _acknowledged(heard)
        case MeasuredMatrix():
            return None
        case _:
            return heard


def rtc_view(status: Status) -> RtcView:
    """Return the RTC as a status message shows it."""
    return RtcView(
        session=status.session,
        loop=status.loop.value,
        frame_rate_hz=status.frame_rate_hz,
        delay_frames=status.delay_frames,
        leak=status.leak,
        gains=status.gains,
        n_controlled=status.n_controlled,
        n_modes=status.n_modes,
        n_slopes=status.n_slopes,
        cm_id=status.cm_id,
        basis_id=status.basis_id,
        config_id=status.config_id,
        magnitude=status.magnitude,
        max_dither_m=status.max_dither_m,
        max_dither_modes=status.max_dither_modes,
        dither_id=status.dither.request.id if status.dither is not None else None,
        dither=None if status.dither is None else _running(status.dither),
        t_ns_utc=status.t_ns,
        seq=-1 if status.seq is None else status.seq,
        pointing=_pointing(status.pointing),
        flux=status.flux,
    )


def _pointing(status: PointingStatus | None) -> Pointing | None:
    if status is None:
        return None
    return Pointing(elevation_deg=status.elevation_deg, azimuth_deg=status.azimuth_deg)


def _running(status: DitherStatus) -> DitherView:
    """Return the dither that runs."""
    request = status.request
    return DitherView(
        id=request.id,
        modes=request.modes,
        amplitude_m=request.amplitude_m,
        frequency_hz=request.frequency_hz or (),
        duration_s=request.duration_s,
        start_seq=status.start_seq,
        asked_ns_utc=0,
        kind=DitherKind(request.kind.value),
        seed=request.seed,
    )


def _acknowledged(acknowledgement: Acknowledgement) -> ev.Acknowledged:
    return ev.Acknowledged(
        id=acknowledgement.id,
        sha256=acknowledgement.sha256,
        session=acknowledgement.session,
        state=MatrixState(acknowledgement.state.value),
        reason=acknowledgement.reason,
        frame_seq=acknowledgement.frame_seq,
    )


def manifest_of(
    record: ReconstructorRecord, layout: MatrixLayout, rtc: RtcView, system: str
) -> Manifest:
    """Return the manifest a reconstructor travels with."""
    return Manifest(
        id=record.id,
        layout=layout,
        alpha=None if record.alpha is None else record.alpha.to_boundary(),
        sigma=None
        if record.sigma is None
        else dict(zip(PARAMETERS, (record.sigma * BOUNDARY_SCALE).tolist(), strict=True)),
        im_id=None,
        parent=record.parent,
        basis_id=rtc.basis_id,
        config_id=rtc.config_id,
        system=system,
        created_ns=record.created_ns_utc,
    )


def record_of(manifest: Manifest) -> ReconstructorRecord:
    """Return what is known of a matrix the RTC brought with it.

    Its manifest may name an α, but nobody here can vouch for it.
    """
    return ReconstructorRecord(
        id=manifest.id,
        state=MatrixState.APPLIED,
        n_modes=manifest.layout.shape[0],
        created_ns_utc=manifest.created_ns,
        sha256=manifest.layout.sha256,
        reason="brought by the RTC",
    )


def measure_request(record: MeasurementRecord) -> MeasureRequest:
    """Return the command that asks the RTC for a measurement."""
    return MeasureRequest(
        id=record.id,
        pattern=Pattern(record.pattern.value),
        modes=record.modes,
        amplitude_m=record.amplitude_m,
        n_average=record.n_average,
        frequency_hz=record.frequency_hz,
        duration_s=record.duration_s,
    )


def measurement_of(manifest: MeasuredManifest) -> MeasurementRecord:
    """Return what is known of an interaction matrix the RTC sends, or of why there is none."""
    there = manifest.reason is None
    return MeasurementRecord(
        id=manifest.id,
        state=MeasureState.STORED if there else MeasureState.FAILED,
        pattern=MeasurePattern(manifest.pattern.value),
        modes=manifest.modes,
        amplitude_m=manifest.amplitude_m,
        n_average=None if manifest.pattern is Pattern.SINE else manifest.n_average,
        reason=manifest.reason or "",
        created_ns_utc=manifest.created_ns,
        n_slopes=manifest.layout.shape[0],
        double_pass=manifest.double_pass,
        session=manifest.session,
        basis_id=manifest.basis_id,
        config_id=manifest.config_id,
        sha256=manifest.layout.sha256,
    )


def state_message(
    state: TrackerState, now_ns: int, waiting: tuple[Waiting, ...] = ()
) -> StateMessage:
    """Return the short account of the state for whoever listens on the network."""
    known = state.registration
    sigma = None if known is None else known.sigma * BOUNDARY_SCALE
    alpha: Misregistration | None = None if known is None else known.alpha
    return StateMessage(
        system=state.system,
        t_ns=now_ns,
        mode=state.mode.value,
        alpha=None if alpha is None else alpha.to_boundary(),
        sigma=None if sigma is None else dict(zip(PARAMETERS, sigma.tolist(), strict=True)),
        in_use=state.in_use,
        validity=None if known is None else known.standing.validity.value,
        waiting_for=tuple(f"{w.party}: {w.text}"[:TEXT_LIMIT] for w in waiting),
    )
