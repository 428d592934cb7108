"""Time of the synthetic interaction matrix, and of the same matrix from other codes.

``python -m benchmarks.model [--threads 2] [--repeat 5] [--json FILE]``

Peers compute every mode by push-pull at a cost proportional to the number of modes: they are timed
on a few and scaled to all; the difference of those columns from pyrcal's shows that it is the same
matrix. A peer that is not installed is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.peers import MODES, PEERS
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.sensor import Mapper


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """One line of the table."""

    what: str
    """What was computed, and by whom."""

    seconds: float
    """Median over the repetitions."""

    n_repeated: int
    """Repetitions; for a peer the modes really computed before scaling to all of them."""

    difference: float | None = None
    """Of a peer's columns from pyrcal's, relative Frobenius norm."""


def main() -> None:
    """Measure, print the table, write the JSON."""
    arguments = _arguments()
    with _rows_over(arguments.threads) as mapper:
        model = _model(arguments, mapper)
        timings = own_timings(model, arguments.repeat)
        if not arguments.no_peers:
            timings += peer_timings(model)
    print(_table(timings))
    if arguments.json is not None:
        report = {
            "machine": _machine(),
            "threads": arguments.threads,
            "pupil_sampling": arguments.sampling,
            "detector_nodes": arguments.nodes,
            "n_modes": model.basis.n_modes,
            "n_slopes": model.n_slopes,
            "timings": [asdict(timing) for timing in timings],
        }
        arguments.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def own_timings(model: InteractionModel, n_repeated: int) -> list[Timing]:
    """Return the times of D at a new shift, at a new rotation, and of D with its derivatives."""
    steps = np.linspace(0.01, 0.2, n_repeated)

    def shifted(step: float) -> object:
        return model.interaction_matrix(Misregistration(shift_x_subap=step))

    def turned(step: float) -> object:
        return model.interaction_matrix(Misregistration(rotation_rad=step, magnification=1 + step))

    def linearised(step: float) -> object:
        return model.linearise(Misregistration(shift_x_subap=step, rotation_rad=step))

    model.interaction_matrix(Misregistration())
    return [
        _timed("pyrcal: D at a new shift", shifted, steps),
        _timed("pyrcal: D at a new rotation and magnification", turned, steps),
        _timed("pyrcal: D and its four derivatives at a new alpha", linearised, steps),
    ]


def peer_timings(model: InteractionModel) -> list[Timing]:
    """Return the time each installed peer needs for the same matrix, on one thread."""
    own = model.interaction_matrix(Misregistration())
    found = []
    for name, peer in PEERS.items():
        try:
            measured = peer(model)
        except ImportError as error:
            print(f"{name}: left out ({error})")
            continue
        expected = own[:, MODES]
        error_norm = np.linalg.norm(measured.columns - expected) / np.linalg.norm(expected)
        found.append(
            Timing(
                what=f"{name}: D, push-pull",
                seconds=statistics.median(measured.seconds) * own.shape[1],
                n_repeated=len(measured.seconds),
                difference=float(error_norm),
            )
        )
    return found


def _timed(what: str, compute: Callable[[float], object], steps: np.ndarray) -> Timing:
    seconds = []
    for step in steps:
        start = time.perf_counter()
        compute(float(step))
        seconds.append(time.perf_counter() - start)
    return Timing(what=what, seconds=statistics.median(seconds), n_repeated=len(seconds))


@contextmanager
def _rows_over(n_threads: int) -> Iterator[Mapper]:
    """Spread rows of subapertures over threads, BLAS at one thread in each: nested is slower."""
    with threadpool_limits(limits=1), ThreadPoolExecutor(n_threads) as pool:
        yield pool.map


def _model(arguments: argparse.Namespace, mapper: Mapper) -> InteractionModel:
    instrument = load_instrument(arguments.instrument)
    return InteractionModel(
        instrument,
        karhunen_loeve_basis(instrument),
        pupil_sampling=arguments.sampling,
        detector_nodes=arguments.nodes,
        mapper=mapper,
    )


def _table(timings: list[Timing]) -> str:
    lines = [f"{'':52}{'seconds':>9}{'ratio':>8}{'difference':>12}"]
    for timing in timings:
        ratio = timing.seconds / timings[0].seconds
        percent = "" if timing.difference is None else f"{100 * timing.difference:10.2f} %"
        lines.append(f"{timing.what:52}{timing.seconds:9.3f}{ratio:8.1f}{percent}")
    return "\n".join(lines)


def _machine() -> dict[str, object]:
    return {
        "cpus": os.cpu_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.model", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--instrument", default="flao-lbt", help="packaged name or TOML file")
    parser.add_argument("--sampling", type=int, default=3, help="pupil points per subaperture")
    parser.add_argument("--nodes", type=int, default=3, help="quadrature nodes per axis")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--no-peers", action="store_true", help="time pyrcal alone")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args()


if __name__ == "__main__":
    main()
