"""Record the golden nights: short nights in which everything happens to the service once.

Run: ``python -m pyrcal_studies.campaign.golden_nights [--only jump,steady]``. Recorded twice on one
machine they are the same but for the names of the RTC's sessions, drawn at random; another
processor may round otherwise. With ``--retell`` the events stay as they were recorded, and only
what the tracker makes of them is written anew: the first difference of each night is printed. With
``--alarms`` nothing is recorded: after how long each event of a recorded night raised an alarm, and
what was sent meanwhile, is printed as a table.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal_studies.campaign.golden import (
    FOLDER,
    INSTRUMENT,
    Entry,
    Teller,
    encoded,
    read,
    replayed,
    retold,
    written,
)
from pyrcal_studies.campaign.observatory import SETTINGS as SMALL_SETTINGS
from pyrcal_studies.campaign.observatory import (
    SMALL,
    Dome,
    Observatory,
    OwnHands,
    ShortLink,
    latencies_of,
    true_radius,
)
from pyrcal_studies.shared import study_parser
from service.config import load_settings
from service.control.reconstructor import Recipe, reconstruct
from service.errors import LinkError, PyrcalError
from service.estimation.frames import FrameBlock
from service.instrument import load_instrument
from service.model.pupil import valid_subapertures
from service.records import commands as cmd
from service.records import events as ev
from service.records.commands import Command
from service.records.events import Effect, Event
from service.records.operations import MeasurementRecord, MeasureState, NoisyFinding
from service.records.products import Frame, MatrixState, ModeSet, ShapeKind
from service.records.state import Level, Mode, TrackerState
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker
from service.tracking.policy import Policy
from service.wire import (
    Acknowledgement,
    AckState,
    DitherKind,
    DitherRequest,
    Loop,
    LoopRequest,
    Manifest,
    MeasureRequest,
    Pattern,
    RampRequest,
    ReferencesRequest,
    Reply,
    Status,
    layout_of,
)
from service.wire import Command as Order
from sim_rtc.computer.activities import MAX_DITHER_AMPLITUDE_M

WORDS = (
    f"--instrument={SMALL}",
    "--plant=linear",
    "--imperfections=ideal",
    "--optical-gain=0.7,0.9",
    "--n-controlled=45",
    "--mag=8",
    "--seed=1",
    "--alpha=0.05,-0.03,0.1,1.002",
)
"""The simulator's command line, where a night has no other."""

SETTINGS: Mapping[str, object] = {
    **SMALL_SETTINGS,
    "dither.budget_m": 20e-9,
    "dither.amplitude_m": 10e-9,
    "dither.longest_window_s": 2.0,
    "dither.longest_pause_s": 0.0,
    "control.n_modes_target": 45,
}
"""Of the service, where a night has no others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One night."""

    name: str
    seconds: float
    words: tuple[str, ...] = ()
    """Of the simulator's command line, besides ``WORDS``."""

    settings: Mapping[str, object] = field(default_factory=dict)
    """Of the service, besides ``SETTINGS``."""

    mode: Mode = Mode.AUTO
    slow: float = 1.0
    """How much longer the worker takes than usual."""

    deeds: tuple[tuple[float, Callable[[GoldenNight], None]], ...] = ()
    """What happens and after how many seconds, in its order."""


STRONG = 20.0
"""A dither is so much stronger than was asked for, as far as the mirror goes."""

TRUE_LEAK, TOLD_LEAK = 0.90, 0.99


class Mischief(StrEnum):
    """One way of not keeping to the contract, or to the truth."""

    SIGN = "sign"
    """Slopes, and so the matrices, of the other sign."""

    FLIP_X = "flip-x"
    NANOMETRES = "nanometres"
    """Commands, and so the matrices, in nanometres."""

    LEAK = "leak"
    """0.99 is reported, 0.90 is true."""

    DELAY = "delay"
    """A frame less is reported than there is."""

    GAIN = "gain"
    """Half the gain is reported."""

    SEEING_GAINS = "seeing-gains"
    """Gains that move by 1 % with every status: nothing wrong with that."""

    STRONG_DITHER = "strong-dither"
    OTHER_SHA = "other-sha"
    """What is acknowledged is not what was sent."""

    NO_ACK = "no-ack"
    NO_STATUS = "no-status"
    NO_CM_ID = "no-cm-id"


DIALECTS = frozenset({Mischief.SIGN, Mischief.FLIP_X, Mischief.NANOMETRES})
"""Those of telemetry and matrices: an RTC changes them only when it starts anew."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dialect:
    """How slopes and commands are listed on the wire."""

    index: NDArray[np.intp]
    """``(n_slopes,)``: the place on the wire ``k`` shows slope ``index[k]``."""

    sign: NDArray[np.float32]
    """``(n_slopes,)`` of each place on the wire."""

    unit: float
    """Commands on the wire over commands in metres."""

    def shown(self, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a reconstructor as the RTC would show it."""
        matrix = matrix[:, self.index] * self.sign * np.float32(self.unit)
        return np.ascontiguousarray(matrix, dtype=np.float32)

    def meant(self, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the loop does with a reconstructor it is sent: the inverse of ``shown``."""
        inner = np.empty_like(matrix)
        inner[:, self.index] = matrix * self.sign / np.float32(self.unit)
        return inner

    def spoken(self, block: FrameBlock) -> FrameBlock:
        """Return telemetry as it is sent."""
        unit, dither = np.float32(self.unit), block.dither_m
        return replace(
            block,
            slopes=block.slopes[:, self.index] * self.sign,
            commands_m=block.commands_m * unit,
            dither_m=None if dither is None else dither * unit,
        )


def dialect_of(mischief: Mischief | None, mask: NDArray[np.bool_]) -> Dialect:
    """Return the dialect of an RTC; ``mask`` ``(n, n)`` [y, x] are its valid subapertures."""
    n_valid = int(mask.sum())
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(n_valid)
    signs = (1.0, 1.0)
    if mischief is Mischief.SIGN:
        signs = (-1.0, -1.0)
    elif mischief is Mischief.FLIP_X:
        number, signs = number[:, ::-1], (-1.0, 1.0)
    order = number[number >= 0]
    return Dialect(
        index=np.concatenate([order, order + n_valid]),
        sign=np.repeat(np.array(signs, dtype=np.float32), n_valid),
        unit=1e9 if mischief is Mischief.NANOMETRES else 1.0,
    )


class GoldenDome(Dome):
    """A telescope whose RTC refuses or ignores requests, or differs from what it reports.

    Nothing here knows how the service finds out.
    """

    def __init__(self, words: Sequence[str]) -> None:
        super().__init__(words)
        self.refused: tuple[type[Order], ...] = ()
        """Kinds of commands the RTC refuses."""

        self.deaf = False
        """It accepts dithers and plays none."""

        self.unreachable = False
        """No answer comes from it."""

        self.mischief: set[Mischief] = set()
        self._asked: dict[str, DitherRequest] = {}
        self._n_reported = 0
        self.speak(None)

    def speak(self, mischief: Mischief | None) -> None:
        """Take up a dialect, None the right one, as an RTC does that is set up anew."""
        self.dialect = dialect_of(mischief, valid_subapertures(self.instrument))
        self.mischief -= DIALECTS
        self.mischief |= {mischief} if mischief else set()

    def begin(self, mischief: Mischief) -> None:
        """Get up to something that needs no new session."""
        self.mischief.add(mischief)
        if mischief is Mischief.LEAK:
            self._leak(TRUE_LEAK)

    def end(self, mischief: Mischief) -> None:
        """Behave again."""
        self.mischief.discard(mischief)
        if mischief is Mischief.LEAK:
            self._leak(TOLD_LEAK)

    def _leak(self, leak: float) -> None:
        self.computer.execute(LoopRequest(id=f"strange-{self.frame}", leak=leak))

    @override
    def play(self) -> list[FrameBlock]:
        """Let one block of frames pass and return what is sent of it."""
        return [self.dialect.spoken(block) for block in super().play()]

    @override
    def order(self, command: Order) -> Reply:
        """Tell the RTC something and return its answer."""
        if isinstance(command, self.refused):
            reason = "busy: it is told to refuse"
            return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
        if isinstance(command, DitherRequest):
            if self.deaf:
                return Reply(id=command.id, accepted=True, reason="", start_seq=self.frame + 50)
            if Mischief.STRONG_DITHER in self.mischief:
                self._asked[command.id] = command
                strong = [min(STRONG * a, MAX_DITHER_AMPLITUDE_M) for a in command.amplitude_m]
                command = replace(command, amplitude_m=tuple(strong))
        return super().order(command)

    @override
    def stage(self, reconstructor: Reconstructor) -> None:
        """Hand the loop a matrix, as it understands it."""
        super().stage(replace(reconstructor, matrix=self.dialect.meant(reconstructor.matrix)))

    def applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix in use as the RTC shows it."""
        active = self.computer.reconstructor
        matrix = self.dialect.shown(active.matrix)
        layout = layout_of(matrix, active.manifest.layout.chunk_bytes)
        return replace(active.manifest, layout=layout), matrix

    @override
    def status(self) -> Status:
        """Return what the RTC says of itself, true or not."""
        status = super().status()
        self._n_reported += 1
        dither = status.dither
        if dither is not None and dither.request.id in self._asked:
            asked = self._asked[dither.request.id]
            status = replace(status, dither=replace(dither, request=asked))
        if Mischief.LEAK in self.mischief:
            status = replace(status, leak=TOLD_LEAK)
        if Mischief.DELAY in self.mischief:
            status = replace(status, delay_frames=status.delay_frames - 1.0)
        if Mischief.NO_CM_ID in self.mischief:
            status = replace(status, cm_id=None)
        factor = 0.5 if Mischief.GAIN in self.mischief else 1.0
        if Mischief.SEEING_GAINS in self.mischief:
            factor *= 1.0 + 0.01 * (self._n_reported % 2)
        return replace(status, gains=tuple(factor * gain for gain in status.gains))


class GoldenLink(ShortLink):
    """The way to it, which may be cut; what is acknowledged need not be what was sent."""

    _dome: GoldenDome

    @override
    async def command(self, command: Order) -> Reply:
        """Return the RTC's answer.

        Raises
        ------
        LinkError
            If none comes.
        """
        if self._dome.unreachable:
            raise LinkError("the RTC did not answer within 2 s")
        return await super().command(command)

    @override
    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix the RTC uses, as it shows it."""
        return self._dome.applied()

    @override
    def _told(self, acknowledgement: Acknowledgement) -> Acknowledgement:
        other = Mischief.OTHER_SHA in self._dome.mischief
        return replace(acknowledgement, sha256="0" * 64) if other else acknowledgement


class GoldenNight(Observatory):
    """A night that is recorded where the tracker is told of events."""

    dome: GoldenDome

    def __init__(self, plan: Plan, bench: OpticsWorker) -> None:
        self._teller: Teller | None = None
        self._settings = {**SETTINGS, **plan.settings}
        self._plan = plan
        self.silent = False
        """No status comes from the RTC."""

        words = [*(w for w in WORDS if not _again(w, plan.words)), *plan.words]
        self._n_slopes = bench.describe().n_slopes
        self._bench = bench
        super().__init__(
            words,
            policy_of(load_settings(None, {}, self._settings)),
            plan.mode,
            bench,
            latencies=replace(latencies_of(plan.slow), watch_s=0.5),
            with_poles=False,
            dome=GoldenDome(words),
            link=GoldenLink,
        )

    @property
    def recorded(self) -> list[Entry]:
        """What was told so far, and how it began."""
        begin = {
            "night": self._plan.name,
            "system": self.state.system,
            "mode": self._plan.mode.value,
            "settings": self._settings,
        }
        return [begin, *self._told.entries]

    @property
    def instrument(self) -> Entry:
        """What the tracker knows of the telescope."""
        return {
            "mode_information": encoded(self._engine.policy.mode_information),
            "start": encoded(self._engine.policy.start),
        }

    @property
    def worker(self) -> OwnHands:
        """What computes for the service."""
        return self._workers

    def play(self) -> None:
        """Let the night pass and everything happen in it."""
        for time_s, happen in self._plan.deeds:
            self.advance(time_s - self.time_s)
            happen(self)
        self.advance(self._plan.seconds - self.time_s)

    def ask(self, command: Command) -> None:
        """Let an operator ask for something; a refusal is an answer, too."""
        try:
            self.command(command)
        except PyrcalError:
            return

    def post(self, event: Event) -> None:
        """Let the tracker hear of something."""
        self._post(event)

    def restart_service(self, mode: Mode) -> None:
        """End the service and begin it anew; telescope and RTC go on."""
        self._told.restart(mode, self.dome.now_ns)
        self._agenda.clear()
        self._link.sent.clear()
        self._idle_worker()
        self._engine.state = self._told.state
        self._engine.begin_anew()
        self._begin()

    def measured(self) -> None:
        """Let the RTC send the interaction matrix it measures."""
        record = self.state.measuring
        if record is not None:
            session = self.dome.computer.session
            stored = replace(
                record,
                state=MeasureState.STORED,
                created_ns_utc=self.dome.now_ns,
                n_slopes=self._n_slopes,
                double_pass=False,
                session=session,
                sha256="0" * 64,
            )
            self._post(ev.MatrixMeasured(record=stored))

    def unstable(self, radius: float) -> None:
        """Force a matrix through whose loop has this largest pole radius on this telescope."""
        alpha, recipe = self.dome.alpha, Recipe(n_modes=self.dome.status().n_controlled)
        found = 0.0
        while found < radius:
            alpha = replace(alpha, shift_x_subap=alpha.shift_x_subap + 0.1)
            matrix = reconstruct(self._bench.response(alpha), recipe).matrix
            found = true_radius(matrix, self.dome.optics, self.dome.computer.settings)
        self.force(matrix)

    def proposed(self) -> str:
        """Return the id of the last proposal, or of nothing."""
        records = self.state.matrices.reconstructors
        return next((r.id for r in reversed(records) if r.state is MatrixState.PROPOSED), "none")

    @override
    def step(
        self, state: TrackerState, event: Event, policy: Policy, now_ns: int, cause: str
    ) -> tuple[TrackerState, tuple[Effect, ...]]:
        """Let the tracker decide, and write down what it is told."""
        if self._teller is None:
            self._teller = Teller(state, policy)
        effects = self._teller.tell(event, now_ns, cause)
        return self._teller.state, effects

    @property
    def _told(self) -> Teller:
        if self._teller is None:
            raise ValueError("a night that has not begun")
        return self._teller

    @override
    def _do(self, effect: Effect, state: TrackerState) -> None:
        if isinstance(effect, ev.FinishNoisy) and not self.worker.broken:
            event = ev.MatrixMeasured(record=self._finished(effect.record))
            self._in(self.latencies.make_s, partial(self._post, event, effect.cause))
            return
        super()._do(effect, state)

    @override
    def _hear_status(self) -> None:
        if not self.silent and Mischief.NO_STATUS not in self.dome.mischief:
            super()._hear_status()

    @override
    def _hear(self, event: Event) -> None:
        told = isinstance(event, Acknowledgement)
        if not (told and Mischief.NO_ACK in self.dome.mischief):
            super()._hear(event)

    def _finished(self, record: MeasurementRecord) -> MeasurementRecord:
        """Return a noisy matrix as if it had been fitted: only that it was matters here."""
        finding = NoisyFinding(
            n_slopes=self._n_slopes,
            n_frames=round((record.duration_s or 0.0) * self.dome.rate_hz),
            n_missing=0,
            snr=1.2,
            alpha=None,
            covariance=None,
            optical_gain=None,
            misfit=None,
            cm_id=self.state.matrices.in_use,
            session=self.dome.computer.session,
            created_ns_utc=self.dome.now_ns,
            sha256="0" * 64,
        )
        return replace(record, state=MeasureState.STORED, finding=finding)


def _again(word: str, words: Sequence[str]) -> bool:
    """Return whether an option is given again."""
    return any(other.split("=")[0] == word.split("=")[0] for other in words)


Do = Callable[[GoldenNight], None]
Deeds = tuple[tuple[float, Do], ...]


def ask(command: Command) -> Do:
    """Return an operator's command."""
    return lambda night: night.ask(command)


def hear(event: Event) -> Do:
    """Return something that is heard of."""
    return lambda night: night.post(event)


def order(command: Order) -> Do:
    """Return what somebody else orders of the RTC."""

    def happen(night: GoldenNight) -> None:
        night.dome.order(command)

    return happen


def trouble(name: str, text: str = "as it is said", *, over: bool = False) -> Do:
    """Return an alarm of the link, or its end."""
    return hear(ev.ConditionChanged(name=name, text=text, over=over))


def begin(mischief: Mischief) -> Do:
    """Return the beginning of a mischief."""
    return lambda night: night.dome.begin(mischief)


def end(mischief: Mischief) -> Do:
    """Return the end of one."""
    return lambda night: night.dome.end(mischief)


def speak(mischief: Mischief | None) -> Do:
    """Return an RTC's start in another dialect."""

    def start(night: GoldenNight) -> None:
        night.dome.speak(mischief)
        night.restart_rtc()

    return start


def refuse(*kinds: type[Order]) -> Do:
    """Return an RTC that refuses these; none: that refuses nothing any more."""
    return lambda night: setattr(night.dome, "refused", kinds)


def cut(*, off: bool = True) -> Do:
    """Return a link on which no answer comes."""
    return lambda night: setattr(night.dome, "unreachable", off)


def deaf(*, ears: bool = False) -> Do:
    """Return an RTC that accepts dithers and plays none."""
    return lambda night: setattr(night.dome, "deaf", not ears)


def break_worker(why: str = "the worker has ended") -> Do:
    """Return a worker that does no job; an empty reason: that does them again."""
    return lambda night: setattr(night.worker, "broken", why)


def restart(mode: Mode = Mode.AUTO) -> Do:
    """Return a restart of the service."""
    return lambda night: night.restart_service(mode)


def vanish(night: GoldenNight) -> None:
    """Let the RTC be gone."""
    night.silent = True
    night.post(ev.RtcVanished())


def appear(night: GoldenNight) -> None:
    """Let it be there again."""
    night.silent = False
    night.post(ev.LogEvent(name="rtc.appeared", text="the RTC is there"))


def approve(night: GoldenNight) -> None:
    """Approve the last proposal."""
    night.ask(cmd.Approve(id=night.proposed()))


def reject(night: GoldenNight) -> None:
    """Reject it."""
    night.ask(cmd.Reject(id=night.proposed(), reason="not this one"))


def publish_first(night: GoldenNight) -> None:
    """Send the oldest reconstructor again."""
    night.ask(cmd.Publish(id=night.state.matrices.reconstructors[0].id))


LAST = "last"


def acknowledged(state: AckState, reason: str, name: str | None = LAST) -> Do:
    """Return an answer of the RTC's to the last reconstructor, or another one."""

    def answer(night: GoldenNight) -> None:
        rtc, last = night.state.loop.rtc, night.state.matrices.reconstructors[-1].id
        acknowledgement = Acknowledgement(
            session="" if rtc is None else rtc.session,
            id=last if name == LAST else name,
            sha256=None,
            state=state,
            reason=reason,
            frame_seq=3 if state is AckState.APPLIED else None,
        )
        night.post(acknowledgement)

    return answer


def slew(first_deg: float, rate_deg_s: float, begin_s: float, seconds: float) -> Deeds:
    """Return a telescope that moves in elevation, told once a second."""
    return tuple(
        (
            begin_s + k,
            ask(cmd.SetPointing(elevation_deg=first_deg + k * rate_deg_s, azimuth_deg=30.0)),
        )
        for k in range(round(seconds))
    )


NOISY = 4.0
"""Seconds of a noisy matrix."""

CLOSE, OPEN = cmd.SetLoop(loop="closed"), cmd.SetLoop(loop="open")
STOP, START = cmd.StopDither(), cmd.StartDither()
ACQUIRE, ABORT, REFIT = cmd.Acquire(), cmd.AbortAcquisition(), cmd.Refit()
GROUPS = (cmd.ModeGroup(first=0, last=1), cmd.ModeGroup(first=2, last=44))
RAMP = cmd.Ramp(groups=GROUPS, gains=(0.3, 0.4), step_s=0.5)
MEASURE = cmd.Measure(id="im-1", pattern=Pattern.PUSH_PULL_MODAL, n_average=1)
SINE = cmd.Measure(id="im-2", pattern=Pattern.SINE, modes=(50, 52), duration_s=2.0)
EVERYTHING: tuple[Command, ...] = (
    REFIT,
    cmd.Rollback(),
    START,
    RAMP,
    MEASURE,
    SINE,
    ACQUIRE,
    CLOSE,
    cmd.SetLoop(leak=0.99),
    cmd.MeasureNoisy(id="noisy-late", duration_s=NOISY),
    cmd.GiveUp(id="im-1"),
    cmd.GiveUp(id="noisy-1"),
    ABORT,
    cmd.Approve(id="nobody"),
    cmd.Reject(id="nobody"),
    cmd.Publish(id="nobody"),
    cmd.SetPointing(elevation_deg=70.0, azimuth_deg=0.0),
)
"""One command of each kind; what ends things comes last."""


def everything(begin_s: float, step_s: float = 0.1, *, ending: bool = False) -> Deeds:
    """Return all commands one after the other; those that end things only where that is meant."""
    given = [c for c in EVERYTHING if ending or not isinstance(c, _ENDING)]
    return tuple((begin_s + k * step_s, ask(command)) for k, command in enumerate(given))


_ENDING = (cmd.GiveUp, cmd.AbortAcquisition)


def dither(name: str) -> DitherRequest:
    """Return a dither that somebody else asks for."""
    return DitherRequest(
        id=name,
        kind=DitherKind.SINE,
        modes=(60, 65),
        amplitude_m=(5e-9, 5e-9),
        frequency_hz=(210.0, 260.0),
        duration_s=20.0,
    )


def plan_night(name: str, seconds: float, *deeds: tuple[float, Do], **more: Any) -> Plan:  # noqa: ANN401 - fields
    """Return a night of so many seconds in which these things happen."""
    return Plan(name=name, seconds=seconds, deeds=deeds, **more)


COMMANDED = (
    plan_night(
        "propose",
        30.0,
        (9.0, approve),
        (12.0, publish_first),
        (15.0, ask(cmd.Rollback())),
        (17.0, ask(REFIT)),
        (21.0, approve),
        (23.0, reject),
        (24.0, ask(cmd.SetMode(mode=Mode.AUTO))),
        mode=Mode.PROPOSE,
        words=("--jump=18.0:0.1,0,0,0",),
    ),
    plan_night(
        "stale-approval",
        24.0,
        (8.0, ask(cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=44, gain=0.3),)))),
        (9.0, approve),
        (9.5, order(LoopRequest(id="other-1", leak=0.98))),
        (16.0, approve),
        (20.0, approve),
        mode=Mode.PROPOSE,
        words=("--jump=12.0:0.2,0,0,0",),
    ),
    plan_night(
        "probation",
        26.0,
        (10.0, lambda night: night.unstable(1.02)),
        (16.0, ask(cmd.SetMode(mode=Mode.AUTO))),
        (20.0, lambda night: night.unstable(1.1)),
        (20.8, ask(cmd.StopEverything())),
    ),
    plan_night(
        "hold",
        26.0,
        (1.0, ask(REFIT)),
        (8.0, ask(REFIT)),
        (9.0, ask(REFIT)),
        (12.0, approve),
        (15.0, ask(cmd.Refit(n_modes=85))),
        (18.0, approve),
        (20.0, ask(cmd.Refit(n_modes=500))),
        (21.0, ask(cmd.Rollback())),
        (24.0, restart(Mode.HOLD)),
        mode=Mode.HOLD,
    ),
    plan_night("everything-before-alpha", 12.0, *everything(0.3, 0.05, ending=True)),
    plan_night(
        "everything-in-peace",
        40.0,
        *tuple((6.0 + 2.0 * k, ask(command)) for k, command in enumerate(EVERYTHING)),
    ),
    plan_night(
        "ramp",
        24.0,
        (6.0, ask(RAMP)),
        *everything(6.4, 0.05),
        (10.0, ask(RAMP)),
        (10.8, ask(OPEN)),
        (12.0, ask(CLOSE)),
        (15.0, ask(cmd.Ramp())),
        (16.0, ask(cmd.StopDither())),
        (18.0, refuse(RampRequest)),
        (20.0, ask(RAMP)),
    ),
    plan_night(
        "loop",
        32.0,
        (5.0, ask(cmd.SetLoop(leak=0.98))),
        (7.0, ask(cmd.SetLoop(gains=(cmd.GainGroup(first=40, last=44, gain=0.0),)))),
        (10.0, ask(cmd.SetLoop(effective_gain=0.3))),
        (13.0, ask(cmd.SetLoop(n_controlled=30))),
        (17.0, ask(OPEN)),
        (18.0, ask(cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=3, gain=0.2),)))),
        (19.0, ask(CLOSE)),
        (22.0, order(LoopRequest(id="other-1", loop=Loop.OPEN))),
        (25.0, order(LoopRequest(id="other-2", loop=Loop.CLOSED))),
        (28.0, ask(cmd.SetLoop(n_controlled=500))),
        (29.0, refuse(LoopRequest)),
        (30.0, ask(OPEN)),
    ),
    plan_night(
        "dithers",
        45.0,
        (5.0, ask(STOP)),
        (6.0, ask(cmd.StartDither(modes=(50, 55, 60), duration_s=4.0))),
        (12.0, ask(cmd.StartDither(modes=(50,), amplitude_m=30e-9))),
        (13.0, ask(cmd.StartDither(amplitude_m=15e-9, duration_s=3.0, over_budget=True))),
        (18.0, ask(cmd.StartDither(kind=DitherKind.BINARY, modes=ModeSet.ALL, duration_s=6.0))),
        (27.0, ask(cmd.StartDither(modes=(200,)))),
        (29.0, order(dither("somebodys"))),
        (33.0, ask(STOP)),
        (36.0, order(dither("dither-1"))),
        (40.0, ask(START)),
    ),
)

MEASURING = (
    plan_night(
        "noisy",
        45.0,
        (6.0, ask(cmd.MeasureNoisy(id="noisy-1", duration_s=NOISY))),
        *everything(8.0, 0.05),
        (20.0, ask(cmd.MeasureNoisy(id="noisy-1"))),
        (21.0, ask(cmd.MeasureNoisy(id="noisy-2", modes=ModeSet.ALL, duration_s=NOISY))),
        (24.0, ask(cmd.GiveUp(id="noisy-2"))),
        (25.0, ask(cmd.GiveUp(id="noisy-2"))),
        (28.0, ask(cmd.MeasureNoisy(id="noisy-3", total_amplitude_m=1e-6))),
        (29.0, ask(cmd.MeasureNoisy(id="noisy-4", duration_s=NOISY))),
        (30.0, ask(STOP)),
        (33.0, ask(cmd.MeasureNoisy(id="noisy-5", duration_s=NOISY))),
        (35.5, break_worker()),
        (42.0, break_worker("")),
    ),
    plan_night(
        "noisy-refused",
        40.0,
        (5.0, refuse(DitherRequest)),
        (6.0, ask(cmd.MeasureNoisy(id="noisy-1", duration_s=4.0))),
        (23.0, refuse()),
        (25.0, ask(cmd.MeasureNoisy(id="noisy-2", duration_s=NOISY))),
        (27.0, GoldenNight.restart_rtc),
        (31.0, ask(cmd.MeasureNoisy(id="noisy-3", duration_s=NOISY))),
        (33.0, ask(ACQUIRE)),
    ),
    plan_night(
        "measure",
        45.0,
        (6.0, ask(STOP)),
        (8.0, ask(MEASURE)),
        *everything(9.0, 0.05),
        (16.0, GoldenNight.measured),
        (18.0, ask(SINE)),
        (21.0, GoldenNight.measured),
        (24.0, ask(START)),
        (26.0, ask(STOP)),
        (28.0, ask(cmd.Measure(id="im-3", pattern=Pattern.HADAMARD))),
        (29.0, ask(cmd.GiveUp(id="im-3"))),
        (36.0, refuse(MeasureRequest)),
        (37.0, ask(cmd.Measure(id="im-4", pattern=Pattern.SYSTEM_MODES))),
        (39.0, refuse()),
        (40.0, ask(cmd.Measure(id="im-5", pattern=Pattern.PUSH_PULL_ZONAL))),
        (41.0, GoldenNight.restart_rtc),
    ),
    plan_night(
        "measure-lost",
        30.0,
        (5.0, ask(STOP)),
        (7.0, cut()),
        (7.5, ask(MEASURE)),
        (9.0, cut(off=False)),
        (12.0, ask(cmd.Measure(id="im-6", pattern=Pattern.PUSH_PULL_MODAL))),
        (14.0, vanish),
        (17.0, appear),
        (20.0, ask(START)),
    ),
)


FAR = ("--alpha=0.9,-0.6,3.0,1.02",)
"""Registrations that no window finds."""

SPARSE = {"dither.longest_pause_s": 6.0}
BEND = {"tracking.flexure_subap_per_degree": 0.01, "tracking.flexure_deg_per_degree": 0.01}
TRACKING = (
    plan_night("steady", 15.0),
    plan_night("jump", 18.0, words=("--jump=8.3:0.1,0,0,0",)),
    plan_night("jump-rotation", 18.0, words=("--jump=8.8:0,0,0.12,0",)),
    plan_night(
        "jump-and-back",
        20.0,
        words=("--jump=8.0:0.3,0.1,0,0", "--jump=9.1:-0.3,-0.1,0,0", "--jump=13.5:0.2,0.2,0.3,0"),
    ),
    plan_night("drift", 25.0, words=("--drift=0.4,-0.3,0.3,0.002",)),
    plan_night(
        "slew",
        24.0,
        *slew(60.0, 0.0, 1.0, 2),
        *slew(60.0, 2.0, 9.0, 6),
        *slew(72.0, 0.0, 16.0, 2),
        settings=BEND,
    ),
    plan_night("faint", 25.0, words=("--mag=12.5",), settings={"dither.longest_window_s": 5.0}),
    plan_night("pauses", 60.0, settings=SPARSE, words=("--jump=41.0:0.1,0,0,0",)),
    plan_night(
        "vibrations",
        20.0,
        words=("--vibration=tilt:239:40", "--vibration=focus:47:15"),
        settings={"dither.avoid_hz": (283.0,)},
    ),
    plan_night("slow-worker", 30.0, slow=4.0, words=("--jump=14.0:0.2,0,0.2,0",)),
    plan_night("seeing-gains", 15.0, (3.0, begin(Mischief.SEEING_GAINS))),
    plan_night(
        "more-modes", 30.0, words=("--n-controlled=20",), settings={"control.n_modes_target": 80}
    ),
    plan_night(
        "modes-declined",
        30.0,
        (8.0, reject),
        (14.0, approve),
        (16.0, refuse(LoopRequest)),
        (20.0, approve),
        (23.0, refuse()),
        (26.0, ask(cmd.Refit(n_modes=80))),
        words=("--n-controlled=30",),
        mode=Mode.PROPOSE,
        settings={"control.n_modes_target": 60},
    ),
)

ACQUIRING = (
    plan_night(
        "acquire-ordered", 35.0, (2.0, ask(ACQUIRE)), *everything(3.0), words=FAR, mode=Mode.PROPOSE
    ),
    plan_night("acquire-alone", 45.0, words=FAR, settings={"acquisition.auto": True}),
    plan_night(
        "acquire-aborted",
        25.0,
        (2.0, ask(ACQUIRE)),
        (5.0, ask(ABORT)),
        (7.0, ask(CLOSE)),
        (9.0, ask(ABORT)),
        (11.0, ask(ACQUIRE)),
        (13.0, ask(STOP)),
        (16.0, ask(ACQUIRE)),
        (17.0, ask(cmd.SetMode(mode=Mode.HOLD))),
        (18.0, ask(ABORT)),
        (20.0, ask(cmd.SetMode(mode=Mode.AUTO))),
        words=FAR,
    ),
    plan_night(
        "acquire-refused",
        25.0,
        (2.0, refuse(LoopRequest)),
        (2.5, ask(ACQUIRE)),
        (5.0, refuse(DitherRequest)),
        (6.0, ask(ACQUIRE)),
        (18.0, refuse()),
        (19.0, ask(ACQUIRE)),
        words=FAR,
    ),
    plan_night(
        "acquire-cut-off",
        30.0,
        (2.0, ask(ACQUIRE)),
        (4.0, cut()),
        (8.0, cut(off=False)),
        (12.0, GoldenNight.restart_rtc),
        words=FAR,
    ),
    plan_night(
        "acquire-gap",
        40.0,
        (2.0, ask(ACQUIRE)),
        (5.0, vanish),
        (9.0, appear),
        words=FAR,
        settings={"acquisition.auto": True},
    ),
    plan_night(
        "acquire-restart",
        40.0,
        (2.0, ask(ACQUIRE)),
        (6.0, restart()),
        words=FAR,
        settings={"acquisition.auto": True},
    ),
    plan_night(
        "acquire-restart-propose",
        25.0,
        (2.0, ask(ACQUIRE)),
        (6.0, restart(Mode.PROPOSE)),
        (10.0, ask(CLOSE)),
        (16.0, restart(Mode.PROPOSE)),
        words=FAR,
        mode=Mode.PROPOSE,
    ),
    plan_night(
        "acquire-somebody-closes",
        30.0,
        (2.0, ask(ACQUIRE)),
        (5.0, order(LoopRequest(id="other-1", loop=Loop.CLOSED))),
        (9.0, break_worker()),
        (16.0, break_worker("")),
        words=FAR,
    ),
    plan_night(
        "diverging",
        30.0,
        (7.0, order(LoopRequest(id="other-1", gains=(1.6,) * 45 + (0.0,) * 45))),
        settings={"acquisition.auto": True},
    ),
)

FAULTS = (
    plan_night(
        "worker-broken",
        28.0,
        (4.0, break_worker()),
        (10.0, break_worker("")),
        (14.0, break_worker()),
        (15.0, ask(REFIT)),
        (17.0, ask(cmd.Rollback())),
        (19.0, break_worker("")),
    ),
    plan_night(
        "no-acknowledgement",
        24.0,
        (3.0, begin(Mischief.NO_ACK)),
        (16.0, end(Mischief.NO_ACK)),
        (18.0, ask(REFIT)),
    ),
    plan_night(
        "not-applied",
        26.0,
        (6.0, acknowledged(AckState.REJECTED, "range: it says")),
        (9.0, GoldenNight.restart_rtc),
        (15.0, acknowledged(AckState.REJECTED, "it says")),
        (
            17.0,
            acknowledged(AckState.REJECTED, "what?", None),
        ),
        (
            18.0,
            acknowledged(AckState.APPLIED, "", "unknown"),
        ),
        words=("--jump=13.0:0.1,0,0,0",),
    ),
    plan_night(
        "other-sha", 20.0, (3.0, begin(Mischief.OTHER_SHA)), (13.0, end(Mischief.OTHER_SHA))
    ),
    plan_night("no-cm-id", 16.0, (0.1, begin(Mischief.NO_CM_ID)), (9.0, end(Mischief.NO_CM_ID))),
    plan_night(
        "strong-dither",
        24.0,
        (4.0, begin(Mischief.STRONG_DITHER)),
        (14.0, end(Mischief.STRONG_DITHER)),
    ),
    plan_night(
        "loop-law",
        34.0,
        (3.0, begin(Mischief.LEAK)),
        (12.0, end(Mischief.LEAK)),
        (14.0, begin(Mischief.DELAY)),
        (22.0, end(Mischief.DELAY)),
        (24.0, begin(Mischief.GAIN)),
        (31.0, end(Mischief.GAIN)),
    ),
    plan_night("sign", 20.0, (0.5, speak(Mischief.SIGN)), (12.0, speak(None))),
    plan_night("flip", 20.0, (5.0, speak(Mischief.FLIP_X)), (14.0, speak(None))),
    plan_night("nanometres", 18.0, (5.0, speak(Mischief.NANOMETRES)), (12.0, speak(None))),
    plan_night(
        "rtc-restarts",
        26.0,
        (7.0, GoldenNight.restart_rtc),
        (14.0, GoldenNight.restart_rtc),
        (14.2, vanish),
        (17.0, appear),
        (20.0, begin(Mischief.NO_STATUS)),
        (24.0, end(Mischief.NO_STATUS)),
        words=("--jump=16.0:0.1,0,0,0",),
    ),
    plan_night(
        "service-restarts",
        36.0,
        (8.0, restart()),
        (14.0, ask(cmd.SetMode(mode=Mode.HOLD))),
        (15.0, ask(STOP)),
        (17.0, restart()),
        (22.0, ask(START)),
        (23.0, ask(cmd.SetMode(mode=Mode.AUTO))),
        (28.0, ask(cmd.SetMode(mode=Mode.HOLD))),
        (29.0, restart(Mode.PROPOSE)),
    ),
    plan_night(
        "second-service",
        24.0,
        (6.0, hear(ev.ServicesMet(drives=False, others=("one on host a, process 1",)))),
        *everything(8.0, 0.05),
        (12.0, hear(ev.ServicesMet(drives=True, others=("one on b",)))),
        (16.0, hear(ev.ServicesMet(drives=True, others=()))),
    ),
    plan_night(
        "alarms",
        44.0,
        (5.0, trouble("second-rtc")),
        (7.0, trouble("basis-mismatch")),
        (26.0, trouble("archive-failed")),
        (29.0, trouble("archive-failed", over=True)),
        (31.0, trouble("worker-behind")),
        (33.0, trouble("worker-behind", over=True)),
        (34.0, trouble("columns-misaligned")),
        (
            36.0,
            hear(ev.LogEvent(name="message.malformed", text="status: 3", level=Level.WARNING)),
        ),
        (
            36.5,
            hear(ev.LogEvent(name="message.malformed", text="status: 4", level=Level.WARNING)),
        ),
        (38.0, trouble("commands-off-loop")),
        (40.0, trouble("commands-off-loop", over=True)),
    ),
    plan_night("deaf", 30.0, (4.0, deaf()), (16.0, deaf(ears=True))),
    plan_night(
        "dither-refused",
        34.0,
        (0.1, refuse(DitherRequest)),
        (12.0, refuse()),
        (20.0, cut()),
        (26.0, cut(off=False)),
    ),
)


def spoil(factor: float, *, hidden: bool) -> Do:
    """Return an RTC that applies offsets of its references times a factor, and may hide it."""

    def begin_spoiling(night: GoldenNight) -> None:
        night.dome.computer.spoil_references(
            lambda _, requested: np.float32(factor) * requested, hidden=hidden
        )

    return begin_spoiling


def approve_references(night: GoldenNight) -> None:
    """Approve the references made last."""
    night.ask(cmd.ApproveReferences(id=night.state.references.records[-1].id))


LOAD = cmd.LoadShape(
    kind=ShapeKind.MODES,
    frame=Frame.MIRROR,
    values=(0.0, 0.0, 30.0, 0.0, 15.0, 10.0),
    unit="nm",
    by="Ada",
)
HOLDING = (
    plan_night(
        "references",
        115.0,
        (8.0, ask(LOAD)),
        (12.0, approve_references),
        (24.0, ask(cmd.SetMode(mode=Mode.AUTO))),
        (26.0, ask(replace(LOAD, values=(0.0, 0.0, 400.0)))),
        (32.0, ask(LOAD)),
        (44.0, ask(cmd.RollBackReferences(reason="image got worse"))),
        (50.0, ask(LOAD)),
        (56.0, restart()),
        (68.0, lambda night: night.restart_rtc()),
        (86.0, spoil(-1.0, hidden=False)),
        (87.0, ask(LOAD)),
        (96.0, ask(cmd.ClearShape())),
        (102.0, refuse(ReferencesRequest)),
        (103.0, ask(LOAD)),
        (112.0, ask(cmd.ClearShape())),
        mode=Mode.PROPOSE,
    ),
)

NIGHTS = (*HOLDING, *TRACKING, *ACQUIRING, *COMMANDED, *MEASURING, *FAULTS)


def main() -> int:
    """Record the nights that are asked for."""
    parser = study_parser("pyrcal_studies.campaign.golden_nights", __doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--retell", action="store_true", help="keep the events")
    parser.add_argument("--alarms", action="store_true", help="print when alarms were raised")
    parser.add_argument("--only", default="", metavar="NAME,NAME", help="default: all nights")
    given = parser.parse_args()
    names = given.only.split(",") if given.only else [plan.name for plan in NIGHTS]
    with threadpool_limits(1):
        for plan in NIGHTS:
            if plan.name not in names:
                continue
            if given.alarms:
                sys.stdout.writelines(
                    _alarm_lines(plan, read(given.folder / f"{plan.name}.jsonl.xz"))
                )
                continue
            if given.retell:
                _retell(given.folder, plan.name)
                continue
            begun = time.process_time()
            # of this night alone: a worker may take up what a matrix tells of the slopes
            night = GoldenNight(plan, OpticsWorker(load_instrument(SMALL), Compute(threads=1)))
            night.play()
            path = given.folder / f"{plan.name}.jsonl.xz"
            written(night.recorded, path)
            written([night.instrument], given.folder / INSTRUMENT)
            took_s = time.process_time() - begun
            sys.stdout.write(
                f"{plan.name}: {len(night.recorded) - 1} events, "
                f"{path.stat().st_size / 1e3:.0f} kB, {took_s:.1f} s\n"
            )
            sys.stdout.flush()
    return 0


def _alarm_lines(plan: Plan, night: Sequence[Entry]) -> Iterator[str]:
    """Yield a line for each event of a night: first alarms after it, and matrices sent."""
    _, *entries = night
    moments_s = [time_s for time_s, _ in plan.deeds]
    for start_s, end_s in pairwise([*moments_s, plan.seconds]):
        known: set[str] = set()
        raised, n_sent = [], 0
        for entry in entries:
            time_s = (entry["t"] - entries[0]["t"]) * 1e-9
            active = set(entry.get("seen", {}).get("alarms", known))
            if start_s <= time_s < end_s:
                raised += [f"`{name}` {time_s - start_s:.1f} s" for name in active - known]
                n_sent += sum(effect["is"] in SENDING for effect in entry.get("effects", ()))
            known = active
        yield f"| {plan.name} | {start_s:g} | {', '.join(raised) or '-'} | {n_sent} |\n"


SENDING = ("SendMatrix", "RepublishMatrix")
"""Effects that send a matrix."""


def _retell(folder: Path, name: str) -> None:
    path, (instrument,) = folder / f"{name}.jsonl.xz", read(folder / INSTRUMENT)
    night = read(path)
    sys.stdout.write(f"{name}: {replayed(night, instrument) or 'as it was'}\n")
    written(retold(night, instrument), path)


if __name__ == "__main__":
    sys.exit(main())
