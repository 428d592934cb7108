"""The streaming estimators, fed with every block of telemetry as it comes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation import control_law, loopcheck, passive, probation
from service.estimation.control_law import ControlLawCheck
from service.estimation.description import Description, EdgeWatch, edge_watch
from service.estimation.dither_monitor import (
    DitherMeasurement,
    DitherMonitor,
    measure_block,
    with_expected,
)
from service.estimation.frames import FrameBlock
from service.estimation.health import (
    EdgeHealth,
    LoopHealth,
    VibrationMonitor,
    observe,
    observe_edge,
)
from service.estimation.lockin import LockIn, Spectra
from service.estimation.loop import closed_loop, last_seq, same_but_for_modes, same_loop, same_rate
from service.estimation.loopcheck import ENOUGH_SAMPLES, SAMPLES_PER_S, CommandResidual, LoopCheck
from service.estimation.passive import Passive
from service.estimation.probation import Comparison
from service.estimation.random_dither import Correlated, RandomDither
from service.estimation.rejection import Rejection
from service.estimation.standstill import Standstill
from service.estimation.windows import ClosedLoop, Telemetry, WindowRefused
from service.tracking.dither_request import (
    SETTLING_S,
    Dither,
    expected_dither,
    lock_in_plan,
    random_plan,
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
class EstimatorBank:
    """The state of every streaming estimator; ``fed`` makes the next one."""

    description: Description
    """What telemetry must look like."""

    rtc: Status | None = None
    """The loop the frames come from."""

    received_ns_utc: int = 0
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

    dither_monitor: DitherMonitor | None = None
    """Of how strong that is on the mirror; None as above."""

    dither_measurement: DitherMeasurement | None = None
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
    checked_seq: int = 0
    """Up to here the commands were found to obey the loop."""

    command_residual: CommandResidual | None = None
    """How the commands fail to obey the loop; None: they obey, or nobody knows."""

    control_law: ControlLawCheck = field(default_factory=ControlLawCheck)
    control_law_errors: tuple[str, ...] = ()
    """What the last verdicts on the loop's law found to be otherwise than told, without a break."""

    standstill: Standstill = field(default_factory=Standstill)
    rejection: Rejection = field(default_factory=Rejection)
    comparison: Comparison = field(default_factory=Comparison)
    """Of telemetry with the matrix in use and with the one before."""

    compared: Status | None = None
    """The loop that both must be of, but for how many modes are controlled."""


Window = Spectra | Correlated | WindowRefused


def with_rtc(bank: EstimatorBank, rtc: Status | None) -> EstimatorBank:
    """Follow the RTC: another loop makes the open window and the passive sums void."""
    before = bank.rtc
    bank = replace(bank, rtc=rtc)
    if rtc is None:
        return replace(
            bank,
            loop=None,
            vibrations=None,
            passive=None,
            cutter=None,
            dither=None,
            check=LoopCheck(),
            command_residual=None,
            control_law=ControlLawCheck(),
            control_law_errors=(),
            edge_watch=None,
            comparison=Comparison(),
            compared=None,
        )
    bank = _comparable(bank, rtc)
    if before is not None and before.session != rtc.session:
        bank = replace(bank, health=LoopHealth())
    bank = _check_control_law(bank, before, rtc)
    if bank.loop is not None and before is not None and same_loop(bank.loop, rtc):
        return bank if before.seq == rtc.seq else _confirmed(bank, rtc)
    bank = replace(bank, loop=rtc)
    in_loop = np.array(rtc.in_loop, dtype=np.intp)
    # an RTC of another instrument may have more
    known = in_loop[in_loop < bank.description.n_modes]
    still = np.setdiff1d(np.arange(rtc.n_controlled), known)
    bank = replace(bank, in_loop=known, still=still)
    if bank.dither is not None and bank.dither_monitor is not None:
        asked = expected_dither(bank.dither, rtc, bank.description.products)
        bank = replace(bank, dither_monitor=with_expected(bank.dither_monitor, asked))
    bank = _watching_the_edge(bank, rtc)
    # frames that are on their way may have been made by the loop as it was
    bank = replace(
        bank, check=LoopCheck(from_seq=last_seq(rtc) + 1), command_residual=None, checked_seq=0
    )
    memory = _no_sums(rtc, bank.received_ns_utc)
    if before is None or not same_rate(before.frame_rate_hz, rtc.frame_rate_hz):
        bank = replace(bank, cutter=None, dither=None)
        monitor = VibrationMonitor.begin(rtc.n_slopes, bank.description.kind)
        return replace(bank, vibrations=monitor, passive=memory)
    return _cut(replace(bank, passive=memory), rtc)


def _comparable(bank: EstimatorBank, rtc: Status) -> EstimatorBank:
    """Compare only what one loop does, under two matrices; gains may follow the seeing."""
    before = bank.compared
    if before is None or not same_but_for_modes(before, rtc):
        begun = probation.begun_anew(bank.comparison, "the loop was changed after the swap")
        return replace(bank, comparison=begun, compared=rtc)
    return bank if bank.comparison.before is not None else replace(bank, compared=rtc)


def _watching_the_edge(bank: EstimatorBank, rtc: Status) -> EstimatorBank:
    """Watch the ring that this loop drives; what is closed, or watched, anew has a clean slate."""
    known = bank.description
    if not rtc.in_loop or known.actuators is None:
        return replace(bank, edge_watch=None, edge=EdgeHealth())
    watch = edge_watch(known.actuators, known.mode_variance_m2, bank.in_loop)
    # a ring nobody can watch any more has not slipped for ever
    edge = EdgeHealth() if watch is None else bank.edge
    return replace(bank, edge_watch=watch, edge=edge)


def _cut(bank: EstimatorBank, rtc: Status) -> EstimatorBank:
    """Give up the open window; the next begins when the changed loop has settled.

    Counted from the status' own frame, not from when it was read, so that a recorded night is cut
    at the same frames again.
    """
    settled_seq = last_seq(rtc) + round(SETTLING_S * rtc.frame_rate_hz)
    if bank.cutter is None:
        return bank
    return replace(bank, cutter=bank.cutter.begun_anew(settled_seq))


def with_matrix(bank: EstimatorBank, cm_id: str, matrix: NDArray[np.float32]) -> EstimatorBank:
    """Know the numbers of one more reconstructor."""
    others = tuple(known for known in bank.matrices if known[0] != cm_id)
    return replace(bank, matrices=(*others, (cm_id, matrix))[-MATRICES_KEPT:])


def _terms(bank: EstimatorBank, cm_id: str | None) -> ClosedLoop | None:
    """Return the loop that a reconstructor closes; None: it is open, not known, or another's."""
    rtc = bank.rtc
    matrix = next((matrix for known, matrix in bank.matrices if known == cm_id), None)
    if rtc is None or rtc.loop == "open" or cm_id is None or matrix is None:
        return None
    if matrix.shape[1] != rtc.n_slopes or len(matrix) > rtc.n_modes:
        return None
    return closed_loop(rtc, cm_id, matrix)


def _check_control_law(bank: EstimatorBank, before: Status | None, rtc: Status) -> EstimatorBank:
    """Judge the loop's law by the frames up to a status, or begin anew with another loop.

    Gains may follow the seeing meanwhile.
    """
    if before is None or not same_loop(before, rtc):
        return replace(
            bank, control_law=ControlLawCheck(from_seq=last_seq(rtc) + 1), control_law_errors=()
        )
    terms = _terms(bank, rtc.cm_id)
    if terms is None or bank.control_law.cm_id != rtc.cm_id:
        return bank
    law, found = control_law.judged(bank.control_law, terms, last_seq(rtc))
    if found is None:
        return replace(bank, control_law=law)
    if found.wrong:
        unlawful = (*bank.control_law_errors, found.wrong)[-VERDICTS:]
        return replace(bank, control_law=law, control_law_errors=unlawful)
    law = replace(law, judged_seq=law.judged_seq + round(AT_EASE_S * rtc.frame_rate_hz))
    return replace(bank, control_law=law, control_law_errors=())


def _confirmed(bank: EstimatorBank, rtc: Status) -> EstimatorBank:
    """Judge the frames up to a status that shows the same loop as the one before."""
    seq = last_seq(rtc)
    if bank.command_residual is None and seq < bank.checked_seq + AT_EASE_S * rtc.frame_rate_hz:
        return bank
    span, terms = loopcheck.last_samples(bank.check, seq), _terms(bank, rtc.cm_id)
    if span is None or terms is None:
        return bank
    check, found = loopcheck.command_residual(bank.check, terms, *span)
    if found is None or found.holds:
        return replace(bank, check=check, command_residual=None, checked_seq=seq)
    return replace(bank, check=check, command_residual=found)


def with_dither(bank: EstimatorBank, dither: Dither | None, window_s: float) -> EstimatorBank:
    """Follow the dither: a new one that has begun starts a new series of windows.

    Raises
    ------
    ModelError
        If its lines, or its modes, cannot be told apart in a window of ``window_s``.
    """
    rtc = bank.rtc
    if dither is None or dither.start_seq is None or rtc is None:
        return replace(
            bank,
            cutter=None,
            dither=None,
            dither_silent_s=0.0,
            dither_monitor=None,
            dither_measurement=None,
        )
    dither = replace(dither, asked_ns_utc=0)
    if dither == bank.dither:
        return bank
    # a status may announce a dither that began long ago
    seen_seq = max(dither.start_seq or 0, last_seq(rtc))
    cutter: LockIn | RandomDither
    if dither.request.kind is DitherKind.BINARY:
        cutter = RandomDither(plan=random_plan(dither, rtc, window_s))
    else:
        cutter = LockIn(plan=lock_in_plan(dither, rtc, window_s))
    return replace(
        bank,
        cutter=cutter,
        dither=dither,
        dither_monitor=DitherMonitor(asked=expected_dither(dither, rtc, bank.description.products)),
        dither_measurement=None,
        dither_seen_seq=seen_seq,
        dither_silent_s=0.0,
    )


def process_block(bank: EstimatorBank, block: FrameBlock) -> tuple[EstimatorBank, list[Window]]:
    """Return the state after one more block, and the windows that ended in it."""
    rtc = bank.rtc
    if rtc is None or block.session != rtc.session or not _fits(rtc, block):
        return bank, []
    standstill = bank.standstill.follow(block) if len(bank.in_loop) else Standstill()
    bank = replace(bank, standstill=standstill)
    if standstill.stands:
        return _without_standstill(bank, rtc, block), []
    return _measured_slopes(bank, rtc, block)


def _measured_slopes(
    bank: EstimatorBank, rtc: Status, block: FrameBlock
) -> tuple[EstimatorBank, list[Window]]:
    """Return the same of slopes that are a measurement."""
    terms, check, law = _terms(bank, block.cm_id), bank.check, bank.control_law
    if terms is not None:
        check, law = loopcheck.observe(check, block, terms), control_law.follow(law, block, terms)
    vibrations, sums = bank.vibrations, bank.passive
    lines = () if bank.dither is None else bank.dither.frequency_hz
    if vibrations is not None and sums is not None and len(bank.in_loop):
        vibrations = vibrations.update(block, lines)
        sums = passive.accumulate(sums, _moving(bank, block))
    bank = replace(
        bank,
        received_ns_utc=block.next_t_ns - block.dt_ns,
        check=check,
        control_law=law,
        vibrations=vibrations,
        passive=sums,
    )
    bank = _holding(bank, block, terms, lines)
    bank, ended = _dithered(_note_dither_seen(bank, rtc, block), rtc, block)
    if ended:
        bank = replace(bank, loop=rtc)  # the next one begins with the gains of now
    return _refuse_disobeyed(bank, ended)


def _holding(
    bank: EstimatorBank, block: FrameBlock, terms: ClosedLoop | None, lines: tuple[float, ...]
) -> EstimatorBank:
    """Return streams that know whether the loop holds, and as well as with the matrix before."""
    health, edge = bank.health, bank.edge
    if block.cm_id != bank.comparison.cm_id:
        # what another matrix has made of the loop says nothing of this one
        health = replace(health, ratio=0.0)
    health = observe(health, block, bank.description.mode_variance_m2, bank.in_loop)
    if bank.edge_watch is not None and not health.absurd:
        edge = observe_edge(edge, block, bank.edge_watch)
    comparison = bank.comparison
    if len(bank.in_loop) and not health.absurd:
        matrix = None if terms is None else terms.reconstructor
        comparison = probation.observe(
            comparison, block, bank.in_loop, lines, bank.edge_watch, matrix
        )
    rejection = Rejection()
    if bank.rtc is not None and len(bank.in_loop):
        gains = np.array(bank.rtc.gains)[bank.in_loop]
        rejection = bank.rejection.follow(block, bank.in_loop, gains, bank.rtc.leak)
    return replace(bank, health=health, edge=edge, comparison=comparison, rejection=rejection)


def _without_standstill(bank: EstimatorBank, rtc: Status, block: FrameBlock) -> EstimatorBank:
    """Return streams that measure nothing on slopes that stand, nor on what came just before."""
    bank = replace(bank, received_ns_utc=block.next_t_ns - block.dt_ns)
    bank = _note_dither_seen(bank, rtc, block)
    settled_seq = block.next_seq + round(SETTLING_S * rtc.frame_rate_hz)
    cutter = None if bank.cutter is None else bank.cutter.begun_anew(settled_seq)
    return replace(
        bank,
        cutter=cutter,
        dither_measurement=None,
        check=LoopCheck(from_seq=settled_seq),
        command_residual=None,
        control_law=ControlLawCheck(from_seq=settled_seq),
        control_law_errors=(),
        passive=_no_sums(rtc, bank.received_ns_utc, settled_seq),
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


def _moving(bank: EstimatorBank, block: FrameBlock) -> FrameBlock:
    """Return a block without what stands in controlled modes that have no gain.

    An integrator without leak keeps it for ever; a mode that never moves tells nothing.
    """
    still = bank.still
    if not len(still):
        return block
    commands = block.commands_m.copy()
    commands[:, still] = 0.0 if block.dither_m is None else block.dither_m[:, still]
    return replace(block, commands_m=commands)


def _dithered(
    bank: EstimatorBank, rtc: Status, block: FrameBlock
) -> tuple[EstimatorBank, Sequence[Window]]:
    """Feed the estimator that reads the dither which runs."""
    if bank.cutter is None:
        return bank, ()
    cutter, ended = bank.cutter.accumulate(block)
    over = _beyond_the_dither(bank, rtc, cutter)
    return replace(bank, cutter=None if over else cutter), ended


def _beyond_the_dither(bank: EstimatorBank, rtc: Status, reading: LockIn | RandomDither) -> bool:
    """Return whether the end of the dither would cut the window that has begun."""
    dither, window = bank.dither, reading.window
    if dither is None or window is None:
        return False
    stop_seq = (dither.start_seq or 0) + round(dither.request.duration_s * rtc.frame_rate_hz)
    return window.first_seq + reading.plan.n_frames > stop_seq


def _note_dither_seen(bank: EstimatorBank, rtc: Status, block: FrameBlock) -> EstimatorBank:
    """Note whether a block holds the dither that should be there."""
    dither, next_seq = bank.dither, block.next_seq
    if bank.dither_monitor is not None:
        monitor, found = measure_block(bank.dither_monitor, block)
        bank = replace(
            bank, dither_monitor=monitor, dither_measurement=found or bank.dither_measurement
        )
    if block.is_dithered:
        return replace(bank, dither_seen_seq=next_seq, dither_silent_s=0.0)
    if dither is None:
        return bank
    stop_seq = (dither.start_seq or 0) + round(dither.request.duration_s * rtc.frame_rate_hz)
    silent = max(min(next_seq, stop_seq) - bank.dither_seen_seq, 0)
    return replace(bank, dither_silent_s=silent / rtc.frame_rate_hz)


def _refuse_disobeyed(
    bank: EstimatorBank, ended: Sequence[Window]
) -> tuple[EstimatorBank, list[Window]]:
    """Return windows, or why the commands of one are not what the loop makes of its slopes."""
    told: list[Window] = []
    for window in ended:
        if isinstance(window, WindowRefused):
            told.append(window)
            continue
        bank, found = _command_residual(bank, window)
        if found is None or found.holds:
            told.append(window)
        else:
            told.append(WindowRefused(reason=found.text, t_ns_utc=window.t_end_ns_utc))
    return bank, told


def _command_residual(
    bank: EstimatorBank, window: Telemetry
) -> tuple[EstimatorBank, CommandResidual | None]:
    """Return how commands obeyed the loop in a window; None: nobody knows."""
    terms = _terms(bank, window.cm_id)
    if terms is None:
        return bank, None
    last_seq = window.first_seq + window.plan.n_frames - 1
    check, found = loopcheck.command_residual(
        bank.check, terms, window.first_seq, last_seq, WINDOW_SAMPLES
    )
    bank = replace(bank, check=check)
    lasts_s = window.plan.n_frames / terms.frame_rate_hz
    if found is not None and found.holds and lasts_s >= ENOUGH_SAMPLES / SAMPLES_PER_S:
        # what a long window shows need not be asked again
        bank = replace(bank, checked_seq=max(last_seq, bank.checked_seq))
    return bank, found


def _fits(rtc: Status, block: FrameBlock) -> bool:
    """Return whether a block has as many slopes and modes as the RTC's status says."""
    return (block.slopes.shape[1], block.commands_m.shape[1]) == (rtc.n_slopes, rtc.n_modes)
