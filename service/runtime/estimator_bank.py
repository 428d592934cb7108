"""The bank of streaming estimators.

It knows none of them by name: ``service.runtime.registry`` lists them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation import estimator
from service.estimation.description import Description, actuator_watch, edge_watch
from service.estimation.dither_windows import Window
from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming
from service.estimation.frames import FrameBlock
from service.estimation.loop import last_seq, same_loop, same_rate
from service.estimation.passive import Passive
from service.estimation.windows import DITHER_SETTLING_S
from service.records.estimates import WindowRefused
from service.records.messages import Message
from service.records.operations import Dither
from service.runtime.registry import REGISTRY, Entry
from service.tracking.dither_request import expected_dither, lock_in_plan, random_plan
from service.wire import DitherKind, Status

N_MATRICES_FOLLOWED = 3
"""The reconstructor in use, the one before, of which frames may still come, and one that is sent.
"""

_PLANS = {DitherKind.SINE: lock_in_plan, DitherKind.BINARY: random_plan}
"""Functions that plan the windows of each kind of dither."""

Member = TypeVar("Member", bound=Streaming)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimatorBank:
    """All streaming estimators and their view of the loop."""

    loop: LoopContext
    entries: tuple[Entry, ...]
    """Estimators of the registry, in the order in which they are fed."""

    members: tuple[Streaming, ...]
    """One for each of them."""

    begun_with: Status | None = None
    """The loop as it was when the open window, or the sums of ordinary telemetry, began."""

    dither: Dither | None = None
    """The one that is followed."""

    @classmethod
    def of(cls, description: Description) -> EstimatorBank:
        """Return the estimators of the registry, before any RTC has been seen."""
        loop = LoopContext(description=description)
        members = tuple(entry.kind.begin(loop) for entry in REGISTRY)
        return cls(loop=loop, entries=REGISTRY, members=members)

    def __getitem__(self, kind: type[Member]) -> Member:
        """Return the estimator of a kind."""
        return next(member for member in self.members if isinstance(member, kind))

    @property
    def marks(self) -> Mark:
        """Findings of all estimators in the last block."""
        marks = estimator.UNMARKED
        for member in self.members:
            marks |= member.marks
        return marks


def with_rtc(bank: EstimatorBank, rtc: Status | None) -> EstimatorBank:
    """Follow the RTC: another loop makes the open window and the passive sums void."""
    before = bank.loop.rtc
    if rtc is None:
        if before is None:
            return bank
        loop = replace(bank.loop, rtc=None, dither=None, edge=None, actuators=None, cm_id=None)
        return replace(_reset_members(bank, loop, Change.GONE), begun_with=None, dither=None)
    changes = estimator.NOTHING if rtc is before else _changes(bank, before, rtc)
    loop = replace(bank.loop, rtc=rtc)
    if changes & (Change.LOOP | Change.STATUS):
        seq = last_seq(rtc)
        # frames that are on their way may have been made by the loop as it was
        settled_seq = seq + round(DITHER_SETTLING_S * rtc.frame_rate_hz)
        loop = replace(loop, from_seq=seq + 1, settled_seq=settled_seq)
    if Change.LOOP in changes:
        bank, loop = replace(bank, begun_with=rtc), _of_modes(loop, rtc)
    if Change.RATE in changes:
        # The plan of a dither counts in frames: at another rate its windows and lines are others.
        bank, loop = replace(bank, dither=None), replace(loop, dither=None)
    bank = _reset_members(bank, loop, changes)
    fresh = before is None or before.seq != rtc.seq
    members = tuple(member.on_status(loop, fresh=fresh) for member in bank.members)
    return replace(bank, members=members)


def _changes(bank: EstimatorBank, before: Status | None, rtc: Status) -> Change:
    """Return what a status changes."""
    changes = estimator.NOTHING
    if before is None or not same_loop(before, rtc):
        changes |= Change.STATUS
    if before is not None and before.session != rtc.session:
        changes |= Change.SESSION
    # Compared with the start of the window, not with the last status: gains that creep add up
    # inside a window.
    if before is None or bank.begun_with is None or not same_loop(bank.begun_with, rtc):
        changes |= Change.LOOP
        if before is None or not same_rate(before.frame_rate_hz, rtc.frame_rate_hz):
            changes |= Change.RATE
    return changes


def _of_modes(loop: LoopContext, rtc: Status) -> LoopContext:
    """Return a loop of the status's modes, its edge watched on those that move."""
    known, dither = loop.description, loop.dither
    in_loop = np.array(rtc.in_loop, dtype=np.intp)
    # an RTC of another instrument may have more
    in_loop = in_loop[in_loop < known.n_modes]
    edge = watch = None
    if rtc.in_loop and known.actuators is not None:
        edge = edge_watch(known.actuators, known.mode_variance_m2, in_loop, known.diameter_m)
        watch = actuator_watch(known.actuators, known.mode_variance_m2, in_loop)
    if dither is not None:
        dither = replace(dither, own=tuple(mode not in rtc.in_loop for mode in dither.modes))
    still = np.setdiff1d(np.arange(rtc.n_controlled), in_loop)
    return replace(loop, in_loop=in_loop, still=still, edge=edge, actuators=watch, dither=dither)


def _reset_members(bank: EstimatorBank, loop: LoopContext, changes: Change) -> EstimatorBank:
    """Return the bank for a changed loop: members that declare one of the changes are reset."""
    members = tuple(
        member.restart(loop, why) if (why := changes & member.resets) else member
        for member in bank.members
    )
    return replace(bank, loop=loop, members=members)


def with_matrix(bank: EstimatorBank, cm_id: str, matrix: NDArray[np.float32]) -> EstimatorBank:
    """Know the numbers of one more reconstructor."""
    # Removed and appended again, so that the last are those most recently in use. However many are
    # sent and rejected, the one that multiplies stays.
    others = tuple(known for known in bank.loop.matrices if known[0] != cm_id)
    others = tuple(sorted(others, key=lambda known: known[0] == bank.loop.cm_id))
    matrices = (*others, (cm_id, matrix))[-N_MATRICES_FOLLOWED:]
    return replace(bank, loop=replace(bank.loop, matrices=matrices))


def with_dither(bank: EstimatorBank, dither: Dither | None, window_s: float) -> EstimatorBank:
    """Follow the dither: a new one begins a new series of windows.

    A dither whose lines or modes cannot be separated in a window of ``window_s`` gives no windows,
    with the reason.
    """
    rtc, played = bank.loop.rtc, None
    if dither is None or dither.start_seq is None or rtc is None:
        dither = None
    else:
        # This time changes when the RTC accepts the dither. Without it the comparison below finds
        # the same dither.
        dither = replace(dither, asked_ns_utc=0)
    if dither == bank.dither:
        return bank
    if dither is not None and rtc is not None:
        played = expected_dither(dither, rtc, bank.loop.description.products)
        try:
            plan = _PLANS[dither.request.kind](dither, rtc, window_s)
            played = replace(played, plan=plan)
        except ModelError as error:
            played = replace(played, why_unreadable=str(error))
    bank = _reset_members(bank, replace(bank.loop, dither=played), Change.DITHER)
    return replace(bank, dither=dither)


Fed = tuple[EstimatorBank, list[Window]]
"""The bank after some frames, and the windows that ended in them."""


def process_blocks(bank: EstimatorBank, blocks: Iterable[FrameBlock]) -> Fed:
    """Return the estimators after these frames, and the windows that ended in them."""
    windows: list[Window] = []
    for block in blocks:
        bank, ended = process_block(bank, block)
        windows += ended
    return bank, windows


def process_block(bank: EstimatorBank, block: FrameBlock) -> Fed:
    """Return the state after one more block, and the windows that ended in it."""
    loop, rtc = bank.loop, bank.loop.rtc
    # Frames travel faster than statuses: the first frames of a session come before the status that
    # describes it.
    if rtc is None or block.session != rtc.session or not _fits(rtc, block):
        return bank, []
    closed = len(loop.in_loop) > 0
    changes = estimator.NOTHING if closed else Change.OPEN
    changes |= estimator.NOTHING if block.cm_id == loop.cm_id else Change.MATRIX
    same_references = block.reference_name == loop.reference_name
    changes |= estimator.NOTHING if same_references else Change.REFERENCES
    loop = replace(
        loop,
        received_ns_utc=block.next_t_ns - block.dt_ns,
        cm_id=block.cm_id,
        reference_name=block.reference_name,
    )
    frames = FrameContext(
        block=block,
        loop=loop,
        rtc=rtc,
        terms=loop.terms(block.cm_id),
        lines_hz=() if loop.dither is None else loop.dither.frequency_hz,
    )
    members: list[Streaming] = []
    for member in bank.members:
        if why := changes & member.resets:
            member = member.restart(frames.loop, why)
        if (closed or not member.only_closed) and not frames.marks & member.unless:
            member = member.update(frames)
        # Later members of the registry see the mark with this very block, and skip it if they
        # declare so.
        if member.marks:
            frames = _mark_block(frames, member.marks)
            changes |= Change.STANDSTILL if Mark.STANDS in member.marks else estimator.NOTHING
        members.append(member)
    return _with_windows(replace(bank, loop=loop), members)


def _mark_block(frames: FrameContext, marks: Mark) -> FrameContext:
    """Return a block with the marks of a member; after frozen slopes measurements begin again."""
    loop = frames.loop
    if Mark.STANDS in marks:
        seq = frames.block.next_seq + round(DITHER_SETTLING_S * frames.rtc.frame_rate_hz)
        loop = replace(loop, from_seq=seq, settled_seq=seq)
    return replace(frames, loop=loop, marks=frames.marks | marks)


def _with_windows(bank: EstimatorBank, members: list[Streaming]) -> Fed:
    """Return the bank with these members, and the windows that ended, refused where one must be."""
    ended: list[Window] = [window for member in members for window in member.ended]
    if not ended:
        return replace(bank, members=tuple(members)), []
    windows: list[Window] = []
    for window in ended:
        if isinstance(window, WindowRefused):
            windows.append(window)
            continue
        reasons: list[Message] = []
        for k, member in enumerate(members):
            members[k], reason = member.vet(window, bank.loop)
            reasons += [] if reason is None else [reason]
        # All members were asked, although one reason is enough: each of them keeps count of the
        # windows it has vetted.
        windows.append(window.refuse(reasons[0]) if reasons else window)
    # the next one begins with the gains of now
    return replace(bank, members=tuple(members), begun_with=bank.loop.rtc), windows


def close_sums(
    bank: EstimatorBank, *, has_windows: bool = False
) -> tuple[EstimatorBank, Passive | str | None]:
    """Return the bank with new sums of ordinary telemetry, and the old ones.

    A text is the reason why there are none; None means that telemetry is skipped next to a dither.
    """
    marks, closed = bank.marks, bank[Passive]
    begun, sums = closed.close(bank.loop, marks, has_windows=has_windows)
    members = tuple(begun if member is closed else member for member in bank.members)
    # a window that is under way is of the gains with which it began
    anew = isinstance(sums, Passive) and Mark.WINDOWS not in marks
    begun_with = bank.loop.rtc if anew else bank.begun_with
    return replace(bank, members=members, begun_with=begun_with), sums


def _fits(rtc: Status, block: FrameBlock) -> bool:
    """Return whether a block has as many slopes and modes as the RTC's status says."""
    return (block.slopes.shape[1], block.commands_m.shape[1]) == (rtc.n_slopes, rtc.n_modes)
