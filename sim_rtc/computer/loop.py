"""The modal integrator, in blocks of frames.

``c[k+d] = leak c[k+d-1] - gain R s[k]``. The dither is added to the applied command and never fed
back. For a linear plant ``R s = R s_open + (R D) c``: the first term is one product for many
frames, the second a small one for each ``d`` of them, whose commands are already determined. The
slopes themselves follow at the end. Any other plant computes its slopes frame by frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.telescope.mirror import MirrorDrive
from sim_rtc.telescope.plant import Optics

Array32 = NDArray[np.float32]

Sense = Callable[[int, Array32], Array32]
"""Slopes ``(n_slopes,)`` of frame k of the block, with this command on the mirror."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopTerms:
    """The integrator's terms, constant during a block."""

    reconstructor: Array32
    """R ``(n_controlled, n_slopes)``, metres per slope."""

    gains: Array32
    """``(n_controlled,)``; all 0 leaves the integrator to its leak."""

    leak: float
    """Per frame; 1 forgets nothing."""

    slopes_per_command: Array32 | None = None
    """D ``(n_slopes, n_modes)`` of a linear plant, slope per metre; None: it is not linear."""

    modal_response: Array32 | None = None
    """R D ``(n_controlled, n_modes)``, in columns: for two frames at a time a copy of it would cost
    four times the product."""

    references: Array32 | None = None
    """Reference slopes ``(n_slopes,)``, or of each frame ``(n_frames, n_slopes)``, subtracted from
    the sensor's; None: they are zero."""

    @classmethod
    def of(
        cls,
        optics: Optics,
        reconstructor: Array32,
        gains: Array32,
        leak: float,
        references: Array32 | None = None,
    ) -> LoopTerms:
        """Return the terms of a loop around these optics."""
        if not isinstance(optics, LinearOptics):
            return cls(reconstructor=reconstructor, gains=gains, leak=leak, references=references)
        response = optics.slopes_per_command
        return cls(
            # in columns, as the product with rows of slopes reads it
            reconstructor=np.asfortranarray(reconstructor),
            gains=gains,
            leak=leak,
            slopes_per_command=response,
            modal_response=np.asfortranarray(reconstructor @ response),
            references=references,
        )


@dataclass(slots=True, kw_only=True, eq=False)
class LoopBlock:
    """Commands and slopes of a block; at first, the part added to the integrator's commands."""

    slopes: Array32
    """``(n_frames, n_slopes)``."""

    commands_m: Array32
    """``(n_frames, n_modes)`` on the mirror during each exposure, dither included, clipped."""

    dither_m: Array32 | None
    """``(n_frames, n_modes)`` dither part, as requested and as the mirror follows it."""

    n_clipped: int = 0
    """Commands that met a limit of the mirror."""

    asked_m: Array32 | None = None
    """``(n_frames, n_modes)`` commands before any limit; None if those played are reported."""

    def reported(self) -> LoopBlock:
        """Return the block with the commands that the telemetry holds."""
        if self.asked_m is not None:
            self.commands_m, self.asked_m = self.asked_m, None
        return self

    @classmethod
    def of(
        cls, slopes: Array32, dither_m: Array32 | None, played_m: Array32 | None, n_modes: int
    ) -> LoopBlock:
        """Return the sum of dither and played commands; the arrays become the mirror's in place."""
        commands = np.zeros((len(slopes), n_modes), dtype=np.float32)
        for part in (dither_m, played_m):
            if part is not None:
                commands += part
        dither = None if dither_m is None else dither_m.copy()
        return cls(slopes=slopes, commands_m=commands, dither_m=dither)


class ModalLoop:
    """The integrator's memory: the commands already decided for the frames to come."""

    def __init__(
        self,
        *,
        n_modes: int,
        delay_frames: int,
        stroke_m: float,
        drive: MirrorDrive | None = None,
        reports_asked: bool = False,
    ) -> None:
        """Take a drive for a mirror with limits or a lag; without one it obeys at once.

        ``reports_asked`` reports commands as they are before any limit, which the slopes do not
        show.
        """
        self._reports_asked = reports_asked
        self._stroke_m = np.float32(stroke_m)
        self._drive = drive
        self._decided = np.zeros((delay_frames, n_modes), dtype=np.float32)
        self._asked = np.zeros_like(self._decided)
        self._integrator = np.empty((0, n_modes), dtype=np.float32)
        """Commands of the block under way, kept from block to block for its memory."""

    def limit(self, stroke_m: float) -> None:
        """Clip commands at this from now on, metres RMS of a mode."""
        self._stroke_m = np.float32(stroke_m)

    def reset(self) -> None:
        """Forget everything: the integrator starts from zero."""
        self._decided[:] = self._asked[:] = 0.0

    def release(self, n_controlled: int) -> None:
        """Zero the modes from ``n_controlled`` on: nothing would correct them any more."""
        self._decided[:, n_controlled:] = self._asked[:, n_controlled:] = 0.0

    def run(
        self,
        open_slopes: Array32,
        terms: LoopTerms,
        dither_m: Array32 | None,
        played_m: Array32 | None = None,
        open_modes: Array32 | None = None,
    ) -> LoopBlock:
        """Run the frames with open-loop slopes ``open_slopes`` ``(n_frames, n_slopes)``.

        ``dither_m`` and ``played_m`` are ``(n_frames, n_modes)``, added to the integrator's
        command. The dither is reported on the link, the played turbulence is not. A command beyond
        the stroke limit is clipped, in the integrator too, so that a diverging loop stays finite
        and recovers. ``open_modes`` are ``open_slopes @ R.T`` if they are known already.
        """
        matrix, modal_response = terms.slopes_per_command, terms.modal_response
        if matrix is None or modal_response is None:
            raise TypeError("loop: found no matrix of the plant; only a linear one has open slopes")
        if open_modes is None:
            open_modes = open_slopes @ terms.reconstructor.T
        if terms.references is not None:
            open_modes = open_modes - terms.references @ terms.reconstructor.T
        block = LoopBlock.of(open_slopes, dither_m, played_m, self._decided.shape[1])
        added = dither_m is not None or played_m is not None
        moved = self._count_movable_modes(block.commands_m if added else None, len(terms.gains))
        response = modal_response[:, :moved]

        def estimate(first: int, commands: Array32) -> Array32:
            modes = commands[:, :moved] @ response.T
            modes += open_modes[first : first + len(modes)]
            return modes

        self._integrate(estimate, terms, block)
        block.slopes = block.commands_m[:, :moved] @ matrix[:, :moved].T
        block.slopes += open_slopes
        if terms.references is not None:
            block.slopes -= terms.references
        return block.reported()

    def _count_movable_modes(self, added_m: Array32 | None, n_controlled: int) -> int:
        """Return how many of the first modes may move: nothing corrects those beyond the loop."""
        if self._drive is not None:
            return int(self._decided.shape[1])
        beyond = self._decided.any(axis=0)
        if added_m is not None:
            beyond |= added_m.any(axis=0)
        return max(n_controlled, int(np.flatnonzero(beyond)[-1]) + 1 if beyond.any() else 0)

    def run_frames(
        self,
        n_frames: int,
        sense: Sense,
        terms: LoopTerms,
        dither_m: Array32 | None,
        played_m: Array32 | None = None,
    ) -> LoopBlock:
        """Run frames one by one, each with the slopes that ``sense`` says it makes."""
        slopes = np.empty((n_frames, terms.reconstructor.shape[1]), dtype=np.float32)
        references = np.zeros(1, np.float32) if terms.references is None else terms.references
        references = np.broadcast_to(references, slopes.shape)

        def estimate(first: int, commands: Array32) -> Array32:
            for k, command in enumerate(commands, first):
                slopes[k] = sense(k, command) - references[k]
            return np.asarray(slopes[first : first + len(commands)] @ terms.reconstructor.T)

        block = LoopBlock.of(slopes, dither_m, played_m, self._decided.shape[1])
        self._integrate(estimate, terms, block)
        return block.reported()

    def _integrate(
        self,
        estimate: Callable[[int, Array32], Array32],
        terms: LoopTerms,
        block: LoopBlock,
    ) -> None:
        """Complete the commands of ``block`` frame by frame, and count the clipped ones.

        ``estimate`` gives the modes ``(n, n_controlled)`` that frames k, k + 1, ... show under n
        commands; a frame in which one of them is not finite corrects nothing.
        """
        applied = block.commands_m
        n_frames, delay = len(applied), len(self._decided)
        if len(self._integrator) != n_frames + delay:
            self._integrator = np.empty((n_frames + delay, applied.shape[1]), dtype=np.float32)
        integrator = self._integrator
        integrator[:delay] = self._decided
        # Arrays of no dimension: a scalar is converted again in every frame.
        leak, stroke = np.array(terms.leak, dtype=np.float32), np.array(self._stroke_m)
        least = -stroke
        n_controlled = len(terms.gains)
        n_limited, asked = 0, self._begin_asked(block)
        for first in range(0, n_frames, delay):
            commands = applied[first : first + delay]
            commands += integrator[first : first + len(commands)]
            np.minimum(commands, stroke, out=commands)
            np.maximum(commands, least, out=commands)
            if self._drive is not None:
                n_limited += self._follow(self._drive, first, block)
            corrections = estimate(first, commands)
            corrections *= terms.gains
            # a slope that is no number would stay in the integrator for ever, at a gain of 0, too
            if not math.isfinite(np.add.reduce(corrections, axis=None)):
                corrections[~np.isfinite(corrections).all(axis=1)] = 0.0
            for k, correction in enumerate(corrections, first + delay):
                decided = integrator[k]
                np.multiply(integrator[k - 1], leak, out=decided)
                decided[:n_controlled] -= correction
                asked[k : k + 1] = decided
                np.minimum(decided, stroke, out=decided)
                np.maximum(decided, least, out=decided)
        self._decided[:] = integrator[n_frames:]
        self._end_asked(block, asked)
        block.n_clipped = n_limited + int(np.count_nonzero(np.abs(applied) >= stroke))

    def _begin_asked(self, block: LoopBlock) -> Array32:
        """Return ``(n_frames + delay, n_modes)`` for the integrator before its limit."""
        n_frames, n_modes = block.commands_m.shape
        if not self._reports_asked:
            return np.empty((0, n_modes), dtype=np.float32)
        block.asked_m = block.commands_m.copy()
        asked = np.empty((n_frames + len(self._asked), n_modes), dtype=np.float32)
        asked[: len(self._asked)] = self._asked
        return asked

    def _end_asked(self, block: LoopBlock, asked: Array32) -> None:
        """Add the integrator before its limit to what is reported, and keep what is to come."""
        if block.asked_m is not None:
            n_frames = len(block.asked_m)
            block.asked_m += asked[:n_frames]
            self._asked[:] = asked[n_frames:]

    def _follow(self, drive: MirrorDrive, first: int, block: LoopBlock) -> int:
        """Let the drive make what it can of the next commands; count its limits."""
        commands, dither = block.commands_m, block.dither_m
        return sum(
            drive.follow(commands[k], None if dither is None else dither[k])
            for k in range(first, min(first + len(self._decided), len(commands)))
        )
