"""Stop everything and resume; what a restart takes over."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from service.records import commands as cmd
from service.records.alarms import NOT_RESTORED, Interlock
from service.records.products import MatrixState, ReconstructorRecord, ReferencesRecord
from service.records.state import Orders, Saved, TrackerState
from service.tracking import dither, mode_proof, offload, references, validity
from service.tracking.alarm_records import restore_records
from service.tracking.alarm_rules import derive_alarms
from service.tracking.operations.acquisition import (
    MISSES_BEFORE_ACQUISITION,
    abort_acquisition,
    acquisition_to_save,
    restore_acquisition,
)
from service.tracking.operations.measurement import give_up
from service.tracking.operations.running import running_ramp
from service.tracking.operator import change_mode
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.reconstructors import prune
from service.tracking.step_context import StepContext
from service.tracking.validity import without_previous

MAX_CLOCK_DIFFERENCE_S = 60.0
"""A state from further in the future than this was saved under another clock."""

Sent = TypeVar("Sent", ReconstructorRecord, ReferencesRecord)

_RESTARTED = {
    MatrixState.PUBLISHED: MatrixState.FAILED,
    MatrixState.STAGED: MatrixState.FAILED,
    MatrixState.PROPOSED: MatrixState.DISCARDED,
}


def stop_everything(context: StepContext, command: cmd.StopEverything) -> None:
    """End everything; then request only the end of dithers.

    An acquisition gives back the loop as it was found, now. One that a measurement has opened is
    closed again when all is released: the RTC is busy until then. A gain ramp is the RTC's, and
    ends by itself; only opening the loop would end it sooner.
    """
    # The first order is remembered; a second one only ends what has begun since.
    if not context.operator.stopped_because:
        ramp = running_ramp(context.state, context.now_ns)
        left = "" if ramp is None else f"; {ramp.id} is the RTC's and ends by itself"
        text = f"everything was stopped {command.signed}{left}"
        context.operator = replace(context.operator, stopped_because=text)
    if context.acquisition.under_way:
        abort_acquisition(context, "by the operator", held_off=True)
    for record in (context.state.measuring, context.state.noisy_measurement):
        if record is not None:
            give_up(context, record.id)
    # On standby another service drives the RTC, and stops its own dither.
    if context.rtc is None or context.blocking_alarm(Interlock.ASK) is not None:
        dither.forget_dither(context)
    else:
        dither.stop_running_dither(context)


def resume_everything(context: StepContext, command: cmd.Resume) -> None:
    """Return to the mode and the dither ordered."""
    context.operator = replace(context.operator, stopped_because="")
    context.log("resumed", command.signed)


def orders_of(state: TrackerState) -> Orders:
    """Return what the next service has to obey; the default is nothing."""
    return Orders(
        mode=None if state.operator.settings_mode is None else state.operator.mode,
        settings_mode=state.operator.settings_mode,
        dither_stopped=state.dithers.stopped,
        stopped=state.operator.stopped_because,
        seen=state.alarms.records,
        shape=state.references.shape,
        references_paused=state.references.paused,
    )


def obey_orders(context: StepContext, orders: Orders) -> None:
    """Take over what was ordered before a restart, the mode being the settings' so far.

    The last order counts: an order outlives the service, and ends with the next one, or when
    the settings say something else than they did when it was given.
    """
    if orders.dither_stopped:
        dither.allow_dither(context, allowed=False)
        text = "by an operator before the restart; start the dither to let it dither again"
        context.warn("dither.stopped", text)
    of_settings, ordered = context.operator.mode, orders.mode
    if ordered is None or ordered is of_settings:
        return
    if of_settings is not orders.settings_mode:
        text = (
            f"mode is {of_settings}: the settings, which said {orders.settings_mode} when an "
            f"operator set {ordered}, have been changed since"
        )
    else:
        text = (
            f"mode is {ordered}, as an operator set it before the restart, and not {of_settings} "
            "as the settings say; set the mode to change it"
        )
        change_mode(context, ordered)
    context.warn("mode", text)


def restored(records: tuple[ReconstructorRecord, ...]) -> tuple[ReconstructorRecord, ...]:
    """Return the records that a restarted service takes over from its archive.

    Operations that were under way have failed, and the verdict of a proposal is out of date. A
    matrix that the RTC brought can be restored, and is read again, because it may have changed.
    """
    return prune(_after_restart(records), None)


def restored_references(records: tuple[ReferencesRecord, ...]) -> tuple[ReferencesRecord, ...]:
    """Return the references that a restarted service takes over from its archive.

    Those in use are known again when the RTC names them.
    """
    return tuple(
        replace(record, state=MatrixState.SUPERSEDED, reason="the service restarted")
        if record.state is MatrixState.APPLIED
        else record
        for record in _after_restart(records)[-references.RECORDS_KEPT :]
    )


def _after_restart(records: tuple[Sent, ...]) -> list[Sent]:
    return [
        replace(record, state=_RESTARTED[record.state], reason="the service restarted")
        if record.state in _RESTARTED
        else record
        for record in records
    ]


def saved_of(state: TrackerState, now_ns: int) -> Saved | None:
    """Return the part of a state that is saved; None if nothing is known yet, nor ordered."""
    registration, rtc = state.alpha.registration, state.loop.rtc
    acquisition, orders = acquisition_to_save(state), orders_of(state)
    if registration is not None:
        registration = replace(
            registration,
            bias=without_previous(registration.bias),
            # The window that would confirm or refute the jump belongs to the run that ends.
            suspected_jump=None,
            previous_estimate=None,
        )
    elif acquisition is None and state.alpha.offload is None and orders == Orders():
        return None
    return Saved(
        system=state.system,
        saved_ns_utc=now_ns,
        session=None if rtc is None else rtc.session,
        in_use=state.matrices.in_use,
        pointing=state.alpha.pointing,
        registration=registration,
        acquisition=acquisition,
        orders=None if orders == Orders() else orders,
        offload=state.alpha.offload,
        void_intervals=state.alpha.void_intervals,
        mode_proof=None if registration is None else mode_proof.proof_to_keep(state),
    )


def with_orders(left: Saved, state: TrackerState) -> Saved | None:
    """Return what was saved before, with what has been ordered since; None: it is that already.

    While nothing is known of α, what another night has left of it stays.
    """
    orders = orders_of(state)
    return None if (left.orders or Orders()) == orders else replace(left, orders=orders)


def resumed(state: TrackerState, saved: Saved, policy: Policy, now_ns: int) -> TrackerState:
    """Return the state with α restored, σ increased by the time away, and no confirming window.

    α is the start of fits and the reference for the verdict on the matrix in use; nothing is made
    from it until windows of this run agree. An acquisition that was under way is restored with it,
    and operators' orders hold, whatever becomes of α.
    """
    context = StepContext(state, policy, now_ns)
    if saved.orders is not None and saved.system == state.system:
        obey_orders(context, saved.orders)
        stopped = saved.orders.stopped
        context.operator = replace(context.operator, stopped_because=stopped)
        restore_records(context, saved.orders)
        references.restore_shape(context, saved.orders)
    if saved.system == state.system:
        validity.restore_intervals(context, saved.void_intervals)
    _take_over_alpha(context, saved, now_ns)
    if saved.offload is not None and saved.system == state.system:
        offload.restore_offload(context, saved.offload)
    derive_alarms(context)
    return context.state


def _in_present_mode(context: StepContext, saved: Saved) -> Saved:
    """Return what was saved in another mode of the sensor in the subapertures of the present."""
    registration, now = saved.registration, context.loop.config_id
    if registration is None or now is None or registration.config_id == now:
        return saved
    scale = context.policy.alpha_scale(registration.config_id, now)
    if scale is None:
        return saved
    # Modes were verified as another mode of the sensor sees them.
    return replace(
        saved, registration=validity.in_subapertures(registration, scale, now), mode_proof=None
    )


def _take_over_alpha(context: StepContext, saved: Saved, now_ns: int) -> None:
    saved = _in_present_mode(context, saved)
    reason = _why_not(context.state, saved, now_ns)
    if reason is not None:
        text = f"the α saved before the restart is not taken over: {reason}"
        context.warn("registration.not-restored", text)
        if saved.registration is not None:
            context.raise_alarm(NOT_RESTORED, text)
        validity.forget_registration(context)
        return
    if saved.acquisition is not None:
        restore_acquisition(context, saved.acquisition)
    registration = saved.registration
    if registration is not None:
        # The clock may have been set back meanwhile.
        away_s = max(now_ns - registration.arrived_ns_utc, 0) / SECOND_NS
        restored_now = replace(registration, n_windows=0, restored_ns_utc=now_ns)
        validity.store_registration(context, restored_now)
        text = f"α of {away_s:.0f} s ago; {saved.in_use or 'no known matrix'} was in use then"
        context.log("registration.restored", text)
        validity.age_registration(context)
    if saved.mode_proof is not None and saved.session is not None:
        mode_proof.restore_proof(context, saved.mode_proof, saved.session)


def drop_unconfirmed(context: StepContext) -> None:
    """Forget a restored α from which no window is found, or fits would begin there for ever."""
    known, misses = context.registration, context.acquisition.misses
    restored = known is not None and known.restored_ns_utc is not None and not known.n_windows
    if restored and misses >= MISSES_BEFORE_ACQUISITION:
        validity.forget_registration(context)
        text = f"the α from before the restart is dropped: {misses} windows were not found from it"
        context.raise_alarm(NOT_RESTORED, text)


def _why_not(state: TrackerState, saved: Saved, now_ns: int) -> str | None:
    if saved.system != state.system:
        return f"it is of system {saved.system}, this is {state.system}"
    ahead_s = (saved.saved_ns_utc - now_ns) / SECOND_NS
    if ahead_s > MAX_CLOCK_DIFFERENCE_S:
        return f"it was saved {ahead_s:.0f} s in the future: is this machine's clock right?"
    registration = saved.registration
    if registration is None:
        return None
    for name, found, expected in (
        ("basis", registration.basis_id, state.loop.basis_id),
        ("configuration", registration.config_id, state.loop.config_id),
    ):
        if expected is not None and found != expected:
            return f"it is of {name} {found}, the instrument file has {expected}"
    return None
