"""How the work keeps pace with the telemetry: what it costs, and what is said where it does not."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from service.routes.service import Pace
from service.runtime.workers import WorkerPool
from service.tracking import events as ev
from service.tracking.alarms import WORKER_BEHIND, WORKER_LOST
from service.tracking.state import TrackerState

MEMORY_S = 60.0
"""What is told is of the last minute."""

ENOUGH_S = 20.0
"""Before so much of it has passed nobody is said to be behind: a matrix is made meanwhile."""

LATE_WINDOWS = 3
"""Windows that came before the worker had a hand free for the one before them, to be behind;"""

FULLY_BUSY, AT_EASE = 0.8, 0.65
"""and the share of the time in which it has a job: above the first it is behind, and below the
second, or with no late window in a minute, it is not any more."""

STARVED = 0.6
"""Processor time of the worker over the time it is at work: with less the machine is loaded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Mark:
    """All counters at one moment, seconds."""

    clock: float
    service: float = 0.0
    busy: float = 0.0
    telemetry: float = 0.0
    jobs: Mapping[str, float] = field(default_factory=dict)
    late: int = 0
    fitted: int = 0
    fitted_s: float = 0.0


class PaceMeter:
    """Counts what the work costs; ``look`` at it once a second."""

    def __init__(self, workers: WorkerPool) -> None:
        self._workers = workers
        self._telemetry_s = 0.0
        self._late = self._fitted = 0
        self._fitted_s = 0.0
        self._marks: deque[_Mark] = deque([self._mark()])
        self._behind = False

    def heard(self, seconds: float) -> None:
        """Count telemetry that was taken in."""
        self._telemetry_s += seconds

    def was_late(self) -> None:
        """Count a window that came while another one still waited."""
        self._late += 1

    def fitted(self, window_s: float) -> None:
        """Count a window that the worker has begun with."""
        self._fitted += 1
        self._fitted_s += window_s

    def look(self) -> Pace:
        """Take note of where everything stands, and return how it goes."""
        now = self._mark()
        self._marks.append(now)
        while len(self._marks) > 2 and now.clock - self._marks[1].clock >= MEMORY_S:
            self._marks.popleft()
        return self.pace

    @property
    def pace(self) -> Pace:
        """What the work of the last minute cost."""
        first, last = self._marks[0], self._marks[-1]
        lasted_s = max(last.clock - first.clock, 1e-9)
        telemetry_s, fitted = last.telemetry - first.telemetry, last.fitted - first.fitted
        jobs = Counter(last.jobs)
        jobs.subtract(first.jobs)
        per_s = {name: s / telemetry_s for name, s in jobs.items() if s > 0} if telemetry_s else {}
        return Pace(
            worker_per_s=sum(per_s.values()) if telemetry_s else None,
            by_job=dict(sorted(per_s.items(), key=lambda item: -item[1])),
            service_per_s=(last.service - first.service) / lasted_s,
            busy_ratio=(last.busy - first.busy) / lasted_s,
            window_s=(last.fitted_s - first.fitted_s) / fitted if fitted else None,
            windows_late=last.late - first.late,
        )

    def news(self, state: TrackerState) -> list[ev.Trouble]:
        """Return which alarms of the worker come or go."""
        lost = self._workers.trouble
        if lost:
            lost = f"{lost}; another one takes over, what it was at is lost. If it comes again: is "
            lost += "there memory enough, and does the machine get to run it?"
        said = [
            (WORKER_LOST, lost, "the worker does its work again"),
            (WORKER_BEHIND, self._why_behind(), "the worker keeps up with the telemetry again"),
        ]
        known = {alarm.name for alarm in state.alarms}
        return [
            ev.Trouble(name=name, text=text or over, over=name in known)
            for name, text, over in said
            if bool(text) is not (name in known)
        ]

    def _why_behind(self) -> str:
        pace, first, last = self.pace, self._marks[0], self._marks[-1]
        if last.clock - first.clock < ENOUGH_S or pace.busy_ratio is None:
            return ""
        if self._behind:
            self._behind = pace.busy_ratio > AT_EASE and pace.windows_late > 0
        else:
            self._behind = pace.busy_ratio > FULLY_BUSY and pace.windows_late >= LATE_WINDOWS
        if not self._behind:
            return ""
        most = ", ".join(f"{name} {share:.2f}" for name, share in list(pace.by_job.items())[:3])
        got = sum(last.jobs.values()) - sum(first.jobs.values())
        share = got / max(last.busy - first.busy, 1e-9)
        cause = (
            f"the machine is loaded: of a second at work it gets {share:.1f} s of a processor"
            if share < STARVED
            else "the machine is too slow for this instrument"
        )
        return (
            f"the worker does not keep up: it is busy {pace.busy_ratio:.0%} of the time and takes "
            f"{pace.worker_per_s or 0.0:.2f} s of processor time for each second of telemetry "
            f"({most or 'nothing done yet'}); {cause}. Windows are now {pace.window_s or 0.0:.1f} "
            "s long and α comes as much later; end other work there, or control and dither less"
        )

    def _mark(self) -> _Mark:
        return _Mark(
            clock=time.monotonic(),
            service=time.process_time(),
            busy=self._workers.busy_s,
            telemetry=self._telemetry_s,
            jobs=dict(self._workers.cpu_s),
            late=self._late,
            fitted=self._fitted,
            fitted_s=self._fitted_s,
        )
