"""The command line of the study."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pyrcal_studies.heritier2018 import matrices, report
from pyrcal_studies.heritier2018.crew import carry_out
from pyrcal_studies.heritier2018.plan import FULL, QUICK, every_task
from pyrcal_studies.heritier2018.store import Store


def main() -> int:
    """Do what is missing, write the report, say where it is."""
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.heritier2018",
        description="Heritier et al. 2018 on the simulated telescope: one HTML report. Results of "
        "every step are kept in the output folder; an interrupted run goes on where it was.",
    )
    parser.add_argument("--quick", action="store_true", help="a rehearsal of about four minutes")
    parser.add_argument("--output", type=Path, default=Path("var/paper"), metavar="FOLDER")
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help="processes (default: 2)"
    )
    given = parser.parse_args()
    try:
        import matplotlib  # noqa: F401 - minutes of work are not begun without it
    except ImportError:
        parser.error("needs matplotlib; expected pyrcal installed with its extra 'plots'")
    if given.workers < 1:
        parser.error(f"--workers: found {given.workers}; expected 1 or more")
    budget = QUICK if given.quick else FULL
    store = Store(given.output / "steps")
    tasks = (*every_task(budget), matrices.comparison(budget))
    try:
        seconds = carry_out(tasks, store, n_workers=given.workers)
    except KeyboardInterrupt:
        sys.stderr.write("paper: the same command goes on from here\n")
        return 130
    path = given.output / f"heritier2018{'-quick' if given.quick else ''}.html"
    report.write(budget, store, path, seconds=seconds)
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
