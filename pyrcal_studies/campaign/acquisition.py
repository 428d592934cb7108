"""Acquisitions of the whole service from registrations it knows nothing of, in simulated time.

Run: ``python -m pyrcal_studies.campaign.acquisition --plant linear --starts 0:100 --output
var/acquisition.jsonl --table table.md``; starts that are there already are not run again. A hundred
starts of FLAO take about an hour of one core.

Each start draws its registration uniformly from ±1.5 subapertures, ±6 deg and ±5 %; the loop is
closed on the matrix of a perfect registration, which is all that the service gets to know.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Observatory, bench_of
from pyrcal_studies.campaign.rows import (
    UNITS,
    Row,
    campaign_parser,
    complete,
    grouped,
    heading,
    line,
    range_of,
    tell,
)
from pyrcal_studies.campaign.system_nights import GAINS
from service.config import load_settings
from service.model.misregistration import BOUNDARY_SCALE
from service.records.operations import AcquisitionStage
from service.records.state import Mode
from service.runtime.policy import policy_of

RANGE = np.array([1.5, 1.5, 6.0, 0.05])
"""Of the registrations that are drawn, boundary units."""

_SEED = 1905
_LOOK_S = 0.5
_HOLDS_S = 4.0
"""For so long the loop must hold: one that has slipped is found out and opened in three."""

_OVER = (AcquisitionStage.TRACKING, AcquisitionStage.FAILED, AcquisitionStage.ABORTED)


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """What is run; two starts that are equal give the same row."""

    instrument: str = "flao-lbt"
    plant: str = "linear"
    truth: str = "ideal"
    """The simulator's set of imperfections."""

    seed: int = 0
    magnitude: float = 10.0
    gain: float = 0.4
    n_controlled: int = 400
    """Modes in the loop as it is found, and to come back to."""

    within_s: float = 90.0
    sampling: int = 3
    """Of the service's model: pupil points per subaperture, and nodes."""

    @property
    def alpha(self) -> NDArray[np.float64]:
        """``(4,)`` where the mirror truly lies, boundary units."""
        rng = np.random.default_rng([_SEED, self.seed])
        return np.asarray(rng.uniform(-1.0, 1.0, 4) * RANGE + [0.0, 0.0, 0.0, 1.0])

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        alpha = ",".join(f"{value:.5f}" for value in self.alpha)
        return [
            f"--instrument={self.instrument}",
            f"--plant={self.plant}",
            f"--imperfections={self.truth}",
            f"--mag={self.magnitude}",
            f"--seed={self.seed}",
            f"--gain={self.gain}",
            f"--n-controlled={self.n_controlled}",
            f"--alpha={alpha}",
        ]


def play(start: Start) -> Row:
    """Run one start until it tracks, fails, or its time is over."""
    with threadpool_limits(1):
        settings = load_settings(None, {}, {"control.n_modes_target": start.n_controlled})
        bench = bench_of(start.instrument, start.sampling)
        linear = start.plant == "linear"
        night = Observatory(start.words, policy_of(settings), Mode.AUTO, bench, with_poles=linear)
        over_s = None
        while night.time_s < start.within_s and not _ended(night, over_s):
            night.advance(_LOOK_S)
            stage = night.state.operations.acquisition.stage
            over_s = (over_s or night.time_s) if stage in _OVER else None
    acquisition, registration = night.state.operations.acquisition, night.state.alpha.registration
    row: Row = {
        "stage": str(acquisition.stage),
        "text": acquisition.text,
        "time_s": over_s or night.time_s,
        "attempts": acquisition.attempt,
        "n_modes": night.dome.moments[-1].n_controlled,
        "closed": night.dome.moments[-1].closed,
        "wavefront_nm": _wavefront_nm(night),
        "error": None,
        "sigma": None,
        "log": [entry.text for entry in night.state.log if entry.name.startswith("acquisition")],
    }
    if registration is not None:
        error = registration.alpha.vector - night.dome.alpha.vector
        row["error"] = (error * BOUNDARY_SCALE).tolist()
        row["sigma"] = (registration.sigma * BOUNDARY_SCALE).tolist()
    row["radii"] = [swap.radius for swap in night.swaps]
    return asdict(start) | row


def _wavefront_nm(night: Observatory) -> float:
    """Return the RMS of the last second."""
    last = [m.wavefront_nm for m in night.dome.moments if m.time_s > night.time_s - 1.0]
    return float(np.sqrt(np.mean(np.square(last))))


def _ended(night: Observatory, over_s: float | None) -> bool:
    """Return whether it is over: one that tracks has to hold, or it is no acquisition."""
    if over_s is None:
        return False
    tracking = night.state.operations.acquisition.stage is AcquisitionStage.TRACKING
    return not tracking or night.time_s >= over_s + _HOLDS_S


def main() -> int:
    """Run what is missing, then print the table."""
    parser = campaign_parser("acquisition", __doc__)
    parser.add_argument("--instrument", default="flao-lbt", metavar="NAME|FILE")
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="linear")
    parser.add_argument("--truth", default="ideal", metavar="NAME")
    parser.add_argument("--starts", type=range_of, default=range(2), metavar="FIRST:END")
    parser.add_argument("--mag", type=float, default=10.0)
    parser.add_argument("--gain", type=float, help="default: 0.4 linear, 0.6 diffractive")
    parser.add_argument("--n-controlled", type=int, default=400)
    parser.add_argument("--within", type=float, default=90.0, metavar="S")
    parser.add_argument("--sampling", type=int, default=3, help="of the service's model (3)")
    given = parser.parse_args()
    tell(table(complete(play, _starts(given), given)), given.table, parser.prog)
    return 0


def _starts(given: argparse.Namespace) -> Iterator[Start]:
    for seed in given.starts:
        yield Start(
            instrument=given.instrument,
            plant=given.plant,
            truth=given.truth,
            seed=seed,
            magnitude=given.mag,
            gain=GAINS[given.plant] if given.gain is None else given.gain,
            n_controlled=given.n_controlled,
            within_s=given.within,
            sampling=given.sampling,
        )


WRONG = np.array([0.1, 0.1, 0.1, 0.005])
"""An α further off than this is wrong (boundary units): what a loop needs, and ten times the
accuracy asked for; or further than 5 of its own σ."""

WRONG_SIGMA = 5.0

_HEADER = heading(
    *("telescope, plant, truth", "starts", "tracking (share)", "time s: median, longest"),
    *("opened again", "failed, clear state", "unclear", "wrong α", "unstable matrix applied"),
    "error RMS x, y % / mdeg / %",
)


def table(rows: list[Row]) -> str:
    """Return the table, one line for each kind of start."""
    return _HEADER + "".join(map(_line, grouped(rows, Start, "seed")))


def wrong(row: Row) -> bool:
    """Return whether the service relied on a registration that is not the telescope's."""
    if row["error"] is None or row["stage"] != "tracking":
        return False
    error = np.abs(row["error"])
    return bool(np.any(error > WRONG) or np.any(error > WRONG_SIGMA * np.array(row["sigma"])))


def _line(rows: list[Row]) -> str:
    about = Start(**{field.name: rows[0].get(field.name, field.default) for field in fields(Start)})
    tracking = [row for row in rows if row["stage"] == "tracking"]
    failed = [row for row in rows if row["stage"] == "failed"]
    times = [row["time_s"] for row in tracking]
    spent = f"{np.median(times):.0f}, {max(times):.0f}" if times else "-"
    again = sum(row["attempts"] > 1 for row in rows)
    unstable = sum(radius is not None and radius >= 1.0 for row in rows for radius in row["radii"])
    errors = np.array([row["error"] for row in tracking if row["error"] is not None])
    rms = "-"
    if len(errors):
        x, y, rotation, magnification = np.sqrt(np.mean(errors**2, axis=0)) * UNITS
        rms = f"{x:.2f} {y:.2f} {rotation:.1f} {magnification:.3f}"
    return line(
        f"{Path(about.instrument).stem}, {about.plant}, {about.truth}, mag {about.magnitude:g}, "
        f"{about.n_controlled} modes g {about.gain:g}",
        len(rows),
        f"{len(tracking)} ({len(tracking) / len(rows):.0%})",
        *(spent, again, len(failed), len(rows) - len(tracking) - len(failed)),
        *(sum(map(wrong, rows)), unstable, rms),
    )


if __name__ == "__main__":
    sys.exit(main())
