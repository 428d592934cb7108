"""A story in which the world answers: an RTC that does as it is told, a worker that is quick."""

from dataclasses import replace

from service.records import events as ev
from service.records.estimates import WideCaptureEstimate
from service.records.operations import MeasureState, NoisyFinding
from service.records.products import MatrixState
from service.records.state import Mode
from service.wire import (
    DitherRequest,
    DitherStatus,
    DitherStop,
    Loop,
    LoopRequest,
    MeasureRequest,
    RampRequest,
    Reply,
)
from tests.support.situations import (
    ALPHA,
    N_MODES,
    POLICY,
    PRECISE,
    SECOND,
    START_NS,
    Story,
    acknowledged,
    dither_answered,
    estimate,
    foreign,
    judged,
    loop_answered,
    record,
    rtc,
    verdict,
)

RATE_HZ = 1000
MEASURES_FOR_S = 6.0
WINDOW_S = 2.0
STEP_S = 0.5


class World(Story):
    """Time passes in steps of half a second; in each the RTC tells its status.

    It plays dithers for as long as was asked, measures for ``MEASURES_FOR_S``, refuses what the
    wire's busy is for, and begins a session whenever the loop opens or a measurement ends.
    """

    def __init__(self, mode=Mode.AUTO, policy=POLICY, **changes):
        super().__init__(mode, policy)
        self.session = 1
        self.changes = changes
        self.n_controlled = 400
        self.gains = 0.4
        self.loop = "closed"
        self.cm_id = "initial"
        self.playing = None
        self.ramp_until_ns = 0
        self.measured = None
        self.pending = []
        self.n_made = 0
        self.told = []
        self.since_window_s = 0.0
        self.tell(ev.SessionStarted(session="s1"))
        self.pass_(4.0)

    def __copy__(self):
        """Return a world that goes on by itself: states are frozen, the lists are not."""
        other = object.__new__(type(self))
        other.__dict__ |= self.__dict__
        other.effects, other.pending, other.told = [*self.effects], [*self.pending], [*self.told]
        return other

    @property
    def seq(self):
        return (self.now_ns - START_NS) * RATE_HZ // SECOND

    def status(self):
        open_loop = self.loop == "open"
        gains = (0.0,) * N_MODES
        if not open_loop:
            gains = (self.gains,) * self.n_controlled + (0.0,) * (N_MODES - self.n_controlled)
        seen = {
            "session": f"s{self.session}",
            "loop": self.loop,
            "gains": gains,
            "n_controlled": self.n_controlled,
            "cm_id": self.cm_id,
            "dither": self.playing,
            "seq": self.seq,
            "t_ns": self.now_ns,
        }
        return rtc(**(seen | self.changes))

    def tell(self, event, after_s=0.0, cause=""):
        effects = super().tell(event, after_s, cause)
        self.pending += effects
        return effects

    def pass_(self, seconds):
        """Let time pass, and the world answer."""
        for _ in range(round(seconds / STEP_S)):
            self.now_ns += round(STEP_S * SECOND)
            waiting, self.pending = self.pending, []
            for effect in waiting:
                for event in self.answers(effect):
                    self.tell(event, cause=effect.cause)
            self.go_on()
            self.tell(self.status())
            self.tell(ev.Tick())
        return self

    def go_on(self):
        """What the RTC has begun goes on, and ends."""
        dither = self.playing
        if dither is not None:
            over = dither.start_seq + round(dither.request.duration_s * RATE_HZ)
            if self.seq >= over:
                self.playing = None
        if self.measured is not None and self.now_ns >= self.measured[1]:
            done, _ = self.measured
            self.measured = None
            self.begin_session(done.opens_loop)
            if done.opens_loop and done.closed_before:
                self.loop = "closed"
            stored = replace(done, state=MeasureState.STORED, start_seq=9, n_slopes=1384)
            self.tell(ev.MatrixMeasured(record=stored))
        self.windows()

    def windows(self):
        """A window ends every two seconds of a dither that is read."""
        self.since_window_s = 0.0 if self.playing is None else self.since_window_s + STEP_S
        if self.since_window_s < WINDOW_S + STEP_S or self.state.dithers.dither is None:
            return
        self.since_window_s = STEP_S
        fitted = estimate(ALPHA, t_ns=self.now_ns, session=f"s{self.session}")
        if self.state.operations.acquisition.uses_wide_capture:
            far = replace(fitted, modes=self.playing.request.modes, covariance=1e2 * PRECISE)
            self.tell(
                ev.WideCaptureFitted(
                    found=WideCaptureEstimate(estimate=far, unexplained=0.05, n_starts=1)
                )
            )
        elif self.loop != "open":
            self.tell(ev.WindowFitted(estimate=fitted))

    def begin_session(self, begins=True):
        if begins:
            self.session += 1
            self.playing = None
            self.ramp_until_ns = 0
            self.tell(ev.SessionStarted(session=f"s{self.session}"))

    @property
    def busy(self):
        """Why the mirror or the loop cannot be had, in the wire's words."""
        if self.now_ns < self.ramp_until_ns:
            return "busy: ramp"
        return "" if self.measured is None else "busy: measuring"

    def answers(self, effect):
        """The world's answers to something that was asked of it."""
        self.told.append(effect)
        match effect:
            case ev.Ask(request=DitherRequest() as asked):
                busy = self.busy or ("busy: dither" if self.playing is not None else "")
                if not busy:
                    self.playing = DitherStatus(request=asked, start_seq=self.seq + 1)
                start = None if busy else self.seq + 1
                yield dither_answered(asked.id, accepted=not busy, reason=busy, start_seq=start)
            case ev.Ask(request=DitherStop()):
                self.playing = None
            case ev.Ask(request=LoopRequest() | RampRequest() as asked):
                yield from self.of_the_loop(asked)
            case ev.Ask(request=MeasureRequest() as asked):
                busy = self.busy or ("busy: dither" if self.playing is not None else "")
                start = None if busy else 9
                if not busy:
                    record = self.state.measurement(asked.id)
                    self.measured = (record, self.now_ns + round(MEASURES_FOR_S * SECOND))
                    if record.opens_loop:
                        self.loop = "open"
                        self.begin_session()
                reply = Reply(id=asked.id, accepted=not busy, reason=busy, start_seq=start)
                yield ev.Answered(request=asked, reply=reply)
            case _:
                yield from self.of_matrices(effect)

    def of_the_loop(self, asked):
        opens = isinstance(asked, LoopRequest) and asked.loop is Loop.OPEN
        busy = "" if opens and self.measured is None else self.busy
        if not busy and isinstance(asked, RampRequest):
            n_frames = len(asked.groups) * len(asked.gains) * asked.frames_per_gain
            self.ramp_until_ns = self.now_ns + n_frames * SECOND // RATE_HZ
        elif not busy:
            self.n_controlled = asked.n_controlled or self.n_controlled
            if asked.loop is not None and asked.loop != self.loop:
                self.loop = asked.loop
                self.begin_session(opens)
        yield loop_answered(asked.id, accepted=not busy, reason=busy)

    def of_matrices(self, effect):
        registration, view = self.state.alpha.registration, self.state.loop.rtc or self.status()
        match effect:
            case ev.MakeMatrix() | ev.RepublishMatrix() as asked:
                self.n_made += 1
                n_modes = asked.n_modes if isinstance(asked, ev.MakeMatrix) else 400
                changes = {"n_modes": n_modes, "created_ns_utc": self.now_ns}
                if registration is not None:
                    gains = getattr(asked, "gains", None)
                    at = judged(registration, view, n_modes)
                    at = at if gains is None else replace(at, gains=gains[:n_modes])
                    changes |= {"alpha": registration.alpha, "judged": at}
                made = record(f"cm-{self.n_made}", MatrixState.PROPOSED, **changes)
                wanted = isinstance(asked, ev.RepublishMatrix)
                yield ev.MatrixMade(record=made, wanted=wanted)
            case ev.FetchMatrix(id=name):
                yield ev.MatrixFetched(record=foreign(name or self.cm_id))
            case ev.JudgeMatrix(id=name):
                yield ev.MarginJudged(id=name, verdict=verdict())
            case ev.JudgeProposal(id=name, gains=gains, wanted=wanted):
                at = replace(judged(registration, view, len(gains)), gains=gains)
                yield ev.ProposalJudged(id=name, verdict=verdict(), judged=at, wanted=wanted)
            case ev.SendMatrix(id=name, n_modes=n_modes):
                self.cm_id, self.n_controlled = name, n_modes
                yield acknowledged(
                    name,
                    state=MatrixState.APPLIED,
                    frame_seq=self.seq,
                    session=f"s{self.session}",
                )
            case ev.FinishNoisy(record=asked):
                yield ev.MatrixMeasured(
                    record=replace(asked, state=MeasureState.STORED, finding=FOUND)
                )
            case _:
                raise TypeError(f"nobody answers {effect!r}")


FOUND = NoisyFinding(
    n_slopes=1384,
    n_frames=29_994,
    n_missing=0,
    snr=1.4,
    alpha=ALPHA,
    covariance=PRECISE,
    optical_gain=0.6,
    misfit=1.0,
    cm_id="initial",
    session="s1",
    created_ns_utc=START_NS,
    sha256="0" * 64,
)
