"""The noisy interaction matrix of a closed loop, on the simulated telescope.

Random signs on all controlled modes, 5 nm RMS on the mirror altogether: what one element of the
matrix is worth after half a minute, and what the registration fitted to it is worth. Run:
``python -m pyrcal_studies.noisy_matrix --magnitude 7 --out noisy-7.json --archive noisy``. Beside
what the windows say it archives the matrix as the service does, and draws it.

``--instrument tests/system/small.toml --image-offset-rms 0.1 --images unknown`` displaces the pupil
images; their places are in the service's instrument file, unknown, or on the grid.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.night import blocks_of
from pyrcal_studies.noisy_figure import draw
from service.archive import Archive
from service.config.settings import Settings
from service.estimation.random_dither import (
    Correlated,
    RandomDither,
    RandomEstimate,
    RandomPlan,
    join_random_windows,
    noisy_matrix,
)
from service.estimation.windows import WindowRefused
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.sensors.registry import kind_of
from service.runtime.estimates import work_out
from service.runtime.policy import floor_of
from service.runtime.worker import Compute, OpticsWorker
from service.tracking.operation_records import MeasurementRecord, MeasureState
from service.wire import DitherKind, DitherRequest
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import Ahead
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.options import parse_options
from sim_rtc.truth import WavefrontError

Array = NDArray[np.float64]

IMAGES = ("on the grid", "told", "unknown")
"""What the service's instrument file says of the pupil images' places."""

SETTLING_S = 0.5
N_BATCHES = 20
"""Of the simulator, in one block of telemetry."""


def main() -> None:
    """Play, print a line per window, write what was found."""
    given = _arguments()
    instrument = load_instrument(given.instrument)
    options = parse_options(_simulated(given))
    rows: list[dict[str, Any]] = []
    with threadpool_limits(1):
        telescope = build_telescope(options, instrument)
        true = telescope.optics.start().alpha
        about = _with_images(instrument, given.images, telescope.plant.image_offsets_px)
        bench = OpticsWorker(about, Compute(threads=1))
        floor = floor_of(Settings(), about)
        total: Correlated | None = None
        start = Misregistration()
        for window, wavefront_nm in _windows(given, telescope, options.frame_rate_hz):
            outcome: RandomEstimate | WindowRefused
            if isinstance(window, WindowRefused):
                outcome = window
            else:
                total = window if total is None else join_random_windows(total, window)
                outcome = bench.fit_random(window, start)
            rows.append(_row(outcome, true, floor) | {"wavefront_nm": wavefront_nm})
            if isinstance(outcome, RandomEstimate):
                start = outcome.alpha
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
            sys.stdout.flush()
        if total is None:
            raise SystemExit("no window was finished")
        whole = bench.fit_random(total, start)
        if given.archive is not None:
            _archive(given, total, bench, start)
    found = {
        "arguments": {k: str(v) for k, v in vars(given).items()},
        "windows": rows,
        "whole": _row(whole, true, floor) | _signal(total),
    }
    given.out.write_text(json.dumps(found, indent=1) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.noisy_matrix")
    parser.add_argument("--instrument", default="flao-lbt")
    parser.add_argument("--image-offset-rms", type=float, default=0.0, help="pixels")
    parser.add_argument("--images", default="on the grid", choices=IMAGES)
    parser.add_argument("--plant", default="diffractive", choices=["diffractive", "linear"])
    parser.add_argument("--truth", default="ideal", choices=["ideal", "realistic"])
    parser.add_argument("--magnitude", type=float, default=7.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gain", type=float, default=0.6)
    parser.add_argument("--wind", default="12,37")
    parser.add_argument("--n-controlled", type=int, default=400)
    parser.add_argument("--n-modes", type=int, default=400, help="dithered, the first ones")
    parser.add_argument("--total-nm", type=float, default=5.0, help="RMS of all modes together")
    parser.add_argument("--window-s", type=float, default=5.0)
    parser.add_argument("--windows", type=int, default=6)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--archive", type=Path, help="folder for the matrix and its picture")
    return parser.parse_args()


def _simulated(given: argparse.Namespace) -> list[str]:
    return [
        f"--plant={given.plant}",
        f"--imperfections={given.truth}",
        f"--mag={given.magnitude}",
        f"--seed={given.seed}",
        f"--gain={given.gain}",
        f"--wind={given.wind}",
        f"--n-controlled={given.n_controlled}",
        f"--image-offset-rms={given.image_offset_rms}",
    ]


def _windows(
    given: argparse.Namespace, telescope: Telescope, rate_hz: float
) -> Iterator[tuple[Correlated | WindowRefused, float]]:
    """Yield windows of random dither, each with the wavefront error since the last, nm RMS."""
    errors_nm: list[float] = []
    error, n_done = WavefrontError(telescope.weights), 0
    with Ahead(telescope.feed.blocks()) as ahead:
        computer = telescope.computer(iter(ahead))
        computer.prepare()
        state = RandomDither(plan=_started(given, computer, rate_hz))
        while n_done < given.windows:
            batches = [computer.next_batch() for _ in range(N_BATCHES)]
            if batches[0].seq0 >= state.plan.first_seq:
                errors_nm += error.rms_nm(batches)
            for block in blocks_of(batches, telescope):
                state, ended = state.accumulate(block)
                for window in ended:
                    n_done += 1
                    yield window, float(np.sqrt(np.mean(np.square(errors_nm))))
                    errors_nm.clear()


def _started(given: argparse.Namespace, computer: RealTimeComputer, rate_hz: float) -> RandomPlan:
    """Close the loop for a moment, ask for the dither, and return how it is to be read."""
    computer.next_batch()
    modes = tuple(range(given.n_modes))
    amplitude_m = (given.total_nm * 1e-9 / np.sqrt(given.n_modes),) * given.n_modes
    reply = computer.execute(
        DitherRequest(
            id="study",
            kind=DitherKind.BINARY,
            modes=modes,
            amplitude_m=amplitude_m,
            duration_s=2.0 + given.window_s * (given.windows + 2),
            seed=given.seed,
        )
    )
    if reply.start_seq is None:
        raise SystemExit(f"the simulator refused the dither: {reply.reason}")
    return RandomPlan(
        modes=modes,
        amplitude_m=amplitude_m,
        n_frames=round(given.window_s * rate_hz),
        first_seq=reply.start_seq + round(SETTLING_S * rate_hz),
    )


def _with_images(instrument: Instrument, images: str, offsets_px: Array | None) -> Instrument:
    """Return the instrument with the places of its pupil images told, or unknown."""
    if images == "unknown":
        return replace(instrument, unknown=(*instrument.unknown, "wfs.image_offsets_px"))
    if images == "told" and offsets_px is not None:
        return replace(instrument, wfs=kind_of(instrument).with_images_at(instrument, offsets_px))
    return instrument


def _row(
    outcome: RandomEstimate | WindowRefused, true: Misregistration, floor: Array
) -> dict[str, Any]:
    if isinstance(outcome, WindowRefused):
        return {"refused": outcome.reason}
    error = (outcome.alpha.vector - true.vector) * BOUNDARY_SCALE
    sigma = outcome.sigma * BOUNDARY_SCALE
    return {
        "error": error.tolist(),
        "sigma": sigma.tolist(),
        "sigma_with_floor": np.hypot(sigma, floor).tolist(),
        "misfit": outcome.misfit,
        "optical_gain": float(np.average(outcome.optical_gain, weights=outcome.gain_sigma**-2.0)),
        "lag_frames": float(outcome.lag_frames[0]),
    }


def _signal(total: Correlated) -> dict[str, Any]:
    found = noisy_matrix(total)
    return {
        "snr": found.snr,
        "snr_of_modes": found.snr_of_modes.tolist(),
        "n_pairs": total.sums.n_pairs,
        "memory": total.sums.memory,
    }


def _archive(
    given: argparse.Namespace, total: Correlated, bench: OpticsWorker, start: Misregistration
) -> None:
    """Archive the matrix as the service does, and draw it."""
    instrument = load_instrument(given.instrument)
    record = MeasurementRecord(
        id=f"noisy-mag{given.magnitude:g}",
        state=MeasureState.FINISHING,
        pattern=None,
        modes=total.plan.modes,
        amplitude_m=total.plan.amplitude_m,
        duration_s=given.window_s * given.windows,
        window_s=given.window_s,
        seed=given.seed,
        asked_ns_utc=0,
        basis_id="simulated",
        config_id="simulated",
    )
    record, numbers = work_out(bench, record, total, start)
    archive = Archive(given.archive)
    archive.open()
    with archive:
        archive.noisy.store(record, numbers, instrument.name)
    picture = draw(archive.noisy.path_of(record.id), instrument)
    (given.archive / f"{record.id}.png").write_bytes(picture)


if __name__ == "__main__":
    main()
