"""Orders to the loop: which of them it can carry out, and what its settings are then."""

from __future__ import annotations

from dataclasses import replace

from service.wire import Loop, LoopRequest, RampRequest, Reply
from sim_rtc.telemetry import LoopSettings

LARGEST_GAIN = 2.0


def accepted(request_id: str, start_seq: int) -> Reply:
    """Return the reply to an order that is carried out from this frame on."""
    return Reply(id=request_id, accepted=True, reason="", start_seq=start_seq)


def refused(request_id: str, reason: str) -> Reply:
    """Return the reply to an order that is not carried out."""
    return Reply(id=request_id, accepted=False, reason=reason, start_seq=None)


def loop_refusal(request: LoopRequest, n_modes: int) -> str:
    """Return why the loop cannot be changed so, in the wire's words; empty: it can."""
    gains = request.gains
    if gains is not None and len(gains) != n_modes:
        return f"range: {len(gains)} gains, expected {n_modes}"
    if gains is not None and max(gains) > LARGEST_GAIN:
        return f"range: gain {max(gains):g}, expected at most {LARGEST_GAIN:g}"
    if request.n_controlled is not None and not 1 <= request.n_controlled <= n_modes:
        return f"range: n_controlled {request.n_controlled}, expected 1 to {n_modes}"
    if request.loop is Loop.PARTIAL:
        return "unsupported: loop 'partial', ask for 'closed' with some gains 0"
    return ""


def changed(settings: LoopSettings, request: LoopRequest) -> LoopSettings:
    """Return the settings after a request that :func:`loop_refusal` has nothing against."""
    return replace(
        settings,
        closed=settings.closed if request.loop is None else request.loop is not Loop.OPEN,
        gains=settings.gains if request.gains is None else request.gains,
        leak=settings.leak if request.leak is None else request.leak,
        n_controlled_next=request.n_controlled or settings.n_controlled_next,
    )


def ramp_refusal(request: RampRequest, settings: LoopSettings, n_controlled: int) -> str:
    """Return why gains cannot be tried so, in the wire's words; empty: they can."""
    if not settings.closed:
        return "unsupported: a gain ramp while the loop is open; close it first"
    last = max(last for _, last in request.groups)
    if last >= n_controlled:
        return f"range: mode {last} in groups, expected 0 to {n_controlled - 1}"
    if max(request.gains) > LARGEST_GAIN:
        return f"range: gain {max(request.gains):g}, expected at most {LARGEST_GAIN:g}"
    return ""
