"""Probation tried: matrices at the edge of stability, and good ones in changing seeing.

Run: ``python -m pyrcal_studies.campaign.probation --plant diffractive --marginal 50 --good 50
--output var/probation.jsonl``. The small telescope, no service: matrices are swapped in one after
the other, telemetry is compared as the service does, which knows their numbers, and one that is
found worse gives way to the one before ``BACK_S`` later. A marginal matrix is made for a
registration so far off, in a random direction, that the loop's largest pole radius, with the
response that the sensor has around the residual wavefront of this very night, is what the trial
asks for; a good one for the true registration, as well as it is measured. Each has as many modes as
before, more, or fewer.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.observatory_checks import true_response
from pyrcal_studies.campaign.observatory_dome import Dome, Moment
from pyrcal_studies.campaign.small import SMALL, bench_of
from service.control.loop import pole_radius
from service.control.reconstructor import Recipe, reconstruct
from service.estimation.comparison import ProbationFinding, Verdict
from service.estimation.probation import Comparison, observe
from service.model.misregistration import Misregistration
from service.wire import DitherKind, DitherRequest, DitherStop, LoopRequest
from sim_rtc.computer.telemetry import Batch
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array = NDArray[np.float64]

RADII = (1.0, 1.03, 1.06, 1.1)
BACK_S = 0.3
"""From the verdict until the matrix before is in use again."""

SETTLED_S = 3.0
"""With a matrix before the next trial."""

JUDGED_S = 4.3
"""At most, with the one on trial."""

LOST_RATIO = 1.5
"""Times the wavefront error of the night's beginning: the loop is lost, the night ends."""

REACH = np.array([0.3, 0.3, np.deg2rad(2.0), 0.02])
"""How far α is off for as much loss in each parameter (numeric units)."""

MEASURED = 0.05
"""Share of that by which a good matrix is off."""

TRIALS_A_NIGHT = 12
N_MODES = (45, 60)
GAIN = 0.6
_N_RESIDUALS = 8
_STROKE_M = 5e-9
_DITHER = DitherRequest(
    id="trial",
    kind=DitherKind.SINE,
    modes=(70, 75, 80, 85),
    amplitude_m=(10e-9,) * 4,
    frequency_hz=(205.0, 251.0, 293.0, 347.0),
    duration_s=600.0,
)


class Sky(Dome):
    """A telescope that remembers residual wavefronts."""

    residuals: list[NDArray[np.float32]]

    @override
    def _moment(self, batches: list[Batch]) -> Moment:
        first = batches[0]
        residual = first.optics.opd_per_command @ first.commands_m[0] + first.phase_m
        self.residuals = [*getattr(self, "residuals", [])[1 - _N_RESIDUALS :], residual]
        return super()._moment(batches)


class Night:
    """One night of swaps."""

    def __init__(self, plant: str, seed: int) -> None:
        self._rng = rng = np.random.default_rng(seed)
        seeing = [f"--seeing-at={t}:{rng.uniform(0.6, 1.1):.2f}" for t in range(3, 120, 3)]
        words = [
            f"--instrument={SMALL}",
            f"--plant={plant}",
            f"--n-controlled={N_MODES[0]}",
            f"--gain={GAIN}",
            f"--wind={rng.uniform(6, 15):.1f},20",
            f"--mag={rng.uniform(7, 10):.1f}",
            f"--seed={seed}",
            "--seeing=0.8",
            *seeing,
        ]
        words.append(
            "--imperfections=realistic" if plant == "diffractive" else "--optical-gain=0.7,0.9"
        )
        self.dome = Sky(words)
        self.words = tuple(words)
        self.comparison = Comparison()
        self._model = bench_of(SMALL)
        self._n_swaps, self._n_now, self.dithered = 0, N_MODES[0], False
        self._matrices: dict[str | None, NDArray[np.float32]] = {}
        self._swap(self.good(N_MODES[0]))
        self.pass_(SETTLED_S)
        self.calm_nm = self.wavefront_nm(1.0)
        self._response = self._on_sky()

    def good(self, n_modes: int) -> NDArray[np.float32]:
        """Return a matrix for α as it is measured."""
        return self._at(self._rng.normal(size=4) * MEASURED, n_modes)

    def marginal(self, radius: float, n_modes: int) -> NDArray[np.float32]:
        """Return one whose loop has this largest pole radius on this sky."""
        away = self._rng.normal(size=4)
        low, high = 0.0, 6.0
        for _ in range(10):
            middle = (low + high) / 2
            stable = self.radius(self._at(middle * away / np.linalg.norm(away), n_modes)) < radius
            low, high = (middle, high) if stable else (low, middle)
        return self._at(high * away / np.linalg.norm(away), n_modes)

    def radius(self, matrix: NDArray[np.float32]) -> float:
        """Return the largest pole radius of its loop on this sky."""
        terms = self.dome.computer.status()
        eigenvalues = np.linalg.eigvals(GAIN * (matrix @ self._response[:, : len(matrix)]))
        radii = pole_radius(eigenvalues, leak=terms.leak, delay_frames=terms.delay_frames)
        return float(radii.max())

    def trial(self, matrix: NDArray[np.float32], kind: str, radius: float) -> dict[str, object]:
        """Swap a matrix in and return what came of it; one found worse gives way again."""
        before, before_nm = self.dome.computer.reconstructor.matrix, self.wavefront_nm(1.0)
        began_s = self.dome.time_s
        self._swap(matrix)
        found: ProbationFinding | None = None
        while found is None and self.dome.time_s < began_s + JUDGED_S:
            self.pass_(0.05)
            found = self.comparison.found
        after_nm, after_s = self.wavefront_nm(0.2), self.dome.time_s - began_s
        worse = found is not None and found.verdict is Verdict.WORSE
        if worse:
            self.pass_(BACK_S)
            worst_nm = self.wavefront_nm(0.2)
            self._swap(before)
        else:
            worst_nm = after_nm
        for _ in range(3 if worse else 1):
            self.pass_(SETTLED_S if worse else 0.2)
            if self.wavefront_nm(0.5) < LOST_RATIO * self.calm_nm:
                break
        return {
            "kind": kind,
            "radius": radius,
            "n_modes": len(matrix),
            "n_before": len(before),
            "dithered": self.dithered,
            "verdict": "none" if found is None else found.verdict.value,
            "within_s": after_s,
            "mode_ratio": found.mode_ratio if found else None,
            "limit": found.limit if found else None,
            "common_ratio": found.common_ratio if found else None,
            "residual_ratio": found.residual_ratio if found else None,
            "residual_limit": found.residual_limit if found else None,
            "slopes_ratio": found.slopes_ratio if found else None,
            "before_nm": before_nm,
            "after_nm": after_nm,
            "worst_nm": worst_nm,
            "recovered_nm": self.wavefront_nm(0.5),
            "calm_nm": self.calm_nm,
        }

    @property
    def lost(self) -> bool:
        """Whether the loop does not hold any more, whatever matrix is in use."""
        return self.wavefront_nm(0.5) > 2.0 * LOST_RATIO * self.calm_nm

    def toggle_dither(self) -> None:
        """Begin or end a dither."""
        self.dome.order(DitherStop(id="stop") if self.dithered else _DITHER)
        self.dithered = not self.dithered

    def pass_(self, seconds: float) -> None:
        """Let time pass, and compare."""
        end_s = self.dome.time_s + seconds - 1e-6
        modes = np.arange(self._n_now)
        lines = _DITHER.frequency_hz or ()
        while self.dome.time_s < end_s:
            for block in self.dome.play():
                matrix = self._matrices.get(block.cm_id)
                self.comparison = observe(self.comparison, block, modes, lines, matrix=matrix)

    def wavefront_nm(self, seconds: float) -> float:
        """Return the RMS wavefront error of the last seconds."""
        since_s = self.dome.time_s - seconds - 1e-6
        last = [m.wavefront_nm for m in self.dome.moments if m.time_s > since_s]
        return float(np.sqrt(np.mean(np.square(last))))

    def _at(self, away: Array, n_modes: int) -> NDArray[np.float32]:
        alpha = Misregistration.from_vector(self.dome.alpha.vector + away * REACH)
        recipe = Recipe(n_modes=n_modes)
        return np.ascontiguousarray(reconstruct(self._model.response(alpha), recipe).matrix)

    def _swap(self, matrix: NDArray[np.float32]) -> None:
        self._n_swaps += 1
        name, n_modes, total = (
            f"cm-{self._n_swaps}",
            len(matrix),
            self.dome.instrument.modes.n_modes,
        )
        gains = (GAIN,) * n_modes + (0.0,) * (total - n_modes)
        self._matrices[name] = matrix
        self.dome.order(LoopRequest(id=name, n_controlled=n_modes, gains=gains))
        known = self.dome.computer.reconstructor
        manifest = replace(known.manifest, id=name)
        self.dome.stage(replace(known, matrix=matrix, manifest=manifest))
        self._n_now = n_modes

    def _on_sky(self) -> NDArray[np.float32]:
        """Return the response ``(n_slopes, n_modes)`` around residual wavefronts, their mean."""
        optics, rng = self.dome.optics, np.random.default_rng(0)
        if not isinstance(optics, DiffractiveOptics):
            return true_response(optics, N_MODES[-1])
        columns = []
        for mode in range(N_MODES[-1]):
            stroke = np.float32(_STROKE_M) * optics.opd_per_command[:, mode]
            pairs = [
                optics.slopes(r + stroke, None, rng) - optics.slopes(r - stroke, None, rng)
                for r in self.dome.residuals
            ]
            columns.append(np.mean(pairs, axis=0) / np.float32(2.0 * _STROKE_M))
        return np.column_stack(columns)


def nights(plant: str, n_marginal: int, n_good: int, first_seed: int, output: Path) -> None:
    """Run trials, night after night, and write what came of each at once.

    Those that are in the file count: it goes on with the night after the last of them.
    """
    lines = output.read_text(encoding="utf-8").splitlines() if output.exists() else []
    done = [row for row in map(json.loads, lines) if row["plant"] == plant]
    n_done = Counter(row["kind"] for row in done)
    left = {"marginal": n_marginal - n_done["marginal"], "good": n_good - n_done["good"]}
    seed = max([first_seed, *(row["seed"] + 1 for row in done)])
    while any(n > 0 for n in left.values()):
        night, rng = Night(plant, seed), np.random.default_rng(1000 + seed)
        for k in range(TRIALS_A_NIGHT):
            kinds = [kind for kind, n in left.items() if n > 0]
            if not kinds:
                return
            kind, n_modes = kinds[k % len(kinds)], N_MODES[int(rng.integers(2))]
            radius = RADII[int(rng.integers(len(RADII)))] if kind == "marginal" else 0.0
            matrix = night.marginal(radius, n_modes) if radius else night.good(n_modes)
            if not radius and rng.random() < 0.5:
                night.toggle_dither()
            row = night.trial(matrix, kind, radius or night.radius(matrix))
            left[kind] -= 1
            with output.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"plant": plant, "seed": seed, "trial": k, **row}) + "\n")
            if night.lost:
                break
        seed += 1


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.probation")
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="diffractive")
    parser.add_argument("--marginal", type=int, default=10, metavar="N")
    parser.add_argument("--good", type=int, default=10, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("var/probation.jsonl"))
    given = parser.parse_args()
    given.output.parent.mkdir(parents=True, exist_ok=True)
    begun = time.process_time()
    with threadpool_limits(1):
        nights(given.plant, given.marginal, given.good, given.seed, given.output)
    sys.stdout.write(f"{time.process_time() - begun:.0f} s of processor time\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
