"""Run the study and write its page and pictures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pyrcal_studies.heritier2018 import figures, page
from pyrcal_studies.heritier2018.plan import FULL, QUICK, every_task
from pyrcal_studies.heritier2018.store import Store, carry_out, processor_minutes

PAGES = Path(__file__).parents[2] / "docs" / "results"


def main() -> int:
    """Carry out the missing steps, write page and pictures, and print the page's path."""
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.heritier2018",
        description="Heritier et al. 2018 on the simulated telescope: one page and twelve figures. "
        "The results of every step are kept; an interrupted run continues where it was.",
    )
    parser.add_argument(
        "--quick", action="store_true", help="rehearse in three minutes; the page goes to --output"
    )
    parser.add_argument("--output", type=Path, default=Path("var/paper"), metavar="FOLDER")
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help="processes (default: 2)"
    )
    given = parser.parse_args()
    try:
        import matplotlib  # noqa: F401 - a missing package is reported before minutes of work
    except ImportError:
        parser.error("needs matplotlib; expected pyrcal installed with its extra 'plots'")
    if given.workers < 1:
        parser.error(f"--workers: found {given.workers}; expected 1 or more")
    budget = QUICK if given.quick else FULL
    store = Store(given.output / "steps")
    tasks = every_task(budget)
    try:
        carry_out(tasks, store, n_workers=given.workers)
    except KeyboardInterrupt:
        sys.stderr.write("paper: the same command continues from here\n")
        return 130
    folder = given.output if given.quick else PAGES
    figures.write_all(budget, store, folder / page.PICTURES)
    path = folder / "heritier2018.md"
    minutes = processor_minutes(tasks, store)
    path.write_text(page.write(budget, store, minutes), encoding="utf-8")
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
