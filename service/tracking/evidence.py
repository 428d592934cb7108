"""Windows, and looks at ordinary telemetry, become the registration, or a reason why not.

One window far out may be a jump or a mistake. It is held, nothing is made from α meanwhile, and
the next window decides: one that agrees with it makes it a jump, one that agrees with all before
makes it an outlier. A jump that one window alone cannot tell from noise is told by two together.
Where windows scatter by more than they say, they must agree for longer than turbulence is alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.estimation import kalman
from service.estimation.kalman import Joint
from service.estimation.passive import PassiveEstimate
from service.estimation.random_dither import RandomEstimate
from service.estimation.windows import RefusalKind
from service.model.misregistration import Misregistration, step_text
from service.tracking import alarms, filtering, jumps, refusals, validity
from service.tracking import events as ev
from service.tracking.acquisition_stages import count_miss
from service.tracking.dither import found_again
from service.tracking.dither_plan import why_none as why_no_dither
from service.tracking.filtering import Folded, Measured
from service.tracking.jumps import Distance
from service.tracking.loop import loop_numbers, same_numbers
from service.tracking.policy import SECOND_NS
from service.tracking.registration import (
    Candidate,
    HistoryEntry,
    Reading,
    Registration,
    Seen,
    Source,
    Watchdog,
)
from service.tracking.state import Level, TrackerState
from service.tracking.turn import Turn

Array = NDArray[Any]

TOO_EARLY = (
    "it began before α came into doubt and agrees with what was known then: only one taken since "
    "can tell"
)


def on_window(turn: Turn, event: ev.WindowFitted) -> None:
    """Fold one window's estimate into the registration, or refuse it with its reason."""
    estimate = event.estimate
    when = validity.taken(event.began_ns_utc, estimate.t_ns_utc)
    why = filtering.why_no_window(turn, estimate, when)
    if why is not None:
        kind, reason = why
        refuse_window(turn, reason, kind)
        return
    refusals.use(turn)
    if validity.tells_of(turn.state, alarms.DITHER_LOST, when):
        found_again(turn)
    random = isinstance(estimate, RandomEstimate)
    for name in (alarms.MISALIGNED, *(() if random else (alarms.WRONG_ANSWER,))):
        if validity.tells_of(turn.state, name, when):
            turn.calm(name)
    known = turn.known
    modes, gains, gain_sigma = filtering.gains_of(estimate)
    measured = Measured(
        alpha=estimate.alpha,
        covariance=estimate.covariance,
        t_ns_utc=estimate.t_ns_utc,
        pointing=validity.pointing_at(turn.state, estimate.t_ns_utc),
        began_ns_utc=when.began_ns_utc,
        source=Source.RANDOM if random else Source.LOCK_IN,
        optical_gain=float(gains.mean()),
        optical_gains=filtering.followed_gains(
            () if known is None else known.optical_gains,
            modes,
            gains[: len(modes)],
            gain_sigma,
            estimate.t_ns_utc,
        ),
        floor=filtering.model_error_of(known, estimate, turn.policy),
        misfit=estimate.misfit,
    )
    enter(turn, measured)


def on_lost(turn: Turn, event: ev.WindowLost) -> None:
    """Count a window that nothing could be made of."""
    refuse_window(turn, event.refused.reason, event.refused.kind)


def refuse_window(turn: Turn, reason: str, kind: RefusalKind = RefusalKind.OTHER) -> None:
    """Count a window that gave nothing, and say why."""
    count_miss(turn, kind)
    if kind is RefusalKind.MISALIGNED:
        turn.alarm(alarms.MISALIGNED, reason)
    if kind is RefusalKind.MISTOLD:
        turn.alarm(alarms.WRONG_ANSWER, reason)
    level = Level.INFO if kind is RefusalKind.CUT_SHORT else Level.WARNING
    turn.log("window.refused", reason, level)
    refusals.refuse(turn, reason, kind)


def enter(turn: Turn, measured: Measured) -> None:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    known = turn.known
    if known is None:
        joint = kalman.begin_joint(measured.alpha.vector, measured.covariance)
        filtering.accept(turn, Folded(joint=joint, n_windows=1, innovation=0.0), measured)
        return
    first = jumps.window_before(known)
    both = jumps.pair_surprise(known, measured, turn.policy)
    if first is not None and both.far:
        if jumps.lasts(known, first, measured, both):
            _jump(turn, known, first, measured)
        else:
            _put_aside(turn, known, measured, both, first)
        return
    far = jumps.window_surprise(known, measured, turn.policy)
    if (
        known.doubt
        and not far.far
        and validity.precedes(turn.state, measured.when, known.doubted_ns_utc)
    ):
        refusals.count(turn)
        turn.log("window.refused", TOO_EARLY)
        return
    if known.candidate is not None:
        text = (
            f"the window {_away(known.candidate, known)} from α was not confirmed: the one after "
            f"it lies {_away(measured, known)} away"
        )
        n_outlying = turn.state.windows_outlying + 1
        turn.state = replace(turn.state, windows_outlying=n_outlying)
        turn.warn("window.outlier", text)
        known = replace(known, scatter=kalman.learnt(known.scatter, kalman.JUMP_THRESHOLD))
    if far.far:
        _put_aside(turn, known, measured, far)
        return
    prior = filtering.brought_forward(turn, known, measured.t_ns_utc)
    folded = Folded(
        joint=kalman.corrected(prior, measured.alpha.vector, measured.covariance),
        n_windows=filtering.counted(turn, known, prior),
        innovation=_innovation(prior, measured),
        scatter=kalman.learnt(known.scatter, far.innovation),
    )
    filtering.accept(turn, folded, measured)


def _put_aside(
    turn: Turn, known: Registration, measured: Measured, far: Distance, first: Seen | None = None
) -> None:
    """Put a window that is far out aside, and doubt α until another one has come.

    ``first``: the one before, which tells the same place; together they are so ``far``.
    """
    innovation = far.innovation
    text = (
        f"a window lies {_away(measured, known)} from α (innovation {innovation:.0f}, expected 4, "
        f"rotation {np.sqrt(far.rotation):.1f} sigma): the next one decides; nothing is made or "
        "sent meanwhile"
    )
    candidate = Candidate(
        alpha=measured.alpha,
        covariance=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        held_ns_utc=turn.now_ns,
        began_ns_utc=(first or measured).began_ns_utc,
    )
    doubt = "a jump is suspected"
    validity.hold(turn, replace(_doubted(known, doubt, measured.t_ns_utc), candidate=candidate))
    filtering.remember(turn, filtering.entry_of(measured, known, innovation, entered=False))
    if first is None or known.candidate is None:
        turn.warn("registration.jump-suspected", text)
    turn.alarm(alarms.SUSPECTED, text)
    validity.want_window(turn, doubt)
    validity.age(turn)


def _jump(turn: Turn, known: Registration, first: Seen, measured: Measured) -> None:
    """Go to the new place, which two windows have now seen.

    The first of them is used if it is wholly of the new place.
    """
    policy = turn.policy
    prior = filtering.brought_forward(turn, known, measured.t_ns_utc)
    noise = measured.covariance
    whole = jumps.wholly_after(first, measured, known.alpha, policy)
    if whole:
        elapsed_s = max(measured.t_ns_utc - first.t_ns_utc, 0) / SECOND_NS
        noise = first.covariance + np.diag(policy.drift_rate**2 * elapsed_s)
    joint = kalman.widened(prior, noise)
    if whole:
        joint = kalman.corrected(joint, first.alpha.vector, noise)
    folded = Folded(
        joint=kalman.corrected(joint, measured.alpha.vector, measured.covariance),
        n_windows=2 if whole else 1,
        innovation=_innovation(prior, measured),
        scatter=known.scatter,
        jumped=True,
    )
    validity.hold(turn, replace(known, passive_after_ns_utc=first.t_ns_utc))
    both = whole and known.candidate is not None
    filtering.accept(turn, folded, measured, n_accepted=2 if both else 1)
    turn.warn("registration.jump", f"jumped by {_away(measured, known)}, as two windows have seen")


def _doubted(known: Registration, doubt: str, since_ns_utc: int) -> Registration:
    """Return what is known in doubt, not since earlier than it already is."""
    since_ns = max(known.doubted_ns_utc if known.doubt else 0, since_ns_utc)
    return replace(known, doubt=doubt, doubted_ns_utc=since_ns, doubt_voids=True)


def _innovation(prior: Joint, measured: Measured) -> float:
    return kalman.innovation(prior, measured.alpha.vector, measured.covariance)


def _away(seen: Seen, known: Registration) -> str:
    return step_text(seen.alpha.vector - known.alpha.vector)


def on_watchdog(turn: Turn, event: ev.Watched) -> None:
    """Fold the passive estimate in, its bias allowed for, or doubt α where it does not fit."""
    reason = _why_no_look(turn.state, event) or _why_known_already(turn.state, event)
    if reason is not None:
        cannot_watch(turn, f"a look was not used: {reason}")
        return
    known, estimate = turn.known, event.estimate
    if known is None:
        _show_alone(turn, event)
        return
    known = _expecting(known, estimate.bias_excess)
    forward = filtering.brought_forward(turn, known, event.t_ns_utc)
    prior = kalman.allowing(forward, estimate.bias_excess)
    if _mixed(known):
        text = "not used: its telemetry may be from both sides of a jump"
        bias = filtering.bias_of(
            filtering.joint_of(known), event.t_ns_utc, _loop(turn.state, known)
        )
        validity.hold(turn, replace(known, bias=bias))
        _show(turn, event, _reading_sigma(estimate, prior), prior.bias, text)
        return
    measured = estimate.alpha.vector
    reading = Reading(
        alpha=estimate.alpha,
        covariance=prior.scatter * estimate.covariance,
        t_ns_utc=event.t_ns_utc,
        pointing=validity.pointing_at(turn.state, event.t_ns_utc),
    )
    far = jumps.look_surprise(known, filtering.joint_of(known), reading, turn.policy)
    if far > jumps.LOOK_LIMIT:
        _ask_for_window(turn, known, event, prior, far)
        return
    joint = kalman.scattered(
        kalman.corrected(prior, measured, estimate.covariance, kalman.PASSIVE), far
    )
    registration = _after_look(turn, known, joint, event)
    validity.hold(turn, registration)
    validity.age(turn)
    sigma = _reading_sigma(estimate, prior)
    entry = HistoryEntry(
        t_ns_utc=event.t_ns_utc,
        measured=Misregistration.from_vector(measured - joint.bias),
        measured_sigma=sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.sigma,
        innovation=kalman.innovation(prior, measured, estimate.covariance, kalman.PASSIVE),
        misfit=estimate.misfit,
        source=Source.PASSIVE,
    )
    filtering.remember(turn, entry)
    _show(turn, event, sigma, joint.bias, "agrees with α and with what is known of its own bias")


def cannot_watch(turn: Turn, why: str) -> None:
    """Note why ordinary telemetry says nothing of α now."""
    turn.state = replace(turn.state, unwatched=why)


def fit_begins_at(state: TrackerState) -> Misregistration | None:
    """Return about what a look is to be fitted: α, or the last look; None: the nominal rotation."""
    if state.registration is not None:
        return state.registration.alpha
    last = state.watchdog
    return last.alpha if last is not None and np.isfinite(last.sigma).all() else None


def _why_no_look(state: TrackerState, event: ev.Watched) -> str | None:
    """Return why a look says nothing of the telescope as it is, or None."""
    of_loop = loop_numbers(state.rtc)
    if event.loop and of_loop and not same_numbers(event.loop, of_loop):
        return "the loop has changed since"
    return filtering.why_no_measurement(state, validity.taken(event.began_ns_utc, event.t_ns_utc))


def _why_known_already(state: TrackerState, event: ev.Watched) -> str | None:
    """Return which later telemetry has told more than a look that was long under way, or None."""
    known = state.registration
    if known is None or not known.window_began_ns_utc:
        return None
    since = validity.taken(known.window_began_ns_utc, known.window_began_ns_utc)
    if validity.precedes(state, since, event.t_ns_utc):
        return None
    return "a dithered window taken since has been fitted before it"


def _show_alone(turn: Turn, event: ev.Watched) -> None:
    """Show a look while α is not known: it is all there is, and no more than it says it is."""
    step = event.estimate.alpha.vector - turn.policy.start.vector
    if np.any(np.abs(step) > filtering.CAPTURE_RANGE):
        text = (
            f"it cannot tell: {event.estimate.alpha.to_boundary()} is too far from where its fit "
            "begins, the nominal rotation; let the service acquire, or dither"
        )
        _show(turn, event, np.full(4, np.inf), np.zeros(4), text)
        return
    text = "no dithered estimate to compare with: nothing is made from this reading alone"
    _show(turn, event, event.estimate.sigma, np.zeros(4), text)


def _expecting(known: Registration, excess: Array) -> Registration:
    """Return what is known with the bias as large as the first look at it says that it may be.

    A later look that says more is allowed for by the filter alone: whether the mirror has jumped is
    told with less patience.
    """
    if known.bias is not None and known.bias.looked_ns_utc:
        return known
    return replace(
        known, bias=filtering.bias_of(kalman.forgotten(filtering.joint_of(known), excess), 0, ())
    )


def _loop(state: TrackerState, known: Registration) -> tuple[float, ...]:
    """Return the loop that is looked at; while no RTC is there, the one of the last look."""
    if state.rtc is not None:
        return loop_numbers(state.rtc)
    return () if known.bias is None else known.bias.loop


def _mixed(known: Registration) -> bool:
    """Return whether a look may be at telemetry from before a jump and from after it.

    It began no earlier than the one before it ended.
    """
    began_ns_utc = known.bias.looked_ns_utc if known.bias is not None else 0
    jumped_ns_utc = known.passive_after_ns_utc
    return known.candidate is not None or (jumped_ns_utc > 0 and began_ns_utc < jumped_ns_utc)


def _ask_for_window(
    turn: Turn, known: Registration, event: ev.Watched, prior: Joint, far: float
) -> None:
    """Forget the bias and want a dithered window: the wind has changed or the mirror has moved.

    A look alone is no match for windows: α stays valid, and nothing is made or sent until a window
    taken since has told. It is an alarm where none can, or none has when a second look disagrees.
    """
    text = (
        "ordinary telemetry disagrees: the wind has changed or the mirror has moved, and a "
        "dithered window must tell which"
    )
    known = turn.known or known
    waits, void = bool(known.doubt), bool(known.doubt) and known.doubt_voids
    why_none = None if turn.rtc is None else why_no_dither(turn, turn.rtc)
    gone = kalman.forgotten(prior, event.estimate.bias_excess)
    after = _after_look(turn, known, gone, event)
    bias = filtering.bias_of(gone, event.t_ns_utc, _loop(turn.state, known))
    doubted = replace(_doubted(after, text, event.t_ns_utc), bias=bias, doubt_voids=void)
    validity.hold(turn, doubted)
    turn.warn("registration.passive-jump", f"{text} (innovation {far:.0f}, expected 4)")
    validity.want_window(turn, text)
    if why_none is not None or waits:
        cannot = "none has since the last look that did" if why_none is None else why_none
        turn.alarm(alarms.DISAGREES, f"{text}: {cannot}; α stands as windows have it")
    validity.age(turn)
    _show(turn, event, event.estimate.sigma, np.zeros(4), text, consistent=False)


def _after_look(turn: Turn, known: Registration, joint: Joint, event: ev.Watched) -> Registration:
    """Return the registration as the filter has it after a look."""
    loop = _loop(turn.state, known)
    return replace(
        known,
        alpha=Misregistration.from_vector(joint.alpha),
        covariance=joint.alpha_covariance,
        t_ns_utc=max(event.t_ns_utc, known.t_ns_utc),
        arrived_ns_utc=turn.now_ns,
        bias=filtering.bias_of(
            joint, event.t_ns_utc, loop, jumps.sum_of(known, filtering.joint_of(known))
        ),
        pointing=validity.pointing_at(turn.state, event.t_ns_utc),
    )


def _reading_sigma(estimate: PassiveEstimate, prior: Joint) -> Array:
    """Return ``(4,)`` 1 σ of the estimate as a reading of α: its scatter, and that of its bias."""
    return np.sqrt(np.diag(estimate.covariance) + np.diag(prior.covariance)[4:])


def _show(
    turn: Turn,
    event: ev.Watched,
    sigma: Array,
    bias: Array,
    text: str,
    *,
    consistent: bool = True,
) -> None:
    watchdog = Watchdog(
        alpha=event.estimate.alpha,
        sigma=sigma,
        misfit=event.estimate.misfit,
        t_ns_utc=event.t_ns_utc,
        consistent=consistent,
        text=text,
        bias=bias,
    )
    turn.state = replace(turn.state, watchdog=watchdog, unwatched="")
