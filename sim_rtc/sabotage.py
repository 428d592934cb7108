"""Faults of the computer itself: it stalls, restarts, opens its loop, loses stroke or dither."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

import structlog

from service.wire import Command, Loop, LoopRequest, Reply
from sim_rtc.clock import FrameClock, Pace
from sim_rtc.faults import Fault, FaultKind, FaultPlan

_NEVER_FRAMES = 2**40

_log = structlog.get_logger("sim_rtc")


class Victim(Protocol):
    """What of the computer the faults act on."""

    def execute(self, command: Command) -> Reply:
        """Carry out a command."""

    def restart(self) -> None:
        """Begin a session from frame 0 with the matrix of the start."""

    def limit_stroke(self, stroke_m: float | None) -> None:
        """Clip commands at this, metres RMS; None: as at the start."""

    def delay_dithers(self, n_frames: int) -> None:
        """Let dithers to come begin so many frames after the announced one."""


class Sabotage:
    """Carries out the plan between two batches, in the loop's thread."""

    def __init__(
        self,
        plan: FaultPlan,
        victim: Victim,
        *,
        clock: FrameClock,
        pace: Pace,
        absence: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Take the parts.

        Parameters
        ----------
        plan
            What is to happen when.
        victim
            The computer.
        clock, pace
            Of its frames.
        absence
            Context in which the RTC is not to be seen on the network.
        """
        self._plan = plan
        self._victim = victim
        self._clock = clock
        self._pace = pace
        self._absence = absence
        self._waiting = list(plan.faults)
        self._lasting: list[Fault] = []

    def before_batch(self, time_s: float, stopped: threading.Event) -> None:
        """Begin and end what is due at this loop time; a stall waits here."""
        self._plan.now_s = time_s
        while self._lasting and min(f.end_s for f in self._lasting) <= time_s:
            over = min(self._lasting, key=lambda fault: fault.end_s)
            self._lasting.remove(over)
            self._end(over)
        while self._waiting and self._waiting[0].time_s <= time_s:
            fault = self._waiting.pop(0)
            _log.warning("fault", fault=str(fault), text="as asked for")
            self._lasting.append(fault)
            self._begin(fault, stopped)

    def _begin(self, fault: Fault, stopped: threading.Event) -> None:
        match fault.kind:
            case FaultKind.STALL:
                stopped.wait(fault.value("SECONDS"))
            case FaultKind.PAUSE:
                self._rest(fault.value("SECONDS"), stopped)
            case FaultKind.RESTART:
                self._restart(fault.value("SECONDS"), stopped)
            case FaultKind.CLOCK:
                self._clock.step(round(1e9 * fault.value("STEP")))
            case _:
                self._change(fault)

    def _change(self, fault: Fault) -> None:
        """Begin what lasts until ``_end``."""
        match fault.kind:
            case FaultKind.OPEN:
                self._command(fault, Loop.OPEN)
            case FaultKind.SATURATION:
                self._victim.limit_stroke(1e-9 * fault.value("STROKE_NM"))
            case FaultKind.DITHER_LOST:
                self._victim.delay_dithers(_NEVER_FRAMES)
            case FaultKind.DITHER_LATE:
                self._victim.delay_dithers(round(1e9 * fault.value("DELAY") / self._clock.dt_ns))
            case _:
                pass

    def _end(self, fault: Fault) -> None:
        match fault.kind:
            case FaultKind.OPEN:
                self._command(fault, Loop.CLOSED)
            case FaultKind.SATURATION:
                self._victim.limit_stroke(None)
            case FaultKind.DITHER_LOST | FaultKind.DITHER_LATE:
                self._victim.delay_dithers(0)
            case _:
                pass

    def _restart(self, seconds: float, stopped: threading.Event) -> None:
        with self._absence():
            self._rest(seconds, stopped)
            self._victim.restart()
            self._clock.restart(time.time_ns())

    def _rest(self, seconds: float, stopped: threading.Event) -> None:
        """Do nothing, as a computer that hangs: no frame is made up for afterwards."""
        stopped.wait(seconds)
        self._clock.step(round(1e9 * seconds))
        self._pace.forgive(seconds)

    def _command(self, fault: Fault, loop: Loop) -> None:
        self._victim.execute(LoopRequest(id=f"fault-{fault.kind}", loop=loop))
