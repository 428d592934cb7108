"""Nights of a telescope whose pupil images are off the pixel grid, unknown to the service.

The telescope is linear, everything else about it ideal; the service tracks in ``auto``, in
simulated time. The RTC begins with the inverse of a matrix that was measured on this telescope by
day. A row has the mean error of α of one night, and the median of σ with and without the allowance
for places of images that the instrument file does not state.

Run: ``python -m pyrcal_studies.campaign.image_nights --rms 0.1 --seeds 1:17 --output
var/image_nights.jsonl``; nights that are there already are not run again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal_studies.campaign.observatory import (
    SETTINGS,
    SMALL,
    Dome,
    Latencies,
    Observatory,
    true_response,
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
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker
from service.wire import checksum
from sim_rtc.assembly import Telescope
from sim_rtc.computer.reconstructors import compute_truncated_inverse
from sim_rtc.options import Options

CALIBRATED = (0.05, -0.03, 0.05, 1.001)
"""Registration at which the RTC's own matrix was measured, boundary units."""

LATENCIES = Latencies(make_s=0.6, judge_s=0.5)
"""Three times what the worker takes for 150 modes on a core of its own: 0.21 and 0.18 s."""


class CalibratedDome(Dome):
    """A telescope whose RTC begins with the inverse of its matrix at ``CALIBRATED``."""

    @override
    def _built(self, options: Options) -> Telescope:
        telescope = super()._built(options)
        calibrated = Misregistration.from_vector(np.array(CALIBRATED) / BOUNDARY_SCALE)
        n_controlled = options.n_controlled(self.instrument.modes.n_modes)
        measured = true_response(telescope.plant.optics(calibrated), n_controlled)
        matrix = compute_truncated_inverse(measured)
        own = Reconstructor.own(
            f"own-{n_controlled}-{checksum(matrix)[:8]}",
            matrix,
            telescope.identity,
            created_ns=telescope.reconstructor.manifest.created_ns,
        )
        return replace(telescope, reconstructor=own)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNight:
    """One night."""

    seed: int = 1
    rms_px: float = 0.1
    """Displacement of an image along an axis, RMS."""

    seconds: float = 60.0

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        magnitude = round(float(np.random.default_rng([5, self.seed]).uniform(7.0, 11.0)), 1)
        offset = [f"--image-offset-rms={self.rms_px}"] if self.rms_px else []
        return [
            f"--instrument={SMALL}",
            "--plant=linear",
            "--n-controlled=45",
            "--gain=0.4",
            "--leak=0.99",
            "--seeing=0.7",
            "--wind=8,20",
            f"--mag={magnitude}",
            "--alpha=0.12,-0.08,0.2,1.003",
            f"--seed={self.seed}",
            "--imperfections=ideal",
            *offset,
        ]


def play(night: ImageNight) -> Row:
    """Run one night."""
    # floors as the service takes them, so that σ is that of a user
    asked = {key: value for key, value in SETTINGS.items() if not key.startswith("tracking")}
    instrument = load_instrument(SMALL)
    service = Observatory(
        (),
        policy_of(load_settings(None, {}, asked), instrument),
        Mode.AUTO,
        OpticsWorker(instrument, Compute(threads=1)),
        latencies=LATENCIES,
        with_poles=False,
        dome=CalibratedDome(night.words),
    )
    errors, sigmas, shown = [], [], []
    levels, alarms = set(), set()
    while service.time_s < night.seconds:
        service.advance(1.0)
        known = service.state.alpha.registration
        alarms |= {alarm.name for alarm in service.state.alarms.active}
        if known is None or known.n_windows < 2:
            continue
        errors.append(known.alpha.vector - service.dome.alpha.vector)
        sigmas.append(known.sigma)
        shown.append(known.shown_sigma)
        levels.add(str(known.validity.level))
    return asdict(night) | {
        "error": (np.mean(errors, axis=0) * BOUNDARY_SCALE).tolist(),
        "sigma": (np.median(sigmas, axis=0) * BOUNDARY_SCALE).tolist(),
        "shown_sigma": (np.median(shown, axis=0) * BOUNDARY_SCALE).tolist(),
        "largest": np.max(np.abs(errors) / np.array(sigmas), axis=0).tolist(),
        "shown_largest": np.max(np.abs(errors) / np.array(shown), axis=0).tolist(),
        "levels": sorted(levels),
        "alarms": sorted(alarms),
        "modes": service.dome.moments[-1].n_controlled,
    }


def table(rows: Sequence[Row]) -> str:
    """Return a row for each displacement."""
    text = heading(
        *("pixel RMS", "nights", "error RMS: x, y (subap), rotation (deg)"),
        *("error over σ without images: RMS; largest", "with images: RMS; largest", "modes"),
        *("levels", "nights with alarms"),
    )
    for rms in sorted({row["rms_px"] for row in rows}):
        these = [row for row in rows if row["rms_px"] == rms]
        error = np.array([row["error"] for row in these])
        text += line(
            *(rms, len(these), _numbers(_rms(error)[:3], 4)),
            *(_over(these, error, name) for name in ("", "shown_")),
            "/".join(sorted({str(row["modes"]) for row in these})),
            ", ".join(sorted({level for row in these for level in row["levels"]})),
            sum(bool(row["alarms"]) for row in these),
        )
    return text


def _over(rows: Sequence[Row], error: NDArray[np.float64], name: str) -> str:
    over = _rms(error / np.array([row[f"{name}sigma"] for row in rows]))
    largest = np.max([row[f"{name}largest"] for row in rows])
    return f"{_numbers(over, 2)}; {largest:.1f}"


def _rms(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _numbers(values: NDArray[np.float64], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def main() -> int:
    """Run what is missing, then print the table."""
    parser = campaign_parser("image_nights", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(1, 17), metavar="FIRST:END")
    parser.add_argument("--rms", type=float, nargs="+", default=[0.1])
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    nights = [
        ImageNight(seed=seed, rms_px=rms, seconds=given.seconds)
        for rms in given.rms
        for seed in given.seeds
    ]
    with threadpool_limits(1):
        tell(table(complete(play, nights, given)), given.table, parser.prog)
    return 0


if __name__ == "__main__":
    sys.exit(main())
