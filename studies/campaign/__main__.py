"""Campaigns: seeds x magnitudes x winds x truths, in parallel and resumable.

Run: ``pyrcal campaign --magnitudes 7,10,12.5 --seeds 0:10 --output var/campaign.jsonl``; rows that
are there already are not run again. ``--table FILE.md`` writes the table, ``--plot FILE.png``
draws errors against stated σ.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

from service.config import load_settings
from service.config.policy import floor_of
from studies.campaign.night import play
from studies.campaign.plan import Estimator, Night, without_dither
from studies.campaign.plots import plot
from studies.campaign.rows import Row, RowFile, range_of, tell
from studies.campaign.summary import table
from studies.campaign.trouble import Trouble


def main() -> int:
    """Run what is missing, then print the table."""
    given = _parser().parse_args()
    file = RowFile(given.output)
    done = {_key(row) for row in file.rows}
    nights = [night for night in _nights(given) if _key(asdict(night)) not in done]
    started = time.monotonic()
    with _executor(given.workers) as executor:
        for k, new in enumerate(_played(executor, nights, given.keep), start=1):
            file.add(*new)
            left_s = (time.monotonic() - started) / k * (len(nights) - k)
            sys.stderr.write(f"\r{k} of {len(nights)} nights, {left_s / 60:.0f} min left   ")
    sys.stderr.write("\n")
    environment = {}
    if given.working_point_modes is not None:
        environment["PYRCAL_COMPUTE__WORKING_POINT_MODES"] = str(given.working_point_modes)
    floor = floor_of(load_settings(None, environment))
    text = table(file.rows, floor, pooled=given.winds_in_turn is not None)
    tell(text, given.table, "pyrcal campaign")
    if given.plot is not None:
        plot(given.plot, file.rows, floor)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pyrcal campaign",
        description="Runs many simulated nights and compares what was estimated with the truth.",
    )
    parser.add_argument("--output", type=Path, default=Path("campaign.jsonl"), help="rows, resumed")
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="needs the extra 'plots'")
    parser.add_argument("--seeds", type=range_of, default=range(2), metavar="FIRST:END")
    parser.add_argument("--magnitudes", type=_floats, default=(10.0,), metavar="R,R...")
    parser.add_argument("--winds", type=_floats, default=(12.0,), metavar="M_S,M_S...")
    parser.add_argument(
        "--winds-in-turn",
        type=_floats,
        metavar="M_S,M_S...",
        help="one for each seed, over and over, and one line of the table for all",
    )
    parser.add_argument("--profile", help="named layers instead of winds")
    parser.add_argument("--truths", type=_words, default=("ideal",), metavar="NAME,NAME...")
    parser.add_argument("--estimators", type=_words, default=("lock-in",), metavar="NAME,NAME...")
    parser.add_argument(
        "--troubles",
        type=_words,
        default=("none",),
        metavar="NAME,NAME...",
        help=", ".join(Trouble),
    )
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="diffractive")
    parser.add_argument("--gain", type=float, default=0.6)
    parser.add_argument("--n-controlled", type=int, default=400)
    parser.add_argument("--amplitude-nm", type=float, default=5.0, help="RMS of each of four modes")
    parser.add_argument("--window-s", type=float, default=5.0)
    parser.add_argument("--windows", type=int, default=4, help="of each night")
    parser.add_argument("--working-point-modes", type=int)
    parser.add_argument("--modes", type=_ints, metavar="MODE,MODE...", help="that are dithered")
    parser.add_argument("--camera", choices=("ccd", "emccd"), default="ccd")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="of sums to look at again")
    parser.add_argument("--twins", action="store_true", help="also without dither: what it costs")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    return parser


def _nights(given: argparse.Namespace) -> Iterator[Night]:
    """Yield every night of the grid."""
    grid = itertools.product(
        given.seeds, given.truths, given.estimators, given.troubles, given.magnitudes, given.winds
    )
    turns = given.winds_in_turn
    for seed, truth, estimator, trouble, magnitude, wind in grid:
        wind_m_s = wind if turns is None else turns[seed % len(turns)]
        night = Night(
            plant=given.plant,
            truth=truth,
            estimator=Estimator(estimator),
            trouble=Trouble(trouble),
            magnitude=magnitude,
            wind_m_s=wind_m_s,
            profile=given.profile,
            seed=seed,
            gain=given.gain,
            n_controlled=given.n_controlled,
            amplitude_nm=given.amplitude_nm,
            window_s=given.window_s,
            n_windows=given.windows,
            working_point_modes=given.working_point_modes,
            modes=given.modes,
            camera=given.camera,
        )
        yield night
        if given.twins:
            yield without_dither(night)


def _executor(workers: int) -> Executor:
    """Return where nights are run: anything with ``submit`` may take its place."""
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))


def _played(executor: Executor, nights: Iterable[Night], keep: Path | None) -> Iterator[list[Row]]:
    for finished in as_completed([executor.submit(play, night, keep) for night in nights]):
        yield finished.result()


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    values = (row[name] for name in asdict(Night()))
    return tuple(tuple(value) if isinstance(value, list) else value for value in values)


def _floats(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split(","))


def _ints(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


if __name__ == "__main__":
    sys.exit(main())
