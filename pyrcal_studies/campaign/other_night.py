"""A night at an outside RTC: the telescope, the service, and the service killed and begun anew."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pyrcal_studies.campaign.kept_night import KeptNight
from pyrcal_studies.campaign.observatory import Latencies
from pyrcal_studies.campaign.other_truth import OtherDome, OtherLink, Truth
from service.config import load_settings
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.tracking.state import Mode

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


class OtherNight(KeptNight):
    """The service at such a telescope; with a ``folder`` it can be killed and begun again."""

    dome: OtherDome

    def __init__(self, plan: Plan, folder: Path | None = None) -> None:
        settings = load_settings(None, {}, {"control.n_modes_target": plan.n_target})
        self.said: dict[tuple[str, str], float] = {}
        """Every text of an alarm, and when it was said first."""

        super().__init__(
            policy_of(settings),
            Mode.AUTO,
            _bench(plan, settings.compute.working_point_modes),
            folder,
            latencies=LATENCIES,
            dome=plan.dome(),
            link=OtherLink,
        )

    def pass_(self, until_s: float) -> None:
        """Let time pass, and read what is said."""
        while self.time_s < until_s - 1e-9:
            self.advance(0.25)
            self.save()
            for alarm in self.state.alarms.active:
                self.said.setdefault((alarm.name, alarm.text), round(self.time_s, 2))


def _bench(plan: Plan, working_point_modes: int | None) -> OpticsWorker:
    """Return a worker that has learnt nothing yet; at its working point if that matters."""
    modes = None if plan.plant == "linear" else working_point_modes
    sampling = Sampling(working_point_modes=modes)
    return OpticsWorker(load_instrument(plan.instrument), Compute(threads=1, sampling=sampling))
