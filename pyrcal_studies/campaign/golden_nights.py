"""Records the golden nights: short nights in which everything happens to the service once.

Run: ``python -m pyrcal_studies.campaign.golden_nights [--only jump,steady]``. Recorded twice on one
machine they are the same but for the names of the RTC's sessions, drawn at random; another
processor may round otherwise. With ``--retell`` the events stay as they were recorded, and only
what the tracker makes of them is written anew: the first difference of each night is printed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.golden import FOLDER, INSTRUMENT, read, replayed, retold, written
from pyrcal_studies.campaign.golden_night import GoldenNight
from pyrcal_studies.campaign.golden_orders import COMMANDED, MEASURING
from pyrcal_studies.campaign.golden_skies import ACQUIRING, FAULTS, TRACKING
from pyrcal_studies.campaign.small import SMALL
from service.instrument import load_instrument
from service.runtime.worker import Compute, OpticsWorker

NIGHTS = (*TRACKING, *ACQUIRING, *COMMANDED, *MEASURING, *FAULTS)


def main() -> int:
    """Record the nights that are asked for."""
    given = _parser().parse_args()
    names = given.only.split(",") if given.only else [plan.name for plan in NIGHTS]
    with threadpool_limits(1):
        for plan in NIGHTS:
            if plan.name not in names:
                continue
            if given.retell:
                _retell(given.folder, plan.name)
                continue
            begun = time.process_time()
            # of this night alone: a worker may take up what a matrix tells of the slopes
            night = GoldenNight(plan, OpticsWorker(load_instrument(SMALL), Compute(threads=1)))
            night.play()
            path = given.folder / f"{plan.name}.jsonl.xz"
            written(night.recorded, path)
            written([night.instrument], given.folder / INSTRUMENT)
            took_s = time.process_time() - begun
            sys.stdout.write(
                f"{plan.name}: {len(night.recorded) - 1} events, "
                f"{path.stat().st_size / 1e3:.0f} kB, {took_s:.1f} s\n"
            )
            sys.stdout.flush()
    return 0


def _retell(folder: Path, name: str) -> None:
    path, (instrument,) = folder / f"{name}.jsonl.xz", read(folder / INSTRUMENT)
    night = read(path)
    sys.stdout.write(f"{name}: {replayed(night, instrument) or 'as it was'}\n")
    written(retold(night, instrument), path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.campaign.golden_nights",
        description="Records the golden nights, what the tracker is compared with.",
    )
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--retell", action="store_true", help="keep the events")
    parser.add_argument("--only", default="", metavar="NAME,NAME", help="default: all nights")
    return parser


if __name__ == "__main__":
    sys.exit(main())
