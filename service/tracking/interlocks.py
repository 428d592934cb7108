"""Decide whether an order may be given now.

``step`` enforces it, the state publishes it, and the page and the command line draw from that. Most
orders are refused because something runs; some need an RTC, α, or a reconstructor besides. What an
order holds in itself, like a mode that the basis does not have, is checked where it is carried out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, get_args

from service.errors import CommandError, UnknownIdError
from service.estimation.loop import NO_RTC
from service.records import commands as cmd
from service.records.alarms import ALARMS, RULE_PREFIX
from service.records.commands import Command
from service.records.events import kebab
from service.records.operations import AcquisitionStage
from service.records.products import MatrixState, ReconstructorRecord
from service.records.registration import Validity
from service.records.state import Mode, TrackerState
from service.tracking.operations.acquisition import check_acquisition
from service.tracking.operations.running import OperationKind, RunningOperation, running_operations
from service.tracking.policy import Policy
from service.tracking.reconstructors import beyond_judging, check_approved, require_record
from service.tracking.references import check_sending, require_references
from service.tracking.update_policy import is_left_behind


@dataclass(frozen=True, slots=True)
class Permission:
    """Permission to give an order at present."""

    allowed: bool
    reason: str = ""
    """Operation or prerequisite that forbids the order, and the remedy; empty if permitted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """State and policy on which an interlock decides."""

    state: TrackerState
    policy: Policy
    running: tuple[RunningOperation, ...]
    """Running operations, the exclusive one first."""


Order = type[Command] | Command
"""A command, or the kind of it: then it is about what an operator would mean by it now."""

_ALL = frozenset[type](get_args(Command))

_SEEN = frozenset[type]({cmd.AcknowledgeAlarm, cmd.MuteAlarm, cmd.UnmuteAlarm})

_ALWAYS = _SEEN | frozenset[type](
    {
        cmd.AbortAcquisition,
        cmd.GiveUp,
        cmd.Reject,
        cmd.RejectReferences,
        cmd.Resume,
        cmd.SetMode,
        cmd.SetPointing,
        cmd.SetValue,
        cmd.StopEverything,
        cmd.StopDither,
    }
)
"""Orders that end something, or disturb nothing."""

_SWAPS = frozenset[type](
    {cmd.Approve, cmd.Publish, cmd.Rollback, cmd.ApproveReferences, cmd.RollBackReferences}
) | {cmd.LoadShape, cmd.ClearShape}
"""Orders that swap a matrix or references."""

ALLOWS: Final[dict[OperationKind, frozenset[type]]] = {
    OperationKind.STOPPED: _ALWAYS,
    OperationKind.MEASURING: _ALWAYS,
    # a swap costs it a window, and must not wait for minutes
    OperationKind.GATHERING: _ALWAYS | _SWAPS | {cmd.Refit},
    OperationKind.RAMPING: _ALWAYS,
    OperationKind.ACQUIRING: _ALWAYS,
    # it makes way for what needs the loop, and an RTC measures under no dither
    OperationKind.OWN_DITHER: _ALL - {cmd.Measure, cmd.StartDither},
    OperationKind.OTHER_DITHER: _ALL - {cmd.Measure, cmd.StartDither, cmd.MeasureNoisy},
    OperationKind.STANDING_BY: _ALWAYS - {cmd.AbortAcquisition, cmd.GiveUp, cmd.StopDither},
    OperationKind.MAKING: _ALL - {cmd.Measure, cmd.Refit, cmd.Publish},
    OperationKind.SENDING: _ALL - {cmd.Measure},
}
"""Orders that are carried out while it runs; ``_LET_OPEN`` also let the loop be opened."""

_LET_OPEN: Final = {OperationKind.RAMPING, OperationKind.STOPPED}
"""Operations during which the loop may be opened. An RTC ends a gain ramp when its loop is opened,
and knows no other way; alarms ask for an open loop also while everything is stopped."""


def permitted(state: TrackerState, order: Order, policy: Policy, now_ns: int) -> Permission:
    """Return whether an order may be given now.

    Parameters
    ----------
    state
        What is known.
    order
        A command; or the kind of one, which is then about the reconstructor that is proposed, the
        measurement under way, or any alarm.
    policy
        The user's numbers.
    now_ns
        The service's clock, nanoseconds.

    Raises
    ------
    UnknownIdError
        If a command names what does not exist.
    """
    running = running_operations(state, now_ns)
    return _decide(Moment(state=state, policy=policy, running=running), order)


def permissions(state: TrackerState, policy: Policy, now_ns: int) -> Mapping[str, Permission]:
    """Return the same of every order, by its name."""
    moment = Moment(state=state, policy=policy, running=running_operations(state, now_ns))
    return {name: _decide(moment, order) for name, order in ORDERS.items()}


def require(state: TrackerState, command: Command, policy: Policy, now_ns: int) -> None:
    """Refuse an order that may not be given now.

    Raises
    ------
    CommandError
        If so: what runs or is missing, and what to do first.
    UnknownIdError
        If it names what does not exist.
    """
    permission = permitted(state, command, policy, now_ns)
    if not permission.allowed:
        raise CommandError(permission.reason)


def _decide(moment: Moment, order: Order) -> Permission:
    kind = order if isinstance(order, type) else type(order)
    opens = isinstance(order, cmd.SetLoop) and order.loop == "open"
    for running in moment.running:
        if kind not in ALLOWS[running.kind] and not (opens and running.kind in _LET_OPEN):
            return Permission(allowed=False, reason=running.text)
    interlock = INTERLOCKS.get(kind)
    reason = None if interlock is None else interlock(moment, _named(order))
    if reason is None and isinstance(order, cmd.Gains) and order.effective_gain is not None:
        reason = _compensate(moment)
    return Permission(allowed=reason is None, reason=reason or "")


def _named(order: Order) -> str:
    """Return which reconstructor, measurement or alarm an order is about; empty: it says none."""
    if isinstance(order, type):
        return ""
    name: str = getattr(order, "id", "") or getattr(order, "name", "")
    return name


def _needs_rtc(moment: Moment, _: str = "") -> str | None:
    return f"{NO_RTC}: start it first" if moment.state.loop.rtc is None else None


def _needs_loop(moment: Moment, _: str, *, why: str) -> str | None:
    """Return why something cannot be done that needs the loop closed."""
    rtc = moment.state.loop.rtc
    opened = rtc is not None and rtc.loop == "open"
    return f"the loop is open: close it first, {why}" if opened else _needs_rtc(moment)


def _compensate(moment: Moment) -> str | None:
    """Return why gains cannot be had that act alike on all modes, judged with the matrix in use."""
    registration = moment.state.alpha.registration
    if registration is None or not registration.optical_gains:
        return "no optical gain is measured yet; start a dither and wait for a window"
    unknown = (
        "the reconstructor in use is not known, so no gains can be judged with it: wait until it "
        "is read back, or publish one"
    )
    return unknown if moment.state.matrices.in_use is None else None


def _abort(moment: Moment, _: str) -> str | None:
    acquisition = moment.state.operations.acquisition
    interrupted = acquisition.stage is AcquisitionStage.INTERRUPTED
    return None if acquisition.under_way or interrupted else "no acquisition is under way"


def _resume(moment: Moment, _: str) -> str | None:
    if moment.state.operator.stopped_because:
        return None
    held = "; mode is hold: set another to go on" if moment.state.operator.mode is Mode.HOLD else ""
    return f"nothing is stopped{held}"


def _refit(moment: Moment, _: str) -> str | None:
    registration, why = moment.state.alpha.registration, None
    if registration is None:
        why = "α is not known yet; start a dither and wait for a window"
    elif registration.validity.level is Validity.PREDICTED:
        why = f"α is predicted ({registration.validity.reason}): wait for a window, or acquire"
    return _needs_rtc(moment) or why


def _approve(moment: Moment, matrix_id: str) -> str | None:
    state = moment.state
    record = _named_or_proposed(state, matrix_id)
    if record is None or record.state is not MatrixState.PROPOSED:
        return f"{_not_proposed(record)}{'' if record else ': refit first'}"
    registration = state.alpha.registration
    if registration is not None and not registration.usable:
        why = registration.validity.reason
        level = registration.validity.level
        return f"{record.id} cannot be judged: α is {level} ({why}): wait for a window"
    if is_left_behind(state, record, moment.policy):
        return f"{record.id} was made for another α than the present one: refit"
    reason = check_approved(state, record)
    if reason is not None:
        return f"{record.id} cannot be sent: {reason}"
    if registration is not None and beyond_judging(state, record):
        return f"{record.id}: an open loop shows no gains: close it first"
    return None


def _reject(moment: Moment, matrix_id: str) -> str | None:
    record = _named_or_proposed(moment.state, matrix_id)
    proposed = record is not None and record.state is MatrixState.PROPOSED
    return None if proposed else _not_proposed(record)


def _named_or_proposed(state: TrackerState, matrix_id: str) -> ReconstructorRecord | None:
    """Return the reconstructor of this id; of none, the one that is proposed, if one is."""
    if matrix_id:
        return require_record(state, matrix_id)
    records = reversed(state.matrices.reconstructors)
    return next((one for one in records if one.state is MatrixState.PROPOSED), None)


def _not_proposed(record: ReconstructorRecord | None) -> str:
    if record is None:
        return "no reconstructor is proposed"
    return f"{record.id} is {record.state}, not proposed"


def _references(moment: Moment, reference_id: str, *, sent: bool) -> str | None:
    """Return why proposed references may not be sent, or not be discarded."""
    state, proposed = moment.state, MatrixState.PROPOSED
    records = state.references.records
    record = next((one for one in reversed(records) if one.state is proposed), None)
    if reference_id:
        record = require_references(state, reference_id)
    if record is None:
        return "no references are proposed"
    if record.state is not proposed:
        return f"{record.id} are {record.state}, not proposed"
    reason = check_sending(state, record) if sent else None
    return f"{record.id} cannot be sent: {reason}" if reason else None


def _roll_back_references(moment: Moment, _: str) -> str | None:
    if moment.state.references.used_id is None:
        return "the RTC uses its own references"
    return _needs_rtc(moment) or moment.state.references.unsupported or None


def _clear(moment: Moment, _: str) -> str | None:
    kept = moment.state.references
    if kept.shape is None and kept.used_id is None:
        return "no shape is loaded"
    return _needs_rtc(moment)


def _publish(moment: Moment, matrix_id: str) -> str | None:
    state = moment.state
    if matrix_id:
        record = require_record(state, matrix_id)
        if not record.was_used and state.alpha.registration is None:
            unknown = "α is not known yet; start a dither, wait for a window"
            return f"{record.id} cannot be judged: {unknown}"
    return _needs_rtc(moment)


def _rollback(moment: Moment, _: str) -> str | None:
    if moment.state.previous is None:
        return "no earlier reconstructor has been in use"
    return _needs_rtc(moment)


def _give_up(moment: Moment, measurement_id: str) -> str | None:
    state = moment.state
    if not measurement_id:
        going_on = state.measuring or state.noisy_measurement
        return "nothing is being measured" if going_on is None else None
    record = state.measurement(measurement_id)
    if record is None:
        raise UnknownIdError(f"unknown measurement {measurement_id}")
    over = f"{record.id} is {record.state}: there is nothing to give up"
    return None if record.under_way else over


def _acknowledge(moment: Moment, alarm: str) -> str | None:
    notes = moment.state.alarms.records
    if not alarm:
        unseen = any(record.worst is not None and record.acknowledged is None for record in notes)
        return None if unseen else "every alarm is acknowledged"
    record = next((record for record in notes if record.name == alarm), None)
    if record is None and not _is_known(alarm):
        return None  # nobody can know of it: it is looked up where that is done
    if record is None or record.worst is None:
        return f"{alarm} neither lasts nor is stale: nothing to acknowledge"
    seen = record.acknowledged
    return f"{alarm} was acknowledged by {seen.by}: nothing is left to do" if seen else None


def _unmute(moment: Moment, alarm: str) -> str | None:
    muted = any(
        record.muted for record in moment.state.alarms.records if alarm in {"", record.name}
    )
    if muted or not _is_known(alarm):
        return None
    return f"{alarm} is not muted" if alarm else "no alarm is muted"


def _is_known(alarm: str) -> bool:
    return alarm in ALARMS or alarm.startswith(RULE_PREFIX) or not alarm


INTERLOCKS: Final[dict[type, Callable[[Moment, str], str | None]]] = {
    cmd.Resume: _resume,
    cmd.Acquire: lambda now, _: _needs_rtc(now) or check_acquisition(now.state, now.policy),
    cmd.AbortAcquisition: _abort,
    cmd.Refit: _refit,
    cmd.StartDither: partial(_needs_loop, why="a dither is read in the closed loop"),
    cmd.Approve: _approve,
    cmd.Reject: _reject,
    cmd.Publish: _publish,
    cmd.Rollback: _rollback,
    cmd.LoadShape: _needs_rtc,
    cmd.ClearShape: _clear,
    cmd.ApproveReferences: partial(_references, sent=True),
    cmd.RejectReferences: partial(_references, sent=False),
    cmd.RollBackReferences: _roll_back_references,
    cmd.Measure: _needs_rtc,
    cmd.MeasureNoisy: partial(_needs_loop, why="a noisy matrix is measured in the closed loop"),
    cmd.GiveUp: _give_up,
    cmd.SetLoop: _needs_rtc,
    cmd.Ramp: partial(_needs_loop, why="gains are tried on its residual"),
    cmd.AcknowledgeAlarm: _acknowledge,
    cmd.UnmuteAlarm: _unmute,
}
"""Why an order may not be given though nothing that runs forbids it; the others need nothing."""


ORDERS: Final[Mapping[str, Order]] = {
    **{kebab(kind).replace("-", "_"): kind for kind in get_args(Command)},
    "open_loop": cmd.SetLoop(loop="open"),
    "compensate_gains": cmd.SetLoop(effective_gain=1.0),
}
"""Every order by its name; opening the loop is one of its own, because it ends a gain ramp, and so
are gains that act alike on all modes, because they need a measured optical gain."""
