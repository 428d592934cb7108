"""Nights of the whole service in simulated time: drift, jumps, what the dither costs.

Run: ``python -m pyrcal_studies.campaign.system_nights --cases drift,jump --plant linear --seeds 0:4
--output var/system.jsonl --table table.md``; nights that are there already are not run again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Observatory
from pyrcal_studies.campaign.observatory_dome import replayed
from pyrcal_studies.campaign.rows import (
    Row,
    RowFile,
    add_workers,
    floats,
    played,
    range_of,
    tell,
    words,
)
from pyrcal_studies.campaign.system_cases import Case, Plan
from pyrcal_studies.campaign.system_measures import row_of, wavefront_rms_nm
from pyrcal_studies.campaign.system_table import table
from service.config import load_settings
from service.instrument import load_instrument
from service.program import status_of
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.tracking.state import Mode
from service.wire import DitherRequest

GAINS = {"linear": 0.4, "diffractive": 0.6}
"""Integrator gains that make about the same loop: the pyramid's optical gain lowers the second."""


def main() -> int:
    """Run what is missing, then print the table."""
    given = _parser().parse_args()
    file = RowFile(given.output)
    plans = file.missing(_plans(given))
    started = time.monotonic()
    for k, row in enumerate(played(play, plans, given.workers, given.cluster), start=1):
        file.add(row)
        spent_min = (time.monotonic() - started) / 60.0
        sys.stderr.write(f"\r{k} of {len(plans)} nights in {spent_min:.0f} min   ")
    sys.stderr.write("\n")
    text = table(file.rows)
    tell(text, given.table, "python -m pyrcal_studies.campaign.system_nights")
    return 0


def play(plan: Plan) -> Row:
    """Run one night, and again without its dithers where that is the question."""
    with threadpool_limits(1):
        settings = load_settings(None, {}, _settings(plan))
        # of this night alone: at the working point it follows the seeing
        bench = OpticsWorker(
            load_instrument(plan.instrument),
            Compute(
                threads=1,
                sampling=Sampling(working_point_modes=settings.compute.working_point_modes),
            ),
        )
        begun = time.monotonic()
        night = Observatory(plan.words, policy_of(settings), Mode.AUTO, bench)
        if plan.restart_s is not None:
            night.advance(plan.restart_s)
            night.restart_rtc()
        night.advance(plan.seconds - night.time_s)
        row = row_of(night, plan.jump_times_s)
        if plan.case is Case.BUDGET:
            row["twin_nm"] = _without_dither_nm(night, plan, row["steady_from_s"])
    return asdict(plan) | row | {"took_s": time.monotonic() - begun}


def _settings(plan: Plan) -> dict[str, object]:
    """Return the service's settings: as many modes as at the start, and what was asked for."""
    given: dict[str, object] = {"control.n_modes_target": plan.n_controlled}
    for text in plan.settings:
        key, _, value = text.partition("=")
        given[key] = json.loads(value)
    return given


def _without_dither_nm(night: Observatory, plan: Plan, begin_s: float) -> float | None:
    """Return the wavefront error of the same night, matrices swapped at the same frames."""
    orders = [o for o in night.dome.orders if not isinstance(o.what, DitherRequest)]
    twin = replayed(plan.words, orders, plan.seconds)
    return wavefront_rms_nm([m for m in twin.moments if m.time_s >= begin_s])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.campaign.system_nights",
        description="Runs nights of the whole service and compares what it did with the truth.",
    )
    parser.add_argument("--output", type=Path, default=Path("system.jsonl"), help="rows, resumed")
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    parser.add_argument(
        "--cases", type=words, default=("drift",), metavar="NAME,NAME...", help=", ".join(Case)
    )
    parser.add_argument("--seeds", type=range_of, default=range(2), metavar="FIRST:END")
    parser.add_argument("--magnitudes", type=floats, default=(10.0,), metavar="R,R...")
    parser.add_argument("--truths", type=words, default=("ideal",), metavar="NAME,NAME...")
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="linear")
    parser.add_argument("--instrument", default="flao-lbt", metavar="NAME|FILE")
    parser.add_argument("--gain", type=float, help="default: 0.4 linear, 0.6 diffractive")
    parser.add_argument("--n-controlled", type=int, default=400)
    parser.add_argument("--seconds", type=float, default=90.0, help="of each night")
    parser.add_argument("--period", type=float, default=30.0, help="between jumps, s")
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting of the service, like dither.window_s=5; may be repeated",
    )
    add_workers(parser, 1)
    return parser


def _plans(given: argparse.Namespace) -> Iterator[Plan]:
    """Yield every night of the grid."""
    grid = itertools.product(given.seeds, given.cases, given.truths, given.magnitudes)
    for seed, case, truth, magnitude in grid:
        yield Plan(
            case=Case(case),
            plant=given.plant,
            truth=truth,
            magnitude=magnitude,
            seed=seed,
            gain=GAINS[given.plant] if given.gain is None else given.gain,
            n_controlled=given.n_controlled,
            seconds=given.seconds,
            period_s=given.period,
            instrument=given.instrument,
            settings=tuple(given.settings),
        )


if __name__ == "__main__":
    sys.exit(status_of(main, "system_nights"))
