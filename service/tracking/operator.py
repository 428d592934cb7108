"""Carry out orders: mode, dither, reconstructors, loop."""

from __future__ import annotations

from dataclasses import replace

from service.control.gains import gain_table
from service.errors import CommandError
from service.estimation.loop import extend_gains
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import PROBATION
from service.records.commands import GainGroup, ModeGroup
from service.records.operations import (
    CommandState,
    Dither,
    DitherPurpose,
    LoopCommand,
    RefitJob,
    RefitState,
)
from service.records.products import MatrixState, ModeSet
from service.records.state import Level, Mode
from service.tracking import dither_request, reconstructors
from service.tracking.dither import allow_dither, request_dither
from service.tracking.dither_plan import operator_parameters
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, present
from service.tracking.update_policy import DECLINED_MODES_DELAY_S, limit_declined
from service.tracking.validity import note_pointing
from service.wire import DitherKind, Loop, LoopRequest, Pointing, RampRequest, Reply, Status


def set_mode(context: StepContext, command: cmd.SetMode) -> None:
    """Set the mode; remember that of the settings."""
    change_mode(context, command.mode)
    context.clear_alarm(PROBATION)
    reconstructors.forget_misapplied(context)
    context.log("mode", f"mode is {command.mode}")


def approve(context: StepContext, command: cmd.Approve) -> None:
    """Send a proposal, after a new verdict if necessary."""
    reconstructors.send_once_judged(context, command.id)


def reject(context: StepContext, command: cmd.Reject) -> None:
    """Discard a proposal."""
    reconstructors.change_state(
        context, command.id, MatrixState.DISCARDED, command.reason or "by the operator"
    )
    context.log("reconstructor.discarded", command.id)
    record = reconstructors.require_record(context.state, command.id)
    limit_declined(context, record, DECLINED_MODES_DELAY_S)


def publish(context: StepContext, command: cmd.Publish) -> None:
    """Have a reconstructor judged and sent again; the mode becomes hold, as in a rollback."""
    _republish(context, command.id, f"the operator publishes {command.id} again")


def roll_back(context: StepContext, command: cmd.Rollback) -> None:
    """Have the previous reconstructor judged and sent, without approval.

    The mode becomes hold, because the service would replace it at once.
    """
    earlier = context.state.previous
    if earlier is not None:
        _republish(context, earlier, f"the operator goes back to {earlier}", anyway=command.anyway)


def refit(context: StepContext, command: cmd.Refit) -> None:
    """Make a reconstructor for the present α.

    Raises
    ------
    CommandError
        If the RTC has no such number of modes.
    """
    rtc = present(context.rtc)
    asked = command.n_modes or rtc.n_controlled
    if not 0 < asked <= rtc.n_modes:
        raise CommandError(f"found {asked} modes; expected 1 to {rtc.n_modes}")
    reconstructors.request_matrix(context, ev.MakeMatrix(n_modes=asked, why="the operator asked"))
    job = RefitJob(
        id=context.cause, state=RefitState.RUNNING, n_modes=asked, asked_ns_utc=context.now_ns
    )
    refits = (*context.operations.refits, job)[-REFITS_KEPT:]
    context.operations = replace(context.operations, refits=refits)


def on_refit_made(context: StepContext, made: ev.MatrixMade) -> None:
    """Note that a refit has made its reconstructor, and what the gate says of it."""
    record = made.record
    verdict = record.reason if record.gate is None else record.gate.reason
    refused = record.state is MatrixState.REFUSED
    state = RefitState.REFUSED if refused else RefitState.MADE
    text = f"{record.id}, {record.n_modes} modes: {verdict}"
    _end_refit(context, state, text, record.id)


def on_refit_failed(context: StepContext, _: ev.MakeMatrix, text: str) -> None:
    """Note that a refit has made no reconstructor."""
    _end_refit(context, RefitState.FAILED, text)


def _end_refit(context: StepContext, state: RefitState, text: str, made: str | None = None) -> None:
    refits = tuple(
        replace(job, state=state, reconstructor=made, reason=text)
        if job.id == context.cause and job.state is RefitState.RUNNING
        else job
        for job in context.operations.refits
    )
    context.operations = replace(context.operations, refits=refits)


def start_dither(context: StepContext, command: cmd.StartDither) -> None:
    """Start a dither; choose missing parameters.

    Raises
    ------
    CommandError
        If it cannot be played or read, or costs more than the budget.
    """
    rtc = present(context.rtc)
    dither = _plan_dither(context, rtc, command)
    total, over_budget = dither_request.total_m(dither.request), command.over_budget
    cost = dither_request.cost_of(total, context.policy, over_budget=over_budget)
    # Whoever orders a dither wants those of the service again, too.
    allow_dither(context)
    modes = dither.request.modes
    which = f"modes {modes}" if len(modes) < 10 else f"{len(modes)} modes"
    context.log("dither.asked", f"{dither.request.kind}, {which}, {cost}")
    request_dither(context, dither)


def _plan_dither(context: StepContext, rtc: Status, command: cmd.StartDither) -> Dither:
    """Return the dither to ask for.

    Raises
    ------
    CommandError
        If it could not be played, or not be read.
    """
    policy, now_ns = context.policy, context.now_ns
    if command.kind is DitherKind.BINARY or isinstance(command.modes, ModeSet):
        return dither_request.plan_random(
            rtc,
            policy,
            now_ns,
            purpose=DitherPurpose.OPERATOR,
            dither_id=dither_request.name_dither(DitherPurpose.OPERATOR, now_ns),
            modes=command.modes or ModeSet.CONTROLLED,
            total_m=command.total_amplitude_m
            or min(dither_request.DEFAULT_RANDOM_RMS_M, policy.dither_budget_m),
            duration_s=command.duration_s or dither_request.DEFAULT_DURATION_S,
        )
    dither = dither_request.plan_dither(
        rtc,
        policy,
        now_ns,
        choice=operator_parameters(context, rtc),
        modes=command.modes,
        amplitude_m=command.amplitude_m,
        frequency_hz=command.frequency_hz,
        duration_s=command.duration_s,
    )
    dither_request.check_modes(dither.request.modes, rtc)
    reason = dither_request.check_dither_usable(dither, rtc, policy)
    if reason is not None:
        raise CommandError(reason)
    return dither


def _republish(context: StepContext, source: str, why: str, *, anyway: bool = False) -> None:
    """Offer an earlier matrix again; hold, or the service would replace it at once."""
    reconstructors.request_matrix(
        context, ev.RepublishMatrix(source=source, why=why, anyway=anyway)
    )
    enter_hold(context, why)


def set_pointing(context: StepContext, command: cmd.SetPointing) -> None:
    """Store the pointing that the observatory reports."""
    pointing = Pointing(elevation_deg=command.elevation_deg, azimuth_deg=command.azimuth_deg)
    note_pointing(context, pointing)


def enter_hold(context: StepContext, why: str) -> None:
    """Do nothing unasked until an operator sets another mode."""
    change_mode(context, Mode.HOLD)
    context.log("mode", f"hold: {why}")


def leave_hold(context: StepContext, why: str) -> None:
    """Go on in mode auto after :func:`enter_hold`."""
    change_mode(context, Mode.AUTO)
    context.warn("mode", f"auto: {why}")


def change_mode(context: StepContext, mode: Mode) -> None:
    """Go on in a mode, and remember that of the settings if it is another one."""
    of_settings = context.operator.settings_mode or context.operator.mode
    other = None if mode is of_settings else of_settings
    context.operator = replace(context.operator, mode=mode, settings_mode=other)


REFITS_KEPT = 100
"""Newest refits whose results are remembered, until the service ends."""

RAMP_GROUPS = ((0, 1), (2, 99), (100, None))
"""Tip and tilt, to mode 100, the rest: the paper's groups (Heritier et al. 2018, section 5)."""

RAMP_GAINS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
RAMP_STEP_S = 1.0
"""At each gain: an integrator settles in a tenth of it."""

RECLOSING_INTERVAL_S = 5.0
"""An RTC that still measures refuses; it is asked again."""

MAX_RECLOSING_S = 3600.0
"""Time for which the loop is closed again automatically; a loop open for longer is taken as open on
purpose."""


def set_loop(context: StepContext, command: cmd.SetLoop) -> None:
    """Request a change of the loop.

    Raises
    ------
    CommandError
        If it makes no sense in this state.
    """
    rtc = present(context.rtc)
    n_controlled = command.n_controlled
    if n_controlled is not None and not 1 <= n_controlled <= rtc.n_modes:
        raise CommandError(f"found {n_controlled} modes; expected 1 to {rtc.n_modes}")
    gains, n_modes = None, n_controlled or rtc.n_controlled
    if command.effective_gain is not None:
        gains = _compensate(context, rtc, command.effective_gain, n_modes)
    elif command.gains is not None:
        gains = _gains(rtc, command.gains, n_modes)
    if command.loop is not None:
        # The order counts: the loop is not closed again after a measurement that was given up.
        context.loop = replace(context.loop, close_since_ns_utc=None)
    _ask_loop(
        context,
        LoopRequest(
            id=f"loop-{context.now_ns}",
            loop=None if command.loop is None else Loop(command.loop),
            gains=gains,
            leak=command.leak,
            n_controlled=n_controlled,
        ),
        _request_text(command),
        judged=command.effective_gain is not None,
    )


def ramp(context: StepContext, command: cmd.Ramp) -> None:
    """Request a gain ramp.

    Raises
    ------
    CommandError
        If it names modes that are not controlled.
    """
    rtc = present(context.rtc)
    groups = command.groups or _paper_groups(rtc.n_controlled)
    ranges = _ranges(groups, rtc.n_controlled)
    gains = command.gains or RAMP_GAINS
    # The wire counts frames: a slow RTC takes longer, and so the clock begins with its answer.
    n_frames = max(1, round((command.step_s or RAMP_STEP_S) * rtc.frame_rate_hz))
    lasts_s = len(ranges) * len(gains) * n_frames / rtc.frame_rate_hz
    spans = ", ".join(f"{first} to {last}" for first, last in ranges)
    text = f"{len(gains)} gains on modes {spans}: {lasts_s:.0f} s"
    name = f"ramp-{context.now_ns}"
    request = RampRequest(id=name, groups=ranges, gains=gains, frames_per_gain=n_frames)
    _ask_loop(context, request, text, lasts_s)


def on_loop_answer(context: StepContext, request: LoopRequest | RampRequest, reply: Reply) -> None:
    """Note whether the RTC carries out a command."""
    outcome = CommandState.ACCEPTED if reply.accepted else CommandState.REFUSED
    _note_outcome(context, request.id, outcome, reply.reason)


def on_loop_failed(context: StepContext, request: LoopRequest | RampRequest, text: str) -> None:
    """Note that a command had no answer."""
    _note_outcome(context, request.id, CommandState.FAILED, text)


def _note_outcome(context: StepContext, command: str, outcome: CommandState, reason: str) -> None:
    """Note what became of a command; one that a later one has replaced is only logged."""
    asked, text = context.loop.command, command
    if asked is not None and asked.id == command:
        until_ns = context.now_ns + round(asked.lasts_s * SECOND_NS)
        ended = replace(asked, state=outcome, reason=reason, until_ns_utc=until_ns)
        context.loop = replace(context.loop, command=ended)
        text = asked.text
    level = Level.INFO if outcome is CommandState.ACCEPTED else Level.WARNING
    context.log(f"loop.{outcome}", f"{text}: {reason}" if reason else text, level)


def end_ramp(context: StepContext) -> None:
    """Note that no ramp can be under way: the RTC has begun a new session."""
    asked = context.loop.command
    context.loop = replace(context.loop, command=asked and replace(asked, lasts_s=0.0))


def begin_closing(context: StepContext) -> None:
    """Close the loop again that a measurement has opened which was given up."""
    context.loop = replace(context.loop, close_since_ns_utc=context.now_ns)
    close_again(context)


def close_again(context: StepContext) -> None:
    """Close the loop that a measurement opened which was then given up, as often as it takes."""
    since_ns, rtc = context.loop.close_since_ns_utc, context.rtc
    if since_ns is None or rtc is None or context.operator.stopped_because:
        return
    waited_s = (context.now_ns - since_ns) / SECOND_NS
    # a measurement only just asked for may open it yet
    closed = rtc.loop != "open"
    if waited_s > (RECLOSING_INTERVAL_S if closed else MAX_RECLOSING_S):
        context.loop = replace(context.loop, close_since_ns_utc=None)
        return
    last = context.loop.command
    recent = (
        last is not None and context.now_ns - last.asked_ns_utc < RECLOSING_INTERVAL_S * SECOND_NS
    )
    if not closed and not recent:
        request = LoopRequest(id=f"loop-{context.now_ns}", loop=Loop.CLOSED)
        _ask_loop(context, request, "close again after a measurement given up")


def _gains(rtc: Status, groups: tuple[GainGroup, ...], n_modes: int) -> tuple[float, ...]:
    """Return a gain for each mode of the basis: those in use, except for the groups.

    The status of an open loop does not contain the gains with which it will close.
    """
    ranges = _ranges(groups, n_modes)
    named = sum(last - first + 1 for first, last in ranges)
    if rtc.loop == "open" and named < n_modes:
        raise CommandError(
            f"found gains for {named} modes; expected all {n_modes} while the loop is open, "
            "whose gains its status does not report"
        )
    # Modes outside of all groups keep their gains.
    gains = list(extend_gains(rtc, n_modes))
    for group in groups:
        gains[group.first : group.last + 1] = [group.gain] * (group.last - group.first + 1)
    return tuple(gains)


def _compensate(
    context: StepContext, rtc: Status, in_effect: float, n_modes: int
) -> tuple[float, ...]:
    """Return the gains that act alike on every controlled mode; the others stay at 0."""
    registration = context.registration
    measured = () if registration is None else registration.optical_gains
    gains = gain_table(measured, n_modes).loop_gains(in_effect)
    return (*gains.tolist(), *(0.0,) * (rtc.n_modes - n_modes))


def _paper_groups(n_controlled: int) -> tuple[ModeGroup, ...]:
    end = n_controlled - 1
    return tuple(
        ModeGroup(first=first, last=end if last is None else min(last, end))
        for first, last in RAMP_GROUPS
        if first <= end
    )


def _ranges(groups: tuple[ModeGroup, ...], n_modes: int) -> tuple[tuple[int, int], ...]:
    """Return first and last mode of each group, all of them modes of the loop."""
    for group in groups:
        if group.last >= n_modes:
            raise CommandError(
                f"found modes {group.first} to {group.last}; expected a range within 0 to "
                f"{n_modes - 1}"
            )
    return tuple((group.first, group.last) for group in groups)


def _request_text(command: cmd.SetLoop) -> str:
    parts = {"closed": ["close"], "open": ["open"], None: []}[command.loop]
    parts += [f"gain {g.gain:g} on modes {g.first} to {g.last}" for g in command.gains or ()]
    if command.effective_gain is not None:
        parts.append(f"gain {command.effective_gain:g} in effect on every mode, by the gain table")
    if command.leak is not None:
        parts.append(f"leak {command.leak:g}")
    if command.n_controlled is not None:
        parts.append(f"{command.n_controlled} modes from the next reconstructor on")
    return ", ".join(parts)


def _ask_loop(
    context: StepContext,
    request: LoopRequest | RampRequest,
    text: str,
    lasts_s: float = 0.0,
    *,
    judged: bool = False,
) -> None:
    asked = LoopCommand(
        id=request.id,
        text=text,
        state=CommandState.ASKED,
        asked_ns_utc=context.now_ns,
        lasts_s=lasts_s,
        cause=context.cause,
    )
    context.loop = replace(context.loop, command=asked)
    context.log("loop.asked", text)
    context.ask(ev.Ask(request=request, judged=judged))
