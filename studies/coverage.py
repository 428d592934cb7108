"""Is σ what it says? Many dithered windows on the simulated telescope, against the truth.

Runs the simulated real-time computer without a network, as fast as it goes, estimates α from each
window as the service does, and compares errors with the predicted covariance: the scatter of the
windows of one telescope with the data's own σ, the errors of all of them with σ and the model-error
floor together. Run: ``python -m studies.coverage --telescopes 5 --windows 24 --mag 8``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from service.config import load_instrument, load_settings
from service.estimation import lockin
from service.estimation.frames import FrameBlock
from service.estimation.instrumental import Loop, WindowEstimate
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.wire import DitherAction, DitherKind, DitherRequest
from service.worker import Compute, Workbench
from sim_rtc.assembly import build_telescope
from sim_rtc.computer import RealTimeComputer
from sim_rtc.feed import Ahead
from sim_rtc.options import Options, parse_options

MODES = (509, 527, 545, 563)
FREQUENCIES_HZ = (211.0, 239.0, 283.0, 331.0)
AMPLITUDE_M = 5e-9
SETTLING_FRAMES = 500

Array = NDArray[np.float64]


def windows(computer: RealTimeComputer, plan: LockInPlan, n_windows: int) -> Iterator[Spectra]:
    """Yield demodulated windows of the running loop."""
    lock_in, found = LockIn(plan=plan), 0
    dt_ns = round(1e9 / plan.frame_rate_hz)
    while found < n_windows:
        batch = computer.next_batch()
        block = FrameBlock(
            session=batch.session,
            first_seq=batch.seq0,
            t0_ns_utc=batch.seq0 * dt_ns,
            dt_ns=dt_ns,
            slopes=batch.slopes,
            commands_m=batch.commands_m,
            dither_m=batch.dither_m,
            cm_id=batch.cm_id,
        )
        lock_in, ended = lockin.accumulate(lock_in, block)
        for window in ended:
            if isinstance(window, Spectra):
                found += 1
                yield window


def estimates(
    options: Options, instrument: Instrument, bench: Workbench, *, window_s: float, n_windows: int
) -> tuple[Misregistration, list[WindowEstimate]]:
    """Return the truth of one telescope and what each of its windows says."""
    telescope = build_telescope(options, instrument)
    with Ahead(telescope.feed.blocks()) as ahead:
        computer = telescope.computer(iter(ahead))
        computer.prepare()
        computer.next_batch()
        reply = computer.execute(
            DitherRequest(
                id="coverage",
                action=DitherAction.START,
                kind=DitherKind.SINE,
                modes=MODES,
                amplitude_m=(AMPLITUDE_M,) * len(MODES),
                frequency_hz=FREQUENCIES_HZ,
                duration_s=2.0 + window_s * (n_windows + 1),
            )
        )
        if reply.start_seq is None:
            raise SystemExit(f"the simulator refused the dither: {reply.reason}")
        snapshot = computer.snapshot()
        loop = Loop(
            reconstructor=snapshot.reconstructor.matrix,
            gains=np.array(snapshot.gains),
            leak=snapshot.settings.leak,
            delay_frames=snapshot.settings.delay_frames,
            frame_rate_hz=snapshot.settings.frame_rate_hz,
        )
        plan = LockInPlan(
            modes=MODES,
            frequencies_hz=FREQUENCIES_HZ,
            amplitude_m=(AMPLITUDE_M,) * len(MODES),
            frame_rate_hz=loop.frame_rate_hz,
            n_frames=round(window_s * loop.frame_rate_hz),
            first_seq=reply.start_seq + SETTLING_FRAMES,
        )
        true = telescope.optics.start().alpha
        found: list[WindowEstimate] = []
        for spectra in windows(computer, plan, n_windows):
            outcome = bench.fit(spectra, loop, found[-1].alpha if found else Misregistration())
            if isinstance(outcome, WindowEstimate):
                found.append(outcome)
            else:
                sys.stdout.write(f"refused: {outcome.reason}\n")
    return true, found


def main() -> None:
    """Print scatter, errors and coverage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--telescopes", type=int, default=5)
    parser.add_argument("--windows", type=int, default=24)
    parser.add_argument("--window-s", type=float, default=2.0)
    parser.add_argument("--mag", type=float, default=8.0)
    parser.add_argument("--plant", default="linear")
    parser.add_argument("--gain", type=float, default=0.4)
    parser.add_argument("--working-point-modes", type=int)
    given = parser.parse_args()
    threadpool_limits(1)
    instrument = load_instrument("flao-lbt")
    bench = Workbench(instrument, Compute(working_point_modes=given.working_point_modes))
    tracking = load_settings(None, {}).tracking
    floor = np.array(
        [
            tracking.floor_shift_subap,
            tracking.floor_shift_subap,
            np.deg2rad(tracking.floor_rotation_deg),
            tracking.floor_magnification,
        ]
    )
    ratios, errors, distances = [], [], []
    for seed in range(given.telescopes):
        options = parse_options(
            [f"--{name}={value}" for name, value in (("seed", seed), *_simulated(given))]
        )
        true, found = estimates(
            options, instrument, bench, window_s=given.window_s, n_windows=given.windows
        )
        values = np.array([e.alpha.vector for e in found])
        sigma = np.array([np.sqrt(np.diag(e.covariance)) for e in found])
        ratios.append(values.std(axis=0, ddof=1) / sigma.mean(axis=0))
        errors.append((values.mean(axis=0) - true.vector) * BOUNDARY_SCALE)
        for estimate in found:
            error = estimate.alpha.vector - true.vector
            total = estimate.covariance + np.diag(floor**2)
            distances.append(float(error @ np.linalg.solve(total, error)))
        _say(f"telescope {seed}: mean error", errors[-1])
        _say("             scatter / σ", ratios[-1])
        _say("             σ of a window", sigma.mean(axis=0) * BOUNDARY_SCALE)
    _say("all: scatter / σ", np.sqrt(np.mean(np.square(ratios), axis=0)))
    _say("all: RMS of the mean errors", np.sqrt(np.mean(np.square(errors), axis=0)))
    inside = np.mean(np.array(distances) < chi2.ppf(0.95, 4))
    sys.stdout.write(
        f"{len(distances)} windows: mean chi2/4 {np.mean(distances) / 4:.2f}, "
        f"{inside:.1%} inside the 95 % ellipse, floor included\n"
    )


def _simulated(given: argparse.Namespace) -> list[tuple[str, object]]:
    return [(name, getattr(given, name)) for name in ("mag", "plant", "gain")]


def _say(label: str, values: Array) -> None:
    cells = "  ".join(f"{n} {v:+.5f}" for n, v in zip(PARAMETERS, values, strict=True))
    sys.stdout.write(f"{label:28} {cells}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
