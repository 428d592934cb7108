"""Registration by correlations of commands beside that by slopes, on the same telemetry.

``python -m pyrcal_studies.command_correlation --instrument flao-lbt --plant linear --winds
0,5,10,20 --seeds 0:5 --output rows.jsonl`` plays the nights that the file lacks and prints the
table. Every block of telemetry goes to all readings: *slopes*, the passive estimate; *commands*,
that of :mod:`service.estimation.correlation`; *increments*, the same with increments alone for its
instrument, a regression of what Berdeu et al. (2024) correlate; and *peak*, the sums of *commands*
read as they do: where the correlation has its peak in space. σ is that of the service while nothing
is known of the bias. ``--registered`` gives the loop a reconstructor for an α that is nearly true,
instead of one for a perfect registration.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.passive_nights import REGISTERED_TO
from pyrcal_studies.campaign.passive_table import WITHIN
from pyrcal_studies.campaign.rows import UNITS, Row, RowFile, floats, four, heading, line, range_of
from pyrcal_studies.campaign.telemetry import SETTLING_S, blocks_of
from service.config import load_instrument, load_settings
from service.config.policy import floor_of
from service.control.reconstructor import invert
from service.estimation import correlation, passive
from service.estimation.correlation import CommandCorrelation
from service.estimation.frames import FrameBlock
from service.estimation.passive import BAND_FRAMES, N_TAPS, PASSIVE_MEMORY_S, HighPass, Passive
from service.estimation.windows import ClosedLoop
from service.model.interaction import InteractionModel, Linearisation
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import ModalBasis, analytic_basis
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.options import parse_options

Array = NDArray[Any]
Reading = Passive | CommandCorrelation

LOOK_S = 4.0
BATCHES = 10
ASIDE = np.array([0.05, -0.04, 0.05, 0.001])
"""From the truth to where fits begin, subapertures, degrees, ratio: a reading that hears nothing
of α stays there."""

NO_WIND_M_S = 1e-3
"""The simulator's layers must move."""

REACH = 2.0
"""Subapertures from the middle, within which a correlation's shape is looked at."""

HEADER = heading(
    *("loop", "wind m/s", "reading", "looks", "error RMS x, y % / mdeg / %"),
    *("steady part", "scatter between looks", "scatter stated", "within 1.96 σ stated, each"),
    *("optical gain", "misfit"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A night that is played."""

    instrument: str
    plant: str
    wind_m_s: float
    seed: int
    magnitude: float
    rate_hz: float
    gain: float
    registered: bool
    looks: int

    @property
    def words(self) -> list[str]:
        """The simulator's command line; winds of one seed blow in as many directions."""
        direction_deg = (37 + 61 * self.seed + 9 * self.wind_m_s) % 360
        return [
            f"--instrument={self.instrument}",
            f"--plant={self.plant}",
            f"--wind={max(self.wind_m_s, NO_WIND_M_S)},{direction_deg:g}",
            f"--mag={self.magnitude}",
            f"--rate={self.rate_hz}",
            f"--gain={self.gain}",
            f"--seed={self.seed}",
        ]


class IncrementSums(Passive):
    """Sums whose instrument is the increment of a frame, and no other."""

    __slots__ = ()

    @property
    @override
    def instrument_filter(self) -> HighPass:
        """Differences of commands."""
        return increment_filter(int(self.delay_frames) - 1)


@cache
def increment_filter(ahead: int) -> HighPass:
    """Return the filter ``z_k = c_k - c_{k-1}``."""
    taps = np.zeros(N_TAPS, np.float32)
    taps[ahead], taps[ahead + 1] = 1.0, -1.0
    none = np.zeros(BAND_FRAMES - 1, np.float32)
    band = scipy.linalg.toeplitz([taps[-1], *none], [*taps[::-1], *none])
    return HighPass(taps=taps, ahead=ahead, band=band)


def main() -> int:
    """Play what is missing, then print the table."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.command_correlation")
    parser.add_argument("--instrument", default="flao-lbt")
    parser.add_argument("--plant", choices=["linear", "diffractive"], default="linear")
    parser.add_argument("--winds", type=floats, default="0,5,10,20", metavar="M_S,M_S...")
    parser.add_argument("--seeds", type=range_of, default="0:3", metavar="FIRST:END")
    parser.add_argument("--magnitude", type=float, default=8.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--gain", type=float, default=0.4)
    parser.add_argument("--registered", action="store_true")
    parser.add_argument("--looks", type=int, default=2, help=f"of {LOOK_S:g} s each")
    parser.add_argument("--output", type=Path, default=Path("correlation.jsonl"))
    given = parser.parse_args()
    file = RowFile(given.output)
    done = {json.dumps(row["case"], sort_keys=True) for row in file.rows}
    with threadpool_limits(1):
        for seed, wind in itertools.product(given.seeds, given.winds):
            case = Case(
                instrument=given.instrument,
                plant=given.plant,
                wind_m_s=wind,
                seed=seed,
                magnitude=given.magnitude,
                rate_hz=given.rate,
                gain=given.gain,
                registered=given.registered,
                looks=given.looks,
            )
            if json.dumps(asdict(case), sort_keys=True) not in done:
                file.add(*play(case))
    sys.stdout.write(table(file.rows))
    return 0


def play(case: Case) -> Iterator[Row]:
    """Yield a row for every reading of every look of a night."""
    options = parse_options(case.words)
    telescope = build_telescope(options, load_instrument(options.instrument))
    floor = floor_of(load_settings(None, {}), load_instrument(options.instrument))
    true = telescope.optics.start().alpha
    if case.registered:
        telescope = _registered(case, telescope, true)
    near = model_of(case.instrument).linearise(
        Misregistration.from_vector(true.vector + ASIDE / BOUNDARY_SCALE)
    )
    computer = telescope.computer(telescope.feed.blocks())
    computer.prepare()
    seq, states = 0, begun(telescope)
    for look in range(case.looks):
        states = {name: state.emptied(rests=False) for name, state in states.items()}
        while seq < (SETTLING_S + (look + 1) * LOOK_S) * case.rate_hz:
            for block in blocks_of([computer.next_batch() for _ in range(BATCHES)], telescope):
                seq = block.next_seq
                if block.first_seq >= SETTLING_S * case.rate_hz:
                    states = {name: fed(state, block) for name, state in states.items()}
        for name, state in states.items():
            estimate = state.fit(near)
            if estimate is None:
                raise RuntimeError(f"{name}: {state.n_effective:.0f} frames are too few")
            yield {
                "case": asdict(case),
                "look": look,
                "reading": name,
                "error": ((estimate.alpha.vector - true.vector) * BOUNDARY_SCALE).tolist(),
                "scatter": (np.sqrt(np.diag(estimate.covariance)) * BOUNDARY_SCALE).tolist(),
                "sigma": np.hypot(estimate.sigma * BOUNDARY_SCALE, floor).tolist(),
                "gain": float(np.mean(estimate.optical_gain)),
                "misfit": float(estimate.misfit),
            }
        shift = peak(states["commands"], near, case.instrument)
        yield {
            "case": asdict(case),
            "look": look,
            "reading": "peak",
            "error": [*(shift + ASIDE[:2]).tolist(), np.nan, np.nan],
        }


@cache
def model_of(instrument: str) -> InteractionModel:
    """Return the model of an instrument."""
    known = load_instrument(instrument)
    return InteractionModel(known, analytic_basis(known))


def _registered(case: Case, telescope: Telescope, true: Misregistration) -> Telescope:
    """Return the telescope with the reconstructor of an α that is nearly the true one."""
    off = REGISTERED_TO * np.random.default_rng(case.seed).normal(size=4)
    known = Misregistration.from_vector(true.vector + off)
    matrix = model_of(case.instrument).interaction_matrix(known)
    made = invert(matrix, len(telescope.reconstructor.matrix)).matrix
    return replace(telescope, reconstructor=replace(telescope.reconstructor, matrix=made))


def begun(telescope: Telescope) -> dict[str, Reading]:
    """Return all readings before the first frame."""
    settings, matrix = telescope.settings, telescope.reconstructor.matrix
    terms = ClosedLoop(
        cm_id=None,
        reconstructor=matrix,
        gains=np.array(settings.gains[: len(matrix)], np.float32),
        leak=settings.leak,
        delay_frames=settings.delay_frames,
        frame_rate_hz=settings.frame_rate_hz,
    )
    slopes, increments = (
        kind(
            n_modes=len(matrix),
            memory_frames=PASSIVE_MEMORY_S * settings.frame_rate_hz,
            delay_frames=settings.delay_frames,
        )
        for kind in (Passive, IncrementSums)
    )
    commands = CommandCorrelation(n_modes=len(matrix), sums=slopes, terms=terms)
    return {
        "slopes": slopes,
        "commands": commands,
        "increments": replace(commands, sums=increments),
    }


def fed(state: Reading, block: FrameBlock) -> Reading:
    """Return a reading after one more block."""
    if isinstance(state, CommandCorrelation):
        return correlation.accumulate(state, block)
    return passive.accumulate(state, block)


def peak(state: Reading, near: Linearisation, instrument: str) -> Array:
    """Return how far the peak of a correlation in space lies from where it should, ``(2,)``.

    The map of ``E[δ_{k+d}(x + Δ) z_k(x)]``, summed over the pupil, is fitted by that of ``R D`` and
    of its change with either shift, all three free: subapertures.
    """
    if not isinstance(state, CommandCorrelation) or state.terms is None:
        raise TypeError(f"peak: found {type(state).__name__}; expected correlations of a loop")
    seen, moved = (part.astype(float) for part in state.sums.sums[:2])
    matrix = state.terms.reconstructor.astype(float)
    modes, apart, count = _map_points(instrument, len(matrix))
    inside = np.hypot(*apart.T) <= REACH

    def mapped(product: Array) -> Array:
        pairs = modes @ product @ modes.T
        return np.asarray(np.bincount(count.ravel(), pairs.ravel(), len(apart))[inside])

    shape = mapped(matrix @ near.matrix[:, : len(matrix)] @ moved)
    rates = [mapped(matrix @ part[:, : len(matrix)] @ moved) for part in near.derivatives[:2]]
    found = np.linalg.lstsq(np.stack([shape, *rates], axis=1), mapped(seen), rcond=None)[0]
    return np.asarray(found[1:] / found[0])


@cache
def _map_points(instrument: str, n_modes: int) -> tuple[Array, Array, Array]:
    """Return modes at the subapertures, the distances of pairs of those, and which pair has which.

    ``(n_points, n_modes)``, ``(n_distances, 2)`` and ``(n_points, n_points)``.
    """
    model = model_of(instrument)
    if not isinstance(model.basis, ModalBasis):
        raise TypeError(f"{instrument}: found a measured basis; expected one of actuators")
    n = model.instrument.wfs.n_subapertures
    axis = np.arange(n) - (n - 1) / 2
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    points = points[np.hypot(*points.T) <= n / 2]
    pairs = points[:, None] - points[None]
    apart, count = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    return model.basis.render(points)[:, :n_modes], apart, count.reshape(pairs.shape[:2])


def table(rows: list[Row]) -> str:
    """Return a line for each reading of each kind of night; seeds share it."""
    groups: dict[tuple[str, float, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[_name(row["case"]), row["case"]["wind_m_s"], row["reading"]].append(row)
    return HEADER + "".join(_line(*key, group) for key, group in groups.items())


def _name(case: Row) -> str:
    words = [Path(case["instrument"]).stem, case["plant"], f"mag {case['magnitude']:g}"]
    words += [f"{case['rate_hz']:g} Hz"] + ["registered"] * case["registered"]
    return ", ".join(words)


def _line(name: str, wind: float, reading: str, rows: list[Row]) -> str:
    """Say how far looks are off, and how much of that is the same in all looks of a night."""
    errors = np.array([row["error"] for row in rows])
    nights = defaultdict(list)
    for row, error in zip(rows, errors, strict=True):
        nights[row["case"]["seed"]].append(error)
    between = np.concatenate(
        [np.array(e) - np.mean(e, axis=0) for e in nights.values() if len(e) > 1] or [errors[:0]]
    )
    n_free = len(between) - sum(len(e) > 1 for e in nights.values())
    scatter = np.sqrt(np.sum(between**2, axis=0) / max(n_free, 1))
    rms = np.sqrt(np.mean(errors**2, axis=0))
    steady = np.sqrt(np.maximum(rms**2 - scatter**2, 0.0))
    cells: list[object] = [name, f"{wind:g}", reading, len(rows)]
    cells += [four(part * UNITS) for part in (rms, steady, scatter)]
    if reading == "peak":
        return line(*cells, "-", "-", "-", "-")
    stated = np.sqrt(np.mean(np.square([row["scatter"] for row in rows]), axis=0))
    within = np.abs(errors) <= WITHIN * np.array([row["sigma"] for row in rows])
    cells += [four(stated * UNITS), " ".join(f"{share:.0%}" for share in within.mean(axis=0))]
    cells += [f"{np.mean([row['gain'] for row in rows]):.2f}"]
    return line(*cells, f"{np.median([row['misfit'] for row in rows]):.2f}")


if __name__ == "__main__":
    sys.exit(main())
