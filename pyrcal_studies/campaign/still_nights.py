"""Nights in which the mirror stands still: how often the service says it has jumped.

Run: ``python -m pyrcal_studies.campaign.still_nights --seconds 600 --output var/still.jsonl``;
nights that are there already are not run again. Every plant under every sky, with a worker at its
ease and with one that takes four times as long. A jump that is named, by windows or by ordinary
telemetry, is one too many: it makes α invalid for a while and asks for dither.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.observatory import Observatory
from pyrcal_studies.campaign.rows import Row, RowFile, heading, line
from pyrcal_studies.campaign.small import SETTINGS, SMALL, bench_of, latencies_of
from service.config import load_settings
from service.runtime.policy import policy_of
from service.tracking.events import Event
from service.tracking.state import Mode, TrackerState
from service.tracking.step_context import new_lines

PLANTS = {
    "small, linear": (f"--instrument={SMALL}", "--plant=linear", "--n-controlled=45"),
    "small, diffractive": (
        f"--instrument={SMALL}",
        "--plant=diffractive",
        "--n-controlled=45",
        "--gain=0.6",
        "--imperfections=realistic",
    ),
    "FLAO, linear": ("--instrument=flao-lbt", "--plant=linear"),
}
SKIES = {
    "8 m/s": ("--wind=8,20",),
    "20 m/s": ("--wind=20,-40",),
    "three layers": ("--profile=three-layer",),
    "Paranal, seeing 1.4, L0 12 m": ("--profile=paranal-like", "--seeing=1.4", "--outer-scale=12"),
}
WORKERS = {"at ease": 1.0, "loaded": 4.0}
"""How much longer a job takes than on a machine with nothing else to do."""

NAMED = ("registration.jump", "registration.passive-jump")
SUSPECTED = "registration.jump-suspected"
SETTLING_S = 20.0
"""The night's beginning, with the first matrix and more modes, is not counted."""


class StillNight(Observatory):
    """A night that counts what the service says of jumps."""

    def __init__(self, words: Sequence[str], slower: float) -> None:
        self.said: Counter[str] = Counter()
        instrument = words[0].removeprefix("--instrument=")
        settings = load_settings(None, {}, SETTINGS if instrument == SMALL else {})
        super().__init__(
            words,
            policy_of(settings),
            Mode.AUTO,
            bench_of(instrument),
            latencies=latencies_of(slower),
            with_poles=False,
        )

    @override
    def stepped(self, before: TrackerState, event: Event) -> None:
        super().stepped(before, event)
        if self.time_s > SETTLING_S:
            self.said.update(entry.name for entry in new_lines(before, self.state))


def play(plant: str, sky: str, worker: str, seed: int, seconds: float) -> Row:
    """Run one night and count."""
    begun = time.process_time()
    words = (*PLANTS[plant], *SKIES[sky], f"--seed={seed}", "--mag=8")
    with threadpool_limits(1):
        night = StillNight(words, WORKERS[worker])
        night.advance(SETTLING_S + seconds)
    return {
        "plant": plant,
        "sky": sky,
        "worker": worker,
        "seed": seed,
        "seconds": seconds,
        "named": sum(night.said[name] for name in NAMED),
        "suspected": night.said[SUSPECTED],
        "windows": night.state.windows.accepted,
        "cpu_s": time.process_time() - begun,
    }


def table(rows: Sequence[Row]) -> str:
    """Return the campaign as a Markdown table, a line for each plant and worker."""
    text = heading("plant", "worker", "skies", "hours", "jumps named", "suspected", "windows")
    for plant, worker in itertools.product(PLANTS, WORKERS):
        nights = [row for row in rows if (row["plant"], row["worker"]) == (plant, worker)]
        if nights:
            hours = sum(row["seconds"] for row in nights) / 3600
            counts = (sum(row[key] for row in nights) for key in ("named", "suspected", "windows"))
            skies = len({row["sky"] for row in nights})
            text += line(plant, worker, skies, f"{hours:.2f}", *counts)
    return text


def main() -> int:
    """Run what is missing, then print the table."""
    given = _parser().parse_args()
    given.output.parent.mkdir(parents=True, exist_ok=True)
    file = RowFile(given.output)
    done = {(r["plant"], r["sky"], r["worker"], r["seed"], r["seconds"]) for r in file.rows}
    for plant, sky, worker in itertools.product(given.plants, SKIES, WORKERS):
        if (plant, sky, worker, given.seed, given.seconds) not in done:
            file.add(play(plant, sky, worker, given.seed, given.seconds))
    sys.stdout.write(table(file.rows))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.campaign.still_nights",
        description="Counts the jumps that the service sees in a mirror that stands still.",
    )
    parser.add_argument("--output", type=Path, default=Path("var/still.jsonl"), help="resumed")
    parser.add_argument("--plants", nargs="+", choices=list(PLANTS), default=list(PLANTS))
    parser.add_argument("--seconds", type=float, default=600.0, metavar="S", help="of each night")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    return parser


if __name__ == "__main__":
    sys.exit(main())
