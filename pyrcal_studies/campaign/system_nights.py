"""Nights of the whole service in simulated time: drift, jumps, what the dither costs.

Run: ``python -m pyrcal_studies.campaign.system_nights --cases drift,jump --plant linear --seeds 0:4
--output var/system.jsonl --table table.md``; nights that are there already are not run again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import (
    START_NS,
    Moment,
    Observatory,
    Outcome,
    Publication,
    replayed,
)
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
from service.estimation.passive import PASSIVE_INTERVAL_S
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE
from service.program import status_of
from service.records import alarms
from service.records.products import MatrixState
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.wire import DitherRequest

LATER_S = 10.0
"""A jump comes up to so much later, at random: in a window, or in the pause between two."""


class Case(StrEnum):
    """What the night is about."""

    DRIFT = "drift"
    """5 % of a subaperture and 0.05 deg a minute, all the time."""

    JUMP = "jump"
    """10 % of a subaperture, then 0.1 deg, at once."""

    JUMP_ROTATION = "jump-rotation"
    """0.1 deg at once, then 10 % of a subaperture."""

    BUSY = "busy"
    """Both of them together."""

    BUDGET = "budget"
    """Nothing: what does the dither cost? Played again without it."""

    LOST = "lost"
    """A jump of 0.3 subapertures and 1 deg, which no loop of many modes survives."""

    PASSIVE = "passive"
    """No dither: how wrong is the estimate from ordinary telemetry of a mirror at rest?"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One night; two that are equal give the same row."""

    case: Case
    plant: str = "linear"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    magnitude: float = 10.0
    seed: int = 0
    gain: float = 0.6
    n_controlled: int = 400
    seconds: float = 90.0
    period_s: float = 30.0
    """Between two things that happen; the first comes after it, when all should have settled."""

    instrument: str = "flao-lbt"
    wind_m_s: float = 12.0
    settings: tuple[str, ...] = ()
    """Of the service, ``dither.window_s=5``, where they are not the defaults."""

    @property
    def jump_times_s(self) -> tuple[float, ...]:
        """When the mirror jumps."""
        if self.case is Case.LOST:
            return (self.period_s,)
        if self.case not in {Case.JUMP, Case.JUMP_ROTATION, Case.BUSY}:
            return ()
        due_s = np.arange(self.period_s, self.seconds - LATER_S - self.period_s / 2, self.period_s)
        later_s = np.random.default_rng((11, self.seed)).uniform(0.0, LATER_S, len(due_s))
        return tuple(np.round(due_s + later_s, 2).tolist())

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        options = {
            "instrument": self.instrument,
            "plant": self.plant,
            "imperfections": self.truth,
            "mag": self.magnitude,
            "seed": self.seed,
            "gain": self.gain,
            "n-controlled": self.n_controlled,
            "wind": f"{self.wind_m_s:g},{37 + 61 * self.seed % 360}",
        }
        return [f"--{name}={value}" for name, value in options.items()] + self._motion()

    def _motion(self) -> list[str]:
        angle = np.random.default_rng((7, self.seed)).uniform(0.0, 2.0 * np.pi)
        x, y, turn = np.cos(angle), np.sin(angle), -1.0 if self.seed % 2 else 1.0
        drift = f"--drift={0.05 * x:.4f},{0.05 * y:.4f},{0.05 * turn},0"
        steps = (f"{0.1 * x:.4f},{0.1 * y:.4f},0,0", f"0,0,{0.1 * turn},0")
        first = int(self.case is Case.JUMP_ROTATION)
        jumps = [
            f"--jump={time_s}:{steps[k % 2]}" for k, time_s in enumerate(self.jump_times_s, first)
        ]
        match self.case:
            case Case.DRIFT:
                return [drift]
            case Case.JUMP | Case.JUMP_ROTATION:
                return jumps
            case Case.LOST:
                return [f"--jump={self.period_s}:0.3,0,1,0"]
            case Case.BUSY:
                return [drift, *jumps]
            case Case.BUDGET | Case.PASSIVE:
                return []


GOOD = np.array([0.02, 0.02, 0.02, 0.001])
"""An α this near the truth is a good one: two floors of the shift (boundary units)."""

CORRECTED = np.array([0.03, 0.03, 0.03, 0.002])
"""A matrix made for an α this near the truth corrects a jump: a third of what is to be flagged."""

STEADY_S = 10.0
"""After the first own matrix: the loop has settled and α has been confirmed."""

AFTER_JUMP_S = 15.0
"""What has been corrected so long after a jump is tracking again; before, it is not judged so."""

FLAGS = ("registration.jump-suspected", "registration.jump", "registration.passive-jump")
"""Log entries that say that the mirror has jumped, or may have."""

Array = NDArray[np.float64]


def row_of(night: Observatory, jump_times_s: tuple[float, ...]) -> Row:
    """Return the row; errors in boundary units (subapertures, degrees, ratio)."""
    publications = night.publications()
    own_s = min((p.swap.time_s for p in publications if p.swap.made_for), default=None)
    good_s = first_good_s(night)
    begin_s = STEADY_S + max(own_s or 0.0, good_s or 0.0)
    steady = [m for m in night.dome.moments if m.time_s >= begin_s]
    errors = tracking_errors(night, begin_s, jump_times_s)
    return {
        "good_alpha_s": good_s,
        "own_matrix_s": own_s,
        "modes_reached": night.dome.moments[-1].n_controlled,
        "steady_from_s": begin_s,
        "tracking_rms": np.sqrt(np.mean(errors**2, axis=0)).tolist() if len(errors) else None,
        "jumps": [jump_row(night, publications, t) for t in jump_times_s],
        "wavefront_nm": wavefront_rms_nm(steady),
        "dither_nm": float(np.sqrt(np.mean([m.dither_nm**2 for m in steady]))) if steady else None,
        "windows": [night.state.windows.accepted, night.state.windows.refused],
        "published": [(p.swap.time_s, p.outcome.value) for p in publications],
        "refused": sum(r.state is MatrixState.REFUSED for r in night.state.matrices.reconstructors),
        "unstable": sum(p.outcome is Outcome.DIVERGED for p in publications),
        "log": [
            (round((e.t_ns_utc - START_NS) * 1e-9, 2), e.level.value, e.name, e.text)
            for e in night.state.log
        ],
    }


def recovery_of(night: Observatory, jump_s: float) -> Row:
    """Return when a loop that a jump lost was opened and back on all modes, after the jump."""
    moments = night.dome.moments
    before = [m for m in moments if jump_s - 3.0 < m.time_s < jump_s]
    opened_s = next((m.time_s for m in moments if m.time_s > jump_s and not m.closed), None)
    back_s = None
    if opened_s is not None and before:
        n_modes = before[-1].n_controlled
        later = (m for m in moments if m.time_s > opened_s)
        back_s = next((m.time_s for m in later if m.closed and m.n_controlled >= n_modes), None)
    lost_s = (g.time_s for g in night.glances if g.time_s > jump_s and alarms.LOST in g.alarms)
    return {
        "lost_after_s": _after(next(lost_s, None), jump_s),
        "opened_after_s": _after(opened_s, jump_s),
        "all_modes_after_s": _after(back_s, jump_s),
        "before_nm": wavefront_rms_nm(before),
        "after_nm": None
        if back_s is None
        else wavefront_rms_nm([m for m in moments if m.time_s > back_s + 1.0]),
    }


def _after(time_s: float | None, jump_s: float) -> float | None:
    return None if time_s is None else round(time_s - jump_s, 2)


def passive_of(night: Observatory, seconds: float) -> Row:
    """Play a night and return its passive estimates: errors in boundary units, and over σ.

    The first is not counted: its telemetry holds the start of the loop.
    """
    estimates: dict[int, tuple[list[float], list[float]]] = {}
    while night.time_s < seconds:
        night.advance(PASSIVE_INTERVAL_S / 2)
        passive = night.state.alpha.passive
        if passive is not None:
            error = passive.alpha.vector - night.dome.moments[-1].alpha.vector
            estimates[passive.t_ns_utc] = (
                (error * BOUNDARY_SCALE).tolist(),
                (error / passive.sigma).tolist(),
            )
    return {"passive": [list(pair) for pair in list(estimates.values())[1:]]}


def first_good_s(night: Observatory) -> float | None:
    """Return when α was first within ``GOOD`` of the truth."""
    for moment, glance in zip(night.dome.moments, night.glances, strict=True):
        if glance.alpha is not None:
            error = (glance.alpha - moment.alpha.vector) * BOUNDARY_SCALE
            if np.all(np.abs(error) <= GOOD):
                return glance.time_s
    return None


def tracking_errors(
    night: Observatory, begin_s: float, jump_times_s: tuple[float, ...] = ()
) -> Array:
    """Return ``(n, 4)`` errors of what the service held to be true, block by block.

    Against where the mirror is at that moment: the age of the estimate is part of the error. What
    comes within ``AFTER_JUMP_S`` of a jump is left out.
    """
    found = [
        glance.alpha - moment.alpha.vector
        for moment, glance in zip(night.dome.moments, night.glances, strict=True)
        if glance.alpha is not None
        and glance.time_s >= begin_s
        and not any(0.0 <= glance.time_s - t < AFTER_JUMP_S for t in jump_times_s)
    ]
    return np.asarray(np.reshape(found, (-1, 4)) * BOUNDARY_SCALE)


def jump_row(night: Observatory, publications: list[Publication], time_s: float) -> Row:
    """Return how long after a jump it was flagged, and a corrected matrix applied, seconds."""
    flags = (
        (entry.t_ns_utc - START_NS) * 1e-9 - time_s
        for entry in night.state.log
        if entry.name in FLAGS
    )
    corrected = (
        p.swap.time_s - time_s for p in publications if p.swap.time_s > time_s and _corrects(p)
    )
    return {
        "at_s": time_s,
        "flagged_s": min((t for t in flags if t > 0.0), default=None),
        "corrected_s": min(corrected, default=None),
    }


def wavefront_rms_nm(moments: list[Moment]) -> float | None:
    """Return the RMS over these moments, or None where there is none."""
    if not moments:
        return None
    return float(np.sqrt(np.mean([m.wavefront_nm**2 for m in moments])))


def _corrects(publication: Publication) -> bool:
    made_for = publication.swap.made_for
    if made_for is None:
        return False
    error = (made_for.vector - publication.swap.alpha.vector) * BOUNDARY_SCALE
    return bool(np.all(np.abs(error) <= CORRECTED))


HEADER = heading(
    *("nights", "good α after s", "own matrix after s", "tracking RMS x, y % / mdeg / %"),
    *("flagged after s", "corrected after s", "wavefront nm", "dither nm", "cost nm"),
    *("windows (refused)", "published", "refused by the gate", "unstable"),
)


def table(rows: list[Row]) -> str:
    """Return the nights as a Markdown table, the worst of each group in brackets."""
    groups = grouped(rows, Plan, "seed")
    return HEADER + "".join(line_of(_name(group[0]), group) for group in groups)


def line_of(name: str, rows: list[Row]) -> str:
    """Return the line of a group of nights."""
    jumps = [jump for row in rows for jump in row["jumps"]]
    return line(
        f"{len(rows)} x {name}",
        _worst([row["good_alpha_s"] for row in rows]),
        _worst([row["own_matrix_s"] for row in rows]),
        _tracking(rows),
        _worst([jump["flagged_s"] for jump in jumps]),
        _worst([jump["corrected_s"] for jump in jumps]),
        _mean([row["wavefront_nm"] for row in rows], ".1f"),
        _mean([row["dither_nm"] for row in rows], ".2f"),
        _cost(rows),
        f"{sum(sum(row['windows']) for row in rows)} ({sum(row['windows'][1] for row in rows)})",
        sum(len(row["published"]) for row in rows),
        sum(row["refused"] for row in rows),
        sum(row["unstable"] for row in rows),
    )


def _name(row: Row) -> str:
    words = [
        f"**{row['case']}**, {row['plant']} {row['truth']}, mag {row['magnitude']:g}",
        f"{row['n_controlled']} modes g {row['gain']:g}",
        f"{row['seconds']:g} s, wind {row['wind_m_s']:g} m/s",
        *row["settings"],
    ]
    if row["instrument"] != "flao-lbt":
        words.append("another instrument")
    return ", ".join(words)


def _tracking(rows: list[Row]) -> str:
    """Return the RMS over all nights; of passive estimates with the largest error over σ."""
    passive = np.array([pair for row in rows for pair in row.get("passive", ())])
    if len(passive):
        rms = np.sqrt(np.mean(np.square(passive[:, 0]), axis=0))
        return f"{four(rms * UNITS)} ({np.max(np.abs(passive[:, 1])):.2f} σ, {len(passive)})"
    found = [row["tracking_rms"] for row in rows if row["tracking_rms"] is not None]
    if not found:
        return "-"
    return four(np.sqrt(np.mean(np.square(found), axis=0)) * UNITS)


def _worst(values: list[Any]) -> str:
    """Return mean and worst; what never came is counted."""
    came = [value for value in values if value is not None]
    if not values:
        return "-"
    never = f", {len(values) - len(came)} never" if len(came) < len(values) else ""
    if not came:
        return f"never ({len(values)})"
    return f"{np.mean(came):.1f} ({max(came):.1f}{never})"


def _mean(values: list[Any], form: str) -> str:
    found = [value for value in values if value is not None]
    return format(float(np.mean(found)), form) if found else "-"


def _cost(rows: list[Row]) -> str:
    """Return the plain difference of wavefront errors with and without dither, nm."""
    found = [
        row["wavefront_nm"] - row["twin_nm"]
        for row in rows
        if row.get("twin_nm") is not None and row["wavefront_nm"] is not None
    ]
    return f"{np.mean(found):.3f} ({max(found):.3f})" if found else "-"


GAINS = {"linear": 0.4, "diffractive": 0.6}
"""Integrator gains that make about the same loop: the pyramid's optical gain lowers the second."""


def main() -> int:
    """Run what is missing, then print the table."""
    parser = _parser()
    given = parser.parse_args()
    tell(table(complete(play, _plans(given), given)), given.table, parser.prog)
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
        night = Observatory(plan.words, policy_of(settings), Mode.AUTO, bench)
        passive = {}
        if plan.case is Case.PASSIVE:
            passive = passive_of(night, plan.seconds)
        else:
            night.advance(plan.seconds)
        row = passive | row_of(night, plan.jump_times_s)
        if plan.case is Case.LOST:
            row |= recovery_of(night, plan.period_s)
        if plan.case is Case.BUDGET:
            row["twin_nm"] = _without_dither_nm(night, plan, row["steady_from_s"])
    return asdict(plan) | row


def _settings(plan: Plan) -> dict[str, object]:
    """Return the service's settings: as many modes as at the start, and what was asked for."""
    given: dict[str, object] = {"control.n_modes_target": plan.n_controlled}
    if plan.case is Case.PASSIVE:
        given["dither.enabled"] = False
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
    parser = campaign_parser("system_nights", __doc__)
    parser.add_argument(
        "--cases", type=words, default=("drift",), metavar="NAME,NAME...", help=", ".join(Case)
    )
    parser.add_argument("--seeds", type=range_of, default=range(2), metavar="FIRST:END")
    parser.add_argument("--magnitudes", type=floats, default=(10.0,), metavar="R,R...")
    parser.add_argument("--winds", type=floats, default=(12.0,), metavar="M_S,M_S...")
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
    grid = itertools.product(given.seeds, given.cases, given.truths, given.magnitudes, given.winds)
    for seed, case, truth, magnitude, wind_m_s in grid:
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
            wind_m_s=wind_m_s,
            settings=tuple(given.settings),
        )


if __name__ == "__main__":
    sys.exit(status_of(main, "system_nights"))
