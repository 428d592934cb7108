"""Pointing laws of values that leap, against the whole service in simulated time.

Run: ``python -m pyrcal_studies.campaign.law_leaps --seeds 0:20 --output var/law_leaps.jsonl
--table table.md``. Each draw is a night of 40 s on the simulator's small telescope in mode auto.
After 10 to 18 s a value that the law depends on wraps, is reported wrong, comes after a silence or
reaches a step of its table, and the law leaps by 0.1 to 1 subaperture, 0.5 to 3 deg, or both. The
mirror stays where it was, except in the draws ``mirror moves``, in which it jumps as the law says.
A row has when the leap was named, the matrices that were made or used for another registration than
the true one, and how long α was wrong.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.observatory import (
    SETTINGS,
    SMALL,
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
from service.records import commands as cmd
from service.records import events as ev
from service.records.state import Mode, TrackerState
from service.runtime.policy import policy_of
from service.tracking.policy import Policy

KINDS = (
    *("wraps", "wraps, not declared", "wraps, two values", "wraps to and fro", "step of a table"),
    *("reported wrong", "reported late", "pointing reported wrong", "mirror moves", "mirror moves"),
)
"""What a value does; a seed has each in turn. In the last two the law is right."""

NIGHT_S = 40.0
REPORT_S = 0.2
"""Between two reports of a value."""

SILENCE_S = 8.0
"""Before a value that is reported late."""

TO_AND_FRO_S = 2.0

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
    leap_s: float
    """Time of the leap, seconds of the night."""

    reports: Callable[[float], dict[str, float]]
    """Values reported at a time, seconds since the leap."""

    step: tuple[float, float, float, float]
    """Leap of the law: subapertures, degrees, ratio."""


def story_of(draw: Draw) -> Story:
    """Return the law and the values of a draw."""
    rng, kind = np.random.default_rng([draw.seed, 48]), draw.kind
    part = rng.integers(3)  # both, the shift alone, the rotation alone
    shift = float(rng.uniform(0.1, 1.0) * rng.choice([-1, 1]) * (part != 2))
    turn = float(rng.uniform(0.5, 3.0) * rng.choice([-1, 1]) * (part != 1))
    if kind == "mirror moves":  # as far as a loop survives
        shift, turn = 0.4 * shift, turn / 3.0
    wraps = kind.startswith("wraps")
    name = "azimuth" if kind.startswith("pointing") else "derotator"
    other = "focus" if kind == "wraps, two values" else name
    at = (-180.0, 180.0) if wraps else (-0.01, 0.01)
    # A value that wraps goes from the end of the table to its beginning.
    low, high = (0.5, -0.5) if wraps else (0.0, 1.0)
    period = (360.0,) if wraps and kind != "wraps, not declared" else ()
    law = PointingLaw(
        shift_x_subap=Term(name, at, (low * shift, high * shift), *period),
        rotation_deg=Term(other, at, (low * turn, high * turn), *period),
    )
    speed = float(rng.uniform(0.05, 1.0))  # deg a second

    def reported(since_s: float) -> dict[str, float]:
        turned = speed * since_s + 0.01
        if kind == "wraps to and fro" and 0.0 <= since_s < TO_AND_FRO_S:
            turned = -0.01 if round(since_s / REPORT_S) % 2 else 0.01
        if wraps:
            now = (turned + 360.0) % 360.0 - 180.0
        elif kind in {"reported wrong", "reported late", "pointing reported wrong"}:
            now = 1.0 if since_s >= 0.0 else -1.0
        else:
            now = turned + 0.05 if since_s >= 0.0 else turned - 0.05
        late = kind == "reported late" and -SILENCE_S < since_s < 0.0
        return {} if late else {name: now, other: now}

    return Story(
        law=law,
        leap_s=10.0 + round(float(rng.uniform(0.0, 8.0)) / REPORT_S) * REPORT_S,
        reports=reported,
        step=(shift, 0.0, turn, 0.0),
    )


class LawNight(Observatory):
    """A night that keeps the registration of each matrix as it is made."""

    def __init__(self, draw: Draw, story: Story, policy: Policy) -> None:
        words = [
            *(f"--instrument={SMALL}", "--plant=linear", "--imperfections=ideal", "--mag=8"),
            *("--optical-gain=0.7,0.9", "--n-controlled=45", f"--seed={draw.seed}"),
            f"--alpha={','.join(map(str, START.to_boundary().values()))}",
        ]
        if draw.kind == "mirror moves":
            words.append(f"--jump={story.leap_s:.2f}:{','.join(map(str, story.step))}")
        self.made_wrong: list[str] = []
        super().__init__(words, policy, Mode.AUTO, bench_of(SMALL), with_poles=False)

    def is_wrong(self, alpha: Misregistration | None) -> bool:
        """Return whether a registration is not the mirror's."""
        if alpha is None:
            return False
        off = (alpha.vector - self.dome.alpha.vector) * BOUNDARY_SCALE
        return bool(np.any(np.abs(off) > WRONG))

    @override
    def stepped(self, before: TrackerState, event: ev.Event) -> None:
        """Look at each matrix that was made."""
        super().stepped(before, event)
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
            for name, value in story.reports(night.time_s - story.leap_s).items():
                night.command(
                    cmd.SetPointing(elevation_deg=50.0, azimuth_deg=value)
                    if name == "azimuth"
                    else cmd.SetValue(name=name, value=value, for_s=2.0)
                )
            night.advance(REPORT_S)
    wrong_s, named_s, ended_s = 0.0, None, 0.0
    for glance, moment in zip(night.glances, night.dome.moments, strict=True):
        since_s = round(glance.time_s - story.leap_s, 2)
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
    moments = [m for m in night.dome.moments if m.time_s > story.leap_s]
    before = [m.wavefront_nm for m in night.dome.moments if 6.0 < m.time_s <= story.leap_s]
    used = [swap for swap in night.swaps if swap.time_s > story.leap_s]
    wrong_used = [swap.id for swap in used if swap.id in night.made_wrong]
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
