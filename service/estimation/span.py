"""How much of a window has come: one session, one reconstructor, one clock."""

from __future__ import annotations

from dataclasses import dataclass, replace

from service.estimation.frames import FrameBlock

MAX_MISSING_FRACTION = 0.05
"""A window with more frames missing than this is refused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Frames of an open window so far."""

    session: str
    cm_id: str | None
    first_seq: int
    next_seq: int
    """The frame expected next."""

    next_t_ns: int
    """End of exposure of that frame."""

    n_missing: int = 0
    """Frames before ``next_seq`` that never came."""


def opened(block: FrameBlock, start: int) -> Span:
    """Return the empty span of a window that begins at row ``start`` of this block."""
    return Span(
        session=block.session,
        cm_id=block.cm_id,
        first_seq=block.first_seq + start,
        next_seq=block.first_seq + start,
        next_t_ns=block.t0_ns_utc + start * block.dt_ns,
    )


def advanced(span: Span, block: FrameBlock, rows: slice) -> Span:
    """Return the span with these rows of a block; frames skipped before them count as missing."""
    return replace(
        span,
        next_seq=block.first_seq + rows.stop,
        next_t_ns=block.t0_ns_utc + rows.stop * block.dt_ns,
        n_missing=span.n_missing + block.first_seq + rows.start - span.next_seq,
    )


def without_rest(span: Span, n_frames: int, dt_ns: int) -> Span:
    """Return the span of a window of ``n_frames`` whose last frames never came."""
    lost = span.first_seq + n_frames - span.next_seq
    return replace(
        span,
        next_seq=span.next_seq + lost,
        next_t_ns=span.next_t_ns + lost * dt_ns,
        n_missing=span.n_missing + lost,
    )


def why_broken(span: Span, n_frames: int, block: FrameBlock, start: int) -> str | None:
    """Return why a window of ``n_frames`` cannot take this block from row ``start``, or None."""
    seq = block.first_seq + start
    expected_ns = span.next_t_ns + (seq - span.next_seq) * block.dt_ns
    if block.session != span.session:
        return "the RTC started a new session inside the window"
    if block.cm_id != span.cm_id:
        return f"the reconstructor changed inside the window: {span.cm_id} -> {block.cm_id}"
    if block.dither_m is None:
        return "the dither ended inside the window"
    if abs(block.t0_ns_utc + start * block.dt_ns - expected_ns) > block.dt_ns / 2:
        return "the RTC's clock stepped or it paused inside the window"
    missing = span.n_missing + min(seq, span.first_seq + n_frames) - span.next_seq
    if missing > MAX_MISSING_FRACTION * n_frames:
        return (
            f"{missing} of {n_frames} frames missing, more than "
            f"{MAX_MISSING_FRACTION:.0%}: check the link to the RTC"
        )
    return None
