"""The gain ramp: try gains group by group, keep the best.

A group tries its gains in turn while the others stay; once the residual has clearly grown it
tries no higher one, which is well before the loop is lost. The residual slopes are judged
as the group sees them, through its own rows of the reconstructor: in the RMS of all slopes the
noise of 1400 of them hides tip and tilt.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass

import numpy as np
import structlog
from numpy.typing import NDArray

from service.wire import RampRequest
from sim_rtc.computer.telemetry import Batch, LoopSettings

Array32 = NDArray[np.float32]
_log = structlog.get_logger("sim_rtc")

LARGEST_GAIN = 2.0

GROUP_ENDS = (2, 100)
"""First mode after each group but the last."""

_CLEARLY_WORSE = 1.5
"""Residual over the best so far from which on a group tries no higher gain.

A second of turbulence makes that of tip and tilt differ by a fifth and more by itself.
"""

_SETTLING_S = 0.2
"""Time between a new gain and the first slopes that are evaluated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One gain tried."""

    group: int
    gain: float
    residual_m: float
    """RMS of the slopes, reconstructed into the modes of the group, metres OPD."""


def by_group(gains: tuple[float, float, float], n_modes: int) -> tuple[float, ...]:
    """Return one gain per mode from those of tip and tilt, of the modes to 100, and of the rest."""
    return tuple(gains[bisect(GROUP_ENDS, mode)] for mode in range(n_modes))


class GainRamp:
    """The ramp: given a closed loop, it says which gains to try next."""

    def __init__(
        self, gains: tuple[float, ...], request: RampRequest, *, frame_rate_hz: float
    ) -> None:
        """Take the present gains, one per mode; at most half of the frames settle."""
        self.name = request.id
        """Id of the request."""
        self._settled = np.array(gains)
        self._groups = tuple(slice(first, last + 1) for first, last in request.groups)
        self._gains = request.gains
        self._frames_per_gain = request.frames_per_gain
        settling = round(_SETTLING_S * frame_rate_hz)
        self._settling_frames = min(settling, request.frames_per_gain // 2)
        self._loop: tuple[str, bool] | None = None
        self._group = 0
        self.steps: tuple[Step, ...] = ()
        """Every gain tried so far, in order."""
        self._begin_group()

    @property
    def done(self) -> bool:
        """Return True if every group has its gain."""
        return self._group == len(self._groups)

    @property
    def modes(self) -> slice:
        """The modes whose residual is judged now."""
        return self._groups[min(self._group, len(self._groups) - 1)]

    @property
    def settled(self) -> tuple[float, ...]:
        """One per mode: the gain chosen so far, else the one before."""
        return tuple(self._settled.tolist())

    @property
    def gains(self) -> tuple[float, ...]:
        """One per mode: the gain in force now, once done the one chosen."""
        gains = self._settled.copy()
        if not self.done:
            gains[self.modes] = self._waiting[0]
        return tuple(gains.tolist())

    @property
    def gains_by_group(self) -> tuple[float, ...]:
        """The same, one per group."""
        gains = self.gains
        return tuple(gains[group.start] for group in self._groups)

    def look(self, batch: Batch, matrix: Array32) -> bool:
        """Take a batch and the matrix that multiplied its slopes; return whether gains change.

        Another matrix, or a dither that begins or ends, makes another loop: what the group under
        way has shown by then counts no more.
        """
        loop = (batch.cm_id, batch.dither_m is None)
        known, self._loop = self._loop in {None, loop}, loop
        if not known:
            self.again()
            return True
        return self.take(batch.slopes @ matrix[self.modes].T)

    def take(self, residual_m: Array32) -> bool:
        """Take the residual of the group's modes ``(n_frames, n_group)`` in the next frames.

        Returns
        -------
        Whether other gains are to be tried from now on.
        """
        self._frames += len(residual_m)
        if self.done or self._frames <= self._settling_frames:
            return False
        # A fault may put NaN into slopes; one such frame would spoil the whole step.
        finite = residual_m[np.isfinite(residual_m).all(axis=1)].astype(np.float64)
        self._power += float((finite**2).sum())
        self._judged += finite.size
        if self._frames < self._frames_per_gain:
            return False
        self._judge()
        self._tell()
        return True

    def again(self) -> None:
        """Forget the present group's residuals: the loop is no longer the same."""
        if not self.done:
            self.steps = tuple(step for step in self.steps if step.group != self._group)
            self._begin_group()

    def give_up(self, reason: str) -> None:
        """Log why the ramp ends early."""
        _log.warning("gains.given-up", ramp=self.name, reason=reason)

    def _tell(self) -> None:
        step = self.steps[-1]
        _log.info(
            "gains.step",
            ramp=self.name,
            group=step.group,
            gain=round(step.gain, 3),
            residual_nm=round(1e9 * step.residual_m, 2),
        )
        if self.done:
            chosen = [round(gain, 3) for gain in self.gains_by_group]
            _log.info("gains.chosen", ramp=self.name, by_group=chosen)

    def _judge(self) -> None:
        residual_m = float(np.sqrt(self._power / self._judged)) if self._judged else np.inf
        gain, *waiting = self._waiting
        self.steps = (*self.steps, Step(group=self._group, gain=gain, residual_m=residual_m))
        tried = [step for step in self.steps if step.group == self._group]
        best = min(tried, key=lambda step: step.residual_m)
        if residual_m > _CLEARLY_WORSE * best.residual_m:
            waiting = [other for other in waiting if other < gain]
        if waiting:
            self._begin_step(tuple(waiting))
            return
        self._settled[self.modes] = best.gain
        self._group += 1
        self._begin_group()

    def _begin_group(self) -> None:
        self._begin_step(() if self.done else self._gains)

    def _begin_step(self, waiting: tuple[float, ...]) -> None:
        self._waiting, self._frames, self._power, self._judged = waiting, 0, 0.0, 0


def ramp_refusal(request: RampRequest, settings: LoopSettings, n_controlled: int) -> str:
    """Return why gains cannot be tried so, in the wire's words; empty: they can."""
    if not settings.closed:
        return "unsupported: a gain ramp while the loop is open; close it first"
    last = max(last for _, last in request.groups)
    if last >= n_controlled:
        return f"range: mode {last} in groups, expected 0 to {n_controlled - 1}"
    # With a delay of two frames an integrator is stable up to a gain of 1; an optical gain below 1
    # allows more.
    if max(request.gains) > LARGEST_GAIN:
        return f"range: gain {max(request.gains):g}, expected at most {LARGEST_GAIN:g}"
    return ""
