"""What a telescope of 39 m takes: modes, D, inverse, verdict, refit, telemetry.

``python -m pyrcal_studies.elt [--only STEP ...] [--folder FOLDER]``

The instrument is ours: 100 x 100 subapertures, 83 x 83 actuators on a square grid with Gaussian
functions, 4300 modes. Each step is a process of its own with one thread; what the next one needs is
in the folder. It takes five minutes of processor time and 3.3 GB.
"""

from __future__ import annotations

import multiprocessing
import platform
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from threadpoolctl import threadpool_limits

from benchmarks import estimators
from pyrcal_studies.shared import study_parser
from service.control.gate import judge
from service.control.loop import ControlLoop
from service.control.reconstructor import invert
from service.errors import ModelError
from service.estimation import loopcheck
from service.estimation.lockin import LockIn, LockInPlan
from service.estimation.loopcheck import LoopCheck
from service.estimation.passive import PASSIVE_MEMORY_S, Passive, accumulate
from service.estimation.windows import ClosedLoop
from service.files.disk_cache import DiskCache
from service.instrument.mirrors import grid
from service.model.instrument import Instrument, Mirror
from service.model.interaction import InteractionModel, Linearisation
from service.model.kinds import Influence, InfluenceShape, KarhunenLoeve, Stop
from service.model.memory import work_of
from service.model.misregistration import Misregistration
from service.model.sensors.pyramid.description import Pyramid
from service.runtime.worker.records import Compute, check_controllable

N_MODES, RATE_HZ = 4300, 500.0
HERE = Misregistration(shift_x_subap=0.1, shift_y_subap=0.2, rotation_rad=0.1)
MOVED = np.array([0.03, -0.04, 4e-4, 1e-3])
"""From there to where the refit is to find the mirror."""

SIGMA = np.array([0.003, 0.003, np.deg2rad(0.003), 6e-5])
N_SIGNALS = 24_080
"""Of a camera's 12,040 valid subapertures: more than ours."""

Notes = Iterator[tuple[str, Callable[[], object]]]


def instrument(influence: Influence = Influence.GAUSSIAN) -> Instrument:
    """Return the telescope."""
    pitch_m = 39.0 / 82
    return Instrument(
        name="elt",
        diameter_m=39.0,
        obscuration_ratio=0.28,
        stop=Stop.TELESCOPE,
        wfs=Pyramid(
            n_subapertures=100,
            wavelength_m=800e-9,
            modulation_lambda_over_d=4.0,
            pupil_separation_subap=120.0,
        ),
        mirror=Mirror(
            positions_m=grid(83, pitch_m, 39.0 + 0.12 * pitch_m),
            pitch_m=pitch_m,
            shape=InfluenceShape(influence=influence, coupling=0.35),
        ),
        modes=KarhunenLoeve(n_modes=N_MODES),
    )


def _model(folder: Path, modes: slice | None = None) -> InteractionModel:
    basis = DiskCache(folder).basis(instrument())
    some = basis if modes is None else basis.subset(np.arange(N_MODES)[modes])
    return InteractionModel(instrument(), some)


def _basis(folder: Path) -> Notes:
    yield "KL modes, once", lambda: DiskCache(folder).basis(instrument())


def _cached(folder: Path) -> Notes:
    yield "KL modes from the disk", lambda: DiskCache(folder).basis(instrument())


def _matrix(folder: Path) -> Notes:
    model, spent = _model(folder), []

    def matrix() -> None:
        begun_s = time.process_time()
        model.interaction_matrix(HERE)
        spent.append(time.process_time() - begun_s)

    yield "D of 4300 modes", matrix
    flop = work_of(model.instrument, model.sensor, model.pupil, n_matrices=1).flop
    gflops = _gflops()
    over = spent[0] / (flop / (1e9 * gflops))
    yield (
        f"({flop / 1e12:.2f} TFLOP of products at {gflops:.0f} GFLOPS: {over:.1f} x)",
        lambda: None,
    )


def _linearise(folder: Path) -> Notes:
    model, found = _model(folder), []
    yield "D and four derivatives", lambda: found.append(model.linearise(HERE))
    np.save(folder / "matrix.npy", found[0].matrix)
    np.save(folder / "derivatives.npy", found[0].derivatives)
    expected = work_of(instrument(), model.sensor, model.pupil).memory_bytes
    yield f"(estimated before: {expected / 1e9:.2f} GB)", lambda: None


def _inverse(folder: Path) -> Notes:
    matrix, found = np.load(folder / "matrix.npy"), []
    yield "inverse", lambda: found.append(invert(matrix, N_MODES))
    np.save(folder / "reconstructor.npy", found[0].matrix)
    yield f"(condition {found[0].condition_number:.1f})", lambda: None


def _verdict(folder: Path) -> Notes:
    linearisation = Linearisation(
        alpha=HERE,
        matrix=np.load(folder / "matrix.npy", mmap_mode="r"),
        derivatives=np.load(folder / "derivatives.npy", mmap_mode="r"),
    )
    reconstructor, found = np.load(folder / "reconstructor.npy"), []
    loop = ControlLoop(
        gains=np.full(N_MODES, 0.5), leak=0.999, delay_frames=2.0, frame_rate_hz=RATE_HZ
    )

    def verdict(alpha: Misregistration) -> None:
        covariance = np.diag(SIGMA**2)
        found.append(judge(reconstructor, linearisation, alpha, covariance, loop, bound=0.95))

    yield "verdict of nine points", lambda: verdict(HERE)
    yield f"({found[-1].reason})", lambda: None
    aside = replace(HERE, shift_x_subap=HERE.shift_x_subap + 0.03)
    yield "the same 0.03 subapertures aside", lambda: verdict(aside)
    yield f"({found[-1].reason})", lambda: None


def _refit(folder: Path) -> Notes:
    model = _model(folder, slice(100, 4300, 210))
    truth = Misregistration.from_vector(HERE.vector + MOVED)
    measured, found = model.interaction_matrix(truth), [HERE]

    def step() -> None:
        near = model.linearise(found[-1])
        found.append(Misregistration.from_vector(found[-1].vector + _step(measured, near)))

    yield "refit on 20 modes, first step", step
    yield "second step", step
    left = found[-1].vector - truth.vector
    yield f"(left: {np.abs(left[:2]).max():.0e} subap, {abs(left[2]):.0e} rad)", lambda: None


def _step(measured: np.ndarray[Any, Any], near: Linearisation) -> np.ndarray[Any, Any]:
    """Return the Gauss-Newton step with a free gain for each mode."""
    own = near.matrix / np.linalg.norm(near.matrix, axis=0)
    scale = 1.0 / np.linalg.norm(measured, axis=0)
    gains = (measured * near.matrix).sum(axis=0) / (near.matrix**2).sum(axis=0)
    rates = near.derivatives * gains
    rates -= own * (rates * own).sum(axis=1, keepdims=True)
    columns = (rates * scale).reshape(4, -1).astype(float)
    residual = ((measured - gains * near.matrix) * scale).ravel().astype(float)
    return np.asarray(np.linalg.solve(columns @ columns.T, columns @ residual))


def _telemetry(folder: Path) -> Notes:
    del folder
    estimators.N_SLOPES, estimators.N_MODES, estimators.RATE_HZ = N_SIGNALS, N_MODES, RATE_HZ
    estimators.LINES_HZ = (105.0, 119.0, 141.0, 165.0)
    blocks, n_frames = list(estimators.blocks_of(60, 3000)), 3000
    plan = LockInPlan(
        modes=estimators.DITHERED,
        frequencies_hz=estimators.LINES_HZ,
        amplitude_m=(estimators.AMPLITUDE_M,) * 4,
        frame_rate_hz=RATE_HZ,
        n_frames=2500,
        first_seq=0,
    )
    law = ClosedLoop(
        cm_id="cm",
        reconstructor=np.ones((N_MODES, N_SIGNALS), np.float32),
        gains=np.full(N_MODES, 0.5, np.float32),
        leak=0.999,
        delay_frames=2.0,
        frame_rate_hz=RATE_HZ,
    )

    def lock_in() -> None:
        state = LockIn(plan=plan)
        for block in blocks:
            state = state.accumulate(block)[0]

    def check() -> None:
        state = LoopCheck()
        for block in blocks:
            state = loopcheck.observe(state, block, law)

    def passive() -> None:
        state = Passive(n_modes=N_MODES, memory_frames=PASSIVE_MEMORY_S * RATE_HZ)
        for block in blocks:
            state = accumulate(state, block)
        if not state.sums:
            raise SystemExit("passive sums: nothing was summed")

    seconds = n_frames / RATE_HZ
    yield f"lock-in of four lines, {seconds:g} s of telemetry", lock_in
    yield f"control law, {seconds:g} s of telemetry", check
    yield f"passive sums, {seconds:g} s of telemetry", passive


def _refused(folder: Path) -> Notes:
    del folder
    said = []

    def refuse() -> None:
        try:
            check_controllable(instrument(Influence.THIN_PLATE), Compute())
        except ModelError as error:
            said.append(str(error))

    yield "a thin plate of 5297 actuators, refused", refuse
    yield f"({said[0]})", lambda: None


STEPS = {
    "basis": _basis,
    "cached": _cached,
    "matrix": _matrix,
    "linearise": _linearise,
    "inverse": _inverse,
    "verdict": _verdict,
    "refit": _refit,
    "telemetry": _telemetry,
    "refused": _refused,
}


def _run(step: str, folder: str) -> None:
    """Print the rows of one step."""
    with threadpool_limits(1):
        notes = STEPS[step](Path(folder))
        for what, work in notes:
            begun_s = time.process_time()
            work()
            if what.startswith("("):
                print(f"| {what[1:-1]} | | |", flush=True)
                continue
            spent_s = time.process_time() - begun_s
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
            print(f"| {what} | {spent_s:.{0 if spent_s > 10.0 else 2}f} | {peak:.2f} |", flush=True)


def _gflops() -> float:
    rows = np.random.default_rng(0).normal(size=(3000, 3000)).astype(np.float32)
    with threadpool_limits(1):
        begun_s = time.process_time()
        rows @ rows
        return float(54.0 / (time.process_time() - begun_s))


def main() -> None:
    """Print the table."""
    parser = study_parser("pyrcal_studies.elt", __doc__)
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--folder", help="keep what steps leave for one another here")
    given = parser.parse_args()
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}, "
        f"{_gflops():.0f} GFLOPS of float32 on one core\n"
    )
    print("| what | processor s | peak GB |\n| --- | --- | --- |", flush=True)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as temporary:
        for step in given.only:
            process = context.Process(target=_run, args=(step, given.folder or temporary))
            process.start()
            process.join()
            if process.exitcode:
                raise SystemExit(f"{step}: ended with {process.exitcode}")


if __name__ == "__main__":
    main()
