"""The nights the whole service is put through: what the telescope does, and for how long."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

LATER_S = 10.0
"""A jump comes up to so much later, at random: in a window, or in the pause between two."""

SWING_S = 2.0
"""Of seeing that takes the optical gain with it: from one extreme to the other."""


class Case(StrEnum):
    """What the night is about."""

    DRIFT = "drift"
    """5 % of a subaperture and 0.05 deg a minute, all the time."""

    JUMP = "jump"
    """10 % of a subaperture, then 0.1 deg, at once."""

    JUMP_ROTATION = "jump-rotation"
    """0.1 deg at once, then 10 % of a subaperture."""

    BUSY = "busy"
    """Both of them together."""

    BUDGET = "budget"
    """Nothing: what does the dither cost? Played again without it."""

    SEEING = "seeing"
    """Seeing that grows from 0.8 to 1.3 arcsec and falls again, within minutes."""

    GAIN = "gain"
    """Seeing that swings by 15 % every two seconds, and the optical gain with it."""

    LOST = "lost"
    """A jump of 0.3 subapertures and 1 deg, which no loop of many modes survives."""

    RESTART = "restart"
    """The RTC begins again with the matrix of the start, in the middle of a drift."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One night; two that are equal give the same row."""

    case: Case
    plant: str = "linear"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    magnitude: float = 10.0
    seed: int = 0
    gain: float = 0.6
    n_controlled: int = 400
    seconds: float = 90.0
    period_s: float = 30.0
    """Between two things that happen; the first comes after it, when all should have settled."""

    instrument: str = "flao-lbt"
    settings: tuple[str, ...] = ()
    """Of the service, ``dither.window_s=5``, where they are not the defaults."""

    @property
    def jump_times_s(self) -> tuple[float, ...]:
        """When the mirror jumps."""
        if self.case is Case.LOST:
            return (self.period_s,)
        if self.case not in {Case.JUMP, Case.JUMP_ROTATION, Case.BUSY}:
            return ()
        due_s = np.arange(self.period_s, self.seconds - LATER_S - self.period_s / 2, self.period_s)
        later_s = np.random.default_rng((11, self.seed)).uniform(0.0, LATER_S, len(due_s))
        return tuple(np.round(due_s + later_s, 2).tolist())

    @property
    def restart_s(self) -> float | None:
        """When the RTC begins again."""
        return self.period_s if self.case is Case.RESTART else None

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        options = {
            "instrument": self.instrument,
            "plant": self.plant,
            "imperfections": self.truth,
            "mag": self.magnitude,
            "seed": self.seed,
            "gain": self.gain,
            "n-controlled": self.n_controlled,
            "wind": f"12,{37 + 61 * self.seed % 360}",
        }
        return [f"--{name}={value}" for name, value in options.items()] + self._motion()

    def _motion(self) -> list[str]:
        angle = np.random.default_rng((7, self.seed)).uniform(0.0, 2.0 * np.pi)
        x, y, turn = np.cos(angle), np.sin(angle), -1.0 if self.seed % 2 else 1.0
        drift = f"--drift={0.05 * x:.4f},{0.05 * y:.4f},{0.05 * turn},0"
        steps = (f"{0.1 * x:.4f},{0.1 * y:.4f},0,0", f"0,0,{0.1 * turn},0")
        first = int(self.case is Case.JUMP_ROTATION)
        jumps = [
            f"--jump={time_s}:{steps[k % 2]}" for k, time_s in enumerate(self.jump_times_s, first)
        ]
        match self.case:
            case Case.DRIFT | Case.RESTART:
                return [drift]
            case Case.JUMP | Case.JUMP_ROTATION:
                return jumps
            case Case.LOST:
                return [f"--jump={self.period_s}:0.3,0,1,0"]
            case Case.BUSY:
                return [drift, *jumps]
            case Case.SEEING:
                third = self.seconds / 3.0
                return ["--seeing=0.8", f"--seeing-at={third}:1.3", f"--seeing-at={2 * third}:0.9"]
            case Case.GAIN:
                times = np.arange(SWING_S, self.seconds, SWING_S)
                return [f"--seeing-at={t}:{0.85 if k % 2 else 1.15}" for k, t in enumerate(times)]
            case Case.BUDGET:
                return []
