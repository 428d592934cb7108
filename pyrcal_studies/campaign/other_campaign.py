"""Forty RTCs whose single modes differ, the same with the service killed, healthy nights, jumps.

Run: ``python -m pyrcal_studies.campaign.other_campaign differ --output var/differ.jsonl``, and
``killed``, ``healthy``, ``healthy_diffractive``, ``jumps`` instead of ``differ``; nights that are
there already are not run again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pyrcal_studies.campaign.other_modes import WORSE_S, run, table
from pyrcal_studies.campaign.other_night import N_CONTROLLED, N_TARGET, Plan
from pyrcal_studies.campaign.other_truth import Kind, Truth
from pyrcal_studies.campaign.rows import Row, heading, line, range_of, tell
from pyrcal_studies.campaign.small import SMALL

_SEED = 20261123
FACTORS = (-1.0, -1.0, -1.0, -0.5, 0.1, 0.5, 2.0, 3.0)
KINDS = (Kind.SCALE,) * 5 + (Kind.EXCHANGE,) * 3 + (Kind.ROLL, Kind.PERMUTE)
DIFFRACTIVE_EVERY = 4
"""One RTC in so many is at a diffractive telescope."""

NAMED_S = 15.0
CORRECTED_S = 8.0


def differing(seed: int) -> Plan:
    """Return the night of an RTC whose modes differ: the same for the same seed."""
    rng = np.random.default_rng([_SEED, seed])
    kind = KINDS[seed % len(KINDS)]
    diffractive = seed % DIFFRACTIVE_EVERY == DIFFRACTIVE_EVERY - 1
    n_first, n_all = (45, 60) if diffractive else (N_CONTROLLED, N_TARGET)
    modes: tuple[int, ...] = ()
    factor = 1.0
    if kind is Kind.SCALE:
        factor = float(rng.choice(FACTORS))
        n_modes = int(rng.choice([1, 1, 3]))
        # one in three among those that are not controlled at first
        low, high = (n_first, n_all) if rng.random() < 1 / 3 else (0, n_first)
        modes = tuple(sorted(rng.choice(np.arange(low, high), n_modes, replace=False).tolist()))
    elif kind is Kind.EXCHANGE:
        modes = tuple(sorted(rng.choice(n_all, 2, replace=False).tolist()))
    offered = (seed + seed // DIFFRACTIVE_EVERY) % 2 == 0
    truth = Truth(kind=kind, modes=modes, factor=factor, offered=offered, seed=seed)
    plan = Plan(truth=truth, seed=seed, seconds=40.0, n_controlled=n_first, n_target=n_all)
    if not diffractive:
        return plan
    # the small one: of the other a second takes two
    return replace(plan, instrument=SMALL, plant="diffractive", seconds=25.0)


def killed(seed: int) -> Plan:
    """Return the same night with the service killed at some moment."""
    rng = np.random.default_rng([_SEED, 1, seed])
    return replace(differing(seed), killed_s=round(float(rng.uniform(2.0, 20.0)), 1))


def healthy(seed: int) -> Plan:
    """Return five minutes of an RTC that is as told."""
    rng = np.random.default_rng([_SEED, 2, seed])
    return Plan(seed=seed, seconds=300.0, magnitude=round(float(rng.uniform(7.0, 11.0)), 1))


def healthy_diffractive(seed: int) -> Plan:
    """Return the same of a diffractive telescope; every other RTC keeps its matrix to itself."""
    rng = np.random.default_rng([_SEED, 4, seed])
    plan = replace(healthy(seed), magnitude=round(float(rng.uniform(7.0, 11.0)), 1), seconds=60.0)
    plan = replace(plan, truth=Truth(offered=seed % 2 == 0), n_controlled=45, n_target=60)
    return replace(plan, instrument=SMALL, plant="diffractive")


def jumping(seed: int) -> Plan:
    """Return a night whose mirror jumps once all modes are controlled."""
    rng = np.random.default_rng([_SEED, 3, seed])
    jump_s = round(float(rng.uniform(25.0, 40.0)), 1)
    return Plan(seed=seed, jump_s=jump_s, seconds=jump_s + 20.0)


CAMPAIGNS: Mapping[str, Callable[[int], Plan]] = {
    "differ": differing,
    "killed": killed,
    "healthy": healthy,
    "healthy_diffractive": healthy_diffractive,
    "jumps": jumping,
}


def summary(rows: Sequence[Row]) -> str:
    """Return what counts of all nights, in one line."""
    differ = [row for row in rows if row["truth"]["kind"] != Kind.AS_TOLD]
    jumped = [row for row in rows if row["jump_s"] is not None]
    soon = [row for row in differ if row["named_s"] is not None and row["named_s"] <= NAMED_S]
    in_time = [row for row in jumped if (row["corrected_s"] or np.inf) <= CORRECTED_S]
    text = heading(
        *("nights", "loops made worse by > 10 % for > 1 s", "RTCs that differ", "named in 15 s"),
        *("with alarms", "dither gone for 10 s", "jumps", "corrected in 8 s", "peak above alone"),
    )
    return text + line(
        *(len(rows), sum(row["worse_s"] > WORSE_S for row in rows), len(differ), len(soon)),
        sum(bool(row["said"]) for row in rows),
        sum(row["undithered_s"] > 10.0 for row in rows),
        *(len(jumped), len(in_time)),
        sum(row["peak_nm"] > row["peak_alone_nm"] for row in jumped),
    )


def main() -> int:
    """Run what is missing, then print the tables; 1 if a loop was made worse."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.other_campaign")
    parser.add_argument("campaign", choices=tuple(CAMPAIGNS))
    parser.add_argument("--seeds", type=range_of, default=range(40), metavar="FIRST:END")
    parser.add_argument("--output", type=Path, required=True, help="rows, resumed")
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    given = parser.parse_args()
    rows = run(map(CAMPAIGNS[given.campaign], given.seeds), given.output)
    text = f"{summary(rows)}\n{table(rows)}"
    tell(text, given.table, "python -m pyrcal_studies.campaign.other_campaign")
    return int(any(row["worse_s"] > WORSE_S for row in rows))


if __name__ == "__main__":
    sys.exit(main())
