"""Windows of a dither on many simulated telescopes, and the error of each.

Run: ``python -m pyrcal_studies.campaign --magnitudes 7,10,12.5 --seeds 0:10 --output
var/campaign.jsonl``; nights that are there already are not run again. A night is a telescope, a
star, a dither and the service's lock-in, without its tracker. The table has bias, scatter,
coverage, refusals and wavefront error.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Dome
from pyrcal_studies.campaign.rows import (
    UNITS,
    Row,
    add_workers,
    campaign_parser,
    complete,
    floats,
    four,
    grouped,
    heading,
    line,
    range_of,
    tell,
    words,
)
from service.config import load_settings
from service.estimation.estimate import model_error
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.windows import ClosedLoop
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.records.estimates import LockInEstimate, WindowRefused
from service.runtime.policy import floor_of
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.wire import DitherKind, DitherRequest

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331, 0.389)
"""Of the frame rate: what the service dithers at by itself; the fifth is of a low mode."""

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
    def amplitudes_nm(self) -> tuple[float, ...]:
        """RMS of each of them, nm."""
        return (self.amplitude_nm,) * len(self.dithered)

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
        options["wind"] = f"{self.wind_m_s},{(37 + 61 * self.seed) % 360:g}"
        options["n-controlled"] = self.n_controlled
        if self.instrument != "flao-lbt":
            options["instrument"] = self.instrument
        if self.rate_hz is not None:
            options["rate"] = f"{self.rate_hz:g}"
        if self.camera == "emccd":
            options |= {"read-noise": 0.4, "excess-noise": 2}
        return [f"--{name}={value}" for name, value in options.items()]


def play(night: Night) -> list[Row]:
    """Run one night and return a row for each of its windows."""
    with threadpool_limits(1):
        # of this night alone: it follows the seeing, and rows must not depend on other nights
        bench = OpticsWorker(
            load_instrument(night.instrument),
            Compute(threads=1, sampling=Sampling(working_point_modes=night.working_point_modes)),
        )
        dome = Dome(night.words, block_batches=BLOCK_BATCHES)
        dome.play()
        sums = LockIn(plan=start_dither(night, dome))
        loop, known, rows = loop_of(dome), Misregistration(), list[Row]()
        for window, wavefront_nm in itertools.islice(windows(dome, sums), night.n_windows):
            outcome: Outcome
            if isinstance(window, WindowRefused):
                outcome = window
            else:
                outcome = bench.fit(window, loop, known)
            if not isinstance(outcome, WindowRefused):
                known = outcome.alpha
            about = {"window": len(rows), "alpha": (dome.alpha.vector * BOUNDARY_SCALE).tolist()}
            about["wavefront_nm"] = wavefront_nm
            rows.append(asdict(night) | about | _row(outcome, dome.alpha))
        return rows


def windows(dome: Dome, sums: LockIn) -> Iterator[tuple[Window, float | None]]:
    """Yield the windows of a dither without end, each with the RMS wavefront error during it."""
    waited, errors_nm = 0, list[float]()
    while True:
        for block in dome.play():
            sums, ended = sums.accumulate(block)
            for window in ended:
                yield window, _rms(errors_nm)
                errors_nm.clear()
            waited = 0 if ended or sums.window is not None else waited + block.n_frames
        if sums.window is not None:
            errors_nm.append(dome.moments[-1].wavefront_nm)
        if waited > 2 * sums.plan.n_frames:
            yield WindowRefused(reason="no frame carried a dither", t_ns_utc=0), None
            waited = sums.plan.n_frames


def _rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def start_dither(night: Night, dome: Dome) -> LockInPlan:
    """Ask for the dither, and return how it is to be read."""
    rate_hz = dome.rate_hz
    amplitude_m = tuple(1e-9 * size for size in night.amplitudes_nm)
    fractions = LINE_FRACTIONS[: len(night.dithered)]
    lines = tuple(round(f * rate_hz * night.window_s) / night.window_s for f in fractions)
    reply = dome.order(
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


def loop_of(dome: Dome) -> ClosedLoop:
    """Return the loop as it starts."""
    settings, matrix = dome.telescope.settings, dome.telescope.reconstructor.matrix
    gains = np.array(settings.gains)
    gains[len(matrix) :] = 0.0
    return ClosedLoop(
        reconstructor=matrix,
        gains=gains,
        leak=settings.leak,
        delay_frames=settings.delay_frames,
        frame_rate_hz=settings.frame_rate_hz,
    )


def _row(outcome: Outcome, true: Misregistration) -> Row:
    if isinstance(outcome, WindowRefused):
        return {"refused": str(outcome.reason)}
    difference = outcome.alpha.vector - true.vector
    return {
        "refused": None,
        "error": (difference * BOUNDARY_SCALE).tolist(),
        "covariance": (outcome.covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)).tolist(),
        "misfit": outcome.misfit,
    }


HEADER = heading(
    *("night", "windows (refused)", "bias x, y % / mdeg / %", "scatter", "scatter/σ", "chi2/4"),
    *("inside 95 %", "error RMS", "wavefront nm"),
)


def table(rows: list[Row], floor: Array, *, pooled: bool = False) -> str:
    """Return the campaign as a Markdown table; ``floor`` ``(4,)`` in boundary units.

    ``pooled``: one line for all winds.
    """
    groups = grouped(rows, Night, "seed", "n_windows", *(["wind_m_s"] if pooled else []))
    return HEADER + "".join(_line(group, floor, pooled=pooled) for group in groups)


def _line(rows: list[Row], floor: Array, *, pooled: bool) -> str:
    good = [row for row in rows if row["refused"] is None]
    wavefront = np.array([row["wavefront_nm"] for row in rows if row["wavefront_nm"] is not None])
    name = _name(rows[0], "many winds" if pooled else f"{rows[0]['wind_m_s']:g} m/s")
    counted = f"{len(rows)} ({len(rows) - len(good)})"
    error_nm = f"{np.sqrt(np.mean(wavefront**2)):.1f}" if wavefront.size else "-"
    if not good:
        return line(name, counted, *"------", error_nm)
    errors = np.array([row["error"] for row in good])
    covariances = np.array([row["covariance"] for row in good])
    seeds = np.array([row["seed"] for row in good])
    sigma = np.sqrt(np.mean(np.diagonal(covariances, axis1=1, axis2=2), axis=0))
    scatter = _within(errors, seeds)
    squares = distances(errors, covariances + model_errors(good), floor)
    inside = np.mean(squares < scipy.stats.chi2.ppf(0.95, 4))
    return line(
        *(name, counted),
        four(errors.mean(axis=0) * UNITS),
        four(scatter * UNITS),
        four(scatter / sigma),
        f"{squares.mean() / 4:.2f}",
        f"{inside:.0%}",
        four(np.sqrt(np.mean(errors**2, axis=0)) * UNITS),
        error_nm,
    )


def model_errors(rows: list[Row]) -> Array:
    """Return ``(n, 4, 4)`` what the misfit of each window adds, which the service adds as well."""
    return np.array([np.diag(model_error(row["covariance"], row["misfit"]) ** 2) for row in rows])


def distances(errors: Array, covariances: Array, floor: Array) -> Array:
    """Return ``(n,)`` normalised squared errors, floor included: four degrees of freedom."""
    total = covariances + np.diag(floor**2)
    return np.array([e @ np.linalg.solve(c, e) for e, c in zip(errors, total, strict=True)])


def _within(errors: Array, seeds: NDArray[np.int_]) -> Array:
    """Return the RMS scatter about each telescope's own mean, ``(4,)``."""
    squares, freedom = np.zeros(4), 0
    for seed in np.unique(seeds):
        own = errors[seeds == seed]
        squares += np.sum((own - own.mean(axis=0)) ** 2, axis=0)
        freedom += len(own) - 1
    return np.asarray(np.sqrt(squares / freedom)) if freedom else np.full(4, np.nan)


def _name(key: Row, wind: str) -> str:
    words = [
        f"{key['plant']} {key['truth']}, mag {key['magnitude']:g}, {wind}",
        f"{key['n_controlled']} modes g {key['gain']:g}",
        f"4 x {key['amplitude_nm']:g} nm, {key['window_s']:g} s",
    ]
    if key["working_point_modes"]:
        words.append("working point")
    if key["modes"]:
        words.append("modes " + " ".join(str(mode) for mode in key["modes"]))
    if key["instrument"] != "flao-lbt":
        words.insert(0, Path(key["instrument"]).stem)
    if key["rate_hz"]:
        words.append(f"{key['rate_hz']:g} Hz")
    if key["camera"] != "ccd":
        words.append(key["camera"])
    return ", ".join(words)


def main() -> int:
    """Run what is missing, then print the table."""
    parser = _parser()
    given = parser.parse_args()
    rows = complete(play, _nights(given), given)
    environment = {}
    if given.working_point_modes is not None:
        environment["PYRCAL_COMPUTE__WORKING_POINT_MODES"] = str(given.working_point_modes)
    floor = floor_of(load_settings(None, environment), load_instrument(given.instrument))
    text = table(rows, floor, pooled=given.winds_in_turn is not None)
    tell(text, given.table, parser.prog)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = campaign_parser("", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(2), metavar="FIRST:END")
    parser.add_argument("--magnitudes", type=floats, default=(10.0,), metavar="R,R...")
    parser.add_argument("--winds", type=floats, default=(12.0,), metavar="M_S,M_S...")
    parser.add_argument(
        "--winds-in-turn",
        type=floats,
        metavar="M_S,M_S...",
        help="one for each seed, over and over, and one line of the table for all",
    )
    parser.add_argument("--truths", type=words, default=("ideal",), metavar="NAME,NAME...")
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="diffractive")
    parser.add_argument("--gain", type=float, default=0.6)
    parser.add_argument("--n-controlled", type=int, default=400)
    parser.add_argument("--amplitude-nm", type=float, default=5.0, help="RMS of each of four modes")
    parser.add_argument("--window-s", type=float, default=5.0)
    parser.add_argument("--windows", type=int, default=4, help="of each night")
    parser.add_argument("--working-point-modes", type=int)
    parser.add_argument("--modes", type=_modes, metavar="MODE,MODE...", help="that are dithered")
    parser.add_argument("--camera", choices=("ccd", "emccd"), default="ccd")
    parser.add_argument("--instrument", default="flao-lbt", metavar="NAME|FILE")
    parser.add_argument("--rate", type=float, metavar="HZ", help="frames per second")
    add_workers(parser, os.cpu_count() or 1)
    return parser


def _nights(given: argparse.Namespace) -> Iterator[Night]:
    """Yield every night of the grid."""
    grid = itertools.product(given.seeds, given.truths, given.magnitudes, given.winds)
    turns = given.winds_in_turn
    for seed, truth, magnitude, wind in grid:
        wind_m_s = wind if turns is None else turns[seed % len(turns)]
        yield Night(
            plant=given.plant,
            truth=truth,
            magnitude=magnitude,
            wind_m_s=wind_m_s,
            seed=seed,
            gain=given.gain,
            n_controlled=given.n_controlled,
            amplitude_nm=given.amplitude_nm,
            window_s=given.window_s,
            n_windows=given.windows,
            working_point_modes=given.working_point_modes,
            modes=given.modes,
            camera=given.camera,
            instrument=given.instrument,
            rate_hz=given.rate,
        )


def _modes(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))
