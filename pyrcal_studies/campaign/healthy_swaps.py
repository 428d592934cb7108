"""Try probation on healthy swaps in turbulence that changes, and on matrices that are worse.

Run: ``python -m pyrcal_studies.campaign.healthy_swaps --plant linear --healthy 40 --worse 8
--diverging 4 --output var/healthy_swaps.jsonl``, on the simulator's small telescope of 3 m.

A healthy swap replaces the matrix of a slightly misregistered mirror by the right one. The seeing
changes by a factor of two in 10 s, the wind is 5 to 30 m/s, the frame rate 200 to 2000 Hz, and a
gust raises the residual 1.6 times for one second at a random moment around the swap. A worse
matrix has a lower loop gain, a diverging one makes the loop unstable. Telemetry goes to the
service's own comparison, in blocks of 50 ms, and to its watch of the loop and of commands that are
not played, which must raise no alarm while a healthy matrix is in use.

A healthy swap that is judged worse is played once more with the matrix before under the new id. If
that is judged worse too, the turbulence has lost the loop and the matrix is not the cause
(``unchanged_verdict``, and the true wavefront errors of both).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import SMALL, Dome, bench_of
from pyrcal_studies.campaign.rows import Row, RowFile, campaign_parser, heading, line, tell
from service.control.reconstructor import Recipe, reconstruct
from service.estimation import health
from service.estimation.comparison import REFERENCE_PERIOD_S
from service.estimation.description import actuator_watch
from service.estimation.health import LoopHealth, PlayedCommands, observe_played
from service.estimation.probation import Comparison, observe
from service.model.misregistration import Misregistration
from service.records import alarms
from service.records.operations import Verdict

Array32 = NDArray[np.float32]

RATES_HZ = (200.0, 500.0, 1000.0, 2000.0)
WINDS_M_S = (5.0, 30.0)
SEEING_ARCSEC = (0.6, 1.1)
GUST_SEEING = 1.6 ** (6 / 5)
"""Of the seeing, for a residual 1.6 times as large: the wavefront goes with its power of 5/6."""

CLOSING_S = 0.5
"""The loop closes in it; its telemetry is not shown."""

SLOW_SHARES = (0.2, 0.12)
"""Of the loop gain, in a worse matrix."""

N_SMALL = 60
SWAP_EVERY_S = 6.0
SWAPS_A_NIGHT = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """Conditions of a night."""

    seed: int
    plant: str
    kind: str
    """``healthy``, ``worse`` or ``diverging``."""

    rate_hz: float
    wind_m_s: float
    seeing_arcsec: float
    seeing_trend: int
    """1: it doubles in 10 s; -1: it halves; 0: it stays."""

    gain: float


def drawn(plant: str, kind: str, seed: int, night_number: int) -> Trial:
    """Return a night of random conditions."""
    rng = np.random.default_rng([seed + night_number, 37])
    rng.choice(RATES_HZ)  # every rate has its turn instead
    wind_m_s, seeing_arcsec = rng.uniform(*WINDS_M_S), rng.uniform(*SEEING_ARCSEC)
    trend = int(rng.integers(-1, 2))
    if kind == "healthy":
        rng.choice(4)
    rng.random(2)  # conditions of a plant that was removed: each seed keeps its night
    rate_hz = RATES_HZ[night_number % len(RATES_HZ)]
    if plant == "diffractive" and kind != "healthy":
        # seeing that this small pyramid stands: doubled, it loses every loop
        rate_hz, trend = RATES_HZ[night_number % 2], min(trend, 0)
        seeing_arcsec = 0.5 + 0.4 * (seeing_arcsec - 0.5)
    return Trial(
        seed=seed + night_number,
        plant=plant,
        kind=kind,
        rate_hz=rate_hz,
        wind_m_s=wind_m_s,
        seeing_arcsec=seeing_arcsec,
        seeing_trend=trend,
        gain=float(rng.uniform(0.3, 0.6)),
    )


Watched = tuple[Comparison, frozenset[str]]
"""A comparison that has ended, and the alarms that the watch of the loop raised meanwhile."""


def _row(trial: Trial, watched: Watched, **more: object) -> Row:
    state, raised = watched
    found = state.found
    row = asdict(trial) | more | {"alarms": sorted(raised)}
    if found is None:
        return row | {"verdict": "none"}
    names = ("after_s", "residual_ratio", "residual_limit", "mode_ratio", "limit", "common_ratio")
    numbers = {name: getattr(found, name) for name in (*names, "text")}
    return row | {"verdict": found.verdict.value} | numbers


class SimulatedNight:
    """The simulator's small telescope, with a swap every few seconds."""

    def __init__(self, trial: Trial, n_swaps: int) -> None:
        self._rng = np.random.default_rng([trial.seed, 4])
        self._trial = trial
        words = [
            f"--instrument={SMALL}",
            f"--plant={trial.plant}",
            f"--n-controlled={N_SMALL}",
            f"--gain={trial.gain}",
            f"--rate={trial.rate_hz:g}",
            f"--wind={trial.wind_m_s:.1f},20",
            f"--seed={trial.seed}",
            "--mag=8",
            f"--seeing={trial.seeing_arcsec:.2f}",
            *self._seeing_words(n_swaps),
        ]
        if trial.plant == "linear":
            words.append("--optical-gain=0.7,0.9")
        else:
            words.append("--imperfections=realistic")
        self.dome, self._n_swaps, self._n_planned = Dome(words), 0, n_swaps
        self._matrices: dict[str | None, Array32] = {}
        about = bench_of(SMALL).describe()
        self._variance = about.mode_variance_m2
        self._watch = (
            actuator_watch(about.actuators, self._variance, np.arange(N_SMALL))
            if about.actuators is not None
            else None
        )
        self.loop, self.played = LoopHealth(), PlayedCommands()
        self.alarms: frozenset[str] = frozenset()
        self.state = Comparison()
        self._swap(self._matrix(0.1))
        self._pass(CLOSING_S)
        self.state = Comparison()
        self._pass(SWAP_EVERY_S - CLOSING_S)

    def swaps(self, n: int) -> Iterator[Row]:
        """Swap right matrices and slightly misregistered ones in, in turns."""
        for k in range(n):
            row = self._swap_row(k, self._matrix(0.1 if k % 2 else 0.0))
            if row["verdict"] == Verdict.WORSE:
                row |= SimulatedNight(self._trial, self._n_planned).unchanged(k)
            yield row

    def unchanged(self, k: int) -> Row:
        """Play the night as far as swap ``k`` and leave its matrix in use under the new id."""
        for earlier in range(k):
            self._swap_row(earlier, self._matrix(0.1 if earlier % 2 else 0.0))
        row = self._swap_row(k, next(reversed(self._matrices.values())))
        return {f"unchanged_{key}": row[key] for key in ("verdict", "text", "after_nm")}

    def _swap_row(self, k: int, matrix: Array32) -> Row:
        """Swap a matrix in, let the time until the next pass, and return what is found."""
        begun_s, found_before = self.dome.time_s, self.state.found
        before_nm = self._wavefront_nm(REFERENCE_PERIOD_S)
        self._swap(matrix)
        self._pass(SWAP_EVERY_S)
        found = self.state if self.state.found is not found_before else Comparison()
        after_nm = self._wavefront_nm(SWAP_EVERY_S)
        more = {"swap_s": begun_s, "swap": k, "before_nm": before_nm, "after_nm": after_nm}
        return _row(self._trial, (found, self.alarms), **more)

    def worse(self, share: float, healthy_nm: float | None = None) -> Row:
        """Swap a matrix of so much of the loop gain in.

        The ratio is that of the wavefront error to ``healthy_nm``, of the same night with the right
        matrix, or to that before the swap.
        """
        before_nm = self._wavefront_nm(REFERENCE_PERIOD_S)
        right = next(reversed(self._matrices.values()))
        self._swap(np.asarray(share * right, np.float32))
        self._pass(4.5)
        ratio = self._wavefront_nm(4.0) / (before_nm if healthy_nm is None else healthy_nm)
        return _row(self._trial, (self.state, self.alarms), way="slow", ratio=ratio)

    def healthy_nm(self) -> float:
        """Return the wavefront error of the 4 s after a swap to the same matrix."""
        self.worse(1.0)
        return self._wavefront_nm(4.0)

    def _seeing_words(self, n_swaps: int) -> Iterator[str]:
        """Yield a seeing that changes by two in 10 s, and a gust of a second around each swap."""
        t = self._trial
        end_s, gust = (n_swaps + 1) * SWAP_EVERY_S, GUST_SEEING
        times = np.arange(1.0, end_s, 1.0)
        slow = 2.0 ** (t.seeing_trend * (1.0 - np.abs(times % 20.0 - 10.0) / 10.0))
        points = dict(zip(times.tolist(), (t.seeing_arcsec * slow).tolist(), strict=True))
        if t.kind == "healthy":
            for k in range(n_swaps):
                from_s = (k + 1) * SWAP_EVERY_S + self._rng.uniform(-4.0, 4.0)
                for at_s, factor in ((-0.1, 1.0), (0.0, gust), (1.0, gust), (1.1, 1.0)):
                    level = np.interp(from_s + at_s, times, t.seeing_arcsec * slow)
                    points[round(from_s + at_s, 2)] = float(level) * factor
        for time_s, arcsec in sorted(points.items()):
            if time_s > 0.0:
                yield f"--seeing-at={time_s:.2f}:{min(arcsec, 5.0):.3f}"

    def _matrix(self, off_subap: float) -> Array32:
        alpha = self.dome.alpha.vector + np.array([off_subap, 0.0, 2.0 * off_subap / 57.3, 0.0])
        response = bench_of(SMALL).response(Misregistration.from_vector(alpha))
        return np.ascontiguousarray(reconstruct(response, Recipe(n_modes=N_SMALL)).matrix)

    def _swap(self, matrix: Array32) -> None:
        self._n_swaps += 1
        name = f"cm-{self._n_swaps}"
        self._matrices[name] = matrix
        known = self.dome.computer.reconstructor
        manifest = replace(known.manifest, id=name)
        self.dome.stage(replace(known, matrix=matrix, manifest=manifest))

    def _pass(self, seconds: float) -> None:
        end_s, modes = self.dome.time_s + seconds - 1e-6, np.arange(N_SMALL)
        self.alarms = frozenset()
        while self.dome.time_s < end_s:
            for block in self.dome.play():
                matrix = self._matrices.get(block.cm_id)
                self.state = observe(self.state, block, modes, matrix=matrix)
                self.loop = health.observe(self.loop, block, self._variance, modes)
                if matrix is not None and self._watch is not None:
                    self.played = observe_played(self.played, block, self._watch, matrix)
                self.alarms |= {alarms.DIVERGING} if self.loop.diverging else set()
                self.alarms |= {alarms.NOT_PLAYED} if self.played.unplayed else set()

    def _wavefront_nm(self, seconds: float) -> float:
        since_s = self.dome.time_s - seconds
        last = [m.wavefront_nm for m in self.dome.moments if m.time_s > since_s]
        return float(np.sqrt(np.mean(np.square(last))))


def simulated_rows(plant: str, kind: str, n: int, seed: int) -> Iterator[Row]:
    """Yield what comes of swaps, a few in each night."""
    done = night_number = 0
    while done < n:
        trial = drawn(plant, kind, seed, night_number)
        n_swaps = min(SWAPS_A_NIGHT if kind == "healthy" else 1, n - done)
        night = SimulatedNight(trial, n_swaps)
        if kind == "healthy":
            yield from night.swaps(n_swaps)
        elif kind == "worse":
            healthy_nm = SimulatedNight(trial, n_swaps).healthy_nm()
            yield night.worse(SLOW_SHARES[night_number // 2 % 2], healthy_nm)
        else:
            yield night.worse(-0.5)
        done, night_number = done + n_swaps, night_number + 1


def main() -> int:
    """Play the swaps of each kind, and say how many of them were taken back."""
    parser = campaign_parser("healthy_swaps", __doc__)
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="linear")
    parser.add_argument("--healthy", type=int, default=10, metavar="N")
    parser.add_argument("--worse", type=int, default=0, metavar="N")
    parser.add_argument("--diverging", type=int, default=0, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    file = RowFile(given.output)
    text = heading("plant", "kind", "swaps", "taken back", "after s, the latest")
    with threadpool_limits(1):
        for kind in ("healthy", "worse", "diverging"):
            rows = []
            for row in simulated_rows(given.plant, kind, getattr(given, kind), given.seed):
                file.add(row)
                rows.append(row)
            back = [row["after_s"] for row in rows if row["verdict"] == Verdict.WORSE]
            latest = f"{max(back):.2f}" if back else "-"
            text += line(given.plant, kind, len(rows), len(back), latest)
    tell(text, given.table, parser.prog)
    return 0


if __name__ == "__main__":
    sys.exit(main())
