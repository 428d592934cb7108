"""RTCs that apply another matrix than they say, against the whole service in simulated time.

Run: ``python -m pyrcal_studies.campaign.misapplied --seeds 0:20 --output var/misapplied.jsonl
--table table.md``. Each draw is a night of 60 s on the simulator's small telescope in mode auto;
the mirror creeps, so that new matrices are due again and again. From 6 to 12 s on the RTC
acknowledges each matrix as applied and never swaps it in, swaps it in late, or multiplies with its
sign turned, always or with the first one only; or it does as it should. A row has the matrices that
were sent, when the fault was named, and how long the mirror followed a matrix of the wrong sign.
With ``--plant diffractive`` a night has 25 s at 500 Hz with realistic imperfections.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal.rtc.staging import Replies
from pyrcal_studies.campaign.observatory import (
    SETTINGS,
    SMALL,
    Dome,
    Observatory,
    ShortLink,
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
from service.records import alarms
from service.records import events as ev
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.wire import Acknowledgement

KINDS = ("never swapped", "swapped late", "sign turned", "sign turned once", "as it should")
"""What the RTC does; a seed has each in turn."""

NIGHT_S = 60.0
MAX_MATRICES = 2
MAX_WRONG_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One night; two that are equal give the same row."""

    seed: int
    kind: str
    plant: str

    @property
    def night_s(self) -> float:
        """Length of the night."""
        return NIGHT_S if self.plant == "linear" else 25.0


class FalseLink(ShortLink):
    """A link to an RTC that does not apply what it says."""

    def __init__(self, dome: Dome, draw: Draw) -> None:
        super().__init__(dome)
        rng = np.random.default_rng([draw.seed, 484])
        self.from_s, late_s = float(rng.uniform(6.0, 12.0)), float(rng.uniform(0.8, 8.0))
        self._kind = draw.kind
        self._delay_s = late_s if draw.kind == "swapped late" else NIGHT_S
        self._late: list[tuple[float, Reconstructor]] = []
        self._early: list[str] = []
        self.sent_ids: list[str] = []
        """Matrices that have come since the fault began."""

        self.wrong_ids: list[str] = []
        """Those that are applied with the sign turned."""

    @override
    def swapped(self) -> list[Acknowledgement]:
        """Return what the RTC says of its swaps, some of which have not happened."""
        while self._late and self._late[0][0] <= self._dome.time_s:
            self._dome.stage(self._late.pop(0)[1])
        swaps = self._dome.computer.take_swaps()
        said = [swap for swap in swaps if swap[0] not in self.sent_ids or not self._is_early]
        said += [(name, self._dome.frame) for name in self._early]
        self._early.clear()
        found = [self._staging.applied(*swap) for swap in said]
        return [one for one in found if one is not None]

    @property
    def _is_early(self) -> bool:
        return self._kind in {"never swapped", "swapped late"}

    @override
    def _carry_out(self, outcome: Replies) -> list[Acknowledgement]:
        for matrix in outcome.staged:
            if self._dome.time_s >= self.from_s:
                self._take(matrix)
            else:
                self._dome.stage(matrix)
        return outcome.acknowledgements

    def _take(self, matrix: Reconstructor) -> None:
        """Take a matrix while the fault lasts."""
        name = matrix.manifest.id
        self.sent_ids.append(name)
        if self._is_early:
            self._late.append((self._dome.time_s + self._delay_s, matrix))
            self._early.append(name)
            return
        turned = self._kind == "sign turned"
        if turned or (self._kind == "sign turned once" and len(self.sent_ids) == 1):
            self.wrong_ids.append(name)
            matrix = replace(matrix, matrix=-matrix.matrix)
        self._dome.stage(matrix)


def play(draw: Draw) -> Row:
    """Play one night."""
    creep = [f"--jump={time_s}:0.05,0,0.1,0" for time_s in range(5, int(draw.night_s), 7)]
    plant = {
        "linear": ("--plant=linear", "--imperfections=ideal", "--optical-gain=0.7,0.9"),
        "diffractive": ("--plant=diffractive", "--imperfections=realistic", "--rate=500"),
    }[draw.plant]
    words = [
        *(f"--instrument={SMALL}", *plant, "--mag=8"),
        *("--n-controlled=45", f"--seed={draw.seed}", *creep),
    ]
    given = {"dither.budget_m": 20e-9, "dither.amplitude_m": 10e-9, "control.n_modes_target": 45}
    policy = policy_of(load_settings(None, {}, {**SETTINGS, **given}))
    links: list[FalseLink] = []

    def link(dome: Dome) -> FalseLink:
        links.append(FalseLink(dome, draw))
        return links[0]

    with threadpool_limits(1):
        night = Observatory(words, policy, Mode.AUTO, bench_of(SMALL), with_poles=False, link=link)
        night.advance(draw.night_s)
    return asdict(draw) | _found(night, links[0])


def _found(night: Observatory, link: FalseLink) -> Row:
    moments = night.dome.moments
    wrong = [m.time_s for m in moments if m.closed and m.cm_id in link.wrong_ids]
    named = [g.time_s for g in night.glances if alarms.MISAPPLIED in g.alarms]
    sent = {
        event.id: time_s
        for time_s, event in reversed(night.events)
        if isinstance(event, Acknowledgement) and event.id in link.sent_ids
    }
    first_s = min(sent.values(), default=float("nan"))
    before = [m.wavefront_nm for m in moments if 3.0 < m.time_s < first_s - 0.1]
    after = [m.wavefront_nm for m in moments if m.time_s > first_s - 0.1]
    taken_back = [event for _, event in night.events if isinstance(event, ev.Compared)]
    return {
        "n_sent": len(link.sent_ids),
        "named_s": named[0] - first_s if named else None,
        "wrong_s": max(wrong) - min(wrong) if wrong else 0.0,
        "n_worse": sum(event.finding.verdict == "worse" for event in taken_back),
        "closed": moments[-1].closed,
        "worst_nm": max(after, default=float("nan")),
        "worst_ratio": max(after, default=np.nan) / float(np.median(before)),
        "mode": night.state.operator.mode.value,
        "alarms": sorted({name for glance in night.glances for name in glance.alarms}),
        "text": night.state.matrices.misapplied,
    }


def table(rows: list[Row]) -> str:
    """Return the campaign as a Markdown table."""
    text = heading(
        *("The RTC", "Nights", "Matrices sent, most", "Named after, s", "Wrong sign for, s"),
        *("Loop at the end", "Worst wavefront error, times before"),
    )
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of = [row for row in rows if row["kind"] == kind]
        named = [row["named_s"] for row in of if row["named_s"] is not None]
        n_closed = sum(row["closed"] for row in of)
        text += line(
            *(kind, len(of), max(row["n_sent"] for row in of)),
            f"{max(named):.2f}, {len(named)} of {len(of)}" if named else f"0 of {len(of)}",
            f"{max(row['wrong_s'] for row in of):.2f}",
            f"closed in {n_closed}, open in {len(of) - n_closed}",
            f"{max(row['worst_ratio'] for row in of):.3g}",
        )
    return text


def is_right(row: Row) -> bool:
    """Return whether a night is as it should be: few matrices, named, safe; none taken back."""
    if row["kind"] == "as it should":
        return bool(row["named_s"] is None and row["n_worse"] == 0 and row["n_sent"] > 0)
    safe = row["n_sent"] <= MAX_MATRICES and row["wrong_s"] <= MAX_WRONG_S
    return bool(safe and row["named_s"] is not None)


def main() -> int:
    """Play what is missing, then print the table; 1 if a night is not as it should be."""
    parser = campaign_parser("misapplied", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(20), metavar="FIRST:END")
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="linear")
    given = parser.parse_args()
    draws = [
        Draw(seed=seed, kind=KINDS[seed % len(KINDS)], plant=given.plant) for seed in given.seeds
    ]
    rows = complete(play, draws, given)
    tell(table(rows), given.table, parser.prog)
    return int(not all(is_right(row) for row in rows))


if __name__ == "__main__":
    sys.exit(main())
