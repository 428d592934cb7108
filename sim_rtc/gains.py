"""The gain ramp: one group of modes after the other, the gain of least residual slopes is kept.

The groups are the paper's three: tip and tilt, the modes up to 100, the rest. The gain of a group
rises step by step while the others stay; it stops rising when the residual has clearly grown,
which is well before the loop is lost. The residual slopes are judged as the group sees them,
through its own rows of the reconstructor: in the RMS of all slopes the noise of 1400 of them hides
tip and tilt.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import structlog
from numpy.typing import NDArray

from service.wire import LoopRequest
from sim_rtc.computer import Batch, RealTimeComputer

Array32 = NDArray[np.float32]

GROUP_ENDS = (2, 100)
"""First mode after each group but the last."""

FACTORS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5)
"""Gains tried, over the gain at the start."""

_CLEARLY_WORSE = 1.5
"""Residual over the best so far at which a group's gain rises no further.

A second of turbulence makes that of tip and tilt differ by a fifth and more by itself.
"""

_LARGEST_GAIN = 2.0
_START_S = 2.0
"""Of closed loop before the first step."""

_SETTLING_S = 0.2
"""Between a new gain and the first slopes that are judged."""

_log = structlog.get_logger("sim_rtc")


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One gain tried."""

    group: int
    gain: float
    residual_m: float
    """RMS of the slopes, reconstructed into the modes of the group, metres OPD."""


def groups_of(n_controlled: int) -> tuple[slice, ...]:
    """Return the modes of each group; one that the loop does not reach is left out."""
    edges = (0, *(end for end in GROUP_ENDS if end < n_controlled), n_controlled)
    return tuple(slice(a, b) for a, b in pairwise(edges))


def by_group(gains: tuple[float, ...], n_modes: int) -> tuple[float, ...]:
    """Return one gain per mode from one per group; groups the basis does not reach are ignored."""
    spread = np.empty(n_modes)
    for group, gain in zip(groups_of(n_modes), gains, strict=False):
        spread[group] = gain
    return tuple(spread.tolist())


class GainRamp:
    """The ramp itself: told the residual, it says which gains are to be tried next.

    Parameters
    ----------
    gains
        One per mode of the basis, as they are at the start; within a group the first one counts.
    n_controlled
        Modes in the loop; those beyond get the last group's gain.
    settling_frames, judged_frames
        After each change: frames that are ignored, and then those that are judged.
    """

    def __init__(
        self,
        gains: tuple[float, ...],
        *,
        n_controlled: int,
        settling_frames: int,
        judged_frames: int,
    ) -> None:
        self._settled = np.array(gains)
        self._groups = groups_of(n_controlled)
        self._settling_frames = settling_frames
        self._judged_frames = judged_frames
        self._group = 0
        self.steps: tuple[Step, ...] = ()
        """Every gain tried so far, in order."""
        self._begin_group()

    @property
    def done(self) -> bool:
        """Whether every group has its gain."""
        return self._group == len(self._groups)

    @property
    def modes(self) -> slice:
        """The modes whose residual is judged now."""
        return self._groups[min(self._group, len(self._groups) - 1)]

    @property
    def gains(self) -> tuple[float, ...]:
        """One per mode: what is to be in force now, and once done what was chosen."""
        gains = self._settled.copy()
        if not self.done:
            gains[self._affected()] = self._ladder[self._rung]
        return tuple(gains.tolist())

    @property
    def gains_by_group(self) -> tuple[float, ...]:
        """The same, one per group."""
        gains = self.gains
        return tuple(gains[group.start] for group in self._groups)

    def take(self, residual_m: Array32) -> bool:
        """Take the residual of the group's modes ``(n_frames, n_group)`` in the next frames.

        Returns
        -------
        Whether other gains are to be tried from now on.
        """
        self._frames += len(residual_m)
        if self.done or self._frames <= self._settling_frames:
            return False
        finite = residual_m[np.isfinite(residual_m).all(axis=1)].astype(np.float64)
        self._power += float((finite**2).sum())
        self._judged += finite.size
        if self._frames < self._settling_frames + self._judged_frames:
            return False
        self._judge()
        return True

    def again(self) -> None:
        """Forget what the present group has shown: the loop is no longer the same."""
        if not self.done:
            self.steps = tuple(step for step in self.steps if step.group != self._group)
            self._begin_group()

    def _judge(self) -> None:
        residual_m = float(np.sqrt(self._power / self._judged)) if self._judged else np.inf
        step = Step(group=self._group, gain=self._ladder[self._rung], residual_m=residual_m)
        self.steps = (*self.steps, step)
        tried = [step for step in self.steps if step.group == self._group]
        best = min(tried, key=lambda step: step.residual_m)
        bearable = residual_m <= _CLEARLY_WORSE * best.residual_m
        if self._rung + 1 < len(self._ladder) and bearable:
            self._begin_step(self._rung + 1)
            return
        self._settled[self._affected()] = best.gain
        self._group += 1
        self._begin_group()

    def _affected(self) -> slice:
        """Return the modes that get the gain now tried."""
        last = self._group == len(self._groups) - 1
        return slice(self.modes.start, None if last else self.modes.stop)

    def _begin_group(self) -> None:
        if not self.done:
            start = float(self._settled[self.modes.start])
            self._ladder = tuple(min(start * factor, _LARGEST_GAIN) for factor in FACTORS)
        self._begin_step(0)

    def _begin_step(self, rung: int) -> None:
        self._rung, self._frames, self._power, self._judged = rung, 0, 0.0, 0


class Tuner:
    """Carries a gain ramp out on a computer, batch by batch; its result shows in the gains."""

    def __init__(self, computer: RealTimeComputer, *, step_s: float) -> None:
        snapshot = computer.snapshot()
        settings = snapshot.settings
        self._computer = computer
        self._wait_frames = round(_START_S * settings.frame_rate_hz)
        self._ramp = GainRamp(
            settings.gains,
            n_controlled=len(snapshot.reconstructor.matrix),
            settling_frames=round(_SETTLING_S * settings.frame_rate_hz),
            judged_frames=max(1, round(step_s * settings.frame_rate_hz)),
        )
        self._n_commands = 0
        self._loop: tuple[str, str] | None = None

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""
        return self._ramp.done

    def look(self, batch: Batch) -> None:
        """Take the slopes of a batch and change the gains when it is time."""
        if self.done or not batch.closed:
            return
        loop = (batch.session, batch.cm_id)
        if loop != self._loop:
            restarted = self._loop is not None
            self._loop = loop
            if restarted:
                self._ramp.again()
                self._command()
            return
        if self._wait_frames > 0:
            self._wait_frames -= len(batch.slopes)
            if self._wait_frames <= 0:
                self._command()
            return
        rows = self._computer.snapshot().reconstructor.matrix[self._ramp.modes]
        if self._ramp.take(batch.slopes @ rows.T):
            self._tell()
            self._command()

    def _command(self) -> None:
        """Put the gains in force; a loop that is busy is asked again with the next step."""
        self._n_commands += 1
        name = f"gain-ramp-{self._n_commands}"
        reply = self._computer.execute(LoopRequest(id=name, gains=self._ramp.gains))
        if not reply.accepted:
            _log.warning("gains.refused", reason=reply.reason)
            self._ramp.again()

    def _tell(self) -> None:
        step = self._ramp.steps[-1]
        _log.info(
            "gains.step",
            group=step.group,
            gain=round(step.gain, 3),
            residual_nm=round(1e9 * step.residual_m, 2),
        )
        if self.done:
            chosen = [round(gain, 3) for gain in self._ramp.gains_by_group]
            _log.info("gains.chosen", by_group=chosen)
