"""The streaming estimators, fed with every block of telemetry as it comes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation import loopcheck, looplaw, passive, probation
from service.estimation.frames import FrameBlock
from service.estimation.health import (
    EdgeHealth,
    EdgeWatch,
    LoopHealth,
    VibrationMonitor,
    edge_watch,
    observe,
    observe_edge,
)
from service.estimation.lockin import LockIn, Spectra
from service.estimation.loopcheck import ENOUGH_SAMPLES, SAMPLES_PER_S, LoopCheck, Obedience
from service.estimation.looplaw import LoopLaw
from service.estimation.passive import Passive
from service.estimation.played import Finding, Meter, asked_anew, measured
from service.estimation.probation import Comparison
from service.estimation.random_dither import Correlated, RandomDither
from service.estimation.rejection import Rejection
from service.estimation.standstill import Standstill
from service.estimation.windows import ClosedLoop, Telemetry, WindowRefused
from service.runtime.worker import Description
from service.tracking.dither_request import SETTLING_S, Dither, asked_of, lock_in_plan, random_plan
from service.tracking.loop import (
    closed_loop,
    last_seq,
    same_but_for_modes,
    same_loop,
    same_rate,
)
from service.wire import DitherKind, Status

PASSIVE_MEMORY_S = 10.0

WINDOW_SAMPLES = 5
"""Frames of a window that must have been looked at before it can be said to be off the loop."""

VERDICTS = 2
"""On the loop's law that must agree that something is otherwise than told."""

AT_EASE_S = 1.3
"""A loop that was just found to do as it is told to is not asked again before."""

MATRICES_KEPT = 2
"""The reconstructor in use, and the one before: frames of it may still come."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Streams:
    """The state of every streaming estimator; ``fed`` makes the next one."""

    description: Description
    """What telemetry must look like."""

    rtc: Status | None = None
    """The loop the frames come from."""

    heard_ns_utc: int = 0
    """End of the last frame that came, the RTC's clock; 0: none has."""

    loop: Status | None = None
    """As it was when the open window, or the sums of ordinary telemetry, began."""

    in_loop: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """Modes it moves by itself; empty: it is open."""

    still: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """Controlled modes that have no gain."""

    cutter: LockIn | RandomDither | None = None
    """Windows of the dither; None while there is none, or none that can be read."""

    dither: Dither | None = None
    """The one whose windows are under way, or cannot be."""

    meter: Meter | None = None
    """Of how strong that is on the mirror; None as above."""

    played: Finding | None = None
    """What the last second of frames held of it; None: too few have come."""

    dither_seen_seq: int = 0
    """Up to here the frames held it, or it need not have been there."""

    dither_silent_s: float = 0.0
    """For how long the last frames should have held it and did not."""

    vibrations: VibrationMonitor | None = None
    """None: no RTC is there."""

    passive: Passive | None = None
    health: LoopHealth = field(default_factory=LoopHealth)
    edge_watch: EdgeWatch | None = None
    """How the outer ring is watched; None: too few modes are controlled."""

    edge: EdgeHealth = field(default_factory=EdgeHealth)
    matrices: tuple[tuple[str, NDArray[np.float32]], ...] = ()
    """Reconstructors by id, oldest first, bounded."""

    check: LoopCheck = field(default_factory=LoopCheck)
    obeyed_seq: int = 0
    """Up to here the commands were found to obey the loop."""

    off: Obedience | None = None
    """How the commands fail to obey the loop; None: they obey, or nobody knows."""

    law: LoopLaw = field(default_factory=LoopLaw)
    unlawful: tuple[str, ...] = ()
    """What the last verdicts on the loop's law found to be otherwise than told, without a break."""

    standstill: Standstill = field(default_factory=Standstill)
    rejection: Rejection = field(default_factory=Rejection)
    comparison: Comparison = field(default_factory=Comparison)
    """Of telemetry with the matrix in use and with the one before."""

    compared: Status | None = None
    """The loop that both must be of, but for how many modes are controlled."""


Window = Spectra | Correlated | WindowRefused


def with_rtc(streams: Streams, rtc: Status | None) -> Streams:
    """Follow the RTC: another loop makes the open window and the passive sums void."""
    before = streams.rtc
    streams = replace(streams, rtc=rtc)
    if rtc is None:
        return replace(
            streams,
            loop=None,
            vibrations=None,
            passive=None,
            cutter=None,
            dither=None,
            check=LoopCheck(),
            off=None,
            law=LoopLaw(),
            unlawful=(),
            edge_watch=None,
            comparison=Comparison(),
            compared=None,
        )
    streams = _comparable(streams, rtc)
    if before is not None and before.session != rtc.session:
        streams = replace(streams, health=LoopHealth())
    streams = _lawful(streams, before, rtc)
    if streams.loop is not None and before is not None and same_loop(streams.loop, rtc):
        return streams if before.seq == rtc.seq else _confirmed(streams, rtc)
    streams = replace(streams, loop=rtc)
    in_loop = np.array(rtc.in_loop, dtype=np.intp)
    # an RTC of another instrument may have more
    known = in_loop[in_loop < streams.description.n_modes]
    still = np.setdiff1d(np.arange(rtc.n_controlled), known)
    streams = replace(streams, in_loop=known, still=still)
    if streams.dither is not None and streams.meter is not None:
        asked = asked_of(streams.dither, rtc, streams.description.products)
        streams = replace(streams, meter=asked_anew(streams.meter, asked))
    streams = _watching_the_edge(streams, rtc)
    # frames that are on their way may have been made by the loop as it was
    streams = replace(streams, check=LoopCheck(from_seq=last_seq(rtc) + 1), off=None, obeyed_seq=0)
    memory = _no_sums(rtc, streams.heard_ns_utc)
    if before is None or not same_rate(before.frame_rate_hz, rtc.frame_rate_hz):
        streams = replace(streams, cutter=None, dither=None)
        monitor = VibrationMonitor.begin(rtc.n_slopes, streams.description.kind)
        return replace(streams, vibrations=monitor, passive=memory)
    return _cut(replace(streams, passive=memory), rtc)


def _comparable(streams: Streams, rtc: Status) -> Streams:
    """Compare only what one loop does, under two matrices; gains may follow the seeing."""
    before = streams.compared
    if before is None or not same_but_for_modes(before, rtc):
        begun = probation.begun_anew(streams.comparison, "the loop was changed after the swap")
        return replace(streams, comparison=begun, compared=rtc)
    return streams if streams.comparison.before is not None else replace(streams, compared=rtc)


def _watching_the_edge(streams: Streams, rtc: Status) -> Streams:
    """Watch the ring that this loop drives; what is closed, or watched, anew has a clean slate."""
    known = streams.description
    if not rtc.in_loop or known.actuators is None:
        return replace(streams, edge_watch=None, edge=EdgeHealth())
    watch = edge_watch(known.actuators, known.mode_variance_m2, streams.in_loop)
    # a ring nobody can watch any more has not slipped for ever
    edge = EdgeHealth() if watch is None else streams.edge
    return replace(streams, edge_watch=watch, edge=edge)


def _cut(streams: Streams, rtc: Status) -> Streams:
    """Give up the open window; the next begins when the changed loop has settled.

    Counted from the status' own frame, not from when it was read, so that a recorded night is cut
    at the same frames again.
    """
    settled_seq = last_seq(rtc) + round(SETTLING_S * rtc.frame_rate_hz)
    if streams.cutter is None:
        return streams
    return replace(streams, cutter=streams.cutter.begun_anew(settled_seq))


def with_matrix(streams: Streams, cm_id: str, matrix: NDArray[np.float32]) -> Streams:
    """Know the numbers of one more reconstructor."""
    others = tuple(known for known in streams.matrices if known[0] != cm_id)
    return replace(streams, matrices=(*others, (cm_id, matrix))[-MATRICES_KEPT:])


def _terms(streams: Streams, cm_id: str | None) -> ClosedLoop | None:
    """Return the loop that a reconstructor closes; None: it is open, not known, or another's."""
    rtc = streams.rtc
    matrix = next((matrix for known, matrix in streams.matrices if known == cm_id), None)
    if rtc is None or rtc.loop == "open" or cm_id is None or matrix is None:
        return None
    if matrix.shape[1] != rtc.n_slopes or len(matrix) > rtc.n_modes:
        return None
    return closed_loop(rtc, cm_id, matrix)


def _lawful(streams: Streams, before: Status | None, rtc: Status) -> Streams:
    """Judge the loop's law by the frames up to a status, or begin anew with another loop.

    Gains may follow the seeing meanwhile.
    """
    if before is None or not same_loop(before, rtc):
        return replace(streams, law=LoopLaw(from_seq=last_seq(rtc) + 1), unlawful=())
    terms = _terms(streams, rtc.cm_id)
    if terms is None or streams.law.cm_id != rtc.cm_id:
        return streams
    law, found = looplaw.judged(streams.law, terms, last_seq(rtc))
    if found is None:
        return replace(streams, law=law)
    if found.wrong:
        unlawful = (*streams.unlawful, found.wrong)[-VERDICTS:]
        return replace(streams, law=law, unlawful=unlawful)
    law = replace(law, judged_seq=law.judged_seq + round(AT_EASE_S * rtc.frame_rate_hz))
    return replace(streams, law=law, unlawful=())


def _confirmed(streams: Streams, rtc: Status) -> Streams:
    """Judge the frames up to a status that shows the same loop as the one before."""
    seq = last_seq(rtc)
    if streams.off is None and seq < streams.obeyed_seq + AT_EASE_S * rtc.frame_rate_hz:
        return streams
    span, terms = loopcheck.last_samples(streams.check, seq), _terms(streams, rtc.cm_id)
    if span is None or terms is None:
        return streams
    check, found = loopcheck.obedience(streams.check, terms, *span)
    if found is None or found.holds:
        return replace(streams, check=check, off=None, obeyed_seq=seq)
    return replace(streams, check=check, off=found)


def with_dither(streams: Streams, dither: Dither | None, window_s: float) -> Streams:
    """Follow the dither: a new one that has begun starts a new series of windows.

    Raises
    ------
    ModelError
        If its lines, or its modes, cannot be told apart in a window of ``window_s``.
    """
    rtc = streams.rtc
    if dither is None or dither.start_seq is None or rtc is None:
        return replace(
            streams, cutter=None, dither=None, dither_silent_s=0.0, meter=None, played=None
        )
    dither = replace(dither, asked_ns_utc=0)
    if dither == streams.dither:
        return streams
    # a status may announce a dither that began long ago
    seen_seq = max(dither.start_seq or 0, last_seq(rtc))
    cutter: LockIn | RandomDither
    if dither.request.kind is DitherKind.BINARY:
        cutter = RandomDither(plan=random_plan(dither, rtc, window_s))
    else:
        cutter = LockIn(plan=lock_in_plan(dither, rtc, window_s))
    return replace(
        streams,
        cutter=cutter,
        dither=dither,
        meter=Meter(asked=asked_of(dither, rtc, streams.description.products)),
        played=None,
        dither_seen_seq=seen_seq,
        dither_silent_s=0.0,
    )


def fed(streams: Streams, block: FrameBlock) -> tuple[Streams, list[Window]]:
    """Return the state after one more block, and the windows that ended in it."""
    rtc = streams.rtc
    if rtc is None or block.session != rtc.session or not _fits(rtc, block):
        return streams, []
    standstill = streams.standstill.follow(block) if len(streams.in_loop) else Standstill()
    streams = replace(streams, standstill=standstill)
    if standstill.stands:
        return _standing(streams, rtc, block), []
    return _measured(streams, rtc, block)


def _measured(streams: Streams, rtc: Status, block: FrameBlock) -> tuple[Streams, list[Window]]:
    """Return the same of slopes that are a measurement."""
    terms, check, law = _terms(streams, block.cm_id), streams.check, streams.law
    if terms is not None:
        check, law = loopcheck.observe(check, block, terms), looplaw.follow(law, block, terms)
    vibrations, sums = streams.vibrations, streams.passive
    lines = () if streams.dither is None else streams.dither.frequency_hz
    if vibrations is not None and sums is not None and len(streams.in_loop):
        vibrations = vibrations.update(block, lines)
        sums = passive.accumulate(sums, _moving(streams, block))
    streams = replace(
        streams,
        heard_ns_utc=block.next_t_ns - block.dt_ns,
        check=check,
        law=law,
        vibrations=vibrations,
        passive=sums,
    )
    streams = _holding(streams, block, terms, lines)
    streams, ended = _dithered(_listening(streams, rtc, block), rtc, block)
    if ended:
        streams = replace(streams, loop=rtc)  # the next one begins with the gains of now
    return _obeying(streams, ended)


def _holding(
    streams: Streams, block: FrameBlock, terms: ClosedLoop | None, lines: tuple[float, ...]
) -> Streams:
    """Return streams that know whether the loop holds, and as well as with the matrix before."""
    health, edge = streams.health, streams.edge
    if block.cm_id != streams.comparison.cm_id:
        # what another matrix has made of the loop says nothing of this one
        health = replace(health, ratio=0.0)
    health = observe(health, block, streams.description.mode_variance_m2, streams.in_loop)
    if streams.edge_watch is not None and not health.absurd:
        edge = observe_edge(edge, block, streams.edge_watch)
    comparison = streams.comparison
    if len(streams.in_loop) and not health.absurd:
        matrix = None if terms is None else terms.reconstructor
        comparison = probation.observe(
            comparison, block, streams.in_loop, lines, streams.edge_watch, matrix
        )
    rejection = Rejection()
    if streams.rtc is not None and len(streams.in_loop):
        gains = np.array(streams.rtc.gains)[streams.in_loop]
        rejection = streams.rejection.follow(block, streams.in_loop, gains, streams.rtc.leak)
    return replace(streams, health=health, edge=edge, comparison=comparison, rejection=rejection)


def _standing(streams: Streams, rtc: Status, block: FrameBlock) -> Streams:
    """Return streams that measure nothing on slopes that stand, nor on what came just before."""
    streams = replace(streams, heard_ns_utc=block.next_t_ns - block.dt_ns)
    streams = _listening(streams, rtc, block)
    settled_seq = block.next_seq + round(SETTLING_S * rtc.frame_rate_hz)
    cutter = None if streams.cutter is None else streams.cutter.begun_anew(settled_seq)
    return replace(
        streams,
        cutter=cutter,
        played=None,
        check=LoopCheck(from_seq=settled_seq),
        off=None,
        law=LoopLaw(from_seq=settled_seq),
        unlawful=(),
        passive=_no_sums(rtc, streams.heard_ns_utc, settled_seq),
    )


def _no_sums(rtc: Status, since_ns_utc: int, from_seq: int = 0) -> Passive:
    """Return sums of ordinary telemetry that have begun with nothing."""
    return Passive(
        n_modes=rtc.n_controlled,
        memory_frames=PASSIVE_MEMORY_S * rtc.frame_rate_hz,
        delay_frames=rtc.delay_frames,
        since_ns_utc=since_ns_utc,
        from_seq=from_seq,
    )


def _moving(streams: Streams, block: FrameBlock) -> FrameBlock:
    """Return a block without what stands in controlled modes that have no gain.

    An integrator without leak keeps it for ever; a mode that never moves tells nothing.
    """
    still = streams.still
    if not len(still):
        return block
    commands = block.commands_m.copy()
    commands[:, still] = 0.0 if block.dither_m is None else block.dither_m[:, still]
    return replace(block, commands_m=commands)


def _dithered(streams: Streams, rtc: Status, block: FrameBlock) -> tuple[Streams, Sequence[Window]]:
    """Feed the estimator that reads the dither which runs."""
    if streams.cutter is None:
        return streams, ()
    cutter, ended = streams.cutter.accumulate(block)
    over = _beyond_the_dither(streams, rtc, cutter)
    return replace(streams, cutter=None if over else cutter), ended


def _beyond_the_dither(streams: Streams, rtc: Status, reading: LockIn | RandomDither) -> bool:
    """Return whether the end of the dither would cut the window that has begun."""
    dither, window = streams.dither, reading.window
    if dither is None or window is None:
        return False
    stop_seq = (dither.start_seq or 0) + round(dither.request.duration_s * rtc.frame_rate_hz)
    return window.first_seq + reading.plan.n_frames > stop_seq


def _listening(streams: Streams, rtc: Status, block: FrameBlock) -> Streams:
    """Note whether a block holds the dither that should be there."""
    dither, next_seq = streams.dither, block.next_seq
    if streams.meter is not None:
        meter, found = measured(streams.meter, block)
        streams = replace(streams, meter=meter, played=found or streams.played)
    if block.is_dithered:
        return replace(streams, dither_seen_seq=next_seq, dither_silent_s=0.0)
    if dither is None:
        return streams
    stop_seq = (dither.start_seq or 0) + round(dither.request.duration_s * rtc.frame_rate_hz)
    silent = max(min(next_seq, stop_seq) - streams.dither_seen_seq, 0)
    return replace(streams, dither_silent_s=silent / rtc.frame_rate_hz)


def _obeying(streams: Streams, ended: Sequence[Window]) -> tuple[Streams, list[Window]]:
    """Return windows, or why the commands of one are not what the loop makes of its slopes."""
    told: list[Window] = []
    for window in ended:
        if isinstance(window, WindowRefused):
            told.append(window)
            continue
        streams, found = _obedience(streams, window)
        if found is None or found.holds:
            told.append(window)
        else:
            told.append(WindowRefused(reason=found.text, t_ns_utc=window.t_end_ns_utc))
    return streams, told


def _obedience(streams: Streams, window: Telemetry) -> tuple[Streams, Obedience | None]:
    """Return how commands obeyed the loop in a window; None: nobody knows."""
    terms = _terms(streams, window.cm_id)
    if terms is None:
        return streams, None
    last_seq = window.first_seq + window.plan.n_frames - 1
    check, found = loopcheck.obedience(
        streams.check, terms, window.first_seq, last_seq, WINDOW_SAMPLES
    )
    streams = replace(streams, check=check)
    lasts_s = window.plan.n_frames / terms.frame_rate_hz
    if found is not None and found.holds and lasts_s >= ENOUGH_SAMPLES / SAMPLES_PER_S:
        # what a long window shows need not be asked again
        streams = replace(streams, obeyed_seq=max(last_seq, streams.obeyed_seq))
    return streams, found


def _fits(rtc: Status, block: FrameBlock) -> bool:
    """Return whether a block has as many slopes and modes as the RTC's status says."""
    return (block.slopes.shape[1], block.commands_m.shape[1]) == (rtc.n_slopes, rtc.n_modes)
