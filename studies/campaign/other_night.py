"""A night at an outside RTC: the telescope, the service, and the service killed and begun anew."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from typing_extensions import override

from service.archive import Archive
from service.config import load_instrument, load_settings
from service.config.policy import policy_of
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.runtime.archiving import SAVE_INTERVAL_S, is_unsaved, is_urgent, leave, taken_up
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.tracking.events import Event
from service.tracking.resume import restored
from service.tracking.state import MatrixStates, Mode, OperatorState, TrackerState
from studies.campaign.observatory import Latencies, Observatory
from studies.campaign.other_truth import OtherDome, OtherLink, Truth

INSTRUMENT = "tests/system/middle.toml"
GAINS = {"linear": 0.4, "diffractive": 0.5}
ALPHA = (0.12, -0.08, 0.2, 1.003)
"""Where the mirror truly lies, at the boundary."""

CALIBRATED = (0.05, -0.03, 0.05, 1.001)
"""Where it lay by day, when the RTC's own matrix was measured."""

N_CONTROLLED, N_TARGET = 120, 150

LATENCIES = Latencies(make_s=0.6, judge_s=0.5)
"""Three times what the worker takes for 150 modes on a core of its own: 0.21 and 0.18 s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One night."""

    truth: Truth = field(default_factory=Truth)
    instrument: str = INSTRUMENT
    plant: str = "linear"
    seconds: float = 40.0
    n_controlled: int = N_CONTROLLED
    n_target: int = N_TARGET
    jump_s: float | None = None
    """When the mirror jumps by .3 subapertures and 1 degree; None: never."""

    killed_s: float | None = None
    """When the service is killed and begun again; None: never."""

    magnitude: float = 8.0
    seed: int = 1

    @property
    def name(self) -> str:
        """What tells it from other nights."""
        jump = f"jump with {self.n_target}" if self.jump_s is not None else ""
        kill = "" if self.killed_s is None else f"killed at {self.killed_s:.1f} s"
        return ", ".join(word for word in (jump or self.truth.name, kill) if word)

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        angle = np.random.default_rng(self.seed).uniform(0.0, 2.0 * np.pi)
        x, y = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
        jump = [] if self.jump_s is None else [f"--jump={self.jump_s}:{x:.4f},{y:.4f},1,0"]
        return [
            f"--instrument={self.instrument}",
            f"--plant={self.plant}",
            f"--n-controlled={self.n_controlled}",
            f"--gain={GAINS[self.plant]}",
            "--leak=0.99",
            "--seeing=0.7",
            "--wind=8,20",
            f"--mag={self.magnitude}",
            f"--alpha={','.join(map(str, ALPHA))}",
            f"--seed={self.seed}",
            *jump,
        ]

    def dome(self) -> OtherDome:
        """Return the telescope and its RTC."""
        calibrated = Misregistration.from_vector(np.array(CALIBRATED) / BOUNDARY_SCALE)
        return OtherDome(self.words, self.truth, calibrated)


class OtherNight(Observatory):
    """The service at such a telescope; with a ``folder`` it can be killed and begun again."""

    dome: OtherDome

    def __init__(self, plan: Plan, folder: Path | None = None) -> None:
        settings = load_settings(None, {}, {"control.n_modes_target": plan.n_target})
        self._policy, self._folder = policy_of(settings), folder
        self._archive = None if folder is None else _opened(folder)
        self._saved: TrackerState | None = None
        self._saved_s = 0.0
        self.said: dict[tuple[str, str], float] = {}
        """Every text of an alarm, and when it was said first."""

        super().__init__(
            plan.words,
            self._policy,
            Mode.AUTO,
            _bench(plan, settings.compute.working_point_modes),
            latencies=LATENCIES,
            with_poles=False,
            dome=plan.dome(),
            link=OtherLink,
            archive=self._archive,
        )

    def pass_(self, until_s: float) -> None:
        """Let time pass, and read what is said."""
        while self.time_s < until_s - 1e-9:
            self.advance(0.25)
            self._save()
            for alarm in self.state.alarms.active:
                self.said.setdefault((alarm.name, alarm.text), round(self.time_s, 2))

    def kill(self) -> None:
        """End the service as ``kill -9`` does; another takes up what is on the disk.

        What was on its way to the RTC arrives; telescope and RTC go on.

        Raises
        ------
        ValueError
            If the night has no folder to begin again from.
        """
        if self._archive is None or self._folder is None:
            raise ValueError("kill: found a night without a folder; expected one that has")
        self._arrive()
        self._agenda.clear()
        self._idle_worker()
        self._archive.close()
        begun_s = self.time_s + DOWN_S
        while self.time_s < begun_s:
            self.dome.play()
            for _ in self._link.swapped():
                self._note_swap()
        self._archive = self._shelf = _opened(self._folder)
        self._actions = self._new_actions()
        state = TrackerState(
            system=self.state.system,
            operator=OperatorState(mode=Mode.AUTO),
            matrices=MatrixStates(reconstructors=restored(self._archive.reconstructors.records())),
        )
        self._engine.state = taken_up(self._archive, state, self._policy, self.dome.now_ns)
        self._engine.begin_anew()
        self._begin()

    def close(self) -> None:
        """Close the archive."""
        if self._archive is not None:
            self._archive.close()

    @override
    def stepped(self, before: TrackerState, event: Event) -> None:
        """Keep what the tracker heard, and write what the service would."""
        super().stepped(before, event)
        after = self.state
        if (
            self._archive is not None
            and after.matrices.reconstructors is not before.matrices.reconstructors
        ):
            old = {record.id: record for record in before.matrices.reconstructors}
            news = tuple(r for r in after.matrices.reconstructors if old.get(r.id) is not r)
            self._archive.record(news, (), ())

    def _save(self) -> None:
        """Write what the next service needs as seldom as the service does."""
        archive, state = self._archive, self.state
        before, due = self._saved, self.time_s >= self._saved_s + SAVE_INTERVAL_S
        if archive is None:
            return
        if before is None or ((due or is_urgent(before, state)) and is_unsaved(before, state)):
            leave(archive, state, self.dome.now_ns)
            self._saved, self._saved_s = state, self.time_s


DOWN_S = 3.0
"""From the end of a service until the next one listens."""


def _opened(folder: Path) -> Archive:
    archive = Archive(folder)
    archive.open()
    return archive


def _bench(plan: Plan, working_point_modes: int | None) -> OpticsWorker:
    """Return a worker that has learnt nothing yet; at its working point if that matters."""
    modes = None if plan.plant == "linear" else working_point_modes
    sampling = Sampling(working_point_modes=modes)
    return OpticsWorker(load_instrument(plan.instrument), Compute(threads=1, sampling=sampling))
