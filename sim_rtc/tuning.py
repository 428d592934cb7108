"""A gain ramp under way in a loop: batch by batch, until it is done or given up."""

from __future__ import annotations

from typing import Any

import structlog
from numpy.typing import NDArray

from sim_rtc.gains import GainRamp
from sim_rtc.telemetry import Batch

_log = structlog.get_logger("sim_rtc")


class Tuning:
    """Shows a ramp the batches of a closed loop, and tells the log what it makes of them."""

    def __init__(self, ramp: GainRamp, *, name: str, wait_frames: int = 0) -> None:
        """Take a ramp, and the frames of closed loop after which it begins."""
        self.name = name
        self._ramp = ramp
        self._wait_frames = wait_frames
        self._loop: tuple[str, bool] | None = None

    @property
    def done(self) -> bool:
        """Whether there is nothing left to try."""
        return self._ramp.done

    @property
    def gains(self) -> tuple[float, ...]:
        """One per mode of the basis: what is to be in force now."""
        return self._ramp.settled if self._wait_frames > 0 else self._ramp.gains

    @property
    def settled(self) -> tuple[float, ...]:
        """One per mode of the basis: what is to be in force if the ramp ends here."""
        return self._ramp.settled

    def look(self, batch: Batch, matrix: NDArray[Any]) -> bool:
        """Take a batch and the matrix that multiplied its slopes; return whether gains change.

        Another matrix, or a dither that begins or ends, makes another loop: what the group under
        way has shown by then counts no more.
        """
        loop = (batch.cm_id, batch.dither_m is None)
        known, self._loop = self._loop in {None, loop}, loop
        if self._wait_frames > 0:
            self._wait_frames -= len(batch.slopes)
            return self._wait_frames <= 0
        if not known:
            self._ramp.again()
            return True
        if not self._ramp.take(batch.slopes @ matrix[self._ramp.modes].T):
            return False
        self._tell()
        return True

    def give_up(self, reason: str) -> None:
        """Tell the log why it ends before its time."""
        _log.warning("gains.given-up", ramp=self.name, reason=reason)

    def _tell(self) -> None:
        step = self._ramp.steps[-1]
        _log.info(
            "gains.step",
            ramp=self.name,
            group=step.group,
            gain=round(step.gain, 3),
            residual_nm=round(1e9 * step.residual_m, 2),
        )
        if self.done:
            chosen = [round(gain, 3) for gain in self._ramp.gains_by_group]
            _log.info("gains.chosen", ramp=self.name, by_group=chosen)
