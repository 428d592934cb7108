"""Situations as values: an RTC, windows, reconstructors, and a story to tell them in."""

from dataclasses import replace

import numpy as np

from pyrcal.client.remote import REQUESTS
from service.config import load_settings
from service.errors import CommandError
from service.estimation.loop import select_gains
from service.model.misregistration import Misregistration
from service.records import events as ev
from service.records.estimates import LockInEstimate
from service.records.operations import Dither
from service.records.products import (
    GateVerdict,
    Judged,
    MatrixState,
    ModeProof,
    ReconstructorRecord,
)
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.tracker import step
from service.tracking.step_context import StepContext
from service.wire import (
    Acknowledgement,
    AckState,
    DitherKind,
    DitherRequest,
    DitherStatus,
    DitherStop,
    Loop,
    LoopRequest,
    Reply,
    Status,
)
from tests.support.states import changed, tracker_state

ORDERS = {request.name for request in REQUESTS} | {"acquisition", "loop", "noisy matrix", "ramp"}
SECOND = 1_000_000_000
START_NS = 1_800_000_000 * SECOND
N_MODES = 594
PRECISE = np.diag([0.002, 0.002, 5e-5, 2e-4]) ** 2
POLICY = replace(
    policy_of(load_settings(None, {})),
    acquires=False,
    flexure_per_degree=np.zeros(4),
    drift_rate=np.array([0.006, 0.006, 1e-4, 6e-5]),
    floor=np.array([0.003, 0.003, 9e-5, 3e-4]),
    update_threshold=np.array([0.01, 0.01, np.deg2rad(0.02), 0.001]),
)
ALPHA = Misregistration(
    shift_x_subap=0.12, shift_y_subap=-0.08, rotation_rad=np.deg2rad(0.2), magnification=1.003
)


def rtc(n_controlled=400, **changes):
    values = {
        "session": "s1",
        "seq": None,
        "loop": Loop.CLOSED,
        "frame_rate_hz": 1000.0,
        "delay_frames": 2.0,
        "leak": 0.999,
        "gains": (0.4,) * n_controlled + (0.0,) * (N_MODES - n_controlled),
        "n_controlled": n_controlled,
        "n_modes": N_MODES,
        "n_slopes": 1384,
        "cm_id": "initial",
        "basis_id": "kl-594",
        "config_id": "pyramid-30",
        "magnitude": 8.0,
        "max_dither_m": 5e-8,
        "max_dither_modes": 594,
        "dither": None,
        "t_ns": START_NS,
    } | changes
    if values.get("dither_id") is not None:
        values["dither"] = DitherStatus(request=dither_request(values["dither_id"]), start_seq=0)
    values.pop("dither_id", None)
    if isinstance(values["dither"], Dither):
        dither = values["dither"]
        values["dither"] = DitherStatus(request=dither.request, start_seq=dither.start_seq)
    return Status(**(values | {"loop": Loop(values["loop"])}))


def dither_request(name, **changes):
    """A dither that nobody can read: of its id alone it is somebody's."""
    values = {"kind": DitherKind.BINARY, "modes": (3,), "amplitude_m": (1e-9,), "duration_s": 60.0}
    return DitherRequest(id=name, **(values | {"seed": 1} | changes))


def dither_answered(name, *, accepted, reason="", start_seq=None):
    """What the RTC says to a dither."""
    reply = Reply(id=name, accepted=accepted, reason=reason, start_seq=start_seq)
    return ev.Answered(request=dither_request(name), reply=reply)


def loop_answered(name, *, accepted, reason=""):
    """What the RTC says to a change of its loop."""
    reply = Reply(id=name, accepted=accepted, reason=reason, start_seq=None)
    return ev.Answered(request=LoopRequest(id=name), reply=reply)


def acknowledged(name, *, state, reason="", frame_seq=None, sha256=None, session="s1"):
    """The RTC's word on a reconstructor."""
    return Acknowledgement(
        id=name,
        state=AckState(state),
        reason=reason,
        frame_seq=frame_seq,
        sha256=sha256,
        session=session,
    )


def stopping(story):
    """The wish that no dither plays, at this time of a story."""
    return ev.Ask(request=DitherStop(id=f"stop-{story.now_ns}"))


def verdict(*, accepted=True, radius=0.7):
    return GateVerdict(
        accepted=accepted,
        worst_pole_radius=radius,
        aligned_pole_radius=0.65,
        bound=0.95,
        n_points=9,
        reason="stable" if accepted else "too little margin",
    )


def judged(known, view, n_modes=400, **changes):
    """What a verdict given now is of."""
    values = {
        "session": view.session,
        "gains": select_gains(view, n_modes),
        "leak": view.leak,
        "delay_frames": view.delay_frames,
        "alpha": known.alpha,
        "sigma": known.sigma,
    }
    return Judged(**(values | changes))


def record(matrix_id, state=MatrixState.PROPOSED, **changes):
    """A reconstructor the service made for ``ALPHA``."""
    values = {
        "id": matrix_id,
        "state": state,
        "n_modes": 400,
        "created_ns_utc": START_NS,
        "alpha": ALPHA,
        "sigma": np.array([0.003, 0.003, 9e-5, 3e-4]),
        "parent": "initial",
        "gate": verdict(accepted=state is not MatrixState.REFUSED),
    }
    return ReconstructorRecord(**(values | changes))


def foreign(matrix_id="initial", n_modes=400):
    """What the RTC brought: nobody can say for which registration."""
    return ReconstructorRecord(
        id=matrix_id, state=MatrixState.APPLIED, n_modes=n_modes, created_ns_utc=START_NS
    )


def estimate(alpha=ALPHA, *, t_ns=START_NS, session="s1", **changes):
    values = {
        "alpha": alpha,
        "covariance": PRECISE,
        "optical_gain": np.full(4, 0.6 + 0.0j),
        "lag_frames": np.zeros(4),
        "misfit": 1.0,
        "step": np.zeros(4),
        "t_ns_utc": t_ns,
        "cm_id": "initial",
        "session": session,
    }
    return LockInEstimate(**(values | changes))


def moved(alpha=ALPHA, **by):
    """A registration some way from another, in the numeric units of its fields."""
    return replace(alpha, **{name: getattr(alpha, name) + step for name, step in by.items()})


def turned(state, act, *args, now_ns=START_NS, **kwargs):
    """The state after something was done to it while an event was worked out."""
    context = StepContext(state, POLICY, now_ns)
    act(context, *args, **kwargs)
    return context.state


ALL_SHOWN = ModeProof(proven=frozenset(range(N_MODES)))
"""Each mode has been seen to answer."""


class Story:
    """Tells events to the tracker one after another and keeps everything it wanted done.

    Its RTC holds what it should: asked for a matrix that the service knows, it ``shows`` that.
    """

    shows = True
    all_shown = True
    """Whether each mode of a new session has been seen already: what is told is of other things."""

    def __init__(self, mode=Mode.AUTO, policy=POLICY, state=None):
        proof = ALL_SHOWN if self.all_shown else ModeProof()
        self.state = state or tracker_state(system="flao", mode=mode, mode_proof=proof)
        self.policy = policy
        self.now_ns = START_NS
        self.effects = []

    def tell(self, event, after_s=0.0, cause=""):
        """Let time pass, then something happen; return what is to be done about it."""
        self.now_ns += round(after_s * SECOND)
        if isinstance(event, Status) and event.t_ns == START_NS:
            event = replace(event, t_ns=self.now_ns)
        try:
            self.state, effects = step(self.state, event, self.policy, self.now_ns, cause)
        except CommandError as refusal:
            first = str(refusal).partition(": ")[0]
            if first in {type(event).__name__, *ORDERS}:
                raise AssertionError(f"who is refused has said what: {refusal}") from refusal
            raise
        if self.all_shown and isinstance(event, ev.SessionStarted):
            self.state = changed(self.state, mode_proof=ALL_SHOWN)
        self.effects += effects
        for effect in effects if self.shows else ():
            known = isinstance(effect, ev.FetchMatrix) and self.state.reconstructor(effect.id or "")
            if known:
                effects += self.tell(ev.MatrixFetched(record=known), cause=effect.cause)
        return effects

    def wait(self, seconds, every_s=1.0):
        """Let time pass with nothing but the clock ticking; return what it made the service do."""
        effects = ()
        for _ in range(round(seconds / every_s)):
            effects += self.tell(ev.Tick(), every_s)
        return effects

    def meet(self, **changes):
        """Meet an RTC whose matrix is then known."""
        self.tell(ev.SessionStarted(session=changes.get("session", "s1")))
        self.tell(rtc(**changes))
        view = self.state.loop.rtc
        if view.cm_id is not None and self.state.reconstructor(view.cm_id) is None:
            self.tell(ev.MatrixFetched(record=foreign(view.cm_id, view.n_controlled)))
        self.tell(ev.Tick(), after_s=3)  # a fetch keeps other questions back for so long
        return self

    def see(self, alpha=ALPHA, n_windows=1, every_s=2.0, **changes):
        """Take in windows that measure this registration; return what they made it do."""
        effects = ()
        for _ in range(n_windows):
            self.now_ns += round(every_s * SECOND)
            fitted = estimate(
                alpha, t_ns=self.now_ns, session=self.state.loop.rtc.session, **changes
            )
            effects += self.tell(ev.WindowFitted(estimate=fitted))
        return effects

    def make(self, matrix_id, state=MatrixState.PROPOSED, *, wanted=False, **changes):
        """Hand in a reconstructor, made for the current registration."""
        registration, view = self.state.alpha.registration, self.state.loop.rtc
        changes = {
            "created_ns_utc": self.now_ns,
            "alpha": registration and registration.alpha,
        } | changes
        if view is not None and registration is not None:
            n_modes = changes.get("n_modes", 400)
            changes = {"judged": judged(registration, view, n_modes)} | changes
        made = record(matrix_id, state, **changes)
        return self.tell(ev.MatrixMade(record=made, wanted=wanted))

    def acknowledge(self, matrix_id, state=MatrixState.APPLIED, reason="", frame_seq=1000):
        session = "s1" if self.state.loop.rtc is None else self.state.loop.rtc.session
        return self.tell(
            acknowledged(
                matrix_id, state=state, reason=reason, frame_seq=frame_seq, session=session
            )
        )

    def use(self, matrix_id, n_modes=400):
        """Make, send and apply a reconstructor; the RTC's status follows."""
        self.make(matrix_id, wanted=True, n_modes=n_modes)
        self.acknowledge(matrix_id)
        self.tell(replace(rtc(n_modes), cm_id=matrix_id))
        return self

    def asked(self, kind):
        """Return all effects, or requests to the RTC, of one kind so far."""
        return of_kind(self.effects, kind)

    def matrix_state(self, matrix_id):
        return self.state.reconstructor(matrix_id).state

    @property
    def alarms(self):
        return {alarm.name for alarm in self.state.alarms.active}

    @property
    def logged(self):
        return [entry.name for entry in self.state.log]


def of_kind(effects, kind):
    """Effects, or requests to the RTC, of one kind."""
    wanted = [effect.request if isinstance(effect, ev.Ask) else effect for effect in effects]
    return [effect for effect in wanted if isinstance(effect, kind)]
