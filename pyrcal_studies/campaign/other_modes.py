"""RTCs whose single modes differ from the instrument file, and whether their loop is made worse.

Run: ``python -m pyrcal_studies.campaign.other_modes --plant linear --output var/other_modes.jsonl
--table table.md``; nights that are there already are not run again. Every night is played twice,
once without a service. An outside RTC controls 120 of 150 modes with its own integrator and its own
matrix, the service is in ``auto`` and raises the modes to all.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory_checks import Swap
from pyrcal_studies.campaign.observatory_dome import Moment
from pyrcal_studies.campaign.other_night import GAINS, N_CONTROLLED, N_TARGET, OtherNight, Plan
from pyrcal_studies.campaign.other_truth import LIES, STANDING, Kind, Truth
from pyrcal_studies.campaign.rows import Row, RowFile, heading, line, tell
from service.wire import Loop, LoopRequest

WORSE, WORSE_S = 1.1, 1.0
"""A loop is made worse when its wavefront error is above the first times that of the same night
without a service for longer than the second."""

SMOOTHED_S = 0.25
"""Over which the wavefront error is the RMS."""

CLOSED_S = 2.0
"""Until then the loop is being closed, with a service or without."""

LATE_S = 3.0
"""At the end of a night, to tell what it came to."""


def play(plan: Plan) -> Row:
    """Run one night with a service and without, and return what came of it."""
    begun = time.process_time()
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        night = OtherNight(plan, None if plan.killed_s is None else Path(folder))
        if plan.killed_s is not None:
            night.pass_(plan.killed_s)
            night.kill()
        night.pass_(plan.seconds)
        night.close()
        alone = untouched(
            replace(plan, truth=replace(plan.truth, offered=True), killed_s=None, n_target=0)
        )
    return {**asdict(plan), "name": plan.name, **came_of(plan, night, alone)} | {
        "cpu_s": round(time.process_time() - begun, 1)
    }


@lru_cache(maxsize=1)
def untouched(plan: Plan) -> tuple[Moment, ...]:
    """Return the same night without a service."""
    dome = plan.dome()
    while dome.time_s < plan.seconds:
        dome.play()
    return tuple(dome.moments)


def came_of(plan: Plan, night: OtherNight, alone: Sequence[Moment]) -> Row:
    """Return what the service did to the loop, and what it said."""
    begun = round(CLOSED_S / SMOOTHED_S)
    with_nm, without_nm = (smoothed(m)[begun:] for m in (night.dome.moments, alone))
    worse = with_nm > WORSE * without_nm
    late = round(LATE_S / SMOOTHED_S)
    said = [(at, name, text) for (name, text), at in night.said.items()]
    named = [(at, name) for at, name, text in said if names(plan, text)]
    orders = [(order.frame / night.dome.rate_hz, order.what) for order in night.dome.orders]
    opened = [at for at, what in orders if isinstance(what, LoopRequest) and what.loop is Loop.OPEN]
    return {
        "worse_s": longest(worse) * SMOOTHED_S,
        "worse_in_all_s": float(worse.sum()) * SMOOTHED_S,
        "first_worse_s": CLOSED_S + float(np.argmax(worse)) * SMOOTHED_S if worse.any() else None,
        "peak_nm": float(with_nm.max()),
        "peak_alone_nm": float(without_nm.max()),
        "late_nm": _rms(with_nm[-late:]),
        "late_alone_nm": _rms(without_nm[-late:]),
        "named_s": min(named)[0] if named else None,
        "by": min(named)[1] if named else None,
        "sent": [round(swap.time_s, 2) for swap in night.swaps],
        "n_modes": night.dome.moments[-1].n_controlled,
        "opened": opened,
        "closed_at_last": night.dome.moments[-1].closed,
        "undithered_s": undithered_s(night.dome.moments),
        "corrected_s": corrected_s(plan, night.swaps),
        "said": said,
        "log": [
            (round((entry.t_ns_utc - night.state.log[0].t_ns_utc) / 1e9, 2), entry.name, entry.text)
            for entry in night.state.log[-60:]
        ],
    }


def undithered_s(moments: Sequence[Moment]) -> float:
    """Return the longest time without a dither after the first one."""
    times = [moment.time_s for moment in moments if moment.dither_nm > 0.0]
    if not times:
        return moments[-1].time_s
    return float(np.diff([*times, moments[-1].time_s]).max())


CORRECTED = np.array([0.1, 0.1, np.deg2rad(0.3), 0.01])
"""A matrix is made for where the mirror is when its α is as near as this (numeric units)."""


def corrected_s(plan: Plan, swaps: Sequence[Swap]) -> float | None:
    """Return how long after the jump a matrix for the mirror's new place came into use."""
    for swap in swaps:
        if plan.jump_s is None or swap.made_for is None or swap.time_s <= plan.jump_s:
            continue
        if np.all(np.abs(swap.made_for.vector - swap.alpha.vector) < CORRECTED):
            return swap.time_s - plan.jump_s
    return None


def smoothed(moments: Sequence[Moment]) -> NDArray[np.float64]:
    """Return the wavefront error in nm, the RMS over each stretch of the night."""
    stretch = np.array([int((m.time_s - 1e-6) / SMOOTHED_S) for m in moments])
    power = np.bincount(stretch, [m.wavefront_nm**2 for m in moments])
    return np.asarray(np.sqrt(power / np.bincount(stretch)))


def longest(flags: NDArray[np.bool_]) -> int:
    """Return how many follow one another at most."""
    most = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        most = max(most, run)
    return most


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


WORDS = {
    Kind.SCALE: r"sign|scale|strong|weak|times (?!as)|factor|respon|unit",
    Kind.EXCHANGE: r"exchang|swap|order|place",
    Kind.ROLL: r"order|roll|shift|moved on|place",
    Kind.PERMUTE: r"order|permut|place|other modes|basis",
    Kind.SLOPES: r"order|slopes",
    Kind.PLAYS_EXCHANGED: r"plays|exchang|not the matrix|other matrix|another matrix",
    Kind.PLAYS_TIMES: r"plays|times|not the matrix|other matrix|another matrix",
    Kind.PLAYS_ROLLED: r"plays|roll|order|not the matrix|other matrix|another matrix",
    Kind.ZEROS: r"slopes.*(zero|\b0\b|same|stand)|camera|frozen|stands",
    Kind.FROZEN: r"slopes.*(frozen|same|stand|change|repeat)|camera|stands",
}
"""What an alarm must speak of, besides the modes."""


def names(plan: Plan, text: str) -> bool:
    """Return whether an alarm says what the RTC truly is."""
    truth = plan.truth
    pattern = WORDS.get(truth.kind)
    if pattern is None or re.search(pattern, text, re.IGNORECASE) is None:
        return False
    single = truth.kind in {Kind.SCALE, Kind.EXCHANGE}
    return not single or all(re.search(rf"\b{mode}\b", text) for mode in truth.modes)


def _scale(factor: float, *modes: int) -> Truth:
    return Truth(kind=Kind.SCALE, modes=modes, factor=factor)


TRUTHS = (
    Truth(),
    _scale(-1.0, 10),
    _scale(-1.0, 110),
    _scale(-1.0, 130),
    _scale(-1.0, 145),
    Truth(kind=Kind.EXCHANGE, modes=(10, 11)),
    Truth(kind=Kind.EXCHANGE, modes=(3, 40)),
    Truth(kind=Kind.EXCHANGE, modes=(118, 125)),
    _scale(1.7, 0),
    _scale(-0.5, 15),
    _scale(3.0, 10),
    _scale(0.1, 10),
    Truth(kind=Kind.ROLL),
    Truth(kind=Kind.PERMUTE),
    Truth(kind=Kind.SLOPES),
    Truth(kind=Kind.STRENGTH, factor=0.5),
    Truth(kind=Kind.PLAYS_EXCHANGED, modes=(10, 40)),
    Truth(kind=Kind.PLAYS_TIMES, factor=3.0),
    Truth(kind=Kind.PLAYS_ROLLED),
    Truth(kind=Kind.ZEROS),
    Truth(kind=Kind.FROZEN),
)
"""Those of the issue's table, and of it what an RTC may also keep to itself: its matrix."""


def plans(given: argparse.Namespace) -> list[Plan]:
    """Return the nights that are asked for."""
    base = {"plant": given.plant, "seconds": given.seconds, "seed": given.seed}
    nights = [Plan(truth=truth, **base) for truth in TRUTHS]
    hidden = [t for t in TRUTHS if t.kind not in LIES | STANDING]
    nights += [Plan(truth=Truth(**{**asdict(truth), "offered": False}), **base) for truth in hidden]
    for n_target in (N_CONTROLLED, N_TARGET):
        nights.append(Plan(n_target=n_target, jump_s=25.0, **base))
    return [night for night in nights if given.only in night.name]


def table(rows: Iterable[Row]) -> str:
    """Return the rows in Markdown."""
    text = heading(
        *("plant", "the RTC's truth", "worse than alone by > 10 %", "peak (alone)"),
        *("at the end (alone)", "sent after", "modes", "opened after", "named after", "by"),
    )
    for row in rows:
        named = "-" if row["named_s"] is None else f"{row['named_s']:.1f} s"
        sent = ", ".join(f"{at:.1f}" for at in row["sent"][:5])
        more = " ..." if len(row["sent"]) > 5 else ""
        text += line(
            *(row["plant"], row["name"], f"{row['worse_s']:.1f} s"),
            f"{row['peak_nm']:.0f} ({row['peak_alone_nm']:.0f}) nm",
            f"{row['late_nm']:.0f} ({row['late_alone_nm']:.0f}) nm",
            *(f"{sent}{more} s" if sent else "-", row["n_modes"]),
            f"{row['opened'][0]:.1f} s" if row["opened"] else "-",
            *(named, row["by"] or "-"),
        )
    return text


def run(nights: Iterable[Plan], output: Path) -> list[Row]:
    """Play the nights that are not in the file yet, and return all rows of it."""
    file = RowFile(output)
    done = {(row["plant"], row["name"], row["seed"]) for row in file.rows}
    for plan in nights:
        if (plan.plant, plan.name, plan.seed) not in done:
            file.add(play(plan))
            sys.stderr.write(table(file.rows[-1:]).splitlines()[-1] + "\n")
    return file.rows


def main() -> int:
    """Run what is missing, then print the table; 1 if a loop was made worse."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.other_modes")
    parser.add_argument("--plant", choices=tuple(GAINS), default="linear")
    parser.add_argument("--seconds", type=float, default=40.0, help="of each night")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", metavar="TEXT", help="nights with it in their name")
    parser.add_argument("--output", type=Path, default=Path("other_modes.jsonl"))
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    given = parser.parse_args()
    rows = run(plans(given), given.output)
    tell(table(rows), given.table, "python -m pyrcal_studies.campaign.other_modes")
    return int(any(row["worse_s"] > WORSE_S for row in rows))


if __name__ == "__main__":
    sys.exit(main())
