"""The true registration over time, and the optics for it.

It is constant, drifts, flexes, wanders, jumps. A new registration takes seconds to compute: a
jump's optics are prepared in the background from the moment the previous one is in place; if they
are late, the old ones stay until they are ready. A drift, a flexure or a walk is a chain of exact
optics, with linear steps in between.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from queue import SimpleQueue
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from sim_rtc.telescope.plant import Optics, Plant

Array = NDArray[np.float64]

_LARGEST_SHIFT_SUBAP = 0.2
_LARGEST_ROTATION_DEG = 0.3
_LARGEST_MAGNIFICATION = 0.005

_WALK_STEP_S = 20.0
"""Time between two knots of a random walk: about the time that exact optics take to compute, with a
margin."""

_LONGEST_SEGMENT_S = 20.0
_LAW_SEGMENT_S = 4.0
"""Duration of a segment of a pointing law: a slew takes seconds."""

_SEGMENTS_PER_PERIOD = 12
"""Straight pieces of a sine: they leave it by 3 % of its amplitude at most."""

_STEPS_PER_SEGMENT = 10
_BACKGROUND_NICENESS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A change of the registration, in units of the boundary."""

    shift_x_subap: float = 0.0
    shift_y_subap: float = 0.0
    rotation_deg: float = 0.0
    magnification: float = 0.0
    """Change of the ratio: 0.002 makes the image 0.2 % of its nominal size larger."""

    @classmethod
    def of(cls, boundary: Sequence[float], **more: float) -> Self:
        """Return the change of these four values; ``more`` are the other fields."""
        dx, dy, rotation_deg, magnification = boundary
        return cls(
            shift_x_subap=dx,
            shift_y_subap=dy,
            rotation_deg=rotation_deg,
            magnification=magnification,
            **more,
        )

    @property
    def vector(self) -> Array:
        """The change in numeric units: shifts in subapertures, rotation in radians, ratio."""
        boundary = (self.shift_x_subap, self.shift_y_subap, self.rotation_deg, self.magnification)
        return np.asarray(np.array(boundary) / BOUNDARY_SCALE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Jump(Change):
    """A sudden change of the registration."""

    time_s: float
    """Time of the jump, seconds of loop time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift(Change):
    """A steady change of the registration, per minute."""

    def offset(self, time_s: float) -> Array:
        """Return the departure at this time, in numeric units."""
        return np.asarray(self.vector / 60.0 * time_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flexure(Change):
    """A sinusoid, as the telescope's elevation makes: 0 at time 0, then up to the amplitude."""

    period_s: float = 600.0

    def offset(self, time_s: float) -> Array:
        """Return the departure at this time, in numeric units."""
        return np.asarray(self.vector * np.sin(2 * np.pi * time_s / self.period_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk(Change):
    """A random walk with these standard deviations after a minute, growing with the root of time.

    The same seed gives the same walk, independently of the times at which it is evaluated.
    """

    seed: int = 0

    def offset(self, time_s: float) -> Array:
        """Return the departure at this time, in numeric units: straight between knots."""
        sigma = self.vector * np.sqrt(_WALK_STEP_S / 60.0)
        position = time_s / _WALK_STEP_S
        n_whole = int(position)
        # A generator's first numbers do not depend on how many are drawn.
        steps = np.random.default_rng(self.seed).standard_normal((n_whole + 1, 4)) * sigma
        return np.asarray(steps[:n_whole].sum(axis=0) + (position - n_whole) * steps[n_whole])


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """The mirror's place on the sensor at any time of the run."""

    start: Misregistration
    """At time 0."""

    drift: Drift = Drift()
    flexure: Flexure = Flexure()
    walk: Walk = Walk()
    jumps: tuple[Jump, ...] = ()
    """Jumps, in any order."""

    law: Callable[[float], Array] | None = None
    """Departure since time 0 by the law of pointing, at a time, numeric units; None: there is no
    law."""

    corners_s: tuple[float, ...] = ()
    """Times at which that begins to move otherwise."""

    @property
    def drifts(self) -> bool:
        """Return True if the registration changes between the jumps."""
        departures = [self.drift.vector, self.flexure.vector, self.walk.vector]
        return self.law is not None or bool(np.any(departures))

    @property
    def segment_s(self) -> float:
        """Longest stretch over which the movement between the jumps is as good as straight."""
        if self.law is not None:
            return _LAW_SEGMENT_S
        if np.any(self.flexure.vector):
            return min(_LONGEST_SEGMENT_S, self.flexure.period_s / _SEGMENTS_PER_PERIOD)
        return _LONGEST_SEGMENT_S

    def alpha_at(self, time_s: float) -> Misregistration:
        """Return the registration at this time; a jump belongs to the time after it."""
        vector = self.start.vector + self.drift.offset(time_s)
        vector = vector + self.flexure.offset(time_s) + self.walk.offset(time_s)
        if self.law is not None:
            vector = vector + self.law(time_s)
        for jump in self.jumps:
            if jump.time_s <= time_s:
                vector = vector + jump.vector
        return self.start.with_vector(vector)

    def alpha_before(self, time_s: float) -> Misregistration:
        """Return the registration as this time is reached, a jump at that very time left out."""
        earlier = tuple(jump for jump in self.jumps if jump.time_s < time_s)
        return replace(self, jumps=earlier).alpha_at(time_s)

    def next_jump_after(self, time_s: float) -> float:
        """Return the time of the next jump, infinity when there is none."""
        return min((j.time_s for j in self.jumps if j.time_s > time_s), default=float("inf"))


def random_registration(rng: np.random.Generator, nominal_rad: float = 0.0) -> Misregistration:
    """Draw a registration a 400-mode loop can hold: |shift| <= 0.2 subap, 0.3 deg, 0.5 %.

    The rotation is that far from the nominal one.
    """
    # The square root makes the shifts uniform over the disc.
    radius = _LARGEST_SHIFT_SUBAP * np.sqrt(rng.uniform())
    angle = rng.uniform(0.0, 2 * np.pi)
    return Misregistration.from_vector(
        np.array(
            [
                radius * np.cos(angle),
                radius * np.sin(angle),
                nominal_rad
                + np.deg2rad(rng.uniform(-_LARGEST_ROTATION_DEG, _LARGEST_ROTATION_DEG)),
                1.0 + rng.uniform(-_LARGEST_MAGNIFICATION, _LARGEST_MAGNIFICATION),
            ]
        )
    )


def far_registration(rng: np.random.Generator, nominal_rad: float = 0.0) -> Misregistration:
    """Draw a registration at which FLAO's loop holds 120 modes and would lose 400.

    On the matrix of a perfect registration, with the loop gain and optical gains of an ordinary
    night: largest pole radius 0.83 to 0.86 for 120 modes, above 1.01 for 400.
    """
    radius, angle = rng.uniform(0.40, 0.42), rng.uniform(0.0, 2 * np.pi)
    turn_deg, scale = rng.uniform(0.6, 0.7), rng.uniform(0.002, 0.004)
    sense = rng.choice([-1.0, 1.0], 2)
    return Misregistration.from_vector(
        np.array(
            [
                radius * np.cos(angle),
                radius * np.sin(angle),
                nominal_rad + np.deg2rad(sense[0] * turn_deg),
                1.0 + sense[1] * scale,
            ]
        )
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Segment:
    """A stretch of time between two exact optics; both are the same where nothing drifts."""

    start_s: float
    stop_s: float
    first: Optics
    last: Optics


class MovingOptics:
    """The plant's optics at any time of a run; times must be requested in order."""

    def __init__(
        self,
        plant: Plant,
        schedule: Schedule,
        executor: Executor,
        prepare: Callable[[Optics], None] | None = None,
    ) -> None:
        """Take a function that prepares new optics before the loop uses them."""
        self._plant = plant
        self._prepare = prepare
        self._schedule = schedule
        self._executor = executor
        self._segment: _Segment | None = None
        self._next: Future[_Segment] | None = None
        self._current: tuple[int, Optics] | None = None
        self._demands: SimpleQueue[tuple[float, Array]] = SimpleQueue()
        self._seen_s = 0.0

    def move(self, vector: Array, takes_s: float) -> float:
        """Move the mirror's image by ``(4,)``, numeric units; return the time of arrival.

        The time is seconds of loop time, counted from the last request. If the new optics are late,
        the old ones stay in use until they are computed.
        """
        there_s = self._seen_s + takes_s
        self._demands.put((there_s, vector))
        return there_s

    def start(self) -> Optics:
        """Compute the optics at time 0; takes seconds."""
        self._adopt(self._compute(0.0, None))
        return self.at(0.0)

    def at(self, time_s: float) -> Optics:
        """Return the optics at this time: the same object for as long as nothing has moved."""
        self._seen_s = time_s
        if not self._demands.empty():
            there_s, vector = self._demands.get()
            # A demand moves everything that follows, jumps and drifts included.
            start = self._schedule.start.add_step(vector)
            self._schedule = replace(self._schedule, start=start)
            self._next = self._executor.submit(self._compute, there_s, None)
        if self._next is not None and self._next.done() and time_s >= self._next.result().start_s:
            self._adopt(self._next.result())
        segment = self._segment
        if segment is None:
            return self.start()
        # Nothing drifts: the same object, so that the loop keeps its products of it.
        if segment.first is segment.last:
            return segment.first
        # If the next segment is late, the registration stays at the end of this one.
        share = min(1.0, (time_s - segment.start_s) / (segment.stop_s - segment.start_s))
        # In steps, because each new optics costs the loop its prepared products.
        step = round(share * _STEPS_PER_SEGMENT)
        if self._current is None or self._current[0] != step:
            blend = segment.first.towards(segment.last, step / _STEPS_PER_SEGMENT)
            self._current = (step, blend)
        return self._current[1]

    def _adopt(self, segment: _Segment) -> None:
        self._segment, self._current, self._next = segment, None, None
        if segment.stop_s < float("inf"):
            # Without a jump the end of one segment is the beginning of the next and is not computed
            # twice.
            last = None if self._jumps_at(segment.stop_s) else segment.last
            self._next = self._executor.submit(self._compute, segment.stop_s, last)

    def _jumps_at(self, time_s: float) -> bool:
        return any(jump.time_s == time_s for jump in self._schedule.jumps)

    def _compute(self, start_s: float, first: Optics | None) -> _Segment:
        schedule = self._schedule
        stop_s = schedule.next_jump_after(start_s)
        if first is None:
            first = self._optics(schedule.alpha_at(start_s))
        last = first
        if schedule.drifts:
            corners_s = (corner_s for corner_s in schedule.corners_s if corner_s > start_s)
            stop_s = min(stop_s, start_s + schedule.segment_s, *corners_s)
            last = self._optics(schedule.alpha_before(stop_s))
        return _Segment(start_s=start_s, stop_s=stop_s, first=first, last=last)

    def _optics(self, alpha: Misregistration) -> Optics:
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
