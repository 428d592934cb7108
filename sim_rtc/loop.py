"""The modal integrator, in blocks of frames.

``c[k+d] = leak c[k+d-1] - gain R s[k]``, the dither added to what is applied and never fed back.
The plant is linear, so ``R s = R s_open + (R D) c``: the first term is one product for the whole
block, the second one small product per frame, and the slopes themselves follow at the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopTerms:
    """What stays constant during a block."""

    reconstructor: Array32
    """R ``(n_controlled, n_slopes)``, metres per slope."""

    slopes_per_command: Array32
    """D ``(n_slopes, n_modes)`` of the plant, slope per metre."""

    modal_response: Array32
    """R D ``(n_controlled, n_modes)``."""

    gains: Array32
    """``(n_controlled,)``; all 0 leaves the integrator to its leak."""

    leak: float
    """Per frame; 1 forgets nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopBlock:
    """What a block of frames came to."""

    slopes: Array32
    """``(n_frames, n_slopes)``."""

    commands_m: Array32
    """``(n_frames, n_modes)`` on the mirror during each exposure, dither included, clipped."""

    n_clipped: int
    """Commands that met the stroke limit."""


class ModalLoop:
    """The integrator's memory: the commands already decided for the frames to come."""

    def __init__(self, *, n_modes: int, delay_frames: int, stroke_m: float) -> None:
        self._stroke_m = np.float32(stroke_m)
        self._decided = np.zeros((delay_frames, n_modes), dtype=np.float32)

    def reset(self) -> None:
        """Forget everything: the integrator starts from zero."""
        self._decided[:] = 0.0

    def release(self, n_controlled: int) -> None:
        """Zero the modes from ``n_controlled`` on: nothing would correct them any more."""
        self._decided[:, n_controlled:] = 0.0

    def run(self, open_slopes: Array32, terms: LoopTerms, dither_m: Array32 | None) -> LoopBlock:
        """Run the frames whose slopes, mirror apart, are ``open_slopes`` ``(n_frames, n_slopes)``.

        A command beyond the stroke limit is clipped, in the integrator too: a loop that diverges
        stays finite and recovers.
        """
        n_frames, delay = len(open_slopes), len(self._decided)
        integrator = np.empty((n_frames + delay, self._decided.shape[1]), dtype=np.float32)
        integrator[:delay] = self._decided
        applied = np.zeros((n_frames, self._decided.shape[1]), dtype=np.float32)
        if dither_m is not None:
            applied += dither_m
        open_modes = open_slopes @ terms.reconstructor.T
        leak, stroke = np.float32(terms.leak), self._stroke_m
        n_controlled = len(terms.gains)
        for k in range(n_frames):
            command = applied[k]
            command += integrator[k]
            np.minimum(np.maximum(command, -stroke, out=command), stroke, out=command)
            correction = terms.modal_response @ command
            correction += open_modes[k]
            correction *= terms.gains
            decided = integrator[k + delay]
            np.multiply(integrator[k + delay - 1], leak, out=decided)
            decided[:n_controlled] -= correction
            np.minimum(np.maximum(decided, -stroke, out=decided), stroke, out=decided)
        self._decided = integrator[n_frames:].copy()
        return LoopBlock(
            slopes=open_slopes + applied @ terms.slopes_per_command.T,
            commands_m=applied,
            n_clipped=int(np.count_nonzero(np.abs(applied) >= stroke)),
        )
