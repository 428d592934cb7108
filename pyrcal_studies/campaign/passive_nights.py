"""Nights of the passive estimate, alone or taught its bias by a dither now and then.

Run: ``python -m pyrcal_studies.campaign.passive_nights --plant linear --winds 5,15,25 --seeds 0:3
--output rows.jsonl``; with ``--dither-every-s 60`` five seconds of four sines of 5 nm come once a
minute and the filter of the tracker follows α and the bias. Rows that are there are not played
again. ``--registered`` gives the loop the reconstructor a service would have given it: for an α
that is off by half a percent of a subaperture, a hundredth of a degree and 0.03 %.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.passive_table import table
from pyrcal_studies.campaign.passive_watch import PassiveNight, Watch
from pyrcal_studies.campaign.rows import Row, RowFile, floats, range_of, words
from service.control.reconstructor import invert
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import analytic_basis
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import Ahead
from sim_rtc.options import parse_options

REGISTERED_TO = np.array([0.005, 0.005, np.deg2rad(0.01), 3e-4])
"""1 σ of the α that the loop's reconstructor was made for, about the true one (numeric units)."""


def main() -> int:
    """Play what is missing, then print the table."""
    given = _arguments()
    file = RowFile(given.output)
    done = {json.dumps(row["night"], sort_keys=True) for row in file.rows}
    with threadpool_limits(1):
        for night in _nights(given):
            if json.dumps(asdict(night), sort_keys=True) in done:
                continue
            file.add(*play(night))
    sys.stdout.write(table(file.rows))
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.passive_nights")
    parser.add_argument("--plant", choices=["linear", "diffractive"], default="diffractive")
    parser.add_argument("--truths", type=words, default="ideal,realistic")
    parser.add_argument("--magnitudes", type=floats, default="8,10")
    parser.add_argument("--winds", type=floats, default="5,8,12,15,20,25", metavar="M_S,M_S...")
    parser.add_argument("--profile", default=None, help="named layers instead of winds")
    parser.add_argument("--seeds", type=range_of, default="0:1", metavar="FIRST:END")
    parser.add_argument("--gain", type=float, default=0.6)
    parser.add_argument("--registered", action="store_true")
    parser.add_argument("--seconds", type=float, default=20.5)
    parser.add_argument("--look-s", type=float, default=4.0)
    parser.add_argument("--dither-every-s", type=float, default=0.0)
    parser.add_argument("--output", type=Path, default=Path("passive.jsonl"))
    return parser.parse_args()


def _nights(given: argparse.Namespace) -> Iterator[PassiveNight]:
    winds = given.winds if given.profile is None else [0.0]
    for seed, wind, magnitude, truth in itertools.product(
        given.seeds, winds, given.magnitudes, given.truths
    ):
        yield PassiveNight(
            plant=given.plant,
            truth=truth,
            magnitude=magnitude,
            wind_m_s=wind,
            profile=given.profile,
            seed=seed,
            gain=given.gain,
            registered=given.registered,
            seconds=given.seconds,
            look_s=given.look_s,
            dither_every_s=given.dither_every_s,
        )


def play(night: PassiveNight) -> list[Row]:
    """Return a row for every look at the passive estimate, and for every dithered window."""
    # winds of one seed blow in as many directions
    options = parse_options(night.words(37 + 61 * night.seed + 9 * night.wind_m_s))
    telescope = build_telescope(options, load_instrument(options.instrument))
    true = telescope.optics.start().alpha
    if night.registered:
        telescope = _registered(telescope, true, night.seed)
    rows = []
    with Ahead(telescope.feed.blocks()) as ahead:
        computer = telescope.computer(iter(ahead))
        computer.prepare()
        for look in Watch(telescope, night).looks(computer):
            error = {name: read - true.vector for name, read in look.read.items()}
            row = {
                "night": asdict(night),
                "t_s": look.t_s,
                "error": {name: (e * BOUNDARY_SCALE).tolist() for name, e in error.items()},
                "sigma": {name: (s * BOUNDARY_SCALE).tolist() for name, s in look.sigma.items()},
                "misfit": look.misfit,
            }
            rows.append(row)
    return rows


def _registered(telescope: Telescope, true: Misregistration, seed: int) -> Telescope:
    """Return the telescope with the reconstructor of an α that is nearly the true one."""
    instrument = load_instrument("flao-lbt")
    off = REGISTERED_TO * np.random.default_rng(seed).normal(size=4)
    known = Misregistration.from_vector(true.vector + off)
    matrix = InteractionModel(instrument, analytic_basis(instrument)).interaction_matrix(known)
    made = invert(matrix, len(telescope.reconstructor.matrix)).matrix
    return replace(telescope, reconstructor=replace(telescope.reconstructor, matrix=made))


if __name__ == "__main__":
    sys.exit(main())
