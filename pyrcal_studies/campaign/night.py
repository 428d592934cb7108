"""One simulated night: a telescope, a star, an estimator, and the error of each of its windows."""

from __future__ import annotations

import hashlib
import itertools
import os
import pickle
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.plan import Night
from pyrcal_studies.campaign.telemetry import LINE_FRACTIONS, Arriving, Window, start_dither
from pyrcal_studies.campaign.trouble import options_for, prepare
from service.estimation.lockin import LockInEstimate, Spectra
from service.estimation.random_dither import Correlated, RandomEstimate
from service.estimation.windows import ClosedLoop, WindowRefused
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.runtime.worker import Compute, OpticsWorker, Sampling
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import Ahead
from sim_rtc.options import parse_options
from sim_rtc.truth import WavefrontError

Array = NDArray[np.float64]
Outcome = LockInEstimate | RandomEstimate | WindowRefused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """One window of a night's telemetry, and the truth behind it."""

    window: Window
    loop: ClosedLoop
    true: Misregistration
    errors_nm: tuple[float, ...]
    """Wavefront error of its batches, RMS."""


def play(night: Night, keep: Path | None = None) -> list[dict[str, Any]]:
    """Run one night and return a row for each of its windows.

    With ``keep`` the sums of its telemetry are put there, and a night that is there already is
    not simulated again: only looked at, perhaps with another model.
    """
    with threadpool_limits(1):
        rows, known = [], Misregistration()
        # of this night alone: it follows the seeing, and rows must not depend on other nights
        bench = OpticsWorker(
            load_instrument(night.instrument),
            Compute(threads=1, sampling=Sampling(working_point_modes=night.working_point_modes)),
        )
        for k, seen in enumerate(_kept(night, keep)):
            outcome = _estimated(seen, known, bench)
            if not isinstance(outcome, WindowRefused):
                known = outcome.alpha
            alpha = (seen.true.vector * BOUNDARY_SCALE).tolist()
            rows.append(asdict(night) | _row(outcome, seen) | {"window": k, "alpha": alpha})
        return rows


def kept_in(night: Night, folder: Path) -> Path:
    """Return the file of a night's sums: the model it is looked at with plays no part."""
    words = repr(replace(night, working_point_modes=None))
    return folder / f"{hashlib.sha256(words.encode()).hexdigest()[:16]}.pickle"


def _kept(night: Night, keep: Path | None) -> Iterator[Seen]:
    if keep is None:
        yield from _simulated_windows(night)
        return
    path = kept_in(night, keep)
    if not path.exists():
        keep.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(f".{os.getpid()}")
        unfinished.write_bytes(pickle.dumps(list(_simulated_windows(night)), protocol=5))
        unfinished.rename(path)
    yield from pickle.loads(path.read_bytes())


def _simulated_windows(night: Night) -> Iterator[Seen]:
    options = parse_options(simulated(night))
    telescope = build_telescope(options, load_instrument(night.instrument))
    true, error = telescope.optics.start().alpha, WavefrontError(telescope.weights)
    with Ahead(telescope.feed.blocks()) as ahead:
        computer = telescope.computer(iter(ahead))
        computer.prepare()
        prepare(night.trouble, computer, options.frame_rate_hz)
        plan = start_dither(night, computer, options.frame_rate_hz)
        arriving = Arriving(night=night, telescope=telescope, computer=computer, error=error)
        for window in itertools.islice(arriving.windows(plan), night.n_windows):
            seen = tuple(arriving.errors_nm)
            yield Seen(window=window, loop=loop_of(telescope), true=true, errors_nm=seen)
            arriving.errors_nm.clear()


def simulated(night: Night) -> list[str]:
    """Return the simulator's options of a night."""
    words = [*night.words(37 + 61 * night.seed), f"--n-controlled={night.n_controlled}"]
    if night.instrument != "flao-lbt":
        words.append(f"--instrument={night.instrument}")
    if night.rate_hz is not None:
        words.append(f"--rate={night.rate_hz:g}")
    if night.camera == "emccd":
        words += ["--read-noise=0.4", "--excess-noise=2"]
    return words + options_for(night.trouble, LINE_FRACTIONS[1])


def loop_of(telescope: Telescope) -> ClosedLoop:
    """Return the loop as it starts."""
    settings = telescope.settings
    gains = np.array(settings.gains)
    gains[len(telescope.reconstructor.matrix) :] = 0.0
    return ClosedLoop(
        reconstructor=telescope.reconstructor.matrix,
        gains=gains,
        leak=settings.leak,
        delay_frames=settings.delay_frames,
        frame_rate_hz=settings.frame_rate_hz,
    )


def _estimated(seen: Seen, start: Misregistration, bench: OpticsWorker) -> Outcome:
    match seen.window:
        case Spectra() as window:
            return bench.fit(window, seen.loop, start)
        case Correlated() as window:
            return bench.fit_random(window, start)
        case refused:
            return refused


def _row(outcome: Outcome, seen: Seen) -> dict[str, Any]:
    row: dict[str, Any] = {
        "wavefront_nm": float(np.sqrt(np.mean(np.square(seen.errors_nm))))
        if seen.errors_nm
        else None
    }
    if isinstance(outcome, WindowRefused):
        return row | {"refused": outcome.reason}
    difference = outcome.alpha.vector - seen.true.vector
    covariance, gains = outcome.covariance, np.abs(outcome.optical_gain)
    return row | {
        "refused": None,
        "error": (difference * BOUNDARY_SCALE).tolist(),
        "covariance": (covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)).tolist(),
        "optical_gain": float(gains.mean()),
        "misfit": outcome.misfit,
    }
