"""The optics as the registration moves: computed ahead in the background, never waited for.

A new registration takes seconds to compute. A jump's optics are therefore prepared from the moment
the previous one is in place; if they are late, the old ones stay until they are ready. A drift, a
flexure or a walk is a chain of exact optics, with linear steps in between.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass

from service.model.misregistration import Misregistration
from sim_rtc.plant import Plant, TelescopeOptics
from sim_rtc.schedule import Schedule

_STEPS_PER_SEGMENT = 10
_BACKGROUND_NICENESS = 10


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Segment:
    """A stretch of time between two exact optics; both are the same where nothing drifts."""

    start_s: float
    stop_s: float
    first: TelescopeOptics
    last: TelescopeOptics


class MovingOptics:
    """The plant's optics at any time of a run, asked for in order."""

    def __init__(
        self,
        plant: Plant,
        schedule: Schedule,
        executor: Executor,
        prepare: Callable[[TelescopeOptics], None] | None = None,
    ) -> None:
        """Take what else is to be done with new optics before the loop sees them."""
        self._plant = plant
        self._prepare = prepare
        self._schedule = schedule
        self._executor = executor
        self._segment: _Segment | None = None
        self._next: Future[_Segment] | None = None
        self._current: tuple[int, TelescopeOptics] | None = None

    def start(self) -> TelescopeOptics:
        """Compute the optics at time 0; takes seconds."""
        self._adopt(self._compute(0.0, None))
        return self.at(0.0)

    def at(self, time_s: float) -> TelescopeOptics:
        """Return the optics at this time: the same object for as long as nothing has moved."""
        if self._next is not None and self._next.done() and time_s >= self._next.result().start_s:
            self._adopt(self._next.result())
        segment = self._segment
        if segment is None:
            return self.start()
        if segment.first is segment.last:
            return segment.first
        share = min(1.0, (time_s - segment.start_s) / (segment.stop_s - segment.start_s))
        step = round(share * _STEPS_PER_SEGMENT)
        if self._current is None or self._current[0] != step:
            blend = segment.first.towards(segment.last, step / _STEPS_PER_SEGMENT)
            self._current = (step, blend)
        return self._current[1]

    def _adopt(self, segment: _Segment) -> None:
        self._segment, self._current, self._next = segment, None, None
        if segment.stop_s < float("inf"):
            last = None if self._jumps_at(segment.stop_s) else segment.last
            self._next = self._executor.submit(self._compute, segment.stop_s, last)

    def _jumps_at(self, time_s: float) -> bool:
        return any(jump.time_s == time_s for jump in self._schedule.jumps)

    def _compute(self, start_s: float, first: TelescopeOptics | None) -> _Segment:
        schedule = self._schedule
        stop_s = schedule.next_jump_after(start_s)
        if first is None:
            first = self._optics(schedule.alpha_at(start_s))
        last = first
        if schedule.drifts:
            stop_s = min(stop_s, start_s + schedule.segment_s)
            last = self._optics(schedule.alpha_before(stop_s))
        return _Segment(start_s=start_s, stop_s=stop_s, first=first, last=last)

    def _optics(self, alpha: Misregistration) -> TelescopeOptics:
        optics = self._plant.optics(alpha)
        if self._prepare is not None:
            self._prepare(optics)
        return optics


def background_executor() -> ThreadPoolExecutor:
    """Return an executor of one thread that gives way to the loop."""
    return ThreadPoolExecutor(1, thread_name_prefix="optics", initializer=_give_way)


def _give_way() -> None:
    # Linux alone keeps a niceness per thread; elsewhere this would slow the whole process down.
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _BACKGROUND_NICENESS)
