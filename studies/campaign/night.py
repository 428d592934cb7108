"""One simulated night: a telescope, a star, an estimator, and the error of each of its windows."""

from __future__ import annotations

import hashlib
import itertools
import os
import pickle
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.config import load_instrument
from service.estimation import lockin, passive, randomdither
from service.estimation.frames import FrameBlock
from service.estimation.instrumental import Loop, WindowEstimate
from service.estimation.lockin import LockIn, LockInPlan, Spectra, WindowRefused
from service.estimation.noisymatrix import RandomEstimate
from service.estimation.passive import Passive, PassiveEstimate
from service.estimation.randomdither import Correlated, RandomDither, RandomPlan
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.wire import DitherAction, DitherKind, DitherRequest
from service.worker import Compute, Workbench
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer import RealTimeComputer
from sim_rtc.feed import Ahead
from sim_rtc.options import parse_options
from sim_rtc.telemetry import Batch
from sim_rtc.truth import WavefrontError
from studies.campaign.trouble import Trouble, options_for, troubled

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Of the frame rate: what the service dithers at by itself."""

SETTLING_S = 0.5
BLOCK_BATCHES = 20

Array = NDArray[np.float64]
Window = Spectra | Correlated | Passive | WindowRefused
Outcome = WindowEstimate | RandomEstimate | PassiveEstimate | WindowRefused


class Estimator(StrEnum):
    """What looks at the telemetry."""

    LOCK_IN = "lock-in"
    RANDOM = "random"
    PASSIVE = "passive"


@dataclass(frozen=True, slots=True, kw_only=True)
class Night:
    """What is run; two nights that are equal give the same rows."""

    plant: str = "diffractive"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    estimator: Estimator = Estimator.LOCK_IN
    trouble: Trouble = Trouble.NONE
    magnitude: float = 10.0
    wind_m_s: float = 12.0
    profile: str | None = None
    """Named layers instead of one wind."""

    seed: int = 0
    gain: float = 0.6
    n_controlled: int = 400
    amplitude_nm: float = 5.0
    """RMS of each of four modes; 0: the dither is left out, for the wavefront error."""

    window_s: float = 5.0
    n_windows: int = 4
    working_point_modes: int | None = None
    modes: tuple[int, ...] | None = None
    """0-based indices of the dithered ones; None: four above the controlled ones."""

    camera: str = "ccd"
    """The simulator's usual one, with 4 electrons of read noise, or "emccd": 0.4, and twice the
    photon noise."""

    @property
    def dithered(self) -> tuple[int, ...]:
        """The modes a dither moves."""
        return self.modes or tuple(self.n_controlled + step for step in (9, 27, 45, 63))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """One window of a night's telemetry, and the truth behind it."""

    window: Window
    loop: Loop
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
        bench = Workbench(
            load_instrument("flao-lbt"),
            Compute(threads=1, working_point_modes=night.working_point_modes),
        )
        for k, seen in enumerate(_kept(night, keep)):
            outcome = _estimated(night, seen, known, bench)
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
    telescope = build_telescope(options, load_instrument("flao-lbt"))
    true, error = telescope.optics.start().alpha, WavefrontError(telescope.weights)
    with Ahead(telescope.feed.blocks()) as ahead:
        computer = telescope.computer(iter(ahead))
        computer.prepare()
        plan = start_dither(night, computer, options.frame_rate_hz)
        errors_nm: list[float] = []
        windows = _windows(night, computer, plan, telescope, error, errors_nm)
        for window in itertools.islice(windows, night.n_windows):
            seen = tuple(errors_nm)
            yield Seen(window=window, loop=loop_of(telescope), true=true, errors_nm=seen)
            errors_nm.clear()


def simulated(night: Night) -> list[str]:
    """Return the simulator's options of a night."""
    options = {
        "plant": night.plant,
        "imperfections": night.truth,
        "mag": night.magnitude,
        "seed": night.seed,
        "gain": night.gain,
        "n-controlled": night.n_controlled,
    }
    if night.profile is None:
        options["wind"] = f"{night.wind_m_s},{37 + 61 * night.seed % 360}"
    else:
        options["profile"] = night.profile
    words = [f"--{name}={value}" for name, value in options.items()]
    if night.camera == "emccd":
        words += ["--read-noise=0.4", "--excess-noise=2"]
    return words + options_for(night.trouble, LINE_FRACTIONS[1])


def start_dither(
    night: Night, computer: RealTimeComputer, rate_hz: float
) -> LockInPlan | RandomPlan:
    """Close the loop for a moment, ask for the dither, and return how it is to be read."""
    computer.next_batch()
    n_frames = round(night.window_s * rate_hz)
    amplitude_m = (night.amplitude_nm * 1e-9,) * len(night.dithered)
    lines = tuple(round(f * rate_hz * night.window_s) / night.window_s for f in LINE_FRACTIONS)
    first_seq = round(SETTLING_S * rate_hz)
    silent = night.estimator is Estimator.PASSIVE or night.amplitude_nm == 0.0
    if not silent:
        sine = night.estimator is Estimator.LOCK_IN
        reply = computer.execute(
            DitherRequest(
                id="campaign",
                action=DitherAction.START,
                kind=DitherKind.SINE if sine else DitherKind.BINARY,
                modes=night.dithered,
                amplitude_m=amplitude_m,
                frequency_hz=lines if sine else None,
                duration_s=2.0 + 1.5 * night.window_s * (night.n_windows + 2),
                seed=night.seed,
            )
        )
        if reply.start_seq is None:
            raise RuntimeError(f"the simulator refused the dither: {reply.reason}")
        first_seq += reply.start_seq
    if night.estimator is Estimator.RANDOM:
        return RandomPlan(
            modes=night.dithered,
            amplitude_m=amplitude_m,
            n_frames=n_frames,
            first_seq=first_seq,
        )
    return LockInPlan(
        modes=night.dithered,
        frequencies_hz=lines,
        amplitude_m=tuple(max(a, 1e-12) for a in amplitude_m),
        frame_rate_hz=rate_hz,
        n_frames=n_frames,
        first_seq=first_seq,
    )


def _windows(
    night: Night,
    computer: RealTimeComputer,
    plan: LockInPlan | RandomPlan,
    telescope: Telescope,
    error: WavefrontError,
    errors_nm: list[float],
) -> Iterator[Window]:
    """Yield finished windows of telemetry; the wavefront error of their batches is appended."""
    sums: Any = RandomDither(plan=plan) if isinstance(plan, RandomPlan) else LockIn(plan=plan)
    accumulate: Any = randomdither.accumulate if isinstance(plan, RandomPlan) else lockin.accumulate
    quiet = night.estimator is Estimator.PASSIVE or night.amplitude_nm == 0.0
    watched = Passive(
        n_modes=night.n_controlled,
        memory_frames=2.0 * plan.n_frames,
        delay_frames=telescope.settings.delay_frames,
    )
    rng, n_frames = np.random.default_rng(night.seed), 0
    while True:
        batches = [computer.next_batch() for _ in range(BLOCK_BATCHES)]
        if batches[0].seq0 >= plan.first_seq:
            errors_nm += error.rms_nm(batches)
        for block in troubled(blocks_of(batches, telescope), night.trouble, rng):
            if not quiet:
                sums, ended = accumulate(sums, block)
                yield from ended
            elif block.first_seq >= plan.first_seq:
                watched = passive.accumulate(watched, block)
                n_frames += block.n_frames
        if quiet and n_frames >= plan.n_frames:
            yield watched
            n_frames = 0


def blocks_of(batches: list[Batch], telescope: Telescope) -> list[FrameBlock]:
    """Return batches as the link delivers them: joined while nothing changes."""
    dt_ns = round(1e9 / telescope.settings.frame_rate_hz)
    kept = [(b.session, b.cm_id, b.dither_m is None) for b in batches]
    edges = [0, *(k for k in range(1, len(kept)) if kept[k] != kept[k - 1]), len(kept)]
    blocks = []
    for start, stop in itertools.pairwise(edges):
        part = batches[start:stop]
        dithers = [b.dither_m for b in part if b.dither_m is not None]
        blocks.append(
            FrameBlock(
                session=part[0].session,
                first_seq=part[0].seq0,
                t0_ns_utc=part[0].seq0 * dt_ns,
                dt_ns=dt_ns,
                slopes=np.concatenate([b.slopes for b in part]),
                commands_m=np.concatenate([b.commands_m for b in part]),
                dither_m=np.concatenate(dithers) if dithers else None,
                cm_id=part[0].cm_id,
            )
        )
    return blocks


def loop_of(telescope: Telescope) -> Loop:
    """Return the loop as it starts."""
    settings = telescope.settings
    gains = np.array(settings.gains)
    gains[len(telescope.reconstructor.matrix) :] = 0.0
    return Loop(
        reconstructor=telescope.reconstructor.matrix,
        gains=gains,
        leak=settings.leak,
        delay_frames=settings.delay_frames,
        frame_rate_hz=settings.frame_rate_hz,
    )


def _estimated(night: Night, seen: Seen, start: Misregistration, bench: Workbench) -> Outcome:
    window = seen.window
    if isinstance(window, WindowRefused):
        return window
    if night.amplitude_nm == 0.0 and night.estimator is not Estimator.PASSIVE:
        return WindowRefused(reason="no dither was asked for", t_ns_utc=0)
    match window:
        case Spectra():
            return bench.fit(window, seen.loop, start)
        case Correlated():
            return bench.fit_random(window, start)
        case Passive():
            found = bench.watch(window, start)
            return found or WindowRefused(reason="too few frames", t_ns_utc=0)


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
    if isinstance(outcome, PassiveEstimate):
        # nothing is known of the wind's bias in a night without a dither
        covariance = covariance + np.diag(outcome.sigma**2 - np.diag(covariance))
    return row | {
        "refused": None,
        "error": (difference * BOUNDARY_SCALE).tolist(),
        "covariance": (covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)).tolist(),
        "optical_gain": float(gains.mean()),
        "misfit": outcome.misfit,
    }


def without_dither(night: Night) -> Night:
    """Return the twin of a night whose wavefront error shows what the dither costs."""
    return replace(night, amplitude_nm=0.0)
