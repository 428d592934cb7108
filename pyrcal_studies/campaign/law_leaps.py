"""Pointing laws of values that leap, against the whole service in simulated time.

Run: ``python -m pyrcal_studies.campaign.law_leaps --seeds 0:20 --output var/law_leaps.jsonl
--table table.md``. Each draw is a night of 40 s on the simulator's small telescope in mode auto.
After 12 s a value that the law depends on wraps, is reported wrong, comes after a long silence or
reaches a step of its table, and the law leaps by 0.1 to 1 subaperture, 0.5 to 3 deg, or both. The
mirror stays where it was, except in the draws ``moves``, in which it jumps as the law says. The row
has when the leap was named, the matrices that were made or used for another registration than the
true one, and how long α was wrong.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import (
    SETTINGS,
    SMALL,
    START_NS,
    Observatory,
    bench_of,
)
from pyrcal_studies.campaign.rows import (
    Row,
    campaign_parser,
    complete,
    heading,
    line,
    range_of,
    tell,
)
from service.config import load_settings
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.pointing_law import PointingLaw, Term
from service.runtime.policy import policy_of
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.policy import Policy
from service.tracking.state import Mode

KINDS = ("wraps", "wraps, two values", "table with a step", "typed wrong", "comes late", "moves")
LEAP_S, NIGHT_S = 12.0, 40.0
REPORT_S = 0.2
"""Between two reports of a value."""

SILENCE_S = 8.0
"""Before a value that comes late."""

WRONG = np.array([0.03, 0.03, 0.15, 0.01])
"""Beyond this α, or the registration of a matrix, is wrong: subapertures, degrees, ratio."""

START = Misregistration(shift_x_subap=0.05, shift_y_subap=-0.03, rotation_rad=0.0017)


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One night; two that are equal give the same row."""

    seed: int
    kind: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Story:
    """Law of a draw, and what is reported when."""

    law: PointingLaw
    values: Callable[[float], dict[str, float]]
    """Values reported at a time, seconds since the leap."""

    step: tuple[float, float, float, float]
    """Leap of the law: subapertures, degrees, ratio."""


def story_of(draw: Draw) -> Story:
    """Return the law and the values of a draw."""
    rng = np.random.default_rng([draw.seed, 48])
    shift, rotation = rng.uniform(0.1, 1.0), rng.uniform(0.5, 3.0)
    part = draw.seed % 3  # both, the shift alone, the rotation alone
    shift, rotation = shift * (part != 2) * rng.choice([-1, 1]), rotation * (part != 1)
    if draw.kind == "moves":  # as far as a loop survives
        shift, rotation = 0.5 * shift, rotation / 3.0
    step = (float(shift), 0.0, float(rotation * rng.choice([-1, 1])), 0.0)
    ends: tuple[tuple[float, float], tuple[float, float]]
    match draw.kind:
        case "wraps" | "wraps, two values":
            ends = (180.0, -180.0), (-1.0, 1.0)
            period = 360.0 if draw.seed % 2 else None
        case _:
            ends, period = ((-0.01, 0.01), (0.0, 1.0)), None
    two = draw.kind == "wraps, two values"
    at, share = ends
    terms = [
        Term(
            "focus" if two and k == 2 else "derotator",
            tuple(sorted(at)),
            tuple(s * size for s in (share if at[0] < at[1] else (0.5, -0.5))),
            period,
        )
        for k, size in enumerate(step)
    ]
    law = PointingLaw(shift_x_subap=terms[0], rotation_deg=terms[2])
    speed = float(rng.uniform(0.05, 1.0))  # deg a second

    def values(since_s: float) -> dict[str, float]:
        turned = speed * since_s
        match draw.kind:
            case "wraps" | "wraps, two values":
                now = (turned + 360.0) % 360.0 - 180.0
            case "table with a step" | "moves":
                now = turned + (0.1 if turned >= 0.0 else -0.1)
            case "typed wrong":
                now = 5.0 if since_s >= 0.0 else -5.0
            case _:
                if -SILENCE_S < since_s < 0.0:
                    return {}
                now = 5.0 if since_s >= 0.0 else -5.0
        return {name: float(now) for name in law.names}

    return Story(law=law, values=values, step=step)


class LawNight(Observatory):
    """A night that keeps the registration of each matrix as it is made."""

    def __init__(self, draw: Draw, story: Story, policy: Policy) -> None:
        words = [
            *(f"--instrument={SMALL}", "--plant=linear", "--imperfections=ideal", "--mag=8"),
            *("--optical-gain=0.7,0.9", "--n-controlled=45", f"--seed={draw.seed}"),
            f"--alpha={','.join(map(str, START.to_boundary().values()))}",
        ]
        if draw.kind == "moves":
            words.append(f"--jump={LEAP_S}:{','.join(map(str, story.step))}")
        self.made_wrong: list[str] = []
        super().__init__(words, policy, Mode.AUTO, bench_of(SMALL), with_poles=False)

    def is_wrong(self, alpha: Misregistration | None) -> bool:
        """Return whether a registration is not the mirror's."""
        if alpha is None:
            return False
        off = (alpha.vector - self.dome.alpha.vector) * BOUNDARY_SCALE
        return bool(np.any(np.abs(off) > WRONG))

    def stepped(self, before: object, event: ev.Event) -> None:
        """Look at each matrix that was made."""
        super().stepped(before, event)  # type: ignore[arg-type]
        if isinstance(event, ev.MatrixMade) and self.is_wrong(event.record.alpha):
            self.made_wrong.append(event.record.id)


def play(draw: Draw) -> Row:
    """Play one night."""
    story = story_of(draw)
    given = {"dither.budget_m": 20e-9, "dither.amplitude_m": 10e-9, "control.n_modes_target": 45}
    policy = replace(policy_of(load_settings(None, {}, {**SETTINGS, **given})), law=story.law)
    with threadpool_limits(1):
        night = LawNight(draw, story, policy)
        while night.time_s < NIGHT_S - 1e-6:
            for name, value in story.values(night.time_s - LEAP_S).items():
                night.command(cmd.SetValue(name=name, value=value, for_s=2.0))
            night.advance(REPORT_S)
    wrong_s, named_s, ended_s = 0.0, None, 0.0
    for glance, moment in zip(night.glances, night.dome.moments, strict=True):
        since_s = round(glance.time_s - LEAP_S, 2)
        if since_s < 0.0:
            continue
        if named_s is None and "law-leap" in glance.alarms:
            named_s = since_s
        if "law-leap" in glance.alarms:
            ended_s = since_s
        if glance.alpha is None or np.any(
            np.abs((glance.alpha - moment.alpha.vector) * BOUNDARY_SCALE) > WRONG
        ):
            wrong_s = since_s
    moments = [m for m in night.dome.moments if m.time_s > LEAP_S]
    before = [m.wavefront_nm for m in night.dome.moments if 6.0 < m.time_s <= LEAP_S]
    used = [swap for swap in night.swaps if swap.time_s > LEAP_S]
    wrong_used = [swap.id for swap in used if swap.id in night.made_wrong]
    log = [(e.t_ns_utc - START_NS) * 1e-9 - LEAP_S for e in night.state.log if "law" in e.name]
    return asdict(draw) | {
        "step": story.step,
        "named_s": named_s,
        "confirmed_s": ended_s,
        "right_after_s": wrong_s,
        "n_made_wrong": len(night.made_wrong),
        "n_used_wrong": len(wrong_used),
        "n_swaps": len(used),
        "worst_ratio": max(m.wavefront_nm for m in moments) / float(np.median(before)),
        "alarms": sorted({name for glance in night.glances for name in glance.alarms}),
        "log_s": log,
    }


def table(rows: list[Row]) -> str:
    """Return the campaign as a Markdown table."""
    text = heading(
        *("Value", "Draws", "Leap, subapertures; deg", "Named after, s", "Decided after, s"),
        *("α right after, s", "Matrices made, used for a wrong α"),
    )
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of = [row for row in rows if row["kind"] == kind]
        unnamed = sum(row["named_s"] is None for row in of)
        named = [row["named_s"] for row in of if row["named_s"] is not None]
        sizes = np.abs([row["step"] for row in of])
        text += line(
            *(kind, len(of), f"{sizes[:, 0].max():.2f}; {sizes[:, 2].max():.1f}"),
            f"{max(named, default=float('nan')):.2f}" + (f", {unnamed} not" if unnamed else ""),
            *(f"{max(row[name] for row in of):.1f}" for name in ("confirmed_s", "right_after_s")),
            f"{sum(r['n_made_wrong'] for r in of)}, {sum(r['n_used_wrong'] for r in of)}",
        )
    return text


def main() -> int:
    """Play what is missing, then print the table; 1 if a matrix was made for a wrong α."""
    parser = campaign_parser("law_leaps", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(20), metavar="FIRST:END")
    given = parser.parse_args()
    draws = [Draw(seed=seed, kind=KINDS[seed % len(KINDS)]) for seed in given.seeds]
    rows = complete(play, draws, given)
    tell(table(rows), given.table, parser.prog)
    return int(any(row["n_made_wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
