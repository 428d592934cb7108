"""A short night of a small telescope, recorded where the tracker is told of events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from typing_extensions import override

from pyrcal_studies.campaign.golden import Entry, Teller
from pyrcal_studies.campaign.golden_codec import encoded
from pyrcal_studies.campaign.observatory import Observatory
from pyrcal_studies.campaign.observatory_checks import true_radius
from pyrcal_studies.campaign.observatory_link import OwnHands
from pyrcal_studies.campaign.small import SETTINGS as SMALL_SETTINGS
from pyrcal_studies.campaign.small import SMALL, latencies_of
from pyrcal_studies.campaign.strange_rtc import Mischief, StrangeDome, StrangeLink
from service.config import load_settings
from service.control.reconstructor import Recipe, reconstruct
from service.errors import LinkError, PyrcalError
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from service.tracking import events as ev
from service.tracking.commands import Command
from service.tracking.events import Effect, Event
from service.tracking.operation_records import MeasurementRecord, MeasureState, NoisyFinding
from service.tracking.policy import Policy
from service.tracking.products import MatrixState
from service.tracking.state import Mode, TrackerState
from service.wire import Acknowledgement, DitherRequest, Reply
from service.wire import Command as Order

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


class GoldenDome(StrangeDome):
    """A telescope whose RTC may refuse or ignore what it is asked, or not be reached."""

    def __init__(self, words: Sequence[str]) -> None:
        super().__init__(words)
        self.refused: tuple[type[Order], ...] = ()
        """Kinds of commands the RTC refuses."""

        self.deaf = False
        """It accepts dithers and plays none."""

        self.unreachable = False
        """No answer comes from it."""

    @override
    def order(self, command: Order) -> Reply:
        """Tell the RTC something and return its answer."""
        if isinstance(command, self.refused):
            reason = "busy: it is told to refuse"
            return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
        if self.deaf and isinstance(command, DitherRequest):
            return Reply(id=command.id, accepted=True, reason="", start_seq=self.frame + 50)
        return super().order(command)


class GoldenLink(StrangeLink):
    """The way to it, which may be cut."""

    _strange: GoldenDome

    @override
    async def command(self, command: Order) -> Reply:
        """Return the RTC's answer.

        Raises
        ------
        LinkError
            If none comes.
        """
        if self._strange.unreachable:
            raise LinkError("the RTC did not answer within 2 s")
        return await super().command(command)


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
