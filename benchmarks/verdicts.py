"""What judging a reconstructor and its worth costs the worker, beside fits and an inversion.

One core, processor time, FLAO's 594 modes of which 400 or all are controlled. The cost of a fit of
a window and of an inversion in the same run says what machine that was. *Busy* is the share of one
core where it is done as often as the service does it by default.
Run: ``python -m benchmarks.verdicts``.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Observatory
from service.config import load_settings
from service.control.loop import ControlLoop
from service.control.reconstructor import Recipe, reconstruct
from service.estimation.demodulation import SIDE_OFFSETS_HZ
from service.estimation.lockin import LockInPlan, Spectra, fit_window
from service.estimation.windows import ClosedLoop
from service.files.disk_cache import usual_folder
from service.instrument import load_instrument
from service.model.interaction import InteractionModel, Linearisation
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, Conditions, OpticsWorker
from service.tracking.state import Mode
from service.tracking.updates import JUDGE_INTERVAL_S

N_MODES = 594
CONTROLLED = (400, N_MODES)
RATE_HZ, DELAY_FRAMES, LEAK, GAIN = 1000.0, 2.0, 0.999, 0.5
OPTICAL_GAIN = 0.6
WINDOW_FRAMES = 2000
LINES_HZ = (211.0, 239.0, 283.0, 331.0)
DITHERED = (501, 509, 517, 525)
SIGMA = np.array([0.003, 0.003, 1e-4, 3e-4])
IN_USE = Misregistration()
ALPHA = Misregistration(shift_x_subap=0.05, shift_y_subap=-0.03, rotation_rad=2e-3)
"""Where the mirror is while a matrix for ``IN_USE`` is in use."""

BOUND = 0.95

TELESCOPE = "--plant linear --seed 3 --alpha 0.1,-0.08,0.1,1.002 --mag 8"
SETTLING_S = 25.0
"""First windows, the first matrix, more modes: seconds that are no steady tracking."""

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """Something the worker does."""

    name: str
    work: Callable[[], object]
    every_s: float | None = None
    """How often the service asks for it while little happens; None: now and then."""


def main() -> None:
    """Print a line for each job."""
    given = _arguments()
    if given.steady is not None:
        _print_steady(given.steady, given.words)
        return
    with threadpool_limits(1):
        instrument = load_instrument("flao-lbt")
        bench = OpticsWorker(instrument, Compute(threads=1))
        model = InteractionModel(instrument, karhunen_loeve_basis(instrument))
        near, aligned = model.linearise(ALPHA), model.interaction_matrix(IN_USE)
        # the workbench has its own, once
        few = reconstruct(aligned, Recipe(n_modes=30)).matrix
        bench.judge(few, _conditions(np.diag(SIGMA**2), _settings(30)))
        sys.stdout.write(
            "| modes | job | s | fits | inversions | busy |\n|---|---|---|---|---|---|\n"
        )
        for n_modes in CONTROLLED:
            matrix = reconstruct(aligned, Recipe(n_modes=n_modes)).matrix
            jobs = list(_jobs(bench, near, aligned, matrix))
            costs_s = [_cost_s(job.work, given.repeats) for job in jobs]
            for job, cost_s in zip(jobs, costs_s, strict=True):
                busy = "" if job.every_s is None else f"{cost_s / job.every_s:.1%}"
                sys.stdout.write(
                    f"| {n_modes} | {job.name} | {cost_s:.3f} | {cost_s / costs_s[0]:.1f} "
                    f"| {cost_s / costs_s[1]:.1f} | {busy} |\n"
                )
                sys.stdout.flush()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verdicts")
    parser.add_argument("--repeats", type=int, default=3, help="the fastest counts (default: 3)")
    parser.add_argument("--steady", type=float, metavar="SECONDS", help="of tracking, simulated")
    parser.add_argument(
        "--words", default=TELESCOPE, help=f"of the simulated RTC (default: {TELESCOPE})"
    )
    return parser.parse_args()


def _print_steady(seconds: float, words: str) -> None:
    """Print what each kind of job costs per second of telemetry, once everything has settled."""
    settings = load_settings(None, {}, {})
    with threadpool_limits(1):
        bench = OpticsWorker(
            load_instrument("flao-lbt"), Compute(threads=1, cache=usual_folder(os.environ))
        )
        night = Observatory(words.split(), policy_of(settings), Mode.AUTO, bench, with_poles=False)
        night.advance(SETTLING_S)
        before = night.worker_cpu_s
        night.advance(seconds)
        after = night.worker_cpu_s
    rates = {name: (after[name] - before.get(name, 0.0)) / seconds for name in after}
    sys.stdout.write("| job | before, s | then, s per second of telemetry |\n|---|---|---|\n")
    for name, rate in sorted(rates.items(), key=lambda item: -item[1]):
        sys.stdout.write(f"| {name} | {before.get(name, 0.0):.2f} | {rate:.4f} |\n")
    sys.stdout.write(f"| all | {sum(before.values()):.2f} | {sum(rates.values()):.4f} |\n")
    sys.stdout.write(
        f"\n{len(night.swaps)} matrices swapped in; alarms: {night.glances[-1].alarms}\n"
    )


def _jobs(
    bench: OpticsWorker, near: Linearisation, aligned: Array, matrix: NDArray[np.float32]
) -> Iterator[Job]:
    """Yield the two jobs that are the measure, then those that decide on updates."""
    n_modes, covariance = len(matrix), np.diag(SIGMA**2)
    loop, window, timing = _loop(matrix), _window(len(aligned)), _timing(n_modes)
    recipe, settings = Recipe(n_modes=n_modes), _settings(n_modes)
    yield Job(
        name="fit of a window, 4 lines",
        work=lambda: fit_window(window, near, loop),
        every_s=WINDOW_FRAMES / RATE_HZ,
    )
    yield Job(name="inversion", work=lambda: reconstruct(aligned, recipe))
    yield Job(
        name="gate",
        work=lambda: bench.judge(matrix, _conditions(covariance, settings)),
        every_s=JUDGE_INTERVAL_S,
    )
    yield Job(
        name="expected gain",
        work=lambda: bench.assess(matrix, ALPHA, timing, 10.0),
        every_s=JUDGE_INTERVAL_S,
    )
    yield Job(
        name="new reconstructor, judged",
        work=lambda: bench.make(_conditions(covariance, settings)),
    )


def _conditions(covariance: NDArray[np.float64], loop: ControlLoop) -> Conditions:
    return Conditions(alpha=ALPHA, covariance=covariance, loop=loop, bound=BOUND)


def _settings(n_modes: int) -> ControlLoop:
    return ControlLoop(
        frame_rate_hz=1000.0,
        gains=np.full(n_modes, GAIN),
        leak=LEAK,
        delay_frames=DELAY_FRAMES,
        optical_gain=OPTICAL_GAIN,
    )


def _timing(n_modes: int) -> ControlLoop:
    return ControlLoop(
        frame_rate_hz=RATE_HZ,
        delay_frames=DELAY_FRAMES,
        leak=LEAK,
        gains=np.full(n_modes, GAIN),
        optical_gain=np.full(N_MODES, OPTICAL_GAIN),
    )


def _loop(matrix: NDArray[np.float32]) -> ClosedLoop:
    gains = np.zeros(N_MODES)
    gains[: len(matrix)] = GAIN
    return ClosedLoop(
        reconstructor=matrix,
        gains=gains,
        leak=LEAK,
        delay_frames=DELAY_FRAMES,
        frame_rate_hz=RATE_HZ,
    )


def _window(n_slopes: int) -> Spectra:
    """Return a window: what it holds does not change the cost of a fit."""
    rng = np.random.default_rng(1)

    def noise(*shape: int) -> NDArray[np.complex64]:
        parts: Array = rng.standard_normal((2, *shape))
        return np.asarray(parts[0] + 1j * parts[1], np.complex64)

    n_bins = 1 + len(SIDE_OFFSETS_HZ)
    dither = np.zeros((len(LINES_HZ), N_MODES), np.complex64)
    dither[np.arange(len(DITHERED)), DITHERED] = 1e-6
    return Spectra(
        plan=LockInPlan(
            modes=DITHERED,
            frequencies_hz=LINES_HZ,
            amplitude_m=(5e-9,) * len(LINES_HZ),
            frame_rate_hz=RATE_HZ,
            n_frames=WINDOW_FRAMES,
            first_seq=0,
        ),
        session="benchmark",
        cm_id="cm",
        first_seq=0,
        t_end_ns_utc=0,
        n_missing=0,
        slopes=noise(len(LINES_HZ), n_bins, n_slopes),
        commands=1e-7 * noise(len(LINES_HZ), n_bins, N_MODES),
        dither=dither,
    )


def _cost_s(work: Callable[[], object], repeats: int) -> float:
    """Return processor time, the least of a few."""
    costs = []
    for _ in range(repeats):
        start_s = time.process_time()
        work()
        costs.append(time.process_time() - start_s)
    return min(costs)


if __name__ == "__main__":
    main()
