"""Windows of any dither."""

from __future__ import annotations

from dataclasses import dataclass

from typing_extensions import override

from service.estimation.estimator import (
    UNMARKED,
    Change,
    FrameContext,
    LoopContext,
    Mark,
    Streaming,
)
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.random_dither import Correlated, RandomDither, RandomPlan
from service.records.estimates import WindowRefused

EndedWindow = Spectra | Correlated
"""One that the worker can fit."""

Window = EndedWindow | WindowRefused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherWindows(Streaming):
    """The window under way, cut as the dither allows."""

    resets = Change.GONE | Change.RATE | Change.LOOP | Change.DITHER | Change.STANDSTILL
    unless = Mark.STANDS

    cutter: LockIn | RandomDither | None = None
    """None: no dither plays, none that can be read, or its end would cut the next window."""

    ended: tuple[Window, ...] = ()
    """Windows that ended in the last block."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> DitherWindows:
        """Return windows of the dither that plays."""
        plan = None if loop.dither is None else loop.dither.plan
        if isinstance(plan, LockInPlan):
            return cls(cutter=LockIn(plan=plan))
        return cls(cutter=RandomDither(plan=plan) if isinstance(plan, RandomPlan) else None)

    @override
    def restart(self, loop: LoopContext, why: Change) -> DitherWindows:
        """Give up the open window; the next begins when the changed loop has settled.

        Counted from the status' own frame, not from when it was read, so that a recorded night is
        cut at the same frames again.
        """
        if why & (Change.GONE | Change.RATE | Change.DITHER):
            return self.begin(loop)
        cutter = None if self.cutter is None else self.cutter.restart(loop.settled_seq)
        return DitherWindows(cutter=cutter)

    @override
    def update(self, frames: FrameContext) -> DitherWindows:
        """Return them after one more block."""
        if self.cutter is None:
            return DitherWindows()
        cutter, ended = self.cutter.accumulate(frames.block)
        dither, window = frames.loop.dither, cutter.window
        # A window that the end of the dither would cut is given up at once, and not refused later.
        over = (
            dither is not None
            and window is not None
            and window.first_seq + cutter.plan.n_frames > dither.stop_seq
        )
        return DitherWindows(cutter=None if over else cutter, ended=tuple(ended))

    @property
    @override
    def marks(self) -> Mark:
        """Return the mark that windows are being cut, if they are."""
        return UNMARKED if self.cutter is None else Mark.WINDOWS
