"""One simulated night: a telescope, a star, the lock-in, and the error of each of its windows."""

from __future__ import annotations

import hashlib
import itertools
import os
import pickle
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInEstimate, LockInPlan, Spectra
from service.estimation.windows import ClosedLoop, WindowRefused
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.wire import DitherKind, DitherRequest
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import Ahead
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import Batch
from sim_rtc.options import parse_options
from sim_rtc.truth import WavefrontError

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Of the frame rate: what the service dithers at by itself."""

SETTLING_S = 0.5
BLOCK_BATCHES = 20

Array = NDArray[np.float64]
Window = Spectra | WindowRefused
Outcome = LockInEstimate | WindowRefused


@dataclass(frozen=True, slots=True, kw_only=True)
class Night:
    """What is run; two nights that are equal give the same rows."""

    plant: str = "diffractive"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    magnitude: float = 10.0
    wind_m_s: float = 12.0
    profile: str | None = None
    """Named layers instead of one wind."""

    seed: int = 0
    gain: float = 0.6
    n_controlled: int = 400
    amplitude_nm: float = 5.0
    """RMS of each of four modes."""

    window_s: float = 5.0
    n_windows: int = 4
    working_point_modes: int | None = None
    modes: tuple[int, ...] | None = None
    """0-based indices of the dithered ones; None: four above the controlled ones."""

    camera: str = "ccd"
    """The simulator's usual one, with 4 electrons of read noise, or "emccd": 0.4, and twice the
    photon noise."""

    instrument: str = "flao-lbt"
    rate_hz: float | None = None
    """Frames per second; None: the simulator's usual ones."""

    @property
    def dithered(self) -> tuple[int, ...]:
        """The modes a dither moves."""
        return self.modes or tuple(self.n_controlled + step for step in (9, 27, 45, 63))

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        options: dict[str, object] = {
            "plant": self.plant,
            "imperfections": self.truth,
            "mag": self.magnitude,
            "seed": self.seed,
            "gain": self.gain,
        }
        if self.profile is None:
            options["wind"] = f"{self.wind_m_s},{(37 + 61 * self.seed) % 360:g}"
        else:
            options["profile"] = self.profile
        options["n-controlled"] = self.n_controlled
        if self.instrument != "flao-lbt":
            options["instrument"] = self.instrument
        if self.rate_hz is not None:
            options["rate"] = f"{self.rate_hz:g}"
        if self.camera == "emccd":
            options |= {"read-noise": 0.4, "excess-noise": 2}
        return [f"--{name}={value}" for name, value in options.items()]


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
            outcome: Outcome
            if isinstance(seen.window, WindowRefused):
                outcome = seen.window
            else:
                outcome = bench.fit(seen.window, seen.loop, known)
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
    options = parse_options(night.words)
    telescope = build_telescope(options, load_instrument(night.instrument))
    true, error = telescope.optics.start().alpha, WavefrontError(telescope.weights)
    with Ahead(telescope.feed.blocks()) as ahead:
        computer = telescope.computer(iter(ahead))
        computer.prepare()
        plan = start_dither(night, computer, options.frame_rate_hz)
        arriving = Arriving(telescope=telescope, computer=computer, error=error)
        for window in itertools.islice(arriving.windows(plan), night.n_windows):
            seen = tuple(arriving.errors_nm)
            yield Seen(window=window, loop=loop_of(telescope), true=true, errors_nm=seen)
            arriving.errors_nm.clear()


@dataclass(slots=True, kw_only=True)
class Arriving:
    """Frames of one telescope on their way to the lock-in."""

    telescope: Telescope
    computer: RealTimeComputer
    error: WavefrontError
    errors_nm: list[float] = field(default_factory=list)
    """Wavefront error of the batches of the window under way, RMS."""

    def windows(self, plan: LockInPlan) -> Iterator[Window]:
        """Yield the windows of this plan, without end."""
        sums = LockIn(plan=plan)
        waited = 0
        for blocks in self._blocks(plan.first_seq):
            for block in blocks:
                sums, ended = sums.accumulate(block)
                yield from ended
                waited = 0 if ended or sums.window is not None else waited + block.n_frames
            if waited > 2 * plan.n_frames:
                yield WindowRefused(reason="no frame carried a dither", t_ns_utc=0)
                waited = plan.n_frames

    def _blocks(self, first_seq: int) -> Iterator[list[FrameBlock]]:
        """Yield what arrives, some batches at a time; their wavefront error is noted."""
        while True:
            batches = [self.computer.next_batch() for _ in range(BLOCK_BATCHES)]
            if batches[0].seq0 >= first_seq:
                self.errors_nm += self.error.rms_nm(batches)
            yield blocks_of(batches, self.telescope)


def start_dither(night: Night, computer: RealTimeComputer, rate_hz: float) -> LockInPlan:
    """Close the loop for a moment, ask for the dither, and return how it is to be read."""
    computer.next_batch()
    amplitude_m = (night.amplitude_nm * 1e-9,) * len(night.dithered)
    lines = tuple(round(f * rate_hz * night.window_s) / night.window_s for f in LINE_FRACTIONS)
    reply = computer.execute(
        DitherRequest(
            id="campaign",
            kind=DitherKind.SINE,
            modes=night.dithered,
            amplitude_m=amplitude_m,
            frequency_hz=lines,
            duration_s=2.0 + 1.5 * night.window_s * (night.n_windows + 2),
            seed=night.seed,
        )
    )
    if reply.start_seq is None:
        raise RuntimeError(f"the simulator refused the dither: {reply.reason}")
    return LockInPlan(
        modes=night.dithered,
        frequencies_hz=lines,
        amplitude_m=amplitude_m,
        frame_rate_hz=rate_hz,
        n_frames=round(night.window_s * rate_hz),
        first_seq=reply.start_seq + round(SETTLING_S * rate_hz),
    )


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
