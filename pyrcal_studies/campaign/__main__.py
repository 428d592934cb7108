"""Campaigns: seeds x magnitudes x winds x truths, in parallel and resumable.

Run: ``python -m pyrcal_studies.campaign --magnitudes 7,10,12.5 --seeds 0:10 --output
var/campaign.jsonl``; rows that are there already are not run again. ``--table FILE.md`` writes the
table.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from pyrcal_studies.campaign.night import Night, play
from pyrcal_studies.campaign.rows import RowFile, add_workers, floats, played, range_of, tell, words
from pyrcal_studies.campaign.summary import table
from service.config import load_settings
from service.instrument import load_instrument
from service.program import status_of
from service.runtime.policy import floor_of


def main() -> int:
    """Run what is missing, then print the table."""
    given = campaign_parser().parse_args()
    file = RowFile(given.output)
    nights = file.missing(_nights(given))
    started = time.monotonic()
    rows = played(partial(play, keep=given.keep), nights, given.workers, given.cluster)
    for k, new in enumerate(rows, start=1):
        file.add(*new)
        left_s = (time.monotonic() - started) / k * (len(nights) - k)
        sys.stderr.write(f"\r{k} of {len(nights)} nights, {left_s / 60:.0f} min left   ")
    sys.stderr.write("\n")
    environment = {}
    if given.working_point_modes is not None:
        environment["PYRCAL_COMPUTE__WORKING_POINT_MODES"] = str(given.working_point_modes)
    floor = floor_of(load_settings(None, environment), load_instrument(given.instrument))
    text = table(file.rows, floor, pooled=given.winds_in_turn is not None)
    tell(text, given.table, "python -m pyrcal_studies.campaign")
    return 0


def campaign_parser() -> argparse.ArgumentParser:
    """Return the parser of ``python -m pyrcal_studies.campaign``."""
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.campaign",
        description="Runs many simulated nights and compares what was estimated with the truth.",
    )
    parser.add_argument("--output", type=Path, default=Path("campaign.jsonl"), help="rows, resumed")
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    parser.add_argument("--seeds", type=range_of, default=range(2), metavar="FIRST:END")
    parser.add_argument("--magnitudes", type=floats, default=(10.0,), metavar="R,R...")
    parser.add_argument("--winds", type=floats, default=(12.0,), metavar="M_S,M_S...")
    parser.add_argument(
        "--winds-in-turn",
        type=floats,
        metavar="M_S,M_S...",
        help="one for each seed, over and over, and one line of the table for all",
    )
    parser.add_argument("--profile", help="named layers instead of winds")
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
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="of sums to look at again")
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
            instrument=given.instrument,
            rate_hz=given.rate,
        )


def _modes(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


if __name__ == "__main__":
    sys.exit(status_of(main, "python -m pyrcal_studies.campaign"))
