"""Cut telemetry into windows, and say why one is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.control.loop import ControlLoop
from service.estimation.frames import FrameBlock, join_frames
from service.records.estimates import RefusalKind, Why, WindowRefused
from service.records.messages import Message, compose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClosedLoop(ControlLoop):
    """The loop that runs; its optical gains are not known."""

    reconstructor: NDArray[np.float32]
    """``(n_controlled, n_slopes)`` metres per slope; row i commands mode i."""

    cm_id: str | None = None
    """Id of the reconstructor in use; None if the RTC does not know it."""


DITHER_SETTLING_S = 0.3
"""Settling time of the loop after a dither has begun, before the first window."""

OTHER_SESSION = compose("window.other-session")
"""Why a window is of no use: what it holds belongs to the session before."""

CHUNK_FRAMES = 512
"""Frames multiplied at once: the sums, some MB, are read from memory once for all of them."""

MIN_SUM_FRAMES = 256
"""With so many the sums need not wait for more."""

MAX_MISSING_FRACTION = 0.05
"""A window with more frames missing than this is refused."""

AMPLITUDE_RATIO_RANGE = (0.5, 1.5)
"""A dither weaker or stronger than these shares of its request was not applied as asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowPlan:
    """Length and conditions of a dither's windows."""

    modes: tuple[int, ...]
    """0-based basis indices."""

    amplitude_m: tuple[float, ...]
    """RMS of each mode's dither, metres OPD."""

    n_frames: int
    """Length of a window."""

    first_seq: int
    """No window starts before this frame: the dither is on and the loop has settled."""

    def refusal(self, applied_m: NDArray[Any], lines: tuple[str, ...] = ()) -> Message | None:
        """Return the reason why a dither differs from the request, or None.

        ``applied_m`` ``(n_modes,)`` is its RMS; ``lines`` gives, for every mode, the frequencies
        that were examined.
        """
        ratio = applied_m / np.array(self.amplitude_m)
        weak = ratio.min() < AMPLITUDE_RATIO_RANGE[0]
        if not weak and ratio.max() <= AMPLITUDE_RATIO_RANGE[1]:
            return None
        worst = int(ratio.argmin() if weak else ratio.argmax())
        return compose(
            "window.dither-weak" if weak else "window.dither-strong",
            mode=self.modes[worst],
            found_nm=float(applied_m[worst] * 1e9),
            place=f" at {lines[worst]}" if lines else "",
            requested_nm=self.amplitude_m[worst] * 1e9,
        )


N_CHECKED_LINES = 4
"""Lines on which the slopes are looked at: those that should show most."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedDither:
    """A dither as the service requested it."""

    modes: tuple[int, ...]
    """0-based basis indices."""

    amplitude_m: tuple[float, ...]
    """RMS of each, metres OPD."""

    frequency_hz: tuple[float, ...]
    """One for each mode of a sine; random signs have none."""

    frame_rate_hz: float
    first_seq: int
    stop_seq: int
    """First frame that holds it, and the first that holds it no more."""

    own: tuple[bool, ...]
    """True for each mode outside the loop, whose command consists of the dither alone. In the loop
    the dither is amplified, and its amplitude is known from its column only."""

    response: tuple[float, ...] = ()
    """Sum of the squared slopes of each mode, per metre²; empty if unknown."""

    id: str = ""
    plan: WindowPlan | None = None
    """Plan of its windows; None if it has none."""

    why_unreadable: str = ""
    """Why."""

    @property
    def audible(self) -> list[int]:
        """Return the requested modes whose response in the slopes can be measured."""
        if not self.frequency_hz or not self.response:
            return []
        expected = np.square(self.amplitude_m) * self.response
        return [int(k) for k in np.argsort(expected)[::-1][:N_CHECKED_LINES]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telemetry:
    """Identity of the telemetry in a finished window."""

    session: str
    cm_id: str | None
    """The reconstructor in use, at the end where windows are joined; None: the RTC did not know."""

    first_seq: int
    t_end_ns_utc: int
    """End of exposure of its last frame."""

    n_missing: int
    """Frames that never came."""

    plan: WindowPlan
    """Plan by which it was cut."""

    n_windows: int = 1
    """Windows, one after the other, that are joined here."""

    def refuse(self, reason: str | Message, kind: RefusalKind = RefusalKind.OTHER) -> WindowRefused:
        """Return the refusal of this window."""
        return WindowRefused(reason=reason, t_ns_utc=self.t_end_ns_utc, kind=kind)

    def is_like(self, other: Telemetry) -> bool:
        """Return whether both are windows of one dither and one loop."""
        return (self.session, self.cm_id, replace(self.plan, first_seq=0)) == (
            other.session,
            other.cm_id,
            replace(other.plan, first_seq=0),
        )


P = TypeVar("P", bound=WindowPlan)
S = TypeVar("S")
F = TypeVar("F")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window(Generic[S]):
    """A window under way."""

    session: str
    cm_id: str | None
    reference_name: str | None
    first_seq: int
    next_seq: int
    """The frame expected next."""

    next_t_ns: int
    """End of exposure of that frame."""

    dt_ns: int
    sums: S
    """Sums of the estimator over the frames so far."""

    n_missing: int = 0
    """Frames before ``next_seq`` that never came."""

    waiting: tuple[FrameBlock, ...] = ()
    """Frames that are not in the sums yet, or are needed for the next; each follows the one
    before."""

    @property
    def telemetry(self) -> dict[str, Any]:
        """Return the fields of ``Telemetry``, once it is finished."""
        return {
            "session": self.session,
            "cm_id": self.cm_id,
            "first_seq": self.first_seq,
            # The last frame is the one before the next.
            "t_end_ns_utc": self.next_t_ns - self.dt_ns,
            "n_missing": self.n_missing,
        }

    def without_rest(self, n_frames: int) -> Window[S]:
        """Return a window of ``n_frames`` whose last frames never came."""
        lost = self.first_seq + n_frames - self.next_seq
        return replace(
            self,
            next_seq=self.next_seq + lost,
            next_t_ns=self.next_t_ns + lost * self.dt_ns,
            n_missing=self.n_missing + lost,
        )

    def check_continuity(self, block: FrameBlock, n_frames: int) -> Why | None:
        """Return why a window of ``n_frames`` cannot take this block, or None."""
        expected_ns = self.next_t_ns + (block.first_seq - self.next_seq) * block.dt_ns
        if block.session != self.session:
            return RefusalKind.OTHER, compose("window.new-session")
        if block.cm_id != self.cm_id:
            changed = f"{self.cm_id} -> {block.cm_id}"
            return RefusalKind.CUT_SHORT, compose("window.matrix-changed", changed)
        if block.reference_name != self.reference_name:
            changed = f"{self.reference_name} -> {block.reference_name}"
            return RefusalKind.CUT_SHORT, compose("window.reference-changed", changed)
        if block.dither_m is None:
            return RefusalKind.CUT_SHORT, compose("window.dither-ended")
        if abs(block.t0_ns_utc - expected_ns) > block.dt_ns / 2:
            return RefusalKind.OTHER, compose("window.clock-stepped")
        end_seq = self.first_seq + n_frames
        # A gap that goes beyond the end counts only as far as the window reaches.
        missing = self.n_missing + min(block.first_seq, end_seq) - self.next_seq
        if missing > MAX_MISSING_FRACTION * n_frames:
            most = MAX_MISSING_FRACTION
            return RefusalKind.OTHER, compose(
                "window.frames-missing", missing=missing, n_frames=n_frames, most=most
            )
        return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowCutter(Generic[P, S, F]):
    """Windows of a dither under way, each of one session, one reconstructor and one clock.

    Feed it blocks with ``accumulate``.
    """

    plan: P
    window: Window[S] | None = None

    overlap: ClassVar[int] = 0
    """Frames before its own that a frame is summed with."""

    def begin(self, block: FrameBlock) -> S:
        """Return empty sums for frames like these."""
        raise NotImplementedError

    def add(self, sums: S, block: FrameBlock, place: int) -> S:
        """Return the sums with a block that begins at this place of the window.

        Its first ``overlap`` frames are in them, or have none before them.
        """
        raise NotImplementedError

    def close(self, window: Window[S]) -> F | WindowRefused:
        """Return the result of a window, or the reason why its dither differs from the request."""
        raise NotImplementedError

    def restart(self, first_seq: int) -> Self:
        """Return it without the window under way; none begins before this frame."""
        first_seq = max(self.plan.first_seq, first_seq)
        return replace(self, plan=replace(self.plan, first_seq=first_seq), window=None)

    def accumulate(self, block: FrameBlock) -> tuple[Self, list[F | WindowRefused]]:
        """Add a block of frames; return the new state and the windows that ended in it."""
        ended: list[F | WindowRefused] = []
        window, done = self.window, 0
        while done < block.n_frames:
            window, used, found = self._advance(window, block.rows(done, block.n_frames))
            done += used
            ended += [] if found is None else [found]
        return replace(self, window=window), ended

    def _advance(
        self, window: Window[S] | None, block: FrameBlock
    ) -> tuple[Window[S] | None, int, F | WindowRefused | None]:
        """Take rows from the start of a block: into the open window, or up to the next one."""
        n_frames = self.plan.n_frames
        if window is None:
            if block.first_seq < self.plan.first_seq:
                return None, min(self.plan.first_seq - block.first_seq, block.n_frames), None
            if block.dither_m is None:
                return None, block.n_frames, None
            window = Window(
                session=block.session,
                cm_id=block.cm_id,
                reference_name=block.reference_name,
                first_seq=block.first_seq,
                next_seq=block.first_seq,
                next_t_ns=block.t0_ns_utc,
                dt_ns=block.dt_ns,
                sums=self.begin(block),
            )
        # Before the test for the end: a new session or a stepped clock voids the frame numbers that
        # this test relies on.
        why = window.check_continuity(block, n_frames)
        if why is not None:
            kind, reason = why
            # No row was used: the same block may begin the next window.
            return None, 0, WindowRefused(reason=reason, t_ns_utc=window.next_t_ns, kind=kind)
        end_seq = window.first_seq + n_frames
        if block.first_seq >= end_seq:  # the window's last frames never came
            return None, 0, self.close(self._add_waiting(window).without_rest(n_frames))
        part = block.rows(0, min(block.n_frames, end_seq - block.first_seq, CHUNK_FRAMES))
        window = self._with_rows(window, part)
        if window.next_seq < end_seq:
            return window, part.n_frames, None
        return None, part.n_frames, self.close(self._add_waiting(window))

    def _with_rows(self, window: Window[S], rows: FrameBlock) -> Window[S]:
        """Return the window after some rows, which wait until there are enough to be added."""
        # Only consecutive frames are joined: the place of a block in the window is that of its
        # first frame.
        if window.waiting and not rows.follows(window.waiting[-1]):
            window = replace(self._add_waiting(window), waiting=())
        window = replace(
            window,
            next_seq=rows.next_seq,
            next_t_ns=rows.next_t_ns,
            # frames skipped before these count as missing
            n_missing=window.n_missing + rows.first_seq - window.next_seq,
            waiting=(*window.waiting, rows),
        )
        enough = sum(block.n_frames for block in window.waiting) >= MIN_SUM_FRAMES
        return self._add_waiting(window) if enough else window

    def _add_waiting(self, window: Window[S]) -> Window[S]:
        """Return the window with the frames that wait in its sums."""
        if sum(block.n_frames for block in window.waiting) <= self.overlap:
            return window
        block = join_frames(window.waiting)
        sums = self.add(window.sums, block, block.first_seq - window.first_seq)
        kept = (block.last(self.overlap),) if self.overlap else ()
        return replace(window, sums=sums, waiting=kept)
