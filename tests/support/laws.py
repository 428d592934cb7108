"""What tests of several modules share of properties.test_tracker_laws."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
from hypothesis import HealthCheck, settings

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import WindowRefused
from service.records.operations import MeasurementRecord, MeasureState
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracker import step
from service.wire import (
    DitherRequest,
    LoopRequest,
    MeasureRequest,
    Pattern,
    RampRequest,
    Reply,
    Status,
)
from tests.support.situations import (
    ALPHA,
    POLICY,
    START_NS,
    acknowledged,
    dither_answered,
    estimate,
    foreign,
    judged,
    loop_answered,
    moved,
    record,
    rtc,
    verdict,
)
from tests.support.states import tracker_state

MEASURED = ["im-1", "im-2", "im-3", "im-4"]


IDS = ["initial", "cm-1", "cm-2", "cm-3", "cm-4"]


SESSIONS = ["s1", "s2"]


TROUBLES = [
    "second-rtc",
    "basis-mismatch",
    "instrument-mismatch",
    "loop-diverging",
    "edge-slip",
    "commands-off-loop",
    "other",
]


COMMANDS = (
    cmd.SetMode,
    cmd.Refit,
    cmd.StartDither,
    cmd.StopDither,
    cmd.Approve,
    cmd.Reject,
    cmd.Publish,
    cmd.Rollback,
    cmd.Measure,
    cmd.GiveUp,
    cmd.SetLoop,
    cmd.Ramp,
)


ids = st.sampled_from(IDS)


statuses = st.builds(
    rtc,
    n_controlled=st.sampled_from([300, 400, 500, 594]),
    session=st.sampled_from(SESSIONS),
    loop=st.sampled_from(["open", "closed", "closed", "closed", "partial"]),
    cm_id=st.one_of(st.none(), ids),
    dither_id=st.sampled_from([None, "dither-1", "other"]),
)


windows = st.builds(
    lambda x, session, dt, lag: ev.WindowFitted(
        estimate=estimate(
            moved(ALPHA, shift_x_subap=x),
            session=session,
            t_ns=START_NS + dt,
            lag_frames=np.full(4, lag),
        )
    ),
    x=st.sampled_from([0.0, 0.0, 0.001, 0.05, 0.3, 2.0]),
    session=st.sampled_from(SESSIONS),
    dt=st.integers(-(10**12), 10**12),
    lag=st.sampled_from([0.0, 0.0, 0.0, 0.5]),
)


commands = st.one_of(
    st.builds(cmd.SetMode, mode=st.sampled_from(list(Mode))),
    st.builds(cmd.Refit, n_modes=st.sampled_from([None, 0, 1, 400, 594, 595])),
    st.builds(
        cmd.StartDither,
        modes=st.sampled_from([None, (501,), (501, 502), (700,)]),
        amplitude_m=st.sampled_from([None, 1e-9, 2e-8]),
        over_budget=st.booleans(),
    ),
    st.builds(
        cmd.StartDither,
        modes=st.sampled_from([(501,), (700,)]),
        frequency_hz=st.sampled_from([(250.0,), (1.0,)]),
    ),
    st.just(cmd.StopDither()),
    st.builds(cmd.Approve, id=ids),
    st.builds(cmd.Reject, id=ids),
    st.builds(cmd.Publish, id=ids),
    st.just(cmd.Rollback()),
    st.builds(
        cmd.Measure,
        id=st.sampled_from(MEASURED),
        pattern=st.sampled_from([Pattern.PUSH_PULL_MODAL, Pattern.SINE]),
        modes=st.sampled_from([None, (3, 9), (594,)]),
    ),
    st.builds(cmd.GiveUp, id=st.sampled_from(MEASURED)),
    st.builds(
        cmd.SetLoop,
        loop=st.sampled_from(["open", "closed"]),
    ),
    st.builds(
        cmd.SetLoop,
        leak=st.sampled_from([None, 0.99]),
        gains=st.sampled_from([None, (cmd.GainGroup(first=0, last=299, gain=0.3),)]),
        n_controlled=st.sampled_from([300, 595]),
    ),
    st.builds(cmd.Ramp, groups=st.sampled_from([None, (cmd.ModeGroup(first=0, last=400),)])),
)


heard = st.one_of(
    st.just(ev.Tick()),
    statuses,
    statuses,
    windows,
    windows,
    st.builds(ev.SessionStarted, session=st.sampled_from(SESSIONS)),
    st.just(ev.RtcVanished()),
    st.builds(
        ev.ConditionChanged,
        name=st.sampled_from(TROUBLES),
        text=st.just("found"),
        over=st.booleans(),
    ),
    st.builds(ev.LogEvent, name=st.just("n"), text=st.text(max_size=3)),
    st.just(ev.WindowLost(refused=WindowRefused(reason="r", t_ns_utc=START_NS))),
    st.builds(
        lambda name, passed: ev.MarginJudged(id=name, verdict=verdict(accepted=passed)),
        ids,
        st.booleans(),
    ),
    st.builds(
        acknowledged,
        name=st.sampled_from([*IDS, "never-sent"]),
        state=st.sampled_from([MatrixState.STAGED, MatrixState.APPLIED, MatrixState.REJECTED]),
        reason=st.just("r"),
        frame_seq=st.none() | st.integers(0, 10**6),
    ),
    st.builds(
        ev.DitherSilent,
        id=st.sampled_from(["dither-1", "other"]),
        silent_s=st.sampled_from([1.0, 2.0, 100.0]),
    ),
    st.builds(lambda name: ev.MatrixFetched(record=foreign(name)), ids),
    st.builds(
        lambda name, state, reason: ev.MatrixMeasured(
            record=MeasurementRecord(
                id=name,
                state=state,
                pattern=Pattern.PUSH_PULL_MODAL,
                modes=(0, 1),
                amplitude_m=(1e-8, 1e-8),
                n_average=1,
                reason=reason,
            )
        ),
        st.sampled_from([*MEASURED, "im-other"]),
        st.sampled_from([MeasureState.STORED, MeasureState.STORED, MeasureState.FAILED]),
        st.just("r"),
    ),
)


class Night:
    """Plays a story; what the tracker asks for waits until the story answers it.

    It begins where most nights are: a closed loop, its matrix known, α from two windows.
    """

    def __init__(self, mode=Mode.AUTO):
        self.state = tracker_state(system="flao", mode=mode)
        self.now_ns = START_NS
        self.open = []
        self.n_made = 0
        self.last = ()
        self.tell(ev.SessionStarted(session="s1"), 0.0)
        self.tell(rtc(), 0.0)
        self.tell("done", 0.1)
        for _ in range(2):
            self.tell(ev.WindowFitted(estimate=estimate(t_ns=self.now_ns)), 4.0)

    def tell(self, event, after_s):
        self.now_ns += round(after_s * 1e9)
        if isinstance(event, str):
            event = self.answer(event)
            if event is None:
                self.last = ()
                return
        if isinstance(event, Status):
            event = replace(event, t_ns=self.now_ns)
        try:
            self.state, self.last = step(self.state, event, POLICY, self.now_ns)
        except CommandError:
            assert isinstance(event, COMMANDS)
            self.last = ()
        self.open += self.last

    def answer(self, how):
        """The world answers the oldest thing that was asked of it."""
        if not self.open:
            return None
        effect = self.open.pop(0)
        if how == "failed":
            return ev.JobFailed(effect=effect, text="it could not be done")
        return self.of_the_rtc(effect, how) or self.of_matrices(effect, how)

    def of_the_rtc(self, effect, how):
        accepted = how == "done"
        match effect:
            case ev.Ask(request=DitherRequest(id=name)):
                return dither_answered(
                    name, accepted=accepted, reason="r", start_seq=5 if accepted else None
                )
            case ev.Ask(request=MeasureRequest() as asked):
                reply = Reply(id=asked.id, accepted=accepted, reason="", start_seq=9)
                return ev.Answered(request=asked, reply=reply)
            case ev.Ask(request=LoopRequest(id=command) | RampRequest(id=command)):
                return loop_answered(command, accepted=accepted, reason="r")
            case _:
                return None

    def judged(self, n_modes):
        """What a verdict given now would be of."""
        registration, view = self.state.alpha.registration, self.state.loop.rtc
        return None if registration is None or view is None else judged(registration, view, n_modes)

    def of_matrices(self, effect, how):
        match effect:
            case ev.MakeMatrix() | ev.RepublishMatrix() as asked:
                self.n_made += 1
                state = MatrixState.REFUSED if how == "refused" else MatrixState.PROPOSED
                n = asked.n_modes if isinstance(asked, ev.MakeMatrix) else 400
                made = record(
                    f"made-{self.n_made}",
                    state,
                    n_modes=n,
                    created_ns_utc=self.now_ns,
                    judged=self.judged(n),
                )
                return ev.MatrixMade(record=made, wanted=isinstance(asked, ev.RepublishMatrix))
            case ev.FetchMatrix(id=matrix_id):
                return ev.MatrixFetched(record=foreign(matrix_id or "initial"))
            case ev.JudgeMatrix(id=matrix_id):
                return ev.MarginJudged(id=matrix_id, verdict=verdict(accepted=how == "done"))
            case ev.JudgeProposal(id=matrix_id, gains=gains):
                found = self.judged(len(gains))
                if found is None:
                    return ev.JobFailed(effect=effect, text="α is not known")
                passed = verdict(accepted=how == "done")
                return ev.ProposalJudged(id=matrix_id, verdict=passed, judged=found)
            case ev.SendMatrix(id=matrix_id):
                done = MatrixState.APPLIED if how == "done" else MatrixState.REJECTED
                session = "s1" if self.state.loop.rtc is None else self.state.loop.rtc.session
                return acknowledged(matrix_id, state=done, reason="r", frame_seq=1, session=session)
            case _:
                return None


LAWS = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
