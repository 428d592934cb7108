"""Watch the loop, the mirror's edge, clipped commands, vibrations, and frozen slopes.

**The loop** is watched on the commands of the highest controlled modes: a misregistered loop
becomes unstable there first, while slopes and wavefront error look healthy almost to the end. Their
power is compared with what turbulence requires, and with that of the seconds before: a pyramid
that saturates bounds the commands of a lost loop at 3 to 8 times the expected turbulence.

**The outer ring** of the mirror is watched on the commands as well. A segment at the edge of the
pupil can slip by wavelengths and stay there: the sensor sees little light across it, its slopes
look healthy, and only the command shows the step. On the diffractive telescope the slowly averaged
position of the outermost actuators stays below 2.2 times the RMS that turbulence requires in every
stable loop. A slip takes it to 7 to 18, or leaves it at 3 for seconds while the wavefront is lost
already (docs/results/reliability.md).

**Commands that are not played** are found in telemetry that reports them as asked while the mirror
clips them. While the mirror plays what is asked, the residual less the command is the turbulence.
Where it does not, the integrator winds up: the commands of some actuators go far beyond all
turbulence, for tenths of a second, and the slopes do not show it. Averaged over 0.1 s the implied
turbulence of healthy loops stays below 4.6 times the usual one at every actuator, that of clipped
ones reaches 9 to 27 (docs/results/reliability.md).

**Vibrations** are lines in the slopes; the dither avoids them.

**Frozen slopes** are not a measurement, however healthy they look.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.comparison import REFERENCE_PERIOD_S
from service.estimation.description import ActuatorWatch, EdgeWatch
from service.estimation.estimator import (
    UNMARKED,
    Change,
    FrameContext,
    LoopContext,
    Mark,
    Streaming,
)
from service.estimation.frames import FrameBlock
from service.estimation.probation import MIN_HISTORY_S, MIN_PART_FRAMES, PART_S
from service.estimation.residual import N_LOST_PARTS, RUNAWAY_POWER_RATIO, runs_away
from service.model.defects import list_ranges
from service.model.kinds import SignalKind
from service.model.misregistration import unit_like
from service.model.slopes import TO_SLOPES

Array = NDArray[Any]

DIVERGING_RATIO = 10.0
"""Times the expected turbulence that the upper half of the controlled modes may reach."""

CALM_RATIO = 5.0
"""Below this a loop that was diverging counts as holding again."""

LOST_RATIO = 100.0
"""Times the expected turbulence from which no loop comes back by itself: it is opened at once."""

LOST_S = 0.1
"""Every frame must be beyond ``LOST_RATIO`` for so long: a single wrong frame opens no loop."""

ABSURD_RATIO = 1e4
"""Times the expected turbulence that no mirror reaches: commands are in another unit."""

_MEMORY_S = 0.5

MIN_UPPER_MODES = 10
"""Modes in the upper half; fewer wander by more than ``RUNAWAY_POWER_RATIO`` in a healthy loop."""

CALM_SHARE_OF_RUNAWAY = 0.5
"""Share of ``RUNAWAY_POWER_RATIO`` below which commands that ran away have come back."""

_CALMING_S = 0.05
"""The same for a loop that diverged and carries less: one that was a thousand times beyond and
holds again shows it within a second, not after seven memories."""


def count_part_frames(dt_s: float) -> int:
    """Return the number of frames of a part."""
    return max(round(PART_S / dt_s), MIN_PART_FRAMES)


def cut_parts(n_frames: int, n_open: int, n_part: int) -> Iterator[tuple[slice, int]]:
    """Yield the rows of a block that belong to each part, and how many frames the part then has.

    ``n_open`` frames of the first part came with earlier blocks; the last one may be incomplete.
    """
    start = 0
    while start < n_frames:
        stop = min(start + max(n_part - n_open, 0), n_frames)
        yield slice(start, stop), n_open + stop - start
        start, n_open = stop, 0


@dataclass(frozen=True, slots=True, kw_only=True)
class UpperPower:
    """Power of the commands in the upper half of the modes, now and in the seconds before."""

    n_modes: int = 0
    """Modes in the loop."""

    parts_m2: tuple[float, ...] = ()
    """Power in consecutive parts of ``PART_S``, oldest first, bounded."""

    open_m2: float = 0.0
    """Sum over the frames of the part that is not complete yet."""

    n_open: int = 0
    """Frames of that part."""

    lost_from_m2: float | None = None
    """Usual power before the commands ran away; None if they have not."""

    @property
    def ratio(self) -> float | None:
        """RMS of the commands over that before they ran away; None if they have not."""
        if self.lost_from_m2 is None:
            return None
        return float(np.sqrt(np.median(self.parts_m2[-N_LOST_PARTS:]) / self.lost_from_m2))

    def plus(self, upper_m: Array, n_modes: int, dt_s: float) -> UpperPower:
        """Return it after the commands ``(n_frames, n_upper)`` of a loop of so many modes."""
        state = self if n_modes == self.n_modes else UpperPower(n_modes=n_modes)
        if upper_m.shape[1] < MIN_UPPER_MODES:
            return state
        powers, n_part = np.einsum("km,km->k", upper_m, upper_m), count_part_frames(dt_s)
        for rows, n_open in cut_parts(len(powers), state.n_open, n_part):
            open_m2 = state.open_m2 + float(powers[rows].sum())
            state = replace(state, open_m2=open_m2, n_open=n_open)
            if n_open >= n_part:
                state = state.close_part(n_part * dt_s)
        return state

    def close_part(self, part_s: float) -> UpperPower:
        """Return it with one more complete part, and whether the commands run away now."""
        n_kept = round(REFERENCE_PERIOD_S / part_s) + N_LOST_PARTS
        parts = (*self.parts_m2, self.open_m2 / self.n_open)[-n_kept:]
        state = replace(self, parts_m2=parts, open_m2=0.0, n_open=0)
        before, last = parts[:-N_LOST_PARTS], parts[-N_LOST_PARTS:]
        if self.lost_from_m2 is not None:
            # a loop that comes back begins a history of its own
            calm = max(last) < CALM_SHARE_OF_RUNAWAY * RUNAWAY_POWER_RATIO * self.lost_from_m2
            return replace(state, parts_m2=(), lost_from_m2=None) if calm else state
        if len(before) * part_s < MIN_HISTORY_S:
            return state
        # The median, which a gust in less than half of the parts does not move.
        usual_m2 = float(np.median(before))
        return replace(state, lost_from_m2=usual_m2) if runs_away(last, usual_m2) else state


_OF_COMMANDS = Change.LOOP | Change.REFERENCES
"""Changes after which the power of the commands before is no reference for that after: the noise in
them goes with the gain, and reference slopes put a constant shape into them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopHealth(Streaming):
    """Forgetting mean of how far the high modes are beyond what turbulence asks of them."""

    resets = Change.GONE | Change.SESSION | Change.OPEN | _OF_COMMANDS | Change.MATRIX
    unless = Mark.STANDS
    only_closed = True

    ratio: float = 0.0
    """RMS of the command in the upper half of the controlled modes over its expectation."""

    power: UpperPower = field(default_factory=UpperPower)
    """Power of the commands in the upper half, compared with that of the seconds before."""

    diverging: bool = False
    absurd: bool = False
    """True if commands exceed any mirror's stroke, abruptly, unlike in a diverging loop."""

    beyond_s: float = 0.0
    """Duration for which every frame has been beyond ``LOST_RATIO``, seconds."""

    lost: bool = False
    """True if that lasted for ``LOST_S`` since the loop began to diverge."""

    @override
    def restart(self, loop: LoopContext, why: Change) -> LoopHealth:
        """Return an empty record: the loop of another matrix does not describe this one.

        The power before stays the reference of another matrix: turbulence is the same.
        """
        if why in _OF_COMMANDS:
            known = self.power.lost_from_m2 is None
            return replace(self, power=UpperPower()) if known else self
        return replace(self, ratio=0.0) if why == Change.MATRIX else LoopHealth()

    @override
    def update(self, frames: FrameContext) -> LoopHealth:
        """Return it after one more block."""
        loop = frames.loop
        return observe(self, frames.block, loop.description.mode_variance_m2, loop.in_loop)

    @property
    @override
    def marks(self) -> Mark:
        """Mark of commands in another unit."""
        return Mark.ABSURD if self.absurd else UNMARKED

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Texts of the alarms for commands in another unit and for a diverging or lost loop."""
        unit = unit_like(max(self.ratio, 1.0), 2.1)
        likely = f"look like {unit}" if unit else "are in another unit, or decoded wrongly"
        absurd = (
            f"commands are {self.ratio:.3g} times what turbulence asks: they {likely}, metres of "
            "OPD are expected; nothing is measured, made or sent until the RTC sends metres"
        )
        beyond = (
            f"{self.ratio:.0f} times what turbulence asks of them"
            if self.power.ratio is None
            else f"{self.power.ratio:.1f} times the commands of the seconds before"
        )
        diverging = (
            f"the loop is diverging: its high modes carry {beyond}; open the loop, lower the gain "
            "or control fewer modes"
        )
        lost = (
            f"the loop is lost: its high modes carry {self.ratio:.0f} times what turbulence asks "
            "of them; open the loop at once"
        )
        return (
            absurd if self.absurd else None,
            diverging if self.diverging else None,
            lost if self.lost else None,
        )


def observe(
    health: LoopHealth,
    block: FrameBlock,
    mode_variance_m2: NDArray[np.float64],
    in_loop: NDArray[np.intp],
) -> LoopHealth:
    """Return the health of a loop of these modes after one more block; open, it is well."""
    if not len(in_loop):
        return LoopHealth()
    upper = in_loop[len(in_loop) // 2 :]
    commands = block.commands_m[:, upper]
    expected = float(mode_variance_m2[upper].sum())
    if expected <= 0.0:
        return health
    levels = np.sqrt(np.einsum("km,km->k", commands, commands).astype(float) / expected)
    absurd = _absurd(health, levels)
    if absurd != health.absurd:
        # The mean restarts: values in another unit would dominate it long after they have ended.
        health = LoopHealth(ratio=float(np.sqrt(np.mean(levels**2))))
    # A dither begins and ends with the service, not with the loop: it must not look like a runaway.
    own = commands if block.dither_m is None else commands - block.dither_m[:, upper]
    upper_power = health.power.plus(own, len(in_loop), block.dt_ns * 1e-9)
    if absurd:
        # Powers in another unit must not become the reference.
        upper_power = UpperPower()
    power = float(np.mean(levels**2))
    calming = health.diverging and power < health.ratio**2
    memory_s = _CALMING_S if calming else _MEMORY_S
    fade = float(np.exp(-block.n_frames * block.dt_ns * 1e-9 / memory_s))
    # The mean is one of powers, the ratio that is kept one of RMS.
    ratio = float(np.sqrt(fade * health.ratio**2 + (1.0 - fade) * power))
    # Hysteresis: a ratio near the limit must not switch the alarm on and off.
    limit = CALM_RATIO if health.diverging else DIVERGING_RATIO
    diverging = not absurd and (ratio > limit or upper_power.ratio is not None)
    # For how long every frame has been beyond, at the end of the block.
    below = np.flatnonzero(levels <= LOST_RATIO)
    n_beyond = len(levels) - 1 - int(below[-1]) if len(below) else len(levels)
    beyond_s = (0.0 if len(below) else health.beyond_s) + n_beyond * block.dt_ns * 1e-9
    lost = diverging and (health.lost or beyond_s >= LOST_S)
    return LoopHealth(
        ratio=ratio,
        power=upper_power,
        diverging=diverging,
        absurd=absurd,
        beyond_s=beyond_s,
        lost=lost,
    )


def _absurd(health: LoopHealth, levels: NDArray[np.float64]) -> bool:
    """Return whether the frames are in another unit: one that runs away passes what is possible."""
    beyond = levels > ABSURD_RATIO
    if health.absurd or not beyond.any():
        return health.absurd and bool(beyond[-1])
    # argmax of booleans is the first frame beyond. A loop that runs away grows frame by frame and
    # passes DIVERGING_RATIO first; another unit appears from one frame to the next.
    before = levels[: int(np.argmax(beyond))]
    return not health.diverging and not bool((before > DIVERGING_RATIO).any())


SLIPPED_RATIO = 4.5
"""Averaged position of an outer actuator, in σ of turbulence, that no healthy loop shows."""

SUSPECT_RATIO = 2.5
"""Averaged position of an outer actuator, in σ of turbulence, that no healthy loop exceeds for
longer than ``SUSPECT_DURATION_MEMORIES``; below it, a slip is over."""

SUSPECT_DURATION_MEMORIES = 2.0
"""Times the memory of positions."""

EDGE_STRIDE_FRAMES = 50
"""One of so many frames is looked at, however long a block is."""

SLOW_TURBULENCE_RATIO = 2.0
"""Factor on the RMS of the inner actuators' averaged positions in the comparison with the outer
ones. Turbulence carried by a slow wind keeps both parts of the mirror in place for longer than the
memory; the largest of a ring of healthy actuators is then at 1.2 to 1.8."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeHealth(Streaming):
    """Forgetting means of what the two parts of the mirror do."""

    resets = Change.LOOP
    unless = Mark.STANDS | Mark.ABSURD
    only_closed = True

    command: NDArray[np.float32] | None = None
    """``(n_watched,)`` averaged command of the modes that are watched, metres."""

    turbulence: float = 1.0
    """RMS of the inner actuators, in σ of the turbulence the basis was made for."""

    ratio: float = 0.0
    """Largest averaged position of an outer actuator over what the inner ones show: their RMS, or
    ``SLOW_TURBULENCE_RATIO`` times that of their averaged positions, whichever is larger."""

    suspect_s: float = 0.0
    """Duration for which the ratio has been above ``SUSPECT_RATIO``, seconds."""

    slipped: bool = False

    @override
    def restart(self, loop: LoopContext, why: Change) -> EdgeHealth:
        """Return the health, without history if the loop is open."""
        return EdgeHealth() if loop.edge is None else self

    @override
    def update(self, frames: FrameContext) -> EdgeHealth:
        """Return it after one more block."""
        watch = frames.loop.edge
        return self if watch is None else observe_edge(self, frames.block, watch)

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Text of the alarm for a slipped edge."""
        slipped = (
            f"an outer actuator is {self.ratio:.0f} sigma from its expected position: "
            "the edge has slipped by wavelengths, which the slopes do not show; open the loop and "
            "close it again with fewer modes or a leak of 0.99"
        )
        return (slipped if self.slipped else None,)


def observe_edge(health: EdgeHealth, block: FrameBlock, watch: EdgeWatch) -> EdgeHealth:
    """Return the health after one more block, of which some frames are used."""
    n_frames = np.diff([*range(0, block.n_frames, EDGE_STRIDE_FRAMES), block.n_frames])
    moved = block.commands_m[np.cumsum(n_frames) - 1][:, watch.modes]
    inner = np.einsum("km,km->k", moved @ watch.inner, moved)
    each = zip(moved, inner, n_frames * (block.dt_ns * 1e-9), strict=True)
    for command, mean_square, lasted_s in each:
        health = _after_command(health, watch, command, float(mean_square), float(lasted_s))
    return health


def _after_command(
    health: EdgeHealth, watch: EdgeWatch, command: Array, inner: float, lasted_s: float
) -> EdgeHealth:
    """Return the health after a command that lasted for ``lasted_s``.

    ``inner`` is the mean square of the inner actuators at that command.
    """
    fade = np.float32(np.exp(-lasted_s / watch.memory_s))
    average = (1 - fade) * command
    if health.command is not None and len(health.command) == len(command):
        average += fade * health.command
    power = float(fade) * health.turbulence**2 + float(1 - fade) * max(inner, 0.0)
    turbulence = float(np.sqrt(power))
    # Rounding may make a small quadratic form negative.
    steady = max(float(average @ watch.inner @ average), 0.0) ** 0.5
    # The last value avoids a division by zero while the mirror rests.
    scale = max(turbulence, SLOW_TURBULENCE_RATIO * steady, 1e-3)
    ratio = float(np.abs(watch.outer @ average).max()) / scale
    suspect_s = health.suspect_s + lasted_s if ratio > SUSPECT_RATIO else 0.0
    slipped = ratio > SLIPPED_RATIO or suspect_s > SUSPECT_DURATION_MEMORIES * watch.memory_s
    return EdgeHealth(
        command=average,
        turbulence=turbulence,
        ratio=ratio,
        suspect_s=suspect_s,
        slipped=slipped or (health.slipped and suspect_s > 0.0),
    )


UNPLAYED_RATIO = 6.0
"""Limit of the implied turbulence at an actuator, averaged over a part, relative to the usual."""

STEADY_SHARE = 0.8
"""Smallest ratio of mean to RMS of an actuator's command in a part. In a diverging loop commands
oscillate, and their mean is small."""

N_UNPLAYED_PARTS = 2
"""Number of parts in the last ``UNPLAYED_MEMORY_S`` with an actuator beyond the limit."""

UNPLAYED_MEMORY_S = 5.0

_USUAL_S = 10.0
"""Duration of the telemetry from which the usual turbulence is measured."""

_PLAYED_STRIDE_FRAMES = 4
"""Stride of the frames that are averaged."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlayedCommands(Streaming):
    """Turbulence at every actuator, as commands and slopes imply it."""

    resets = Change.GONE | Change.SESSION | Change.LOOP | Change.OPEN
    unless = Mark.STANDS | Mark.ABSURD
    only_closed = True

    cm_id: str | None = None
    """Matrix of the part under way."""

    slopes: Array | None = None
    """``(n_slopes,)`` sum over the sampled frames of that part; None: it has none."""

    commands_m: tuple[Array, ...] = ()
    """``(n, n_watched)`` each: the commands of these frames."""

    n_frames: int = 0
    """All frames of that part."""

    turbulence: Array | None = None
    """``(n_parts, n_actuators)`` in σ of the expected turbulence, oldest first, bounded."""

    beyond: tuple[tuple[float, frozenset[int]], ...] = ()
    """Largest ratio, and the actuators beyond the limit, of each of the last parts."""

    unplayed: bool = False

    @override
    def update(self, frames: FrameContext) -> PlayedCommands:
        """Return it after one more block."""
        watch, terms = frames.loop.actuators, frames.terms
        if watch is None or terms is None:
            return self
        if watch.modes[-1] >= len(terms.reconstructor):
            return self  # a swap to fewer modes that the status has yet to report
        return observe_played(self, frames.block, watch, terms.reconstructor)

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Text of the alarm for commands that the slopes do not answer."""
        if not self.unplayed:
            return (None,)
        ratio, _ = max(self.beyond, key=lambda part: part[0])
        actuators = np.array(sorted(set().union(*(part[1] for part in self.beyond))))
        return (
            f"commands and slopes part: {len(actuators)} actuators ({list_ranges(actuators, 4)}) "
            f"are commanded up to {ratio:.0f} times what turbulence needs, and the slopes do not "
            "show it. The mirror clips commands that the telemetry reports as asked, or the sensor "
            "saturates: report the commands that the mirror plays, offload, lower the gain or "
            "control fewer modes",
        )


def observe_played(
    state: PlayedCommands,
    block: FrameBlock,
    watch: ActuatorWatch,
    reconstructor: NDArray[np.float32],
) -> PlayedCommands:
    """Return the state after one more block of a loop closed by ``(n_modes, n_slopes)``."""
    if block.cm_id != state.cm_id:
        state = replace(state, cm_id=block.cm_id, slopes=None, commands_m=(), n_frames=0)
    dt_s = block.dt_ns * 1e-9
    n_part = count_part_frames(dt_s)
    for part, n_frames in cut_parts(block.n_frames, state.n_frames, n_part):
        rows = slice(part.start, part.stop, _PLAYED_STRIDE_FRAMES)
        total = block.slopes[rows].sum(axis=0)
        state = replace(
            state,
            slopes=total if state.slopes is None else state.slopes + total,
            commands_m=(*state.commands_m, block.commands_m[rows, watch.modes]),
            n_frames=n_frames,
        )
        if n_frames >= n_part:
            state = _close_played(state, watch, reconstructor, n_part * dt_s)
    return state


def _close_played(
    state: PlayedCommands, watch: ActuatorWatch, reconstructor: NDArray[np.float32], part_s: float
) -> PlayedCommands:
    """Return the state after a complete part."""
    commands = np.concatenate(state.commands_m)
    mean = commands.mean(axis=0)
    slopes = np.asarray(state.slopes) / np.float32(len(commands))
    residual = (reconstructor @ slopes)[watch.modes]
    implied = watch.shapes @ (residual - mean)
    known = implied[None] if state.turbulence is None else np.vstack([state.turbulence, implied])
    known = known[-max(round(_USUAL_S / part_s), 1) :]
    state = replace(state, turbulence=known, slopes=None, commands_m=(), n_frames=0)
    if len(known) * part_s < MIN_HISTORY_S:
        return state
    # a gust moves all actuators of a part, a clipped command moves few of them far
    usual = max(_sigma(known), _sigma(implied))
    ratio = np.abs(implied) / max(usual, 1e-12)
    far = np.flatnonzero(ratio > UNPLAYED_RATIO)
    moved = watch.shapes[far] @ commands.T
    steady = np.abs(moved.mean(axis=1)) > STEADY_SHARE * np.sqrt(np.mean(moved**2, axis=1))
    far = far[steady]
    part = (float(ratio[far].max()) if len(far) else 0.0, frozenset(far.tolist()))
    beyond = (*state.beyond, part)[-max(round(UNPLAYED_MEMORY_S / part_s), 1) :]
    n_beyond = sum(bool(actuators) for _, actuators in beyond)
    # Hysteresis: the alarm lasts until no part of the last seconds is beyond.
    unplayed = n_beyond >= (1 if state.unplayed else N_UNPLAYED_PARTS)
    return replace(state, beyond=beyond, unplayed=unplayed)


def _sigma(values: Array) -> float:
    """Return 1 σ of values around zero by their median, which a few far ones do not change."""
    # Half of a normal distribution is within 0.6745 σ.
    return float(np.median(np.abs(values))) / 0.6745


SEGMENT_FRAMES = 1024
"""Length of a spectrum: 1 Hz per bin at 1 kHz."""

MIN_SEGMENTS = 8
"""Smallest number of averaged spectra; with fewer, noise resembles a line."""

LINE_RATIO = 8.0
"""Power of a line over its neighbourhood's median: a mean of eight spectra of noise never reaches
it, so that a peak which does justifies moving a dither."""

LINE_SEARCH_SEGMENTS = 4
"""Spectra between two searches for lines: a search costs as much as hundreds of frames."""

_NEIGHBOURHOOD_BINS = 20
_MEMORY_SEGMENTS = 32.0
_N_PATTERNS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlopeSpectra:
    """Mean spectra of a few combinations of slopes."""

    views: NDArray[np.float32]
    """``(n_views, n_slopes)``: tip, tilt, and patterns that every other mode is seen by."""

    power: NDArray[np.float64] | None = None
    """``(n_views, n_bins)`` forgetting mean."""

    n_segments: int = 0
    frame_rate_hz: float = 0.0
    next_seq: int = -1
    session: str = ""
    collected: NDArray[np.float32] | None = None
    """``(n, n_views)`` of the segment under way."""

    def with_frames(self, block: FrameBlock) -> SlopeSpectra:
        """Return the spectra after a block; a gap or a new session restarts the segment."""
        rows = (block.slopes @ self.views.T).astype(np.float32)
        unbroken = (block.session, block.first_seq) == (self.session, self.next_seq)
        if unbroken and self.collected is not None:
            rows = np.vstack([self.collected, rows])
        spectra = self
        while len(rows) >= SEGMENT_FRAMES:
            spectra = spectra._with_segment(rows[:SEGMENT_FRAMES])
            rows = rows[SEGMENT_FRAMES:]
        return replace(
            spectra,
            frame_rate_hz=1e9 / block.dt_ns,
            session=block.session,
            next_seq=block.next_seq,
            collected=rows,
        )

    def lines_hz(self, known_hz: tuple[float, ...] = ()) -> tuple[float, ...]:
        """Return the vibration lines, lowest first, without the known ones: the dither's own.

        A bin is a line if in any view it exceeds the median of its neighbourhood by ``LINE_RATIO``
        and is the highest within two bins. Below 2 % of the frame rate turbulence falls too steeply
        for a comparison with the neighbourhood, and no dither goes there.
        """
        if self.power is None or self.n_segments < MIN_SEGMENTS:
            return ()
        typical = np.median(_around(self.power, _NEIGHBOURHOOD_BINS), axis=-1)
        highest = _around(self.power, 2).max(axis=-1)
        peaks = (self.power > LINE_RATIO * typical) & (self.power == highest)
        step = self.frame_rate_hz / SEGMENT_FRAMES
        found = [step * k for k in np.flatnonzero(peaks.any(axis=0)) if k > _NEIGHBOURHOOD_BINS]
        return tuple(
            float(f) for f in found if all(abs(f - known) > 3.0 * step for known in known_hz)
        )

    def _with_segment(self, rows: Array) -> SlopeSpectra:
        window = np.hanning(SEGMENT_FRAMES)[:, None]
        # Without its mean: the window would spread a static slope over the lowest bins.
        power = np.abs(np.fft.rfft((rows - rows.mean(axis=0)) * window, axis=0)).T ** 2
        # A plain mean at first, then a forgetting one.
        share = max(1.0 / (self.n_segments + 1), 1.0 / _MEMORY_SEGMENTS)
        if self.power is not None:
            power = (1.0 - share) * self.power + share * power
        return replace(self, power=power, n_segments=self.n_segments + 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VibrationMonitor(Streaming):
    """Detector of vibrations with and without a dither; ``update`` takes the blocks.

    The spectra with and without a dither are kept apart, because only a pause distinguishes a
    vibration from a dither line at the same frequency.
    """

    resets = Change.GONE | Change.RATE
    unless = Mark.STANDS
    only_closed = True

    quiet: SlopeSpectra
    dithered: SlopeSpectra
    dither_hz: tuple[float, ...] = ()
    """Lines of the dither that ``dithered`` was seen under."""

    lines_hz: tuple[float, ...] = ()
    """Vibration lines as of the last look, lowest first."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> VibrationMonitor:
        """Return one that has seen nothing of this RTC."""
        known = loop.description
        return cls.of(known.n_slopes if loop.rtc is None else loop.rtc.n_slopes, known.kind)

    @override
    def update(self, frames: FrameContext) -> VibrationMonitor:
        """Return it after one more block."""
        return self.follow(frames.block, frames.lines_hz)

    @classmethod
    def of(cls, n_slopes: int, kind: SignalKind = SignalKind.XY) -> VibrationMonitor:
        """Return the monitor of signals of which nothing has been measured yet.

        It uses the mean x and y slopes, and fixed patterns of random signs.
        """
        views = np.zeros((2 + _N_PATTERNS, n_slopes), np.float32)
        tilts = np.repeat(TO_SLOPES[kind], n_slopes // kind.n_planes, axis=1)
        views[:2, : tilts.shape[1]] = tilts / np.sqrt((tilts[0] != 0.0).sum())
        signs = np.random.default_rng(1).choice([-1.0, 1.0], size=(_N_PATTERNS, n_slopes))
        views[2:] = signs / np.sqrt(n_slopes)
        return cls(quiet=SlopeSpectra(views=views), dithered=SlopeSpectra(views=views))

    def follow(self, block: FrameBlock, dither_hz: tuple[float, ...]) -> VibrationMonitor:
        """Return the monitor after a block with these dither lines.

        Vibrations are searched at intervals. The spectra restart with another dither.
        """
        quiet, dithered = self.quiet, self.dithered
        if block.dither_m is None:
            # The last lines are kept over a pause, so that the spectra under the same dither go on.
            quiet, dither_hz = quiet.with_frames(block), self.dither_hz
        else:
            # The lines of another dither would remain in the mean as vibrations.
            if dither_hz != self.dither_hz:
                dithered = SlopeSpectra(views=dithered.views)
            dithered = dithered.with_frames(block)
        before = self.quiet.n_segments + self.dithered.n_segments
        n_segments = quiet.n_segments + dithered.n_segments
        state = replace(self, quiet=quiet, dithered=dithered, dither_hz=dither_hz)
        if n_segments == before or n_segments % LINE_SEARCH_SEGMENTS:
            return state
        lines = quiet.lines_hz()
        under = dithered.lines_hz((*dither_hz, *lines))
        return replace(state, lines_hz=tuple(sorted((*lines, *under))))


STANDSTILL_STRIDE_FRAMES = 8
"""One of so many frames is compared with the last one compared."""

MIN_STANDSTILL_S = 0.05
"""Telemetry that has not changed for so long is no measurement: photons and electrons always move
the last digits of hundreds of slopes."""

STANDSTILL_ALARM_S = 0.5
"""Shortest standstill that raises an alarm: within less a camera may only have skipped some frames.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Standstill(Streaming):
    """The last slopes, and for how long they have been the same."""

    resets = Change.OPEN
    only_closed = True

    session: str = ""
    slopes: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """``(n_slopes,)`` of the last frame looked at."""

    first_seq: int = 0
    """First frame looked at that has these."""

    since_ns_utc: int = 0
    """End of its exposure, the RTC's clock."""

    lasts_s: float = 0.0
    """Until the last frame looked at."""

    @override
    def update(self, frames: FrameContext) -> Standstill:
        """Return it after one more block."""
        block, state = frames.block, self
        # By frame number: which frames are compared does not depend on how they are cut into
        # blocks.
        for row in range(
            -block.first_seq % STANDSTILL_STRIDE_FRAMES, block.n_frames, STANDSTILL_STRIDE_FRAMES
        ):
            slopes, t_ns = block.slopes[row], block.t0_ns_utc + row * block.dt_ns
            if state.session == block.session and np.array_equal(slopes, state.slopes):
                state = replace(state, lasts_s=(t_ns - state.since_ns_utc) * 1e-9)
                continue
            state = Standstill(
                session=block.session,
                # Copied: a view would keep the whole block in memory.
                slopes=slopes.copy(),
                first_seq=block.first_seq + row,
                since_ns_utc=t_ns,
            )
        return state

    @property
    @override
    def marks(self) -> Mark:
        """Mark of slopes that are not a measurement."""
        return Mark.STANDS if self.lasts_s >= MIN_STANDSTILL_S else UNMARKED

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Text of the alarm: what is frozen, since when, and the remedy; None if slopes change."""
        if self.lasts_s < STANDSTILL_ALARM_S:
            return (None,)
        what = "are the same in every frame" if self.slopes.any() else "are all zero"
        since = datetime.fromtimestamp(self.since_ns_utc * 1e-9, UTC)
        text = (
            f"the slopes {what} since frame {self.first_seq}, {since:%H:%M:%S} UTC: the camera "
            "has stopped, or its images do not reach the RTC, so the mirror is driven by no "
            "measurement; open the loop, then check the camera and its link"
        )
        return (text,)


def _around(power: Array, n: int) -> Array:
    """Return every value with its ``n`` neighbours on either side, ``(..., n_bins, 2 n + 1)``."""
    mirrored = np.pad(power, ((0, 0), (n, n)), mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(mirrored, 2 * n + 1, axis=-1)
