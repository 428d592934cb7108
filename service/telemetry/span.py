"""Cutting telemetry into windows: one session, one reconstructor, one clock each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from service.telemetry.frames import FrameBlock

MAX_MISSING_FRACTION = 0.05
"""A window with more frames missing than this is refused."""


class Plan(Protocol):
    """What is known of a window before it begins."""

    @property
    def n_frames(self) -> int:
        """Length of a window."""

    @property
    def first_seq(self) -> int:
        """No window starts before this frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowRefused:
    """A window that gave no estimate."""

    reason: str
    """What was found, and what to do about it."""

    t_ns_utc: int
    """When it was given up."""

    mistold: bool = False
    """Whether it shows that slopes or commands are not what the instrument file says."""


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


P = TypeVar("P", bound=Plan)
S = TypeVar("S")
F = TypeVar("F")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window(Generic[S]):
    """A window under way."""

    span: Span
    dt_ns: int
    sums: S
    """What the estimator has made of the frames so far."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps(Generic[P, S, F]):
    """What an estimator does with the frames of a window."""

    begin: Callable[[P, FrameBlock], S]
    """Returns empty sums for frames like these."""

    add: Callable[[P, Window[S], FrameBlock, slice], Window[S]]
    """Returns the window with these rows of a block in its span and in its sums."""

    close: Callable[[P, Window[S]], F | WindowRefused]
    """Returns what came of it, or why its dither is not the one asked for."""


def cut(
    plan: P, window: Window[S] | None, block: FrameBlock, steps: Steps[P, S, F]
) -> tuple[Window[S] | None, list[F | WindowRefused]]:
    """Add a block to the open window; return the one then open and those that ended in it."""
    ended: list[F | WindowRefused] = []
    done = 0
    while done < block.n_frames:
        window, used, more = _advance(plan, window, block, done, steps)
        done += used
        ended += more
    return window, ended


def _advance(
    plan: P, window: Window[S] | None, block: FrameBlock, start: int, steps: Steps[P, S, F]
) -> tuple[Window[S] | None, int, list[F | WindowRefused]]:
    """Consume rows of the block from ``start``: into the open window, or up to the next one."""
    seq, left = block.first_seq + start, block.n_frames - start
    if window is None:
        if seq < plan.first_seq:
            return None, min(plan.first_seq - seq, left), []
        if block.dither_m is None:
            return None, left, []
        begun = steps.begin(plan, block)
        window = Window(span=opened(block, start), dt_ns=block.dt_ns, sums=begun)
    reason = why_broken(window.span, plan.n_frames, block, start)
    if reason is not None:
        return None, 0, [WindowRefused(reason=reason, t_ns_utc=window.span.next_t_ns)]
    end_seq = window.span.first_seq + plan.n_frames
    if seq >= end_seq:  # the window's last frames never came
        span = without_rest(window.span, plan.n_frames, window.dt_ns)
        return None, 0, [steps.close(plan, replace(window, span=span))]
    n_rows = min(left, end_seq - seq)
    window = steps.add(plan, window, block, slice(start, start + n_rows))
    if window.span.next_seq < end_seq:
        return window, n_rows, []
    return None, n_rows, [steps.close(plan, window)]


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
